"""Environments for learners: restarts, raw observations and rewards, metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint.rl.learner import TrainingDivergedError
from naosprint.rl.rollout import TrainingEnvironment, Transition
from naosprint.tasks.base import RewardTerm
from naosprint.tasks.environment import open_training_environment
from naosprint.tasks.sprint import Sprint1
from naosprint.terms import log

Open = Callable[..., TrainingEnvironment]


@pytest.fixture
def open_env(make_spec: Callable[..., TrainingSpec]) -> Iterator[Open]:
    """Return the maker of small training environments."""
    opened: list[TrainingEnvironment] = []

    def make(**settings: object) -> TrainingEnvironment:
        spec = make_spec(**settings)
        opened.append(TrainingEnvironment.from_spec(spec, *open_training_environment(spec)))
        return opened[-1]

    yield make
    for env in opened:
        env.close()


def advance(env: TrainingEnvironment, actions: np.ndarray) -> Transition:
    """Take one step with all robots."""
    everyone = slice(0, env.n)
    env.step_async(actions, everyone)
    return env.step_wait(everyone)


def test_episode_metrics_are_those_of_the_episode(open_env: Open) -> None:
    """Mean length and return over the window, counted by hand."""
    env = open_env(start_episode_fraction=0.0)
    env.reset()
    rng = np.random.default_rng(1)
    length, total = np.zeros(8), np.zeros(8)
    lengths: list[float] = []
    totals: list[float] = []
    for _ in range(150):
        transition = advance(env, rng.uniform(-1, 1, (8, 20)))
        length += 1
        total += transition.rewards
        for row in np.flatnonzero(transition.dones):
            lengths.append(length[row])
            totals.append(total[row])
            length[row], total[row] = 0, 0.0
        if lengths:
            means = env.window.means()
            assert means["episode_length"] == pytest.approx(np.mean(lengths[-100:]))
            assert means["reward"] == pytest.approx(np.mean(totals[-100:]), rel=1e-4, abs=1e-3)
    assert env.window.episodes == len(lengths) > 5


def test_task_metrics_are_those_of_the_runs(open_env: Open) -> None:
    """The window contains the task's metrics of whole episodes."""
    env = open_env(start_episode_fraction=0.0)
    env.reset()
    rng = np.random.default_rng(1)
    task = env.environment.task
    measured: list[np.ndarray] = []
    measure = task.measure

    def watch(rows: np.ndarray) -> np.ndarray:
        values = measure(rows)
        measured.extend(values)
        return values

    task.measure = watch  # type: ignore[method-assign]
    for _ in range(100):
        advance(env, rng.uniform(-1, 1, (8, 20)))
    names = [metric.name for metric in task.metrics if metric.live]
    expected = dict(zip(names, np.mean(measured[-100:], axis=0), strict=True))
    means = env.window.means()
    assert {name: means[name] for name in names} == pytest.approx(expected)
    assert means["distance_m"] != 0.0


def test_finished_robots_start_over_at_once(open_env: Open) -> None:
    """The observation after an end is the first of a new episode."""
    env = open_env()
    env.reset()
    rng = np.random.default_rng(2)
    for _ in range(150):
        transition = advance(env, rng.uniform(-1, 1, (8, 20)))
        steps = env.observations[:, 0]
        assert np.array_equal(steps == 0, transition.dones)


def test_returned_arrays_are_the_callers(open_env: Open) -> None:
    """A transition does not change with the next steps."""
    env = open_env()
    env.reset()
    first = advance(env, np.zeros((8, 20)))
    rewards, dones = first.rewards.copy(), first.dones.copy()
    for _ in range(60):
        advance(env, np.random.default_rng(0).uniform(-1, 1, (8, 20)))
    assert np.array_equal(first.rewards, rewards)
    assert np.array_equal(first.dones, dones)


