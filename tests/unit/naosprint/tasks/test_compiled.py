"""Compiled steps: the bits of the Python code, chosen where every part of a task has a compiled form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naosim.simspark import EmbeddedSimulator
from naosim.simulator import NativeHandle, Simulator
from naosprint import _compiled
from naosprint.mirror import Mirror
from naosprint.rl.normalization import Normalizer, RunningMoments
from naosprint.tasks import ObservationBlock, RewardTerm, Task
from naosprint.tasks.block import Block
from naosprint.tasks.dribble import Dribble
from naosprint.tasks.environment import STORES, Environment
from naosprint.tasks.getup import GetUp
from naosprint.tasks.kick import Kick
from naosprint.tasks.sprint import Sprint1, Sprint2, SprintSettings
from naosprint.tasks.velocity import Velocity
from naosprint.terms import exp, log, source, sqrt, stack
from naosprint.terms.randomness import add_normal, hashed, normal

NAO = robots.get("nao-0")
FULL = {"drift_penalty": 0.7, "fall_penalty_m": 0.3, "smoothness_penalty": 0.2, "action_penalty": 0.1}


def opened(simulator: Simulator, task: type[Task] = Sprint1, *, compiled: bool = True, **settings: Any) -> Environment:
    chosen = SprintSettings(name=task.name).model_copy(update=settings)
    environment = Environment(simulator, task, task.resolve(chosen, simulator.robot), compiled=compiled)
    n = environment.n
    environment.short[: n // 3] = True
    environment.load_starts(environment.task.starts(8, 0, 2.0))
    environment.restart(np.arange(n), np.arange(n) % 8)
    return environment


def run(environment: Environment, steps: int) -> list[np.ndarray]:
    """Return everything that the steps of an environment computed, with restarts as they come."""
    rng = np.random.default_rng(5)
    found = []
    for step in range(steps):
        width = environment.actuation.n_actions
        actions = rng.normal(0.0, 0.6, (environment.n, width)).astype(np.float32 if step % 2 else np.float64)
        observations = environment.step(actions).copy()
        flags = (environment.terminated, environment.truncated, environment.failed, environment.lost)
        found += [observations, environment.rewards.copy(), *(flag.copy() for flag in flags)]
        found += [flag.copy() for flag in environment.ends.values()]
        over = np.flatnonzero(environment.terminated | environment.truncated)
        found.append(environment.task.measure(over))
        environment.restart(over, over % 2)
        found.append(environment.observations.copy())
    found += [array for _, array in sorted(environment.state().items())]
    environment.close()
    return found


def same(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> None:
    assert len(ours) == len(theirs)
    for number, (one, other) in enumerate(zip(ours, theirs, strict=True)):
        np.testing.assert_array_equal(one, other, err_msg=str(number))
        assert one.tobytes() == other.tobytes() or np.isnan(one.astype(np.float64)).any() or (one == 0).any()


@pytest.mark.parametrize(("robot", "settings"), [("nao-0", {}), ("nao-4", {}), ("nao-0", {"ground_velocity": True})])
@pytest.mark.parametrize("task", [Sprint1, Sprint2])
def test_a_compiled_step_has_the_bits_of_the_python_code(
    robot: str, settings: dict[str, Any], task: type[Task]
) -> None:
    description = robots.get(robot).with_parameters(settings)
    compiled, plain = (
        opened(EmbeddedSimulator(description, 19, threads=2), task, compiled=wanted, **FULL) for wanted in (True, False)
    )
    assert compiled.compiled
    assert not plain.compiled
    assert compiled.load_starts is not None
    ours, theirs = run(compiled, 130), run(plain, 130)
    same(ours, theirs)
    assert compiled.ends["fallen"].dtype == np.bool_


def test_a_robot_that_estimates_its_pose_too() -> None:
    robot = robots.get("nao-3").with_parameters({"onboard_sensing": True})
    compiled, plain = (opened(EmbeddedSimulator(robot, 3), compiled=wanted) for wanted in (True, False))
    assert compiled.compiled
    same(run(compiled, 60), run(plain, 60))


def test_a_mujoco_robot_too() -> None:
    mujoco = pytest.importorskip("naosim.mujoco.embedded")
    robot = robots.get("t1")
    settings = {"hop_penalty": 0.3, "history_steps": 2}
    compiled, plain = (
        opened(mujoco.MujocoSimulator(robot, 3), compiled=wanted, **settings) for wanted in (True, False)
    )
    assert compiled.compiled
    same(run(compiled, 45), run(plain, 45))


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        (
            Velocity,
            {
                "flight_weight": 0.3,
                "speed_weight": 0.5,
                "fall_penalty": 0.2,
                "command_steps": 12,
                "action_penalty": 0.1,
            },
        ),
        (Velocity, {"command_growth": 0.3, "command_ellipsoid": True, "command_steps": 40, "forward_min_mps": -1.0}),
        (GetUp, {"smoothness_penalty": 0.2, "episode_steps": 30, "torque_penalty": 0.1}),
        (Kick, {"handover_states": 8, "approach_steps": 30, "takeover_steps": 2}),
        (Kick, {"handover_states": 8, "rolling_fraction": 1.0, "whole_roll": True}),
        (Kick, {"handover_states": 8, "takeover_steps": 2, "least_share": 1.0, "sight_share": 0.25}),
        (Dribble, {"handover_states": 8, "line_steps": 10}),
        (Dribble, {"handover_states": 8, "course": True}),
        (Block, {"handover_states": 8}),
    ],
)
def test_tasks_of_expressions_have_the_same_bits_in_both_interpreters(
    task: type[Task], settings: dict[str, Any]
) -> None:
    mujoco = pytest.importorskip("naosim.mujoco.embedded")
    environments = []
    for wanted in (True, False):
        robot = robots.get("t1").with_parameters({"head_pitch_rad": 0.6})
        simulator = mujoco.MujocoSimulator(robot, 4, scene=task.scene)
        chosen = task.resolve(task.Parameters(name=task.name).model_copy(update=settings), robot)
        environments.append(Environment(simulator, task, chosen, compiled=wanted, critic=True))
        starts = environments[-1].task.starts(8, 0, 2.0)
        environments[-1].load_starts(starts)
        environments[-1].restart(np.arange(4), np.arange(4) % len(starts))
    assert [environment.compiled for environment in environments] == [True, False]
    # bundled tasks name what their checkpoints have
    assert not any(name.startswith(STORES) for name in environments[0].state())
    same(*(run(environment, 45) for environment in environments))


class OwnAdvance(Sprint1):
    """A sprint that computes something of its own after each step."""

    advances = 0

    def advance(self, rows: slice) -> None:
        """Count, too."""
        super().advance(rows)
        self.advances += 1


class OwnTerm(Sprint1):
    """A sprint with a term that exists in Python only."""

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return one term more."""
        return (*super().reward_terms(), RewardTerm("own", 0.5, lambda rows: self.world.steps[rows] % 2))


