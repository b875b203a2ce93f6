"""Variants of robots that another package adds are trained, evaluated and exported like the robots themselves."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naospec import EvaluationSpec, TrainingSpec, plugins
from naosprint import evaluate, train
from naosprint.export import FORMATS, export_policy
from naosprint.tasks import RobotDefaults, robot_defaults
from naosprint.tasks.getup import GetUp


@pytest.fixture(autouse=True)
def installed(offer: Callable[[str], None]) -> None:
    offer("naosim-crouched")


@pytest.mark.parametrize(("robot", "usual"), [("nao-crouched", "nao-0"), ("t1-crouched", "t1")])
def test_a_variant_is_trained_evaluated_and_exported(robot: str, usual: str, tmp_path: Path, recorder: Any) -> None:
    settings = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "hidden_sizes": [16]}
    spec = TrainingSpec.model_validate(
        {"robot": robot, "algorithm": settings, "total_steps": 128, "runtime": {"learner_threads": 1}}
    )
    own, theirs = robots.configured(spec.robot), robots.get(usual)
    assert (own.nominal != theirs.nominal).any()
    assert robot_defaults(own) == robot_defaults(theirs)
    result = train(spec, workdir=tmp_path / "run", reporter=recorder)
    assert evaluate(result.checkpoint, EvaluationSpec(episodes=2)).summary["robot"] == robot
    written = export_policy(result.checkpoint, tmp_path / "export", FORMATS)
    with np.load(tmp_path / "export" / "policy.npz") as arrays:
        np.testing.assert_allclose(arrays["start_pose_rad"], own.nominal)
    (check,) = (path for path in written if path.name == "check.py")
    done = subprocess.run([sys.executable, "check.py"], cwd=check.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((tmp_path / "export" / "policy.json").read_text(encoding="utf-8"))["robot"] == robot


def test_a_variant_has_the_scripted_motions_of_its_model() -> None:
    """Whatever its name: a robot without motions of its own or its model's demonstrates nothing."""
    shown = {
        name: GetUp.demonstrates(robots.get(name)) for name in ("t1", "t1-crouched", "k1", "nao-0", "nao-crouched")
    }
    assert [name for name, demonstrates in shown.items() if demonstrates] == ["t1", "t1-crouched", "k1"]


def test_the_gains_of_a_variant_are_those_of_its_settings() -> None:
    for name, kp in (("t1", 120.0), ("t1-crouched", 100.0)):
        described = robots.configured(TrainingSpec.model_validate({"robot": name}).robot)
        assert described.parameters.gains("left_knee_pitch")[0] == kp


@pytest.mark.parametrize("name", ["t1-crouched", "booster"])
def test_a_package_states_observations_and_fall_heights_of_its_robot_or_family(
    name: str, offer: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = RobotDefaults(("gravity", "gyro", "joint_angles"), 0.3, 0.4)
    monkeypatch.setattr(f"{__name__}.stated", lambda robot: stated, raising=False)
    offer("naosim-crouched", {plugins.ROBOT_DEFAULTS: {name: f"{__name__}:stated"}})
    assert robot_defaults(robots.get("t1-crouched")) == stated
    assert (robot_defaults(robots.get("t1")) == stated) == (name == "booster")
    assert TrainingSpec.model_validate({"robot": "t1-crouched"}).task.min_height_m == 0.3


def test_a_family_without_observations_is_refused_by_name() -> None:
    walker = dataclasses.replace(robots.get("t1"), name="walker-1", family="walker")
    with pytest.raises(ValueError, match=r"walker-1; offer them as 'walker-1' or 'walker' in .* naosprint\.robots"):
        robot_defaults(walker)
