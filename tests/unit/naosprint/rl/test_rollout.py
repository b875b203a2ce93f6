"""Test the vectorised environment that stable-baselines3 sees."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint.environment import open_training_batch
from naosprint.vec_env import SprintVecEnv
from stable_baselines3 import PPO

Open = Callable[..., SprintVecEnv]


@pytest.fixture
def open_env(make_spec: Callable[..., TrainingSpec]) -> Iterator[Open]:
    """Return the maker of small vectorised environments."""
    opened: list[SprintVecEnv] = []

    def make(**fields: object) -> SprintVecEnv:
        spec = make_spec(**fields)
        opened.append(SprintVecEnv.from_spec(spec, *open_training_batch(spec)))
        return opened[-1]

    yield make
    for env in opened:
        env.close()


def test_stock_ppo_runs_on_it(open_env: Open) -> None:
    """Stable-baselines3's own loop accepts the environment."""
    env = open_env(task="sprint2")
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=32, n_epochs=1, device="cpu")
    model.learn(256)
    assert model.num_timesteps == 256


def test_step_and_advance_are_the_same(open_env: Open) -> None:
    """The library's way and the fast way give the same numbers."""
    ours, theirs = open_env(), open_env()
    assert np.array_equal(ours.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(150):
        actions = rng.uniform(-1, 1, (8, 20)).astype(np.float32)
        transition = ours.advance(actions)
        observations, rewards, dones, infos = theirs.step(actions)
        assert isinstance(observations, np.ndarray)
        assert np.array_equal(transition.observations, observations)
        assert np.array_equal(transition.rewards, rewards)
        assert np.array_equal(transition.dones, dones)
        for row in range(8):
            assert ("episode" in infos[row]) == bool(dones[row])
            ended += bool(dones[row])
    assert ended > 5


def test_episode_figures_are_those_of_the_episode(open_env: Open) -> None:
    """Length and return of an episode, counted by hand."""
    env = open_env(normalise_rewards=False, start_practice=0.0)
    env.reset()
    rng = np.random.default_rng(1)
    length, total = np.zeros(8, int), np.zeros(8)
    checked = 0
    for _ in range(150):
        _, rewards, dones, infos = env.step(rng.uniform(-1, 1, (8, 20)))
        length += 1
        total += rewards
        for row in np.flatnonzero(dones):
            assert infos[row]["episode"]["l"] == length[row]
            assert infos[row]["episode"]["r"] == pytest.approx(total[row], rel=1e-4, abs=1e-3)
            length[row], total[row] = 0, 0.0
            checked += 1
    assert checked > 5
    assert env.window.episodes == checked


def test_finished_robots_start_over_at_once(open_env: Open) -> None:
    """The observation after an end is the first of a new episode."""
    env = open_env(normalise_observations=False)
    env.reset()
    rng = np.random.default_rng(2)
    for _ in range(150):
        transition = env.advance(rng.uniform(-1, 1, (8, 20)))
        steps = transition.observations[:, 0]
        assert np.array_equal(steps == 0, transition.dones)


def test_returned_arrays_are_the_callers(open_env: Open) -> None:
    """A transition does not change when the environments go on."""
    env = open_env()
    env.reset()
    first = env.advance(np.zeros((8, 20)))
    observations, rewards, dones = first.observations.copy(), first.rewards.copy(), first.dones.copy()
    for _ in range(60):
        env.advance(np.random.default_rng(0).uniform(-1, 1, (8, 20)))
    assert np.array_equal(first.observations, observations)
    assert np.array_equal(first.rewards, rewards)
    assert np.array_equal(first.dones, dones)


def test_state_carries_over(open_env: Open) -> None:
    """A second environment continues as the first, through falls and restarts."""
    first, second = open_env(), open_env()
    first.reset()
    second.reset()
    rng = np.random.default_rng(3)
    for _ in range(50):
        first.advance(rng.uniform(-1, 1, (8, 20)))
    second.load_state(first.state())
    for _ in range(100):
        actions = rng.uniform(-1, 1, (8, 20))
        ours, theirs = first.advance(actions), second.advance(actions)
        assert np.array_equal(ours.observations, theirs.observations)
        assert np.array_equal(ours.rewards, theirs.rewards)
    assert first.window.means() == second.window.means()


@pytest.mark.parametrize("bootstrap", [True, False])
def test_end_that_is_no_fall_is_cut_off_where_asked(
    open_env: Open, bootstrap: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the finish line the last observation comes along, to value what would have followed; after a fall never."""
    env = open_env(bootstrap_at_end=bootstrap)
    batch = env.batch
    # a finish line so near that the first stumbles cross it
    monkeypatch.setattr(batch, "task", replace(batch.task, finish_x_m=-13.95))
    env.reset()
    rng = np.random.default_rng(4)
    arrivals = falls = 0
    for _ in range(200):
        step = batch.step
        ends: list[tuple[np.ndarray, np.ndarray]] = []

        def watch(*arguments: object, step: Callable[..., object] = step, ends: list[Any] = ends) -> object:
            observations = step(*arguments)
            ends.append((np.flatnonzero(batch.arrived), np.flatnonzero(batch.fallen)))
            return observations

        monkeypatch.setattr(batch, "step", watch)
        transition = env.advance(rng.uniform(-1, 1, (8, 20)))
        monkeypatch.setattr(batch, "step", step)
        (arrived, fallen) = ends[0]
        assert np.array_equal(transition.cut_rows, arrived if bootstrap else [])
        assert len(transition.cut_observations) == len(transition.cut_rows)
        assert set(np.flatnonzero(transition.dones)) == {*arrived, *fallen}
        arrivals, falls = arrivals + len(arrived), falls + len(fallen)
    assert arrivals > 0
    assert falls > 0


def test_environments_share_one_batch(open_env: Open) -> None:
    """What stable-baselines3 may ask of single environments is answered or refused."""
    env = open_env()
    assert env.get_attr("fall_height_m", [0, 1]) == [0.27, 0.27]
    assert env.env_is_wrapped(object) == [False] * 8
    with pytest.raises(AttributeError, match="of one batch"):
        env.set_attr("fall_height_m", 1.0)
    with pytest.raises(AttributeError, match="of one batch"):
        env.env_method("step")


def test_practised_starts_do_not_count_as_runs(open_env: Open) -> None:
    """What is reported of training speaks of whole episodes alone."""
    env = open_env(start_practice=0.5)
    env.reset()
    rng = np.random.default_rng(0)
    whole = practised = 0
    for _ in range(150):
        dones = env.advance(rng.uniform(-1, 1, (8, 20))).dones
        practised += int(dones[:4].sum())
        whole += int(dones[4:].sum())
    assert practised > 0
    assert env.window.episodes == whole > 0
