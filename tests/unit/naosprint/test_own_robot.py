"""A variant of a robot that another package adds is trained and evaluated like the robot itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naospec import EvaluationSpec, TrainingSpec, plugins
from naosprint import evaluate, train

_BENT = {"nao-4": ("llj4", "rlj4"), "t1": ("Left_Knee_Pitch", "Right_Knee_Pitch")}


def variant(name: str) -> Any:
    """Return a robot whose knees are bent a little further; its name ends in no number."""
    robot = robots.get(name)
    joints = [joint.name for joint in robot.joints if "knee" in joint.name.lower() or joint.name in _BENT[name]]
    bent = {
        joint: robot.nominal_rad.get(joint, 0.0) + np.copysign(0.05, robot.nominal_rad.get(joint, 0.0))
        for joint in joints
    }
    return dataclasses.replace(robot, name=f"{name}-crouched", nominal_rad={**robot.nominal_rad, **bent})


NAO, T1 = variant("nao-4"), variant("t1")


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Offer the variants as an installed package would."""
    extra = [
        EntryPoint(f"{n}-crouched", f"{__name__}:{v}", plugins.ROBOTS) for n, v in (("nao-4", "NAO"), ("t1", "T1"))
    ]
    real = plugins.entry_points
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: [*real(group=group), *(e for e in extra if e.group == group)]
    )
    plugins._entries.cache_clear()
    plugins.load.cache_clear()
    yield
    plugins._entries.cache_clear()
    plugins.load.cache_clear()


@pytest.mark.parametrize("robot", ["nao-4-crouched", "t1-crouched"])
def test_a_variant_is_trained_and_evaluated(robot: str, tmp_path: Path, recorder: Any) -> None:
    settings = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "hidden_sizes": [16]}
    spec = TrainingSpec.model_validate(
        {"robot": robot, "algorithm": settings, "total_steps": 128, "runtime": {"learner_threads": 1}}
    )
    result = train(spec, workdir=tmp_path, reporter=recorder)
    assert evaluate(result.checkpoint, EvaluationSpec(episodes=2)).summary["robot"] == robot
