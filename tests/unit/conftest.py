"""Packages of plug-ins that are installed for one test."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from naospec import plugins

Install = Callable[[str, str, Mapping[str, str]], None]


@pytest.fixture
def install(tmp_path: Path) -> Iterator[Install]:
    """Return a function that installs a package of one module: its name, its code, and groups by what it offers.

    What it offers is the attribute of that name, with ``_`` for ``-``.
    """
    site, modules = tmp_path / "site-packages", set[str]()
    site.mkdir()

    def forget() -> None:
        from naoctl.specflags import training_settings

        importlib.invalidate_caches()
        for known in (plugins._entries, plugins._load, plugins.leave_out, training_settings):
            known.cache_clear()

    def add(package: str, code: str, offers: Mapping[str, str]) -> None:
        module = package.replace("-", "_")
        modules.add(module)
        (site / f"{module}.py").write_text(f"from __future__ import annotations\n\n{code}\n", encoding="utf-8")
        metadata = site / f"{module}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8")
        lines = [f"[{group}]\n{name} = {module}:{name.replace('-', '_')}\n" for name, group in offers.items()]
        (metadata / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
        forget()

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        forget()
        yield add
    for module in modules:
        sys.modules.pop(module, None)
    forget()


@pytest.fixture
def broken(install: Install, tmp_path: Path) -> Path:
    """Install packages that cannot be imported, two that offer the same name, and one whose code fails later.

    Return the folder that they are in.
    """
    task = "from naosprint.tasks import Task\n\n\nclass {0}(Task):\n    name = '{0}'\n    summary = 'Swim.'\n"
    install("sinking", "raise ImportError('no\\nwater')", {"sinks": plugins.TASKS})
    install("lame", "raise SystemExit(3)", {"limps": plugins.ROBOTS})
    for package in ("first-divers", "second-divers"):
        install(package, task.format("dives"), {"dives": plugins.TASKS})
    supports = "    @classmethod\n    def supports(cls, robot):\n        return robot.data['depth'] > 2.0\n"
    install("drifting", f"{task.format('drifts')}\n{supports}", {"drifts": plugins.TASKS})
    return tmp_path / "site-packages"