class OwnBlock(Sprint1):
    """A sprint with an observation that exists in Python only."""

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return one block more."""
        return (*super().observation_blocks(), ObservationBlock(("own",), lambda rows: self.world.steps[rows][:, None]))


class OwnUpdate(Sprint1):
    """A sprint with an observation whose number is stored in Python after each step."""

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return one block more."""
        kept = self.add_array("kept")

        def update(rows: slice) -> None:
            kept[rows] = self.world.steps[rows]

        return (*super().observation_blocks(), ObservationBlock(("kept",), self.stored("kept"), update=update))


class Composed(Sprint1):
    """A sprint with another choice of the project's blocks, and a weight of its own."""

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return the usual blocks, and the latest action."""
        from naosprint.tasks import blocks

        return (*super().observation_blocks(), *blocks(self.world, ["last_action"]))

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return half of each term."""
        return [RewardTerm(term.name, 0.5 * term.weight, term.value) for term in super().reward_terms()]


class Undefined(Sprint1):
    """A sprint that observes what functions have no number for."""

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return functions of arguments beyond what they are defined for."""
        number = 1000.0 * self.world.step  # 0 at first
        values = stack(
            *(exp(number), exp(-number), log(number), log(-number), log(number - number)),
            *(
                sqrt(-number),
                1.0 / (number - number),
                (number - number) / (number - number),
                number % (number - number),
            ),
        )
        return [ObservationBlock([f"undefined_{k}" for k in range(values.width)], values)]


def test_what_has_no_number_is_the_same_in_both_interpreters() -> None:
    environments = [opened(EmbeddedSimulator(NAO, 2), Undefined, compiled=wanted) for wanted in (True, False)]
    assert [environment.compiled for environment in environments] == [True, False]
    for _ in range(3):
        for environment in environments:
            environment.step(np.zeros((2, environment.actuation.n_actions)))
        np.testing.assert_array_equal(*(environment.observations for environment in environments))
    assert environments[0].observations[0, :3].tolist() == [np.inf, 0.0, np.log(3000.0)]
    for environment in environments:
        environment.close()


@pytest.mark.parametrize("task", [OwnAdvance, OwnTerm, OwnBlock, OwnUpdate])
def test_a_task_with_a_part_in_python_only_runs_in_python(task: type[Task]) -> None:
    environment = opened(EmbeddedSimulator(NAO, 3), task)
    assert not environment.compiled
    run(environment, 3)
    assert getattr(environment.task, "advances", 4) == 4  # once when the starts are loaded


def test_a_task_of_the_projects_parts_runs_compiled() -> None:
    compiled, plain = (opened(EmbeddedSimulator(NAO, 5), Composed, compiled=wanted, **FULL) for wanted in (True, False))
    assert compiled.compiled
    same(run(compiled, 60), run(plain, 60))


def test_lost_robots_keep_what_they_had(make_losing: Callable[[int], Simulator]) -> None:
    same(*(run(opened(make_losing(6), compiled=wanted), 40) for wanted in (True, False)))


@pytest.fixture
def make_losing() -> Callable[[int], Simulator]:
    class Losing(EmbeddedSimulator):
        steps = 0

        @property
        def lost(self) -> np.ndarray:
            return (np.arange(self.n) + self.steps) % 7 == 0

        def step_wait(self, rows: slice) -> None:
            super().step_wait(rows)
            self.steps += 1

    return lambda n: Losing(NAO, n)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([("fly", [], 1, [], None, 0)], "function fly: there is none of this name"),
        ([("sin", [0], 1, [], None, 0)], "function sin: no such argument"),
        ([("source", [], 1, [3.0], np.zeros((2, 3)), 0)], "function source: column out of range"),
        ([("constant", [], 2, [1.0], None, 0)], "function constant: one value a number is needed"),
        ([("source", [], 1, [0.0], np.zeros((3, 4)).T, 0)], "function source: the numbers of a row"),
    ],
)
def test_an_unknown_or_incomplete_function_is_named(nodes: list[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _compiled.Operation(nodes, [])


def test_arguments_that_do_not_fit_are_refused_where_an_expression_is_written() -> None:
    with pytest.raises(ValueError, match="add: 2 and 3 numbers do not fit"):
        source(np.zeros((4, 2))) + source(np.zeros((4, 3)))


@pytest.mark.parametrize("seed", [0, 7, 2**63 + 5])
def test_normal_numbers_are_sums_of_hashed_ones(seed: int) -> None:
    streams, draws, count = np.arange(9) * 17 - 3, np.arange(9) + 99, 5
    keys = (np.repeat(streams, 3 * count), np.repeat(draws, 3 * count), np.tile(np.arange(3 * count), 9))
    sums = hashed(seed, *keys).view(np.uint16).reshape(9, count, 12).sum(axis=2, dtype=np.float64)
    np.testing.assert_array_equal(normal(seed, streams, draws, count), (sums + 6.0) / 2.0**16 - 6.0)


def test_normal_numbers_are_added_to_some_rows() -> None:
    """As NumPy adds them, and never to a copy."""
    rng = np.random.default_rng(0)
    given, where, deviations = rng.normal(size=(9, 5)), rng.uniform(size=9) < 0.5, rng.uniform(size=9)
    streams, draws = np.arange(9), np.arange(9) + 99
    expected, found = given.copy(), given.copy()
    expected[where] += (deviations[:, None] * normal(3, streams, draws, 5))[where]
    add_normal(found, deviations, where, 3, streams, draws)
    assert found.tobytes() == expected.tobytes()
    for values in (given.astype(np.float32), given[:, :3], given[:4]):
        with pytest.raises((TypeError, ValueError)):
            add_normal(values, deviations, where, 3, streams, draws)


def reference_merge(moments: RunningMoments, batch: np.ndarray, mirror: Mirror | None = None) -> None:
    """Merge samples with NumPy, operation by operation."""
    k = len(batch)
    mean = batch.mean(axis=0)
    centred = batch - mean
    squares = np.einsum("ij,ij->j", centred, centred)
    if mirror is not None:
        half_gap = 0.5 * (mean - mirror.apply(mean))
        squares = 0.5 * (squares + squares[mirror.index]) + k * half_gap * half_gap
        mean = 0.5 * (mean + mirror.apply(mean))
    count = moments.count[0]
    total = count + k
    delta = mean - moments.mean
    variance = (moments.variance * count + squares + delta * delta * (count * k / total)) / total
    moments.load(moments.mean + delta * (k / total), variance, total)


@pytest.mark.parametrize("n", [1, 5, 64, 128, 300])
@pytest.mark.parametrize("mirrored", [False, True])
def test_normalization_has_the_bits_of_numpy(n: int, mirrored: bool) -> None:
    simulator = EmbeddedSimulator(NAO, 1, threads=2)
    observer = opened(simulator).observer
    width = len(observer.names)
    mirror = observer.mirror if mirrored else None
    normalizer = Normalizer(
        n,
        width,
        observations=True,
        observation_clip=3.0,
        rewards=True,
        gamma=0.97,
        mirror=mirror,
        threads=NativeHandle.threads_of(simulator),
    )
    seen, returned = RunningMoments(width), RunningMoments(1)
    returns = np.zeros(n)
    rng = np.random.default_rng(7)
    for _ in range(5):
        raw = rng.normal(rng.normal(size=width), rng.uniform(0.1, 30.0, width), (n, width))
        reference_merge(seen, raw, mirror)
        scaled = (raw - seen.mean) / np.sqrt(seen.variance + 1e-8)
        normalizer.update_observations(raw)
        np.testing.assert_array_equal(normalizer.observations(raw), np.clip(scaled, -3.0, 3.0).astype(np.float32))
        rewards, dones = rng.normal(0.0, 2.0, n), rng.random(n) < 0.2
        returns = returns * 0.97 + rewards
        reference_merge(returned, returns[:, None])
        expected = np.clip(rewards / np.sqrt(returned.variance[0] + 1e-8), -10.0, 10.0).astype(np.float32)
        np.testing.assert_array_equal(normalizer.rewards(rewards, dones), expected)
        returns[dones] = 0.0
    state = normalizer.state()
    np.testing.assert_array_equal(state["observation_mean"], seen.mean)
    np.testing.assert_array_equal(state["observation_variance"], seen.variance)
    np.testing.assert_array_equal(state["return_variance"], returned.variance)
    simulator.close()
