"""Small trainings that several tests share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from naospec import TrainingSpec
from naospec.flat import nest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


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
