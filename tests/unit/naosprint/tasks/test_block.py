"""The task block: shots that go in unless they are stopped, what is perceived of them, and what counts as saved."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.robots.booster import T1
from naosim.simulator import BALL, STEP_S
from naospec import TrainingSpec
from naosprint.tasks.block import CALM_S, HOME_M, Block, BlockSettings
from naosprint.tasks.environment import Environment
from naosprint.tasks.episodes import Episodes, Statistics
from naosprint.tasks.frozen import FrozenPolicy
from naosprint.tasks.handover import joined, record_own
from pydantic import ValidationError

PITCHED = T1.with_parameters({"head_pitch_rad": 0.6})
HALF_M = 0.5 * T1.field.goal.width_m
RADIUS_M = T1.field.ball_radius_m


def environment_of(n: int, *, seed: int = 0, **settings: Any) -> Environment:
    """Return n robots at their starts."""
    chosen = {"handover_states": 8, "walker": "t1-run-wide", **settings}
    parameters = Block.resolve(BlockSettings(name="block", **chosen), PITCHED)
    simulator = MujocoSimulator(PITCHED, n, BoosterEmbeddedParameters(engine="fast"), scene=Block.scene)
    environment = Environment(simulator, Block, parameters, seed, critic=True)
    environment.load_starts(environment.task.starts(2, seed, 2.0))
    environment.restart(np.arange(n), np.arange(n) % 2)
    return environment


def task_of(environment: Environment) -> Block:
    assert isinstance(environment.task, Block)
    return environment.task


def walk(environment: Environment, steps: int = 1) -> None:
    """Take steps with the walker's actions."""
    walker = task_of(environment)._walker
    for _ in range(steps):
        environment.step(walker.act(environment.observer, slice(0, environment.n)))


def outcomes(environment: Environment) -> dict[str, np.ndarray[Any, np.dtype[np.bool_]]]:
    """Walk until every episode has ended, and return by its first end which ended so."""
    over = np.zeros(environment.n, dtype=np.bool_)
    found = {name: over.copy() for name in environment.ends}
    while not over.all():
        walk(environment)
        assert environment.world.steps.max() < task_of(environment).max_steps
        for name, flags in environment.ends.items():
            found[name] |= flags & ~over
        over |= np.any(list(environment.ends.values()), axis=0)
    return found


