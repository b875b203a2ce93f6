"""Environments with the sprint tasks: rewards and ends of episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naosim.simspark import EmbeddedSimulator
from naosim.simulator import Starts
from naospec import TrainingSpec
from naosprint.tasks.base import RewardTerm, Task
from naosprint.tasks.environment import STORES, Environment, open_training_environment
from naosprint.tasks.measurements import Measurement, StoredNumbers
from naosprint.tasks.observations import ObservationBlock, blocks
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.sprint import Sprint1, Sprint2, SprintSettings
from naosprint.terms import Store, constant, maximum, source, stack, where

FALL = np.ones(20)
FALL[8:] = np.tile([0.0, 0.0, 1.0, -1.0, -1.0, 0.0], 2)


def environment_of(n: int, task: type[Task] = Sprint1, *, compiled: bool = True, **settings: float) -> Environment:
    """Return n standard robots at their starts, rewarded for forward displacement only."""
    robot = robots.get("nao-0")
    chosen = SprintSettings(name=task.name, drift_penalty=0.0).model_copy(update=settings)
    environment = Environment(EmbeddedSimulator(robot, n), task, task.resolve(chosen, robot), compiled=compiled)
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


# --- what stores keep -------------------------------------------------------------------------------------------------


class Forgetful(Sprint1):
    """A sprint whose reward depends on what its stores keep, which it does not name in ``arrays``."""

    def __init__(self, parameters: Any, world: Any, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        n = self.n
        self.best, self.first = source(np.full(n, -99.0)), source(np.zeros(n))
        self.gain, self.unknown, self.count = (source(np.zeros(n)) for _ in range(3))
        x, named = world.true_position[0], source(np.zeros(n))
        self.arrays["named"] = named.array
        best = maximum(self.best, x)
        own = [
            Store(self.gain, update=best - self.best),  # each step writes it before anything reads it
            Store(self.best, begin=x, update=best),
            Store(self.first, begin=x),
            Store(named, begin=x, update=named + self.gain),
            Store(self.unknown, begin=constant(np.nan), update=self.unknown + 1.0),
            Store(self.count, update=self.count + 1.0),  # over episodes
        ]
        self.measurements = (*self.measurements, StoredNumbers(own))

    def observation_blocks(self) -> Sequence[ObservationBlock]:
        """Return a mean that a block keeps, too."""
        mean, y = source(np.zeros((self.n, 1))), self.world.true_position[1]
        stores = [Store(mean, begin=y, update=0.9 * mean + 0.1 * y)]
        return [*blocks(self.world, ["step"]), ObservationBlock(("mean_y",), mean, stores=stores)]

    def reward_terms(self) -> Sequence[RewardTerm]:
        """Return the new part of the way."""
        value = stack(self.gain, self.first, where(self.count > 15.0, 1.0, 0.0)) * [1.0, 0.01, 0.5]
        return [RewardTerm("way", 1.0, value[0] + value[1] + value[2])]


@pytest.mark.parametrize("compiled", [True, False])
def test_what_stores_keep_continues_although_the_task_does_not_name_it(compiled: bool) -> None:
    """Of a block, too; what a step writes first is left out, and NaN, which files refuse elsewhere, is kept."""
    environments = [environment_of(3, Forgetful, compiled=compiled) for _ in range(2)]
    first, second = environments
    rng = np.random.default_rng(3)
    for _ in range(10):
        first.step(rng.uniform(-1, 1, (3, 20)))
    first.restart(np.array([1]), np.array([1]))
    first.step(rng.uniform(-1, 1, (3, 20)))
    state = first.state()
    kept = [name for name in state if name.startswith(STORES)]
    own = len(first.task.measurements) - 1
    assert kept == [f"{STORES}measurements.{own}.{k}" for k in (1, 2, 4, 5)] + [f"{STORES}blocks.mean_y.0"]
    assert all(np.isfinite(state[name]).all() for name in kept)
    second.load_state(state)
    task = second.task
    assert isinstance(task, Forgetful) and np.isnan(task.unknown.array).all()
    for _ in range(10):
        actions = rng.uniform(-1, 1, (3, 20))
        assert np.array_equal(first.step(actions), second.step(actions))
        assert np.array_equal(first.rewards, second.rewards)


def test_what_stores_keep_is_new_in_every_episode_of_an_evaluation() -> None:
    environment = environment_of(2, Forgetful)
    task = environment.task
    assert isinstance(task, Forgetful)
    for _ in range(3):
        environment.step(hold(environment))
    assert task.count.array.tolist() == [4.0, 4.0]  # one step is that in which starts are checked
    environment.restart(np.array([1]), np.array([1]), episodes=np.array([7]))
    assert task.count.array.tolist() == [4.0, 0.0]


class Watching(Measurement):
    """A measurement in Python, which may read any array."""

    def begin(self, rows: np.ndarray) -> None: ...

    def update(self, rows: slice) -> None: ...


def test_code_in_python_may_read_what_the_step_before_has_stored() -> None:
    class Watched(Forgetful):
        def __init__(self, parameters: Any, world: Any, seed: int = 0) -> None:
            super().__init__(parameters, world, seed)
            self.measurements = (*self.measurements[:-1], Watching(), self.measurements[-1])

    class Advancing(Forgetful):
        def advance(self, rows: slice) -> None:
            super().advance(rows)

    for task, left_out in ((Forgetful, True), (Watched, False), (Advancing, False)):
        environment = environment_of(1, task)
        last = len(environment.task.measurements) - 1
        assert (f"{STORES}measurements.{last}.0" not in environment.state()) == left_out


# --- parts that do not fit --------------------------------------------------------------------------------------------


def broken(**parts: Any) -> type[Task]:
    """Return a sprint with other parts."""

    class Broken(Sprint1):
        def __init__(self, parameters: Any, world: Any, seed: int = 0) -> None:
            super().__init__(parameters, world, seed)
            self.arrays |= parts.get("arrays", {})
            if "flags" in parts:
                self.flags = parts["flags"](self)

        def reward_terms(self) -> Sequence[RewardTerm]:
            return [*super().reward_terms(), *([RewardTerm("own", 0.5, parts["term"])] if "term" in parts else ())]

        def observation_blocks(self) -> Sequence[ObservationBlock]:
            usual = super().observation_blocks()
            if "block" not in parts:
                return usual
            return [*usual, ObservationBlock(("a", "b"), parts["block"], rates=parts.get("rates", False))]

    if "ended" in parts:
        Broken.ended = lambda self, rows: parts["ended"](rows)  # type: ignore[method-assign]
    return variant(Broken, **parts.get("attributes", {}))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"flags": lambda task: (task.flags[0],) * 3},
            r"task sprint1: flags has 3 arrays for 2 ends \(fallen, arrived\); one for each is needed",
        ),
        ({"flags": lambda task: (np.zeros(4), task.flags[1])}, "flags: end 'fallen' has float64 of shape"),
        (
            {"flags": lambda task: (task.flags[0], np.zeros((4, 1), dtype=bool))},
            "flags: end 'arrived' has bool of shape",
        ),
        ({"ended": lambda rows: (np.zeros(4, dtype=bool),)}, "task sprint1: ended returned 1 arrays for 2 ends"),
        ({"ended": lambda rows: (np.zeros(4, dtype=bool), np.zeros(4))}, "ended: end 'arrived' has float64 of shape"),
        (
            {"ended": lambda rows: (True, False)},
            r"ended: end 'fallen' has bool of shape \(\); a flag \(bool\) for each of 4",
        ),
        (
            {"term": source(np.zeros((4, 3)))},
            "task sprint1: reward term 'own' has 3 numbers for each robot; one is needed",
        ),
        (
            {"term": lambda rows: 0.5},
            r"task sprint1: the function of reward term 'own' returned an array of shape \(\); \(4,\), a row a robot",
        ),
        ({"term": lambda rows: np.zeros((4, 1))}, r"'own' returned an array of shape \(4, 1\)"),
        ({"block": lambda rows: np.zeros((4, 1))}, r"observations: a, b: the function returned .* \(4, 1\); \(4, 2\)"),
        ({"block": lambda rows: np.zeros((4, 1)), "rates": True}, r"observations: a, b: the function returned"),
        ({"block": lambda rows: np.zeros(2)}, r"observations: a, b: the function returned an array of shape \(2,\)"),
        (
            {"block": lambda rows: np.full((4, 2), "x")},
            "observations: a, b: the function returned an array of <U1; real",
        ),
        ({"term": lambda rows: np.full(4, None)}, "'own' returned an array of object; real numbers are needed"),
        ({"term": 3.0}, "reward term 'own' has value 3.0; an expression or a function of rows is needed"),
        (
            {"attributes": {"reward_terms": lambda task: [RewardTerm("own", np.nan, source(np.zeros(4)))]}},
            "task sprint1: reward term 'own' has weight nan; a finite number is needed",
        ),
        ({"attributes": {"reward_terms": lambda task: None}}, r"reward_terms returned \[None\]; a list of RewardTerm"),
        (
            {"attributes": {"observation_blocks": lambda task: ["height"]}},
            r"task sprint1: observation_blocks returned \['height'\]; a list of ObservationBlock is needed",
        ),
        (
            {"attributes": {"observation_blocks": lambda task: []}},
            "observations: none of the task's blocks has a number",
        ),
        ({"attributes": {"max_steps": 10.5}}, "task sprint1: max_steps is 10.5; a whole number from 1 is needed"),
        ({"attributes": {"max_steps": 0}}, "max_steps is 0; a whole number"),
        ({"attributes": {"__init__": lambda task, *_: None}}, "its __init__ has to call super"),
        ({"attributes": {"ended": lambda task, rows: None}}, "task sprint1: ended returned 0 arrays for 2 ends"),
        ({"attributes": {"succeeded": lambda task, rows: np.ones(4)}}, "task sprint1: succeeded has float64 of shape"),
        (
            {"attributes": {"starts": lambda task, *_: Starts(np.zeros((1, 3)))}},
            r"task sprint1: starts: expected Starts with finite angles of shape \(k, 22\), k from 1, got Starts of",
        ),
        ({"attributes": {"starts": lambda task, *_: None}}, r"got NoneType of shape \(\)"),
        (
            {"arrays": {"own": np.zeros(5)}},
            r"task sprint1: arrays: 'own' is ndarray of shape \(5,\); an array of numbers",
        ),
        ({"arrays": {"own": [0.0] * 4}}, "arrays: 'own' is list of shape"),
    ],
)
def test_a_part_that_does_not_fit_is_named(parts: dict[str, Any], message: str) -> None:
    """Where the task is opened, or where a function is called first."""
    with pytest.raises(ValueError, match=message):
        environment_of(4, broken(**parts)).step(np.zeros((4, 20)))


@pytest.mark.parametrize("wrong", [{"signs": (0.5,)}, {"spread": (0.0,)}, {"spread": (np.nan,)}], ids=str)
def test_a_sign_or_spread_that_is_none_is_named(wrong: dict[str, tuple[float]]) -> None:
    with pytest.raises(ValueError, match=r"observations: own: its sign is .*; a sign is 1 or -1, a spread positive"):
        ObservationBlock(("own",), source(np.zeros(4)), **wrong)


def test_flags_and_small_integers_add_up_as_numbers() -> None:
    """NumPy's sum of two flags is a flag, and that of two bytes a byte."""
    values = (
        np.ones(4, dtype=np.bool_),
        np.ones(4, dtype=np.bool_),
        *(np.full(4, 200, dtype=np.uint8),) * 2,
        [0.5] * 4,
    )
    terms = [RewardTerm(f"own {k}", 1.0, lambda rows, value=value: value) for k, value in enumerate(values)]
    environment = environment_of(4, variant(Sprint1, reward_terms=lambda task: terms), reward_scale=2.0)
    environment.step(hold(environment))
    assert environment.rewards.tolist() == [805.0] * 4


def test_a_measurement_of_another_width_is_named() -> None:
    class Wide(Sprint1):
        def measure(self, rows: np.ndarray) -> np.ndarray:
            return np.zeros((len(rows), 9))

    with pytest.raises(ValueError, match=r"task sprint1: measure, for distance_m, .* shape \(2, 9\); \(2, "):
        environment_of(2, Wide).measured(np.arange(2))
