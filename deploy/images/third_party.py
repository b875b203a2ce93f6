"""Print the third-party requirements of packages, one a line, to install before the packages themselves.

Usage: third_party.py FOLDER... with a pyproject.toml in each; FOLDER[EXTRA,EXTRA] for its optional parts. An image
installs these first, so that a change of the project's code needs no new download.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path


def _name(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[\s\[<>=!~;@(]", requirement.strip(), maxsplit=1)[0]).lower()


def third_party(folders: list[str]) -> list[str]:
    """Return the dependencies of the packages in `folders`, without those packages themselves, sorted.

    Raises:
        KeyError: a package has no such extra.
    """
    ours: set[str] = set()
    needed: set[str] = set()
    for argument in folders:
        folder, _, extras = argument.rstrip("]").partition("[")
        project = tomllib.loads((Path(folder) / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        ours.add(_name(project["name"]))
        needed.update(project.get("dependencies", ()))
        for extra in filter(None, extras.split(",")):
            needed.update(project.get("optional-dependencies", {})[extra])
    return sorted(requirement for requirement in needed if _name(requirement) not in ours)


if __name__ == "__main__":
    sys.stdout.write("".join(f"{line}\n" for line in third_party(sys.argv[1:])))
