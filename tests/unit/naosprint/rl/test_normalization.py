"""Running statistics and normalization."""

from __future__ import annotations

import numpy as np
from naosprint.mirror import Mirror
from naosprint.rl.normalization import Normalizer, RunningMoments
from stable_baselines3.common.running_mean_std import RunningMeanStd


def test_moments_are_those_of_all_samples() -> None:
    """Merging batches gives mean and variance of everything seen."""
    rng = np.random.default_rng(0)
    data = rng.normal(3.0, 5.0, (5000, 4))
    moments = RunningMoments(4)
    for part in np.array_split(data, 37):
        moments.update(part)
    np.testing.assert_allclose(moments.mean, data.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(moments.variance, data.var(axis=0), rtol=1e-5)


def test_moments_agree_with_stable_baselines3() -> None:
    """The same numbers as the library's own, update by update."""
    rng = np.random.default_rng(1)
    ours, theirs = RunningMoments(3), RunningMeanStd(shape=(3,))
    for _ in range(20):
        batch = rng.normal(size=(8, 3))
        ours.update(batch)
        theirs.update(batch)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-12)
        np.testing.assert_allclose(ours.variance, theirs.var, rtol=1e-12)


def test_observations_are_standardized_and_clipped() -> None:
    """Zero mean, unit variance, nothing beyond the clip."""
    rng = np.random.default_rng(2)
    raw = rng.normal(100.0, 7.0, (4000, 2))
    normalizer = Normalizer(1, 2, observations=True, observation_clip=2.0, rewards=False, gamma=0.99)
    normalizer.update_observations(raw)
    seen = normalizer.observations(raw)
    assert seen.dtype == np.float32
    assert np.abs(seen.mean(axis=0)).max() < 0.05
    assert seen.max() == 2.0
    assert seen.min() == -2.0


def test_switched_off_it_passes_everything() -> None:
    """Without normalization the numbers do not change."""
    normalizer = Normalizer(2, 2, observations=False, observation_clip=1.0, rewards=False, gamma=0.99)
    raw = np.array([[50.0, -3.0], [1.0, 2.0]])
    normalizer.update_observations(raw)
    assert np.array_equal(normalizer.observations(raw), raw.astype(np.float32))
    assert np.array_equal(normalizer.rewards(raw[:, 0], np.zeros(2, bool)), raw[:, 0].astype(np.float32))


def test_rewards_are_scaled_by_the_spread_of_the_return() -> None:
    """After normalization of noise of any size the discounted return has unit variance."""
    rng = np.random.default_rng(3)
    normalizer = Normalizer(64, 1, observations=False, observation_clip=1.0, rewards=True, gamma=0.9)
    none_ended = np.zeros(64, dtype=bool)
    scaled = [normalizer.rewards(rng.normal(0.0, 40.0, 64), none_ended) for _ in range(500)]
    returns = np.zeros(64)
    tail = []
    for rewards in scaled[100:]:
        returns = returns * 0.9 + rewards
        tail.append(returns.copy())
    assert abs(np.std(tail[100:]) - 1.0) < 0.1


def test_finished_episodes_leave_nothing_in_the_return() -> None:
    """The discounted return starts over with an episode."""
    normalizer = Normalizer(2, 1, observations=False, observation_clip=1.0, rewards=True, gamma=0.9)
    normalizer.rewards(np.array([1.0, 1.0]), np.array([True, False]))
    assert normalizer.state()["returns"].tolist() == [0.0, 1.0]


def test_state_carries_over() -> None:
    """A second normalizer continues as the first."""
    rng = np.random.default_rng(4)
    settings = {"observations": True, "observation_clip": 5.0, "rewards": True, "gamma": 0.99}
    first, second = Normalizer(3, 2, **settings), Normalizer(3, 2, **settings)  # type: ignore[arg-type]
    for _ in range(5):
        first.update_observations(rng.normal(size=(3, 2)))
        first.rewards(rng.normal(size=3), np.array([False, True, False]))
    second.load_state(first.state())
    raw, rewards = rng.normal(size=(3, 2)), rng.normal(size=3)
    assert np.array_equal(first.observations(raw), second.observations(raw))
    none_ended = np.zeros(3, dtype=bool)
    assert np.array_equal(first.rewards(rewards, none_ended), second.rewards(rewards, none_ended))


def test_mirrored_moments_are_those_of_samples_and_images() -> None:
    """As if every sample had come with its mirror image, and the same on both sides, bit for bit."""
    mirror = Mirror.of_names(("step", "llj1", "rlj1", "yaw"), ("step", "rlj1", "llj1", "yaw"), (1.0, 1.0, 1.0, -1.0))
    plain, mirrored = RunningMoments(4), RunningMoments(4, mirror)
    rng = np.random.default_rng(3)
    for _ in range(4):
        batch = rng.normal([1.0, 2.0, -1.0, 0.5], [1.0, 0.5, 2.0, 1.0], (50, 4))
        plain.update(np.concatenate([batch, mirror.apply(batch)]))
        mirrored.update(batch)
    np.testing.assert_allclose(mirrored.mean, plain.mean, atol=1e-4)
    np.testing.assert_allclose(mirrored.variance, plain.variance, rtol=1e-4)
    np.testing.assert_array_equal(mirror.apply(mirrored.mean), mirrored.mean)
    assert mirrored.variance[1] == mirrored.variance[2]
    assert mirrored.mean[3] == 0.0
