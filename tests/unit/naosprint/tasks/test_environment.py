"""Environments with the sprint tasks: rewards and ends of episodes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from naosim import robots
from naosim.simspark import EmbeddedSimulator
from naospec import TrainingSpec
from naosprint.tasks.base import Task
from naosprint.tasks.environment import Environment, open_training_environment
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.sprint import Sprint1, Sprint2, SprintSettings

FALL = np.ones(20)
FALL[8:] = np.tile([0.0, 0.0, 1.0, -1.0, -1.0, 0.0], 2)


def environment_of(n: int, task: type[Task] = Sprint1, **settings: float) -> Environment:
    """Return n standard robots at their starts, rewarded for forward displacement only."""
    robot = robots.get("nao-0")
    chosen = SprintSettings(name=task.name, drift_penalty=0.0).model_copy(update=settings)
    environment = Environment(EmbeddedSimulator(robot, n), task, task.resolve(chosen, robot))
    environment.load_starts(environment.task.starts(n, 0, 2.0))
    environment.restart(np.arange(n), np.arange(n))
    return environment


def variant(task: type[Task], **attributes: object) -> type[Task]:
    """Return a task with other class attributes."""
    return type(task.__name__, (task,), attributes)


def hold(environment: Environment) -> np.ndarray:
    """Return the action that keeps the start pose."""
    low, high = environment.actuation.low_rad, environment.actuation.high_rad
    return np.repeat((2 * (environment.actuation.nominal - low) / (high - low) - 1)[None], environment.n, axis=0)


def test_reward_is_forward_displacement_times_scale() -> None:
    """The rewards of an episode add up to the distance covered."""
    environment = environment_of(4)
    x = environment.simulator.truth.torso_position[:, 0].copy()
    total = np.zeros(4)
    rng = np.random.default_rng(0)
    for _ in range(30):
        before = environment.simulator.truth.torso_position[:, 0].copy()
        environment.step(rng.uniform(-1, 1, (4, 20)))
        after = environment.simulator.truth.torso_position[:, 0]
        np.testing.assert_allclose(environment.rewards, 100.0 * (after - before), atol=1e-9)
        total += environment.rewards
    moved = environment.simulator.truth.torso_position[:, 0] - x
    np.testing.assert_allclose(total, 100.0 * moved, atol=1e-9)
    np.testing.assert_allclose(environment.task.measure(np.arange(4))[:, 0], moved, atol=1e-12)


def test_penalties_take_from_the_reward_what_drift_and_fall_cost() -> None:
    """A step away from the line is penalized by its metres, a step back is rewarded by them; a fall is penalized
    once."""
    environment = environment_of(4, drift_penalty=0.5, fall_penalty_m=3.0)
    rng = np.random.default_rng(0)
    homeward = 0
    for _ in range(200):
        before = environment.simulator.truth.torso_position.copy()
        environment.step(0.3 * rng.uniform(-1, 1, (4, 20)) + 0.7 * FALL)
        after = environment.simulator.truth.torso_position
        away = np.abs(after[:, 1]) - np.abs(before[:, 1])
        fell = after[:, 2] < 0.27
        np.testing.assert_allclose(
            environment.rewards, 100.0 * (after[:, 0] - before[:, 0] - 0.5 * away - 3.0 * fell), atol=1e-9
        )
        homeward += int((away < 0.0).sum())
        if fell.any():
            break
    assert fell.any()
    assert homeward > 0


def test_short_episodes_are_truncated_after_two_seconds() -> None:
    """Only in the environments that are short, and as truncations, whose value can be estimated."""
    environment = environment_of(4, Sprint2)
    environment.short[:2] = True
    for step in range(1, 101):
        environment.step(hold(environment))
        assert not environment.terminated.any()
        assert environment.truncated.tolist() == [step == 100, step == 100, False, False]


def test_fraction_of_environments_with_short_episodes(make_spec: Callable[..., TrainingSpec]) -> None:
    """The fraction is the specification's."""
    environment, _ = open_training_environment(
        make_spec(n_envs=8, n_steps=8, batch_size=64, start_episode_fraction=0.25)
    )
    assert environment.short.tolist() == [True] * 2 + [False] * 6
    environment.close()


def test_standing_robot_continues() -> None:
    """Holding the start pose neither falls nor ends the episode."""
    environment = environment_of(4)
    for _ in range(100):
        environment.step(hold(environment))
    assert not environment.terminated.any()
    assert not environment.truncated.any()
    assert (environment.steps == 100).all()


def test_fall_ends_the_episode_at_the_first_step_below_the_height() -> None:
    """Terminated exactly when the torso is below the minimum height."""
    environment = environment_of(4)
    for _ in range(200):
        environment.step(np.tile(FALL, (4, 1)))
        low = environment.simulator.truth.torso_position[:, 2] < 0.27
        assert np.array_equal(environment.terminated, low)
        assert np.array_equal(environment.ends["fallen"], low)
        if low.all():
            break
    assert low.all()


