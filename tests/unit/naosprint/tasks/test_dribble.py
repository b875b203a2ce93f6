"""The task dribble: lines and corners, what ends an episode, and what evaluations count."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.robots.booster import T1
from naosim.simulator import BALL, STEP_S
from naospec import TrainingSpec
from naosprint.tasks.ball import components
from naosprint.tasks.dribble import CORRIDOR_HALF_M, LEG_M, LOST_M, Dribble, DribbleSettings
from naosprint.tasks.environment import Environment
from naosprint.tasks.episodes import Episodes, Statistics
from pydantic import ValidationError

APPROACH = {"forward_acceleration_mps2": 3.0, "sideways_acceleration_mps2": 2.0, "turn_acceleration_rad_s2": 4.0}
PITCHED = T1.with_parameters({"head_pitch_rad": 0.6})


def environment_of(n: int, *, seed: int = 0, **settings: Any) -> Environment:
    """Return n robots at their starts."""
    parameters = Dribble.resolve(DribbleSettings(name="dribble", handover_states=8, **settings), PITCHED)
    simulator = MujocoSimulator(PITCHED, n, BoosterEmbeddedParameters(engine="fast"), scene=Dribble.scene)
    environment = Environment(simulator, Dribble, parameters, seed, critic=True)
    environment.load_starts(environment.task.starts(2, seed, 2.0))
    environment.restart(np.arange(n), np.arange(n) % 2)
    return environment


def task_of(environment: Environment) -> Dribble:
    assert isinstance(environment.task, Dribble)
    return environment.task


def walk(environment: Environment, steps: int = 1) -> None:
    """Take steps with the walker's actions."""
    walker = task_of(environment)._walker
    for _ in range(steps):
        environment.step(walker.act(environment.observer, slice(0, environment.n)))


