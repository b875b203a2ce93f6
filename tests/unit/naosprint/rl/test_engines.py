"""Comparison of the engine of trainings with the one of evaluations, during a training."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint.rl import engines
from naosprint.rl.reporter import NullReporter
from naosprint.rl.runner import train

NAMES = ("training_engine_reward", "evaluation_engine_reward")


class Rows(NullReporter):
    """Keeps the metrics."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def metrics(self, row: Any) -> None:
        self.rows.append(dict(row))


def trained(folder: Path, resume: Path | None = None, **simulator: object) -> list[dict[str, Any]]:
    algorithm = {"n_envs": 4, "n_steps": 16, "batch_size": 64, "hidden_sizes": [8, 8]}
    runtime = {"checkpoint_interval_steps": 64, "simulator_threads": 1, "learner_threads": 1}
    content = {"robot": "t1", "simulator": simulator, "total_steps": 128, "algorithm": algorithm, "runtime": runtime}
    rows = Rows()
    train(TrainingSpec.model_validate(content), workdir=folder, reporter=rows, resume=resume)
    return rows.rows


def test_rewards_on_both_engines_are_reported_and_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Comparisons draw nothing from the training's random numbers."""
    monkeypatch.setattr(engines, "STEPS", 20)
    alone = trained(tmp_path / "alone")
    monkeypatch.setattr(engines, "MOST_SHARE", np.inf)
    compared = trained(tmp_path / "compared")
    assert not any(name in row for row in alone for name in NAMES), "there was no time for one"
    for row in compared:
        assert row["left_to_mujoco"] == 0
        assert row[NAMES[0]] == pytest.approx(row[NAMES[1]], abs=1e-6) and row[NAMES[0]] != row[NAMES[1]]
    for checkpoint in sorted(path.name for path in (tmp_path / "alone").iterdir()):
        arrays = [np.load(tmp_path / folder / checkpoint / "policy.npz") for folder in ("alone", "compared")]
        assert all(np.array_equal(arrays[0][name], arrays[1][name]) for name in arrays[0].files)


def test_a_training_on_mujoco_compares_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "MOST_SHARE", np.inf)
    rows = trained(tmp_path, engine="mujoco")
    assert not any(name in row for row in rows for name in (*NAMES, "left_to_mujoco"))


@pytest.mark.parametrize("engine", ["fast", "mujoco"])
def test_a_resumed_training_is_one_that_never_stopped(tmp_path: Path, engine: str) -> None:
    """Bit for bit: weights, statistics, the learner's state and the robots'."""
    trained(tmp_path / "whole", engine=engine)
    trained(tmp_path / "resumed", tmp_path / "whole" / "step-000000000064", engine=engine)
    for file in ("policy.npz", "learner.npz", "environment.npz"):
        one, other = (np.load(tmp_path / name / "step-000000000128" / file) for name in ("whole", "resumed"))
        assert one.files == other.files
        assert all(one[name].tobytes() == other[name].tobytes() for name in one.files), file


def test_every_cycle_of_moving_robots_is_mj_steps() -> None:
    """A share of what the benchmark holds against MuJoCo."""
    against = runpy.run_path(str(Path(__file__).parents[4] / "benchmarks/engine/against_mujoco.py"))
    words = [word for name in ("t1-sprint", "t1-getup", "k1-flail", "k1-swing") for word in ("--motion", name)]
    assert against["main"](["--robots", "2", "--cycles", "12", *words]) == 0
    result = against["fuzzed"](against["T1"], 16)
    assert result["changed_by_neighbours"] == result["not_finite_unreported"] == 0 < result["left_to_mujoco"]
