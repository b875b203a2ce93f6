"""The documentation builds without a warning, and the site loads nothing from other origins."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=150)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_is_built(site: Path) -> None:
    built = {path.relative_to(site).with_suffix("").as_posix() for path in site.rglob("*.html")}
    written = {path.relative_to(ROOT / "docs").with_suffix("").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert written <= built
    assert {
        f"reference/{name}" for name in ("naoctl", "api", "specification", "metrics", "events", "settings")
    } <= built
    assert not [path for path in site.rglob("*") if path.suffix == ".py"]


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    tags = re.compile(r"<(?:script|img|iframe|source|video|link)\b[^>]*>")
    address = re.compile(r"""(?:src|href)=["']?(?:https?:)?//""")
    for page in site.rglob("*.html"):
        found = [tag for tag in tags.findall(page.read_text(encoding="utf-8")) if address.search(tag)]
        assert found == [], page.name
    for sheet in site.rglob("*.css"):
        assert not re.findall(r"url\([\"']?(?:https?:)?//", sheet.read_text(encoding="utf-8")), sheet.name


def test_the_search_works_from_the_disk(site: Path) -> None:
    """Its index is a script, which a page from the disk may load, and so is what stands in for a worker."""
    script = (site / "search" / "search_index.js").read_text(encoding="utf-8")
    index = json.loads(script.removeprefix("var __index = "))
    assert index["docs"]
    for page in (site / "tutorial.html", site / "how-to" / "resume.html"):
        (shim,) = re.findall(r'<script src="([^"]*iframe-worker[^"]*)"', page.read_text(encoding="utf-8"))
        assert "EventTarget" in (page.parent / shim).read_text(encoding="utf-8")


def test_a_search_finds_a_setting_and_a_command(site: Path) -> None:
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))
    texts = {entry["location"]: entry["text"] for entry in index["docs"]}
    assert any("NAOSPRINT_WORKER_CONCURRENCY" in text for text in texts.values())
    assert "reference/naoctl.html#naoctl-submit" in texts