def seen(environment: Environment, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return environment.observations[:, environment.observer.names.index(name)]


def test_the_walker_takes_the_ball_along() -> None:
    """A training that starts from its policy begins with a dribble, however bad."""
    environment = environment_of(16, aim_max_deg=20.0, turn_max_deg=0.0, line_steps=100_000)
    task = task_of(environment)
    first = environment.world.bodies[BALL].position[:, :2].copy()
    walk(environment, 100)
    moved = components(task._aim, environment.world.bodies[BALL].position[:, :2] - first)[0]
    assert np.median(moved) > 0.5


def test_a_line_begins_where_the_ball_is_seen() -> None:
    environment = environment_of(4, line_steps=10, speed_min_mps=0.5)
    task = task_of(environment)
    speeds = task._speed.copy()
    walk(environment, 3)  # all have seen it
    for _ in range(30):
        lines, aims, sighted = task._lines.copy(), task._aim.copy(), task.arrays["sighted"].copy()
        walk(environment)
        begun = task._lines > lines
        np.testing.assert_array_equal(task._line[begun], sighted[begun])
        np.testing.assert_allclose(seen(environment, "ball_offset")[begun], 0.0, atol=0.1)
        assert (task._aim[begun] != aims[begun]).all()
        assert (task._aim[~begun] == aims[~begun]).all()
    assert (task._lines > 1).all()
    assert (task._speed != speeds).all()
    assert np.abs(task._aim).max() <= np.pi


def test_the_walkers_command_is_approached() -> None:
    """A line that turns changes it by no more than the accelerations."""
    limits, names = APPROACH, ("command_forward", "command_sideways", "command_turn")

    def largest_changes(**settings: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        environment = environment_of(8, line_steps=20, **settings)
        walk(environment, 3)
        found = []
        for _ in range(60):
            found.append(np.stack([seen(environment, name) for name in names]))
            walk(environment)
        return np.asarray(np.abs(np.diff(found, axis=0)).max(axis=(0, 2)))

    most = np.array(list(limits.values())) * STEP_S
    np.testing.assert_allclose(largest_changes(**limits), most, rtol=1e-9)
    assert (largest_changes() > 2.0 * most).all()


def test_a_robot_that_takes_over_approaches_its_first_command_from_its_speed() -> None:
    names = ("velocity_x", "velocity_y"), ("command_forward", "command_sideways")
    apart = []
    for settings in (APPROACH, {}):
        environment = environment_of(16, **settings)
        moving, commanded = (np.stack([seen(environment, name) for name in each]) for each in names)
        assert moving[0].max() > 0.5
        apart.append(np.abs(commanded - moving).max(axis=1))
    most = np.array(list(APPROACH.values())[:2]) * STEP_S
    assert (apart[0] <= most + 1e-9).all()
    assert (apart[1] > 2.0 * most).all()


def test_the_walkers_accelerations_are_those_of_its_training() -> None:
    """Unless others are set; a walker without any is commanded at once."""

    def resolved(**settings: Any) -> tuple[float | None, ...]:
        return Dribble.resolve(DribbleSettings(name="dribble", **settings), PITCHED).accelerations

    assert resolved(walker="t1-run-steady") == (4.0, 2.0, 4.0)
    assert resolved(walker="t1-run-steady", turn_acceleration_rad_s2=1.0) == (4.0, 2.0, 1.0)
    assert resolved(walker="t1-run") == (None, None, None)


def test_what_is_drawn_does_not_depend_on_the_number_of_robots() -> None:
    few, many = environment_of(2, line_steps=10), environment_of(5, line_steps=10)
    for _ in range(20):
        walk(few)
        walk(many)
    for name in ("aim", "speed", "line", "lines", "flow"):
        np.testing.assert_array_equal(few.task.arrays[name], many.task.arrays[name][:2])


def test_the_reward_grows_with_a_ball_that_rolls_as_commanded_and_is_near() -> None:
    environment = environment_of(3)
    task = task_of(environment)
    terms = {term.name: term for term in task.reward_terms()}
    every = slice(0, 3)
    task._apart[:] = 0.4
    task._error[:] = (0.0, 0.5, 2.0)
    near = terms["track_ball"].compute(every)
    assert near[0] == pytest.approx(1.0)
    assert (np.diff(near) < 0.0).all()
    task._apart[:] = 1.0
    assert (terms["track_ball"].compute(every) < near).all()
    assert terms["offset"].weight < 0.0


def test_a_ball_out_of_reach_is_lost() -> None:
    environment = environment_of(2)
    ball = environment.world.bodies[BALL].position[:1].copy()
    ball[0, :2] = environment.world.position(slice(0, 1))[0, :2] + (LOST_M + 0.2, 0.0)
    environment.world.place_ball(np.arange(1), ball)
    walk(environment)
    assert environment.ends["lost"].tolist() == [True, False]
    assert environment.terminated.tolist() == [True, False]


def test_a_course_has_a_corner_and_an_end() -> None:
    environment = environment_of(2, course=True, speed_min_mps=1.5)
    task, world = task_of(environment), environment.world
    assert (task._lines == 1).all()
    aim = task._aim.copy()
    for number in (2, 3):
        ball = world.bodies[BALL].position[:1].copy()
        way = np.array([np.cos(task._aim[0]), np.sin(task._aim[0])])
        ball[0, :2] = task._line[0] + (LEG_M + 0.05) * way
        world.place_ball(np.arange(1), ball)
        walk(environment)
        if number == 2:
            assert task._lines.tolist() == [2, 1]
            assert abs(np.cos(task._aim[0] - aim[0])) < 1e-9
            assert task._aim[1] == aim[1]
            task._line[0] = ball[0, :2]  # where a robot beside it would have seen the ball
    assert environment.ends["done"].tolist() == [True, False]


def test_settings_name_what_is_wrong() -> None:
    # ranges of its own, and of classes that it inherits from
    for low, high in (("speed_min_mps", 1.5), ("ball_near_m", 0.9), ("friction_min", 1.0), ("extra_delay", 1)):
        task = {"name": "dribble", "extra_delay_max": 1, low: 2}
        with pytest.raises(ValidationError, match=rf"{low}: 2\S* is above \w+, {high}; exchange them"):
            TrainingSpec.model_validate({"task": task, "robot": "t1", "total_steps": 1})
    evaluated = DribbleSettings(name="dribble", push_mps=1.0).for_evaluation()
    assert (evaluated.course, evaluated.speed_min_mps, evaluated.push_mps) == (True, 1.5, 0.0)


def trace_of(*legs: tuple[float, float, float]) -> Any:
    """Return an episode with lines of (metres, largest offset, largest distance ahead), the second to the left."""
    rows, start, direction = [], np.zeros(2), 0.0
    for number, (reached, offset, ahead) in enumerate(legs, start=1):
        for share in np.linspace(0.0, 1.0, 101):
            way = np.array([np.cos(direction), np.sin(direction)])
            left = np.array([-way[1], way[0]])
            ball = start + share * reached * way + np.sin(np.pi * share) * offset * left
            rows.append([*ball, ahead * np.sin(np.pi * share), number, *start, direction])
        start, direction = start + reached * way, direction + np.pi / 2
    return np.array(rows)


def summary(*traces: Any) -> dict[str, float | None]:
    count = len(traces)
    nothing = [np.zeros(len(trace)) for trace in traces]
    episodes = Episodes(
        x=nothing, y=nothing, height=nothing, up=nothing, feet=nothing, airborne=nothing, trace=list(traces),
        ends={"fallen": np.zeros(count, dtype=np.bool_)}, max_steps=2000,
    )  # fmt: skip
    task = object.__new__(Dribble)
    return {result.metric.name: result.value for result in task.summarize(episodes, Statistics(0.95, 100, 0))[0]}


def test_results_count_lines_within_the_corridor() -> None:
    wide = CORRIDOR_HALF_M + 0.05
    found = summary(
        trace_of((10.0, 0.5, 0.7), (10.0, -0.5, 0.6)),
        trace_of((10.0, wide, 0.7), (10.0, 0.1, 0.9)),
        trace_of((10.0, 0.1, 0.7), (6.0, 0.1, 0.7)),
        trace_of((4.0, 0.0, 0.7)),
    )
    assert found["line_rate"] == pytest.approx(2 / 4)
    assert found["corner_rate"] == pytest.approx(2 / 3)
    assert found["kept_rate"] == pytest.approx(4 / 5)  # of those that were dribbled to their ends
    assert found["course_speed_mps"] == pytest.approx(LEG_M / (101 * STEP_S))
    assert found["farthest_m"] == pytest.approx(0.7, abs=1e-3)


def test_a_ball_may_roll_on_at_a_corner_and_nowhere_else() -> None:
    def wide_at(metres: float) -> Any:
        trace = trace_of((10.0, 0.0, 0.5), (10.0, 0.0, 0.5))
        for number in (1, 2):
            row = np.flatnonzero(trace[:, 3] == number)[round(10 * metres)]
            left = (0.0, 1.0) if number == 1 else (-1.0, 0.0)
            trace[row, :2] += 0.9 * np.array(left)
        return trace

    assert (summary(wide_at(1.0))["line_rate"], summary(wide_at(1.0))["corner_rate"]) == (0.0, 1.0)
    assert (summary(wide_at(3.0))["line_rate"], summary(wide_at(3.0))["corner_rate"]) == (0.0, 0.0)


def test_an_evaluation_without_a_corner_has_none() -> None:
    assert summary(trace_of((4.0, 0.0, 0.7)))["corner_rate"] is None