def seen(environment: Environment, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return environment.observations[:, environment.observer.names.index(name)]


def test_every_shot_goes_in_unless_it_is_stopped() -> None:
    environment = environment_of(48, handover_states=32)
    task, rows = task_of(environment), np.arange(48)
    ball = environment.world.bodies[BALL]
    aside = np.array((20.0, 0.0, 0.0))  # where no robot stands
    task._goal += aside[:2]
    environment.world.place_ball(rows, ball.position + aside, ball.velocity.copy(), ball.spin.copy())
    ends = outcomes(environment)
    assert ends["conceded"].sum() + ends["fallen"].sum() == 48
    assert ends["fallen"].sum() <= 2


def test_the_walker_saves_shots() -> None:
    """A training that starts from its policy begins with saves: of about half of the shots."""
    ends = outcomes(environment_of(64, handover_states=32))
    assert 0.3 < ends["saved"].mean() < 0.7
    assert ends["fallen"].mean() < 0.1


def test_a_keeper_stands_between_ball_and_goal() -> None:
    environment = environment_of(64)
    task, world = task_of(environment), environment.world
    ball = world.bodies[BALL].position[:, :2] - task._goal
    distance = np.hypot(*ball.T)
    assert 4.0 <= distance.min() < distance.max() <= 10.0
    assert np.abs(np.degrees(np.arctan2(ball[:, 1], ball[:, 0]))).max() <= 45.0
    expected = HOME_M * ball / distance[:, None]
    assert np.abs(world.position(slice(0, 64))[:, :2] - task._goal - expected).max() <= 0.3 + 1e-9
    speed = np.hypot(*world.bodies[BALL].velocity[:, :2].T)
    slides = (world.bodies[BALL].spin == 0.0).all(axis=1)
    assert 16 < slides.sum() < 48
    np.testing.assert_allclose(speed, np.where(slides, 1.4, 1.0) * task._shot[:, 0])
    assert 2.0 <= task._shot[:, 0].min() < task._shot[:, 0].max() <= 6.0


def test_what_is_observed_is_where_the_ball_comes() -> None:
    environment = environment_of(32, seed=1)
    task = task_of(environment)
    walk(environment, 14)
    coming = task._touched == 0
    coming &= seen(environment, "crossing_time") < 1.5
    assert coming.sum() > 8
    truth = task._true_crossing(slice(0, 32))[:, 0]
    error = np.abs(seen(environment, "crossing") - truth)[coming]
    assert np.median(error) < 0.15
    place = environment.world.position(slice(0, 32))[:, :2] - task._goal
    np.testing.assert_allclose(seen(environment, "goal_along"), place[:, 0], atol=0.02)
    np.testing.assert_allclose(seen(environment, "goal_across"), place[:, 1], atol=0.02)


@pytest.mark.parametrize(("offset", "goes_in"), [(0.0, True), (HALF_M - 0.05, True), (-HALF_M - 0.05, False)])
def test_a_ball_behind_the_line_is_a_goal_between_the_posts(offset: float, goes_in: bool) -> None:
    environment = environment_of(2)
    task, rows = task_of(environment), np.arange(1)
    place = np.array([[*(task._goal[0] + (-RADIUS_M - 0.02, offset)), RADIUS_M]])
    environment.world.place_ball(rows, place)
    walk(environment)
    assert environment.ends["conceded"].tolist() == [goes_in, False]
    assert environment.terminated.tolist() == [goes_in, False]


def test_a_ball_that_comes_no_nearer_is_saved_after_a_while() -> None:
    environment = environment_of(2)
    task, rows = task_of(environment), np.arange(1)
    environment.world.place_ball(rows, np.array([[*(task._goal[0] + (3.0, 0.0)), RADIUS_M]]))
    steps = 0
    while not environment.ends["saved"][0]:
        walk(environment)
        steps += 1
        assert steps < 100
    assert steps * STEP_S == pytest.approx(CALM_S, abs=0.05)
    term = next(term for term in task.reward_terms() if term.name == "save")
    np.testing.assert_array_equal(term.compute(slice(0, 2)), [1.0, 0.0])


def test_results_tell_saves_by_speed_and_distance() -> None:
    task = task_of(environment_of(2))
    shots = ((True, 2.5, 5.0, "saved"), (True, 3.5, 8.0, "conceded"), (False, 5.5, 9.0, "conceded"))
    row = [np.array([[9.0, 0.0, touched, speed, distance]]) for touched, speed, distance, _ in shots]
    ends = {name: np.array([end == name for *_, end in shots]) for name in ("fallen", "conceded", "saved")}
    empty: list[Any] = [np.zeros(1)] * 3
    episodes = Episodes(empty, empty, empty, empty, empty, empty, row, ends, 600)
    results, (table,) = task.summarize(episodes, Statistics(0.95, 10, 0))
    assert {result.metric.name: result.count for result in results} == {
        "saved_rate": 1,
        "conceded_rate": 2,
        "stopped_rate": 2,
        "fall_rate": 0,
    }
    near, far = table.columns.values()
    assert [result.value for result in near] == [1.0, None, None, None]
    assert [result.value for result in far] == [None, 0.0, None, 0.0]


def test_episodes_begin_with_states_of_each_entry_policy() -> None:
    alone, both = environment_of(2), environment_of(2, entry_policies=("t1-run",))
    own, other = (task_of(each)._entered.states for each in (alone, both))
    assert len(other) == len(own) == 8
    np.testing.assert_array_equal(other.actions[:4], own.actions[:4])
    speeds = np.hypot(*other.motion.torso_mps[:, :2].T)
    assert speeds[4:].max() > 0.0
    assert not np.isin(other.actions[4:], own.actions).all(axis=1).any()


def test_episodes_begin_with_states_of_other_skills() -> None:
    """In the middle of a dribble, and where a kick ends; their own episodes begin as they always do."""
    environment = environment_of(2, entry_policies=("t1-kick", "t1-dribble"), handover_states=24)
    states = task_of(environment)._entered.states
    simulator = MujocoSimulator(PITCHED, 2, BoosterEmbeddedParameters(engine="fast"), scene=Block.scene)
    alone = [record_own(simulator, FrozenPolicy(name), 2, 0) for name in ("t1-kick", "t1-dribble")]
    assert [len(each) for each in alone] == [2, 2]
    np.testing.assert_array_equal(states.actions[2:], joined(alone).actions)
    assert all(np.hypot(*each.motion.torso_mps[:, :2].T).max() > 0.2 for each in alone)


def test_settings_name_what_is_wrong() -> None:
    def message(**settings: Any) -> str:
        with pytest.raises(ValidationError) as error:
            TrainingSpec.model_validate({"robot": "t1", "task": {"name": "block", **settings}})
        return str(error.value)

    assert "shot_speed_min_mps: 5.0 is above shot_speed_max_mps, 4.0" in message(
        shot_speed_min_mps=5.0, shot_speed_max_mps=4.0
    )
    unfit = (
        "is no bundled policy of robot t1 with these ranges of actions and senses, for a task in this world; "
        "use t1-dribble or"
    )
    for name in ("k1-run", "t1-getup", "t2"):  # another robot, other ranges, unknown
        assert f"task.entry_policies: '{name}' {unfit}" in message(entry_policies=[name])
    assert "ball_near_m" in message(ball_near_m=0.5)  # of tasks that begin beside a ball
