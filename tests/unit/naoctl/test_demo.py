"""What the demonstration trains."""

from __future__ import annotations

import pytest
from naoctl.commands.submit import make_body
from naoctl.demo import ROBOTS, bundled_policy
from naospec import TrainingSpec


@pytest.mark.parametrize("robot", ROBOTS)
def test_usual_settings_make_a_training_of_the_robot(robot: str) -> None:
    usual = ROBOTS[robot]
    flags = {"task": "sprint1", "robot": robot, "preset": "fast", "total_steps": str(usual.steps)}
    body = make_body({}, {**flags, **usual.settings}, {"eval_episodes": str(usual.episodes)})
    spec = TrainingSpec.model_validate(body["spec"])
    assert (spec.robot.name, spec.total_steps, spec.algorithm.preset) == (robot, usual.steps, "fast")
    chosen = {**vars(spec.algorithm), **vars(spec.task)}
    for name, value in usual.settings.items():
        assert chosen[name] == pytest.approx(float(value))


def test_the_policy_beside_is_the_robots_sprinter() -> None:
    assert [bundled_policy(robot) for robot in ("nao-0", "t1", "k1")] == ["sprint", "t1-sprint", "k1-sprint"]