def test_erect_limit_ends_it_earlier() -> None:
    """The higher limit is met first."""
    ends = {}
    for limit in (0.27, 0.33):
        environment = environment_of(1, min_height_m=limit)
        while not environment.terminated[0]:
            environment.step(FALL[None])
        ends[limit] = int(environment.steps[0])
    assert ends[0.33] < ends[0.27]


def test_finish_line_ends_the_episode() -> None:
    """Passing the line is an end without a fall."""
    environment = environment_of(4, variant(Sprint1, finish_x_m=-13.95))
    rng = np.random.default_rng(4)
    arrivals = 0
    for _ in range(200):
        environment.step(rng.uniform(-1, 1, (4, 20)))
        x, _, z = environment.simulator.truth.torso_position.T
        arrived = (x > -13.95) & (z >= 0.27)
        assert np.array_equal(environment.ends["arrived"], arrived)
        assert np.array_equal(environment.terminated, arrived | (z < 0.27))
        arrivals += int(arrived.sum())
        over = np.flatnonzero(environment.terminated)
        environment.restart(over, over)
    assert arrivals > 0


def test_horizon_of_task_two_terminates_and_that_of_task_one_truncates() -> None:
    """Only a time limit that is not part of the task truncates."""
    for task, terminal in ((Sprint1, False), (Sprint2, True)):
        environment = environment_of(2, variant(task, max_steps=3))
        for _ in range(3):
            assert not (environment.terminated | environment.truncated).any()
            environment.step(hold(environment))
        assert environment.terminated.all() == terminal
        assert environment.truncated.all() != terminal
        assert not environment.ends["fallen"].any()


def test_inactive_robots_stay_where_they_are() -> None:
    """A masked robot is not moved."""
    environment = environment_of(3)
    before = environment.simulator.truth.torso_position.copy()
    environment.step(np.tile(FALL, (3, 1)), np.array([True, False, True]))
    after = environment.simulator.truth.torso_position
    assert np.array_equal(after[1], before[1])
    assert not np.array_equal(after[0], before[0])


def test_state_and_load_state_continue_bit_for_bit() -> None:
    """A restored environment continues in the middle of an episode."""
    first, second = environment_of(3), environment_of(3)
    rng = np.random.default_rng(3)
    for _ in range(10):
        first.step(rng.uniform(-1, 1, (3, 20)))
    second.load_state(first.state())
    for _ in range(10):
        actions = rng.uniform(-1, 1, (3, 20))
        assert np.array_equal(first.step(actions), second.step(actions))
        assert np.array_equal(first.rewards, second.rewards)


def test_height_above_the_start_pose_is_refused(make_spec: Callable[..., TrainingSpec]) -> None:
    """A limit between crouching and standing would end every episode at once."""
    with pytest.raises(ValueError, match=r"an episode ends at its start \(fall\)"):
        open_training_environment(make_spec(min_height_m=0.38))


def test_lost_robots_keep_their_state_and_are_truncated() -> None:
    """The last report of a failing server is ignored: observation, reward and progress."""

    class Losing(EmbeddedSimulator):
        @property
        def lost(self) -> np.ndarray:
            return np.array([False, True])

    robot = robots.get("nao-0")
    settings = Sprint1.resolve(SprintSettings(name="sprint1"), robot)
    environment = Environment(Losing(robot, 2), Sprint1, settings)
    environment.load_starts(environment.task.starts(2, 0, 2.0))
    environment.restart(np.arange(2), np.arange(2))
    before = environment.observations.copy()
    remembered = {name: array.copy() for name, array in environment.task.arrays.items()}
    environment.step(np.tile(FALL, (2, 1)))
    assert environment.truncated.tolist() == environment.lost.tolist() == [False, True]
    assert not environment.terminated.any()
    assert environment.rewards[1] == 0.0 != environment.rewards[0]
    np.testing.assert_array_equal(environment.observations[1], before[1])
    assert (environment.observations[0] != before[0]).any()
    for name, array in environment.task.arrays.items():
        assert array[1] == remembered[name][1], name


def test_settings_that_depend_on_the_robot_are_its_own() -> None:
    """The fall height is the robot's, higher for erect tasks; a specification shows what was filled in."""
    heights = {}
    for robot in ("nao-0", "nao-3"):
        for task in ("sprint1", "sprint1-erect", "sprint2", "sprint2-erect"):
            described = robot_defaults(robots.get(robot))
            expected = described.erect_height_m if task.endswith("-erect") else described.fall_height_m
            spec = TrainingSpec.model_validate({"task": task, "robot": robot})
            assert spec.task.min_height_m == expected
            heights[task] = expected
    assert heights["sprint1-erect"] > heights["sprint1"]
    own = TrainingSpec.model_validate({"task": {"name": "sprint1", "min_height_m": 0.3}})
    assert own.task.min_height_m == 0.3
