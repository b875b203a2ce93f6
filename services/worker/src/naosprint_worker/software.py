"""Software that a training runs with: versions of packages, and the commit of the source if it is known."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution, entry_points
from pathlib import Path
from urllib.parse import unquote, urlparse

from naospec import plugins

COMMIT_VARIABLE = "NAOSPRINT_COMMIT"
"""Environment variable with the commit of the source, for images, which contain no repository."""
_PACKAGES = ("naospec", "naosim", "naosprint", "naosprint-worker", "numpy", "torch", "mujoco")
_GROUPS = (plugins.ROBOTS, plugins.SIMULATORS, plugins.TASKS, plugins.LEARNERS, plugins.ROBOT_DEFAULTS)
_GIT_S = 5.0
"""Seconds that git may take."""


@cache
def software() -> dict[str, str]:
    """Return the version of Python, of what decides the bits of a training and of each package with plug-ins.

    `commit` is that of our own source, and `+` behind it means that files differ from the commit; the name of another
    package with `@commit` is that of its source.
    """
    names = dict.fromkeys(_PACKAGES)
    for group in _GROUPS:
        names |= {point.dist.name: None for point in entry_points(group=group) if point.dist is not None}
    found = {"python": platform.python_version()}
    for name in names:
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue
        found[name] = package.version
        if commit := _commit(package):
            found[f"{name}@commit"] = commit
    ours = found.get("naosprint@commit", "")
    for name in [name for name in found if name.endswith("@commit") and found[name] == ours]:
        del found[name]
    if commit := os.environ.get(COMMIT_VARIABLE) or ours:
        found["commit"] = commit
    return found


def _commit(package: Distribution) -> str:
    """Return the commit that a package was installed from, or that its folder is at; empty if none is known."""
    try:
        origin = json.loads(package.read_text("direct_url.json") or "{}")
    except ValueError:
        return ""
    if commit := origin.get("vcs_info", {}).get("commit_id"):
        return str(commit)
    if not origin.get("dir_info", {}).get("editable"):
        return ""
    folder = Path(unquote(urlparse(origin["url"]).path))
    commit = _git(folder, "rev-parse", "HEAD")
    return f"{commit}+" if commit and _git(folder, "status", "--porcelain", "--untracked-files=no") else commit


def _git(folder: Path, *arguments: str) -> str:
    """Return what git prints; empty without git or a repository."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=_GIT_S,
            check=True,
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
