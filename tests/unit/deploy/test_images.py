"""What the images are made of: exact versions, hashes, digests. Nothing here needs a network."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[3]
IMAGES = ROOT / "deploy" / "images"
DOCKERFILES = sorted(ROOT.glob("services/*/Dockerfile*"))
EXACT = re.compile(r"^v?\d+\.\d+(\.\d+)?(-[a-z]+)*$")
"""A version such as 3.11.16-slim-bookworm or v3.13.2; some publishers have two numbers only."""


def load(name: str) -> ModuleType:
    """Import a script of deploy/images."""
    spec = importlib.util.spec_from_file_location(f"images_{name}", IMAGES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


LOCK, PIN = load("lock"), load("pin")


def is_exact(image: str, digest: str) -> bool:
    """Return whether an image is always the same version."""
    repository, _, tag = image.partition(":")
    two_numbers = repository in {"postgres", "chrislusf/seaweedfs"}
    return bool(digest) or bool(EXACT.match(tag) and (two_numbers or tag.count(".") >= 2))


@pytest.mark.parametrize(
    ("image", "exact"),
    [
        ("python:3.11-slim", False),
        ("valkey/valkey:9-alpine", False),
        ("caddy:2.11", False),
        ("fedora:43", False),
        ("grafana/grafana:latest", False),
        ("python:3.11.16-slim-bookworm", True),
        ("prom/prometheus:v3.13.2", True),
        ("postgres:18.6-bookworm", True),
    ],
)
def test_floating_versions_are_recognised(image: str, exact: bool) -> None:
    assert is_exact(image, "") is exact
    assert is_exact(image, "@sha256:" + "0" * 64)


def test_every_image_is_at_an_exact_version() -> None:
    found = {item for name in PIN.FILES for item in PIN.IMAGE.findall((ROOT / name).read_text())}
    assert len({image for image, _ in found}) >= 9
    assert [image for image, digest in sorted(found) if not is_exact(image, digest)] == []
    # Each image that others made is one that the pattern above has found.
    for path in (*DOCKERFILES, ROOT / "docker-compose.yml", *ROOT.glob("deploy/**/*.yml")):
        for line in path.read_text().splitlines():
            named = re.match(r"\s*(?:FROM|image:)\s+(\S+)", line)
            if named and not re.search(r"scratch|naosprint/", named[1]):
                assert named[1].startswith("${"), f"{path.name}: {line}"


def test_packages_come_by_hash_or_by_version() -> None:
    for path in DOCKERFILES:
        text = path.read_text().replace("\\\n", " ")
        for command in re.findall(r"pip[\" ][^&\n]*install[^&\n]*|\$install[^&\n]*", text):
            hashed = "--require-hashes" in command or command.startswith("$install")
            assert hashed or "--no-index" in command, f"{path.name}: {command}"
            assert "--extra-index-url" not in command
        for packages in re.findall(r"dnf install(.*?)&&", text, re.DOTALL):
            names = [word.strip("'") for word in packages.split() if not word.startswith("-")]
            assert names and all(re.search(r"-\d", name) for name in names), packages


def locked(name: str) -> dict[str, str]:
    """Return the versions of a lock, all of whose lines have hashes."""
    text = (IMAGES / "locks" / f"{name}.txt").read_text().replace(" \\\n", "")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert lines and all("--hash=sha256:" in line for line in lines)
    return dict(line.split()[0].split("==") for line in lines)


@pytest.mark.parametrize("image", list(LOCK.IMAGES))
def test_a_lock_has_what_its_image_needs_in_the_pinned_versions(image: str) -> None:
    """`deploy/images/lock.py` writes it again after a change of requirements.txt or of a package's dependencies."""
    pins = dict(
        (LOCK.name_of(line), line.split("==")[1])
        for line in (ROOT / "requirements.txt").read_text().splitlines()
        if "==" in line
    )
    versions = locked(image) | locked("torch")
    needed = {LOCK.name_of(requirement) for requirement in LOCK.third_party(LOCK.IMAGES[image])}
    assert needed <= versions.keys()
    differing = {
        name: version for name, version in versions.items() if version.split("+")[0] != pins.get(name, version)
    }
    assert differing == {}


@pytest.fixture
def registry() -> Iterator[str]:
    """A registry that has every image; yields its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            media = "application/vnd.oci.image.index.v1+json"
            name = self.path if "/manifests/sha256:" not in self.path else names[self.path.rsplit(":", 1)[1]]
            index = {"schemaVersion": 2, "mediaType": media, "manifests": [], "annotations": {"name": name}}
            content = json.dumps(index).encode()
            names[hashlib.sha256(content).hexdigest()] = name
            self.send_response(200)
            self.send_header("Content-Type", media)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Docker-Content-Digest", f"sha256:{hashlib.sha256(content).hexdigest()}")
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Write nothing."""

    names: dict[str, str] = {}
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def _has_buildx() -> bool:
    command = ["docker", "buildx", "version"]
    return shutil.which("docker") is not None and subprocess.run(command, capture_output=True).returncode == 0


@pytest.mark.skipif(not _has_buildx(), reason="needs `docker buildx`")
def test_digests_are_filled_in_and_refreshed(registry: str, tmp_path: Path) -> None:
    file = tmp_path / "docker-compose.yml"
    old = "@sha256:" + "0" * 64
    file.write_text(f"image: ${{A_IMAGE:-postgres:18.6-bookworm}}\nimage: ${{B_IMAGE:-prom/prometheus:v3.13.2{old}}}\n")

    def pin(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, IMAGES / "pin.py", "--mirror", registry, *arguments, file]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    before = file.read_text()
    checked = pin("--check")
    assert (checked.returncode, file.read_text()) == (1, before), checked.stderr
    done = pin()
    assert done.returncode == 0, done.stderr
    pinned = dict(PIN.IMAGE.findall(file.read_text()))
    assert pinned.keys() == {"postgres:18.6-bookworm", "prom/prometheus:v3.13.2"}
    assert all(re.fullmatch("@sha256:[0-9a-f]{64}", digest) for digest in pinned.values())
    assert old not in file.read_text()
    assert pin("--check").returncode == 0
