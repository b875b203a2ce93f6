"""The dashboard's scripts are formatted and checked by `make lint`."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
SCRIPTS = ROOT / "services/api/src/naosprint_api/static/js"


def make(*arguments: str, path: str) -> str:
    """Return what `make` prints with this search path."""
    command = [str(shutil.which("make")), "--no-print-directory", *arguments]
    return subprocess.run(command, cwd=ROOT, env={"PATH": path}, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def with_npm(tmp_path: Path) -> str:
    """Search path with a command named npm, which `make -n` looks up and does not run."""
    (tmp_path / "npm").touch(mode=0o755)
    return f"{tmp_path}:/usr/bin:/bin"


def test_lint_checks_scripts_where_npm_is_installed(with_npm: str) -> None:
    assert "npm run --silent check" in make("-n", "lint", path=with_npm)


def test_lint_without_npm_reports_what_it_left_out(tmp_path: Path) -> None:
    assert "scripts were NOT checked: npm is not installed" in make("js", path=str(tmp_path))
    planned = make("-n", "lint", path=str(tmp_path))
    assert "ruff check" in planned
    assert "npm run" not in planned


def test_the_linter_is_pinned_and_names_no_registry() -> None:
    folder = ROOT / "services/api"
    (version,) = json.loads((folder / "package.json").read_text())["devDependencies"].values()
    lock = json.loads((folder / "package-lock.json").read_text())["packages"]
    assert lock["node_modules/@biomejs/biome"]["version"] == version
    assert all(package.get("integrity") for name, package in lock.items() if name)
    assert "resolved" not in (folder / "package-lock.json").read_text()


def test_lines_can_be_read() -> None:
    """A line holds 120 characters; strings and templates, which the formatter does not break, may be longer."""
    long = [
        f"{path.relative_to(SCRIPTS)}:{number}"
        for path in SCRIPTS.rglob("*.js")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > 120 and not set('"`') & set(line)
    ]
    assert not long
