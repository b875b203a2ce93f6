#!/usr/bin/env python3
"""Write deploy/images/locks: what every image installs from a package index, by version and SHA-256.

    deploy/images/lock.py [--torch FOLDER]

Versions are those of requirements.txt. PyTorch's build for processors comes from its own index, or from a FOLDER with
its wheel. It needs pip 24 or newer and an index; the images then need no resolver, and accept no other file.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LOCKS = Path(__file__).resolve().parent / "locks"
INDEX = "https://pypi.org/simple"
TORCH_INDEX = "https://download.pytorch.org/whl/cpu/torch/"
PYTHON = "3.11"
MACHINES = ("x86_64", "aarch64")
PACKAGES = ["packages/naospec", "packages/naopolicies", "packages/naojobs"]
OLDER = ["async-timeout"]
"""What redis needs before Python 3.11.3, as Debian 12 has it; pip evaluates such conditions for its own Python only."""
API = [*OLDER, *PACKAGES, "packages/naosim", "packages/naosprint", "services/api"]
WORKER = [*OLDER, *PACKAGES, "packages/naosim[mujoco,launcher]", "services/worker"]

IMAGES = {
    "backend": ["pip", "setuptools", "scikit-build-core", "nanobind", "cmake", "ninja"],
    "api": API,
    "worker": [*WORKER, "packages/naosprint[train]"],
    "worker-film": [*WORKER, "packages/naosprint[train,film]"],
    "worker-export": [*WORKER, "packages/naosprint[train,export]"],
    "embedded": ["packages/naospec", "packages/naosim"],
    "rcssservermj": ["rcsssmj", "mujoco"],
}
"""Folders with their extras, or names of packages, by lock."""


def name_of(requirement: str) -> str:
    """Return the normal form of the name in a requirement."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\s\[<>=!~;@(]", requirement.strip(), maxsplit=1)[0]).lower()


def third_party(parts: list[str]) -> list[str]:
    """Return what the packages in folders, with their extras, need besides each other; names stay as they are.

    Raises:
        KeyError: a package has no such extra.
    """
    ours: set[str] = set()
    needed: set[str] = set()
    for part in parts:
        folder, _, extras = part.rstrip("]").partition("[")
        if "/" not in folder:
            needed.add(part)
            continue
        project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        ours.add(name_of(project["name"]))
        needed.update(project.get("dependencies", ()))
        for extra in filter(None, extras.split(",")):
            needed.update(project.get("optional-dependencies", {})[extra])
    # The processor build has a local version; without it, a package index would serve the build for graphics cards.
    pinned = next(line for line in (ROOT / "requirements.txt").read_text("utf-8").splitlines() if line[:7] == "torch==")
    return sorted(
        f"{pinned}+cpu" if name_of(requirement) == "torch" else requirement
        for requirement in needed
        if name_of(requirement) not in ours
    )


def resolve(requirements: list[str], machine: str, torch: str) -> dict[str, tuple[str, str]]:
    """Return version and SHA-256 by name of everything that `requirements` need on `machine`."""
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(36, 16, -1)]
    platforms += [f"manylinux2014_{machine}", f"linux_{machine}"]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "--isolated", "--quiet", "install", "--dry-run", "--ignore-installed"]
        command += ["--report", str(report), "--target", folder, "--only-binary=:all:", "--python-version", PYTHON]
        command += [f"--platform={platform}" for platform in platforms]
        command += ["--index-url", INDEX, "--find-links", torch, "-c", str(ROOT / "requirements.txt"), *requirements]
        subprocess.run(command, check=True)
        found = json.loads(report.read_text(encoding="utf-8"))["install"]
    return {
        name_of(item["metadata"]["name"]): (
            item["metadata"]["version"],
            item["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for item in found
    }


def main() -> int:
    """Write all locks; return the exit code."""
    parser = argparse.ArgumentParser(description="Lock what the images install.")
    parser.add_argument("--torch", default=TORCH_INDEX, help="index page or folder of PyTorch's build for processors")
    torch = parser.parse_args().torch
    lines: dict[str, dict[str, set[str]]] = {}
    for image, parts in IMAGES.items():
        requirements = third_party(parts)
        for machine in MACHINES:
            try:
                found = resolve(requirements, machine, torch)
            except subprocess.CalledProcessError:
                sys.stderr.write(f"{image}: not every package has a wheel for {machine}\n")
                if machine == MACHINES[0]:
                    return 1
                continue
            for name, (version, sha256) in found.items():
                lock = "torch" if name == "torch" else image
                lines.setdefault(lock, {}).setdefault(f"{name}=={version}", set()).add(sha256)
    LOCKS.mkdir(exist_ok=True)
    for lock, requirements_of in lines.items():
        text = "# Written by deploy/images/lock.py.\n"
        for requirement, hashes in sorted(requirements_of.items()):
            text += " \\\n    ".join([requirement, *(f"--hash=sha256:{value}" for value in sorted(hashes))]) + "\n"
        (LOCKS / f"{lock}.txt").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
