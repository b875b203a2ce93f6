"""Test the single Gymnasium environment."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from naospec import TrainingSpec
from naosprint.gym_env import SprintEnv
from stable_baselines3.common.env_checker import check_env as check_env_sb3


@pytest.mark.filterwarnings("ignore:.*infinity:UserWarning", "ignore:.*not implemented the `spec`:UserWarning")
@pytest.mark.filterwarnings("ignore:.*same rendering:UserWarning", "ignore:.*render_modes:UserWarning")
def test_checkers_are_content() -> None:
    """Both Gymnasium's and stable-baselines3's."""
    check_env(SprintEnv(), skip_render_check=True)
    check_env_sb3(SprintEnv(), warn=False)


def test_seed_decides_the_start() -> None:
    """The same seed gives the same first observation, another seed another."""
    env = SprintEnv()
    first, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    other, _ = env.reset(seed=2)
    following, _ = env.reset()
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(other, following)


def test_falling_ends_the_episode_and_says_so() -> None:
    """A random policy falls; the rewards add up to the distance."""
    env = SprintEnv(TrainingSpec(reward_scale=1.0, drift_penalty=0.0))
    env.reset(seed=0)
    env.action_space.seed(0)
    total, terminated = 0.0, False
    for _ in range(500):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total += reward
        assert not truncated
        if terminated:
            break
    assert terminated
    assert info["fallen"]
    assert total == pytest.approx(info["distance_m"], abs=1e-9)
    env.close()
