"""Small trainings that several tests share."""

from __future__ import annotations

import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import pytest
from naospec import TrainingSpec, plugins
from naospec.flat import nest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping


class Recorder:
    """Reporter that keeps everything."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self.checkpoints: list[tuple[Path, int]] = []
        self.lines: list[tuple[str, str]] = []

    def metrics(self, row: dict[str, float]) -> None:
        self.rows.append(row)

    def checkpoint(self, path: Path, step: int) -> None:
        self.checkpoints.append((path, step))

    def log(self, level: str, message: str) -> None:
        self.lines.append((level, message))


def small_spec(*, stages: Any = (), **settings: Any) -> TrainingSpec:
    """Return a specification that trains in a fraction of a second, with settings by their short names."""
    defaults: dict[str, Any] = {
        "n_envs": 8,
        "n_steps": 32,
        "batch_size": 64,
        "n_epochs": 2,
        "hidden_sizes": (16, 16),
        "simulator_threads": 1,
        "learner_threads": 1,
        **({} if stages else {"total_steps": 512}),
    }
    return TrainingSpec.model_validate({**nest({**defaults, **settings}), "stages": stages})


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Return a function that offers a package of tests/packages and further entry points as an installation would."""
    real, modules = plugins.entry_points, set[str]()

    def clear() -> None:
        plugins._entries.cache_clear()
        plugins._load.cache_clear()

    def offer(name: str, more: Mapping[str, Mapping[str, str]] = MappingProxyType({})) -> None:
        folder = Path(__file__).parents[2] / "packages" / name
        monkeypatch.syspath_prepend(str(folder))
        groups = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
        extra = [
            EntryPoint(key, value, group)
            for entries in (groups, more)
            for group, values in entries.items()
            for key, value in values.items()
        ]
        modules.update(value.partition(":")[0] for values in groups.values() for value in values.values())
        monkeypatch.setattr(
            plugins, "entry_points", lambda group: [*real(group=group), *(e for e in extra if e.group == group)]
        )
        clear()

    yield offer
    clear()
    for module in modules:
        sys.modules.pop(module, None)


@pytest.fixture
def make_spec() -> Callable[..., TrainingSpec]:
    """Return the maker of small specifications."""
    return small_spec


@pytest.fixture
def recorder() -> Recorder:
    """Return a reporter that keeps everything."""
    return Recorder()


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a checkpoint of a short training; do not write to it."""
    from naosprint import train

    return train(small_spec(), workdir=tmp_path_factory.mktemp("training"), reporter=Recorder()).checkpoint
