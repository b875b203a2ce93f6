"""Print what packages need from elsewhere, one requirement a line: what to install before the packages themselves.

Usage: third_party.py FOLDER... with a pyproject.toml in each. An image installs these first, so that a change of our
own code costs no new download.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path


def _name(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[\s\[<>=!~;@(]", requirement.strip(), maxsplit=1)[0]).lower()


def third_party(folders: list[Path]) -> list[str]:
    """Return the dependencies of the packages in `folders`, without those packages themselves, sorted."""
    projects = [tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"] for folder in folders]
    ours = {_name(project["name"]) for project in projects}
    needed = {requirement for project in projects for requirement in project.get("dependencies", ())}
    return sorted(requirement for requirement in needed if _name(requirement) not in ours)


if __name__ == "__main__":
    sys.stdout.write("".join(f"{line}\n" for line in third_party([Path(argument) for argument in sys.argv[1:]])))