def test_state_carries_over(open_env: Open) -> None:
    """A restored environment continues like the first, through falls and restarts."""
    first, second = open_env(), open_env()
    first.reset()
    second.reset()
    rng = np.random.default_rng(3)
    for _ in range(50):
        advance(first, rng.uniform(-1, 1, (8, 20)))
    second.load_state(first.state())
    for _ in range(100):
        actions = rng.uniform(-1, 1, (8, 20))
        ours, theirs = advance(first, actions), advance(second, actions)
        assert np.array_equal(first.observations, second.observations)
        assert np.array_equal(ours.rewards, theirs.rewards)
    assert first.window.means() == second.window.means()


def test_ends_are_told_apart(open_env: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fall is a failure, the finish line is none; both come with the episode's last observations."""
    # a finish line so near that the first stumbles cross it
    monkeypatch.setattr(Sprint1, "finish_x_m", -13.95)
    env = open_env(start_episode_fraction=0.0)
    env.reset()
    ended: dict[str, list[int]] = {}
    measure = env.environment.task.measure

    def watch(rows: np.ndarray) -> np.ndarray:
        for name, flags in env.environment.ends.items():
            ended[name] = rows[flags[rows]].tolist()
        return measure(rows)

    env.environment.task.measure = watch  # type: ignore[method-assign]
    rng = np.random.default_rng(4)
    arrivals = falls = 0
    for _ in range(200):
        ended.update(fallen=[], arrived=[])
        transition = advance(env, rng.uniform(-1, 1, (8, 20)))
        assert transition.ended.tolist() == np.flatnonzero(transition.dones).tolist()
        assert set(transition.ended) == {*ended["arrived"], *ended["fallen"]}
        assert transition.ended[~transition.failed].tolist() == ended["arrived"]
        assert not transition.truncated.any()
        assert len(transition.last_observations) == len(transition.ended)
        assert (transition.last_observations[:, 0] > 0).all(), "steps since the start: of the episode that ended"
        arrivals, falls = arrivals + len(ended["arrived"]), falls + len(ended["fallen"])
    assert arrivals > 0
    assert falls > 0


def test_short_episodes_do_not_count(open_env: Open) -> None:
    """Metrics are those of whole episodes only."""
    env = open_env(start_episode_fraction=0.5)
    env.reset()
    rng = np.random.default_rng(0)
    whole = short = 0
    for _ in range(150):
        dones = advance(env, rng.uniform(-1, 1, (8, 20))).dones
        short += int(dones[:4].sum())
        whole += int(dones[4:].sum())
    assert short > 0
    assert env.window.episodes == whole > 0


def test_a_reward_that_is_not_finite_is_named_by_its_term(open_env: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a task of expressions as in one in Python, and before the learner's loss, which names the learning rate."""
    usual = Sprint1.reward_terms

    def in_python(task: Sprint1) -> RewardTerm:
        return RewardTerm("own", 0.5, lambda rows: np.where(np.arange(8)[rows] == 3, np.inf, 0.0))

    def compiled(task: Sprint1) -> RewardTerm:
        return RewardTerm("own", 0.5, log(2.5 - task.world.step))

    for term, step, row in ((in_python, 1, 3), (compiled, 3, 0)):
        monkeypatch.setattr(Sprint1, "reward_terms", lambda task, term=term: [*usual(task), term(task)])
        env = open_env()
        env.reset()
        for _ in range(step - 1):
            advance(env, np.zeros((8, 20)))
        message = f"task sprint1: reward term 'own' of environment {row} is not finite after {step} steps"
        with pytest.raises(TrainingDivergedError, match=message):
            advance(env, np.zeros((8, 20)))


def test_a_measurement_that_does_not_fit_the_metrics_is_named(open_env: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Sprint1, "measure", lambda task, rows: np.zeros((len(rows), 9)))
    env = open_env(start_episode_fraction=0.0)
    env.reset()
    rng = np.random.default_rng(1)
    with pytest.raises(ValueError, match="task sprint1: measure, for distance_m,"):
        for _ in range(150):
            advance(env, rng.uniform(-1, 1, (8, 20)))
