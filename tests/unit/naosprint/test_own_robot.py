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
from naosprint.tasks.environment import open_environment
from naosprint.tasks.getup import GetUp
from pydantic import ValidationError


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
    assert evaluate(result.checkpoint, EvaluationSpec(episodes=2, start_noise_deg=0.0)).summary["robot"] == robot
    written = export_policy(result.checkpoint, tmp_path / "export", FORMATS)
    with np.load(tmp_path / "export" / "policy.npz") as arrays:
        np.testing.assert_allclose(arrays["start_pose_rad"], own.nominal)
    (check,) = (path for path in written if path.name == "check.py")
    done = subprocess.run([sys.executable, "check.py"], cwd=check.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((tmp_path / "export" / "policy.json").read_text(encoding="utf-8"))["robot"] == robot


T1 = robots.get("t1")
NARROW = dataclasses.replace(
    T1,
    name="t1-narrow",
    nominal_rad={**T1.nominal_rad, "head_pitch": 0.3},
    action_range_rad={joint.name: 0.2 for joint in T1.joints if joint.actuated},
)
"""A variant with ranges of actions and an angle of the head of its own."""


def test_ranges_and_pose_of_a_variant_are_those_of_its_environments(offer: Callable[..., None]) -> None:
    offer("naosim-crouched", {plugins.ROBOTS: {"t1-narrow": f"{__name__}:NARROW"}})
    spec = TrainingSpec.model_validate({"robot": "t1-narrow"})
    environment = open_environment(spec, 1, threads=1)
    actuation = environment.actuation
    middle, reached = actuation.targets(np.stack([np.zeros(actuation.n_actions), np.ones(actuation.n_actions)]))
    assert np.abs(reached - middle).max() == pytest.approx(0.2)
    assert environment.world.robot.nominal[T1.joint_names.index("head_pitch")] == 0.3
    environment.close()
    with pytest.raises(ValidationError, match=r"robot t1-narrow: action_range_rad: 1 would have no effect.* 0\.2 rad"):
        TrainingSpec.model_validate({"robot": {"name": "t1-narrow", "action_range_rad": 1.0}})


def test_a_variant_with_a_misspelled_joint_is_refused_by_robot_and_field(
    offer: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "misspelled.py").write_text(
        "import dataclasses\nfrom naosim import robots\nt1 = robots.get('t1')\n"
        "ROBOT = dataclasses.replace(t1, name='t1-bent', nominal_rad={**t1.nominal_rad, 'left_knee': 0.6})\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    offer("naosim-crouched", {plugins.ROBOTS: {"t1-bent": "misspelled:ROBOT"}})
    with pytest.raises(
        plugins.BrokenPluginError, match="robot t1-bent: nominal_rad: there is no joint 'left_knee'; its"
    ):
        robots.get("t1-bent")


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
