"""Tasks as Gymnasium environments."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import naosprint  # noqa: F401 - registers the environments
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from naosprint.envs import TaskEnv
from naosprint.registration import env_id
from pydantic import ValidationError
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_env_by_stable_baselines3

from .cleanrl_ppo import train

SPRINT = "naosprint/Sprint-v0"


def make(identity: str = SPRINT, **settings: object) -> TaskEnv:
    """Return the bare environment."""
    env = gymnasium.make(identity, **settings).unwrapped
    assert isinstance(env, TaskEnv)
    return env


def test_every_task_is_registered() -> None:
    names = {identity for identity in gymnasium.registry if identity.startswith("naosprint/")}
    assert {SPRINT, "naosprint/Sprint1-v1", "naosprint/Sprint2Erect-v1"} <= names
    assert env_id("run-backwards", 3) == "naosprint/RunBackwards-v3"
    assert make().specification.task.name == "sprint1"
    assert make("naosprint/Sprint2Erect-v1").specification.task.name == "sprint2-erect"


@pytest.mark.parametrize("settings", [{}, {"robot": "nao-4", "task": "sprint2"}])
def test_checkers_are_content(settings: dict[str, str]) -> None:
    """Both Gymnasium's and stable-baselines3's; a warning is an error here."""
    check_env(make(**settings))
    check_env_by_stable_baselines3(make(**settings))


@pytest.mark.parametrize("task", ["kick", {"name": "sprint2"}])
@pytest.mark.parametrize("make_envs", [gymnasium.make, gymnasium.make_vec])
def test_an_id_that_names_a_task_takes_no_other(make_envs: Callable[..., Any], task: object) -> None:
    with pytest.raises(ValueError, match="task: the id names sprint1, not "):
        make_envs("naosprint/Sprint1-v1", task=task)
    for same in ("sprint1", {"name": "sprint1", "min_height_m": 0.3}, {"min_height_m": 0.3}):
        envs = make_envs("naosprint/Sprint1-v1", task=same)
        assert envs.unwrapped.specification.task.name == "sprint1"
        envs.close()


def test_settings_choose_robot_task_and_simulator() -> None:
    env = make(robot="nao-3", task={"name": "sprint2", "drift_penalty": 0.25}, sensor_digits=3, min_height_m=0.3)
    spec = env.specification
    assert (spec.robot.name, spec.task.name, spec.simulator.sensor_digits) == ("nao-3", "sprint2", 3)
    assert (spec.task.drift_penalty, spec.task.min_height_m) == (0.25, 0.3)
    with pytest.raises(TypeError, match="colour: not a setting"):
        make(colour="red")
    with pytest.raises(ValidationError, match="choose one of"):
        make(robot="asimo")


def test_seed_decides_the_start() -> None:
    """The same seed gives the same first observation, another seed another."""
    env = make()
    first, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    other, _ = env.reset(seed=2)
    following, _ = env.reset()
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(other, following)


def test_a_seed_decides_everything_random_and_environments_differ() -> None:
    """Also what a training draws by robot: commands, pushes, noise, bodies."""
    settings = {"robot": "t1", "engine": "fast", "command_steps": 5, "push_mps": 1.0, "push_steps": 3,
                "sensor_noise": 1.0, "mass_variation": 0.2}  # fmt: skip
    still = np.zeros(21, dtype=np.float32)

    def episode(environment: Any, seed: int | None) -> bytes:
        first = environment.reset(seed=seed)[0]
        return np.array([first, *(environment.step(still)[0] for _ in range(12))]).tobytes()

    single, other = (gymnasium.make("naosprint/Velocity-v1", **settings) for _ in range(2))
    seen = [episode(single, seed) for seed in (7, None, 7, None, 8, None)]
    assert seen[:2] == seen[2:4] and len(set(seen)) == 4
    assert episode(other, 7) == seen[0]
    assert episode(other, None) == seen[1]
    fresh = [gymnasium.make("naosprint/Velocity-v1", **settings) for _ in range(2)]
    assert len({episode(environment, None) for environment in fresh}) == 2
    for environment in (single, other, *fresh):
        environment.close()


@pytest.mark.parametrize(
    "settings",
    [
        {"seed": 3},
        {"gamma": 0.9},
        {"n_envs": 64},
        {"learner_threads": 2},
        {"algorithm": "ppo"},
        {"algorithm.gamma": 0.9},
        {"task.a.b": 1},
    ],
)
def test_settings_that_change_nothing_of_an_environment_are_refused(settings: dict[str, Any]) -> None:
    (name,) = settings
    with pytest.raises(TypeError, match=f"{name}: not a setting of task, robot or simulator"):
        make(**settings)
    assert make(**{"task.min_height_m": 0.3, "preset": "paper"}).specification.task.min_height_m == 0.3
    with pytest.raises(TypeError, match=r"seed: .*; give it to reset"):
        make(seed=3)


@pytest.mark.parametrize("settings", [{"robot": "nao-1"}, {"robot": "t1", "engine": "fast"}])
def test_actions_that_are_not_numbers_for_every_robot_change_nothing(settings: dict[str, str]) -> None:
    envs, other = (gymnasium.make_vec(SPRINT, num_envs=4, **settings) for _ in range(2))
    still = np.zeros(envs.action_space.shape, dtype=np.float32)
    with pytest.raises(ResetNeeded):
        envs.step(still)
    for each in (envs, other):
        each.reset(seed=1)
    width = still.shape[1]
    for rows in (1, 3, 5):
        with pytest.raises(ValueError, match=rf"actions: expected 4 x {width} numbers, .* shape \({rows}, {width}\)"):
            envs.step(np.zeros((rows, width)))
    for wrong in (np.nan, np.inf):
        actions = still.copy()
        actions[2, 1] = wrong
        with pytest.raises(ValueError, match=rf"actions: robot 2, joint \w+: must be a finite number, not {wrong}"):
            envs.step(actions)
    for _ in range(5):
        for ours, theirs in zip(envs.step(still), other.step(still), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    envs.close()
    other.close()


def test_a_mask_restarts_only_its_robots() -> None:
    """As those of Gymnasium's own vector environments."""
    envs = gymnasium.make_vec(SPRINT, num_envs=3, robot="nao-1")
    still = np.zeros(envs.action_space.shape, dtype=np.float32)
    first, _ = envs.reset(seed=1)
    for _ in range(5):
        before = envs.step(still)[0]
    after, _ = envs.reset(seed=1, options={"reset_mask": np.array([True, False, True])})
    np.testing.assert_array_equal(after[[0, 2]], first[[0, 2]])
    np.testing.assert_array_equal(after[1], before[1])
    for mask in (np.ones(2, dtype=np.bool_), [0, 1, 1]):
        with pytest.raises(ValueError, match="reset_mask: expected 3 flags"):
            envs.reset(options={"reset_mask": mask})
    envs.close()


def test_the_seeds_that_were_drawn_begin_the_same_episodes() -> None:
    envs = gymnasium.make_vec(SPRINT, num_envs=3, robot="nao-1", start_noise_deg=2.0)
    first, _ = envs.reset()
    seeds = envs.unwrapped.np_random_seed
    assert len(set(seeds)) == len(envs.unwrapped.np_random) == 3
    assert (envs.reset()[0] != first).any()
    np.testing.assert_array_equal(envs.reset(seed=list(seeds))[0], first)
    envs.close()


def test_the_action_of_a_robot_that_waits_for_its_next_episode_may_be_anything() -> None:
    envs = gymnasium.make_vec(SPRINT, num_envs=2, robot="nao-1")
    envs.reset(seed=0)
    envs.action_space.seed(0)
    ended = np.zeros(2, dtype=np.bool_)
    while ended.sum() != 1:
        _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
        ended = terminated | truncated
    actions = envs.action_space.sample()
    actions[ended] = np.nan
    assert np.isfinite(envs.step(actions)[0]).all()
    with pytest.raises(ValueError, match="must be a finite number"):
        envs.step(actions)
    envs.close()


def test_falling_ends_the_episode_and_info_says_so() -> None:
    """A random policy falls; the rewards add up to the distance."""
    env = make(reward_scale=1.0, drift_penalty=0.0)
    env.reset(seed=0)
    env.action_space.seed(0)
    total, terminated = 0.0, False
    for _ in range(500):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total += reward
        assert not truncated
        if terminated:
            break
        assert info == {}
    assert terminated
    assert (info["end"], info["fall_rate"]) == ("fallen", 1.0)
    assert total == pytest.approx(info["distance_m"], abs=1e-9)
    env.close()
    env.close()


def test_the_vector_environment_is_as_many_single_ones() -> None:
    """Step for step, through the ends of episodes: observations, rewards, flags and infos."""
    together = gymnasium.make_vec(SPRINT, num_envs=4, robot="nao-1")
    single = gymnasium.make_vec(SPRINT, num_envs=4, robot="nao-1", vectorization_mode="sync")
    assert isinstance(single, SyncVectorEnv)
    assert not isinstance(together, SyncVectorEnv)
    assert together.metadata["autoreset_mode"] == single.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert together.single_observation_space == single.single_observation_space
    assert together.action_space == single.action_space
    for seed in (3, [5, 6, 7, 8], None):
        ours, theirs = together.reset(seed=seed), single.reset(seed=seed)  # type: ignore[arg-type]
        assert ours[1] == theirs[1] == {}
        if seed is not None:
            np.testing.assert_array_equal(ours[0], theirs[0])
        assert seed is None or together.np_random_seed == single.np_random_seed
    together.reset(seed=3)
    single.reset(seed=3)
    together.action_space.seed(0)
    ended = 0
    for _ in range(300):
        actions = together.action_space.sample()
        mine, known = together.step(actions), single.step(actions)
        for a, b in zip(mine[:4], known[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        assert mine[4].keys() == known[4].keys()
        for name, values in mine[4].items():
            np.testing.assert_array_equal(values, known[4][name])
        ended += int((mine[2] | mine[3]).sum())
    assert ended > 10
    with pytest.raises(ValueError, match="expected 4 seeds, got 2"):
        together.reset(seed=[1, 2])  # type: ignore[arg-type]
    together.close()
    single.close()


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        (SPRINT, {"robot": "nao-1", "sensor_noise": 1.0}),
        ("naosprint/Velocity-v1", {"robot": "t1", "command_steps": 2, "push_mps": 1.0, "push_steps": 5}),
    ],
)
def test_a_robot_that_waits_for_its_next_episode_draws_nothing(name: str, settings: dict[str, Any]) -> None:
    """Noise, pushes and commands of the episodes after the first are those of a robot alone, which never waits."""
    together = gymnasium.make_vec(name, num_envs=2, **settings)
    single = gymnasium.make_vec(name, num_envs=2, vectorization_mode="sync", **settings)
    together.reset(seed=3)
    single.reset(seed=3)
    together.action_space.seed(0)
    ended = 0
    while ended < 6:
        actions = together.action_space.sample()
        mine, known = together.step(actions), single.step(actions)
        for a, b in zip(mine[:4], known[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        ended += int((mine[2] | mine[3]).sum())
    together.close()
    single.close()


def test_stable_baselines3s_own_ppo_trains_on_it() -> None:
    model = PPO("MlpPolicy", gymnasium.make(SPRINT, task="sprint2"), n_steps=512, batch_size=64, device="cpu", seed=0)
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(2048)
    assert model.num_timesteps == 2048
    assert model.ep_info_buffer is not None and len(model.ep_info_buffer) > 10
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))


def one_by_one(n: int) -> VectorEnv:  # type: ignore[type-arg]
    return SyncVectorEnv([lambda: gymnasium.make(SPRINT) for _ in range(n)])


@pytest.mark.parametrize("make_envs", [one_by_one, lambda n: gymnasium.make_vec(SPRINT, num_envs=n)])
def test_cleanrls_ppo_trains_on_it(make_envs) -> None:  # type: ignore[no-untyped-def]
    """A single-file PPO in the manner of CleanRL, on separate environments and in one simulator."""
    envs = make_envs(4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record = train(envs, total_timesteps=4096, num_steps=256, seed=1)
    assert record.steps == 4096
    assert len(record.returns) > 10
    assert np.isfinite(record.losses).all()
    assert np.isfinite(record.returns).all()
    envs.close()


@pytest.mark.parametrize("robot", ["nao-0", "t1"])
def test_a_program_that_closes_nothing_ends_without_words(robot: str) -> None:
    code = (
        "import gymnasium\n"
        f"env = gymnasium.make('naosprint:naosprint/Sprint-v0', robot='{robot}')\n"
        f"envs = gymnasium.make_vec('naosprint:naosprint/Sprint-v0', num_envs=2, robot='{robot}')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_importing_the_package_loads_no_torch_and_needs_no_gymnasium() -> None:
    """The API describes tasks on machines that train nothing."""
    code = """
import sys
{block}
import naosprint.tasks.sprint
print("torch" in sys.modules, [name for name in sys.modules if name.startswith("gymnasium.envs")] != [])
"""
    without = (
        "import importlib.util as u; f = u.find_spec; u.find_spec = lambda n, *a: n != 'gymnasium' and f(n, *a) or None"
    )
    for block, registered in (("", "True"), (without, "False")):
        text = code.format(block=block)
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["False", registered]


def test_other_processes_make_environments_by_a_name_that_imports_them() -> None:
    """As those that SubprocVecEnv starts from a notebook, which have imported nothing."""
    code = (
        "import gymnasium\n"
        "from stable_baselines3.common.vec_env import SubprocVecEnv\n"
        "make = lambda: gymnasium.make('naosprint:naosprint/Sprint-v0')\n"
        "robots = SubprocVecEnv([make, make], start_method='spawn')\n"
        "assert robots.reset().shape == (2, *robots.observation_space.shape)\n"
        "robots.close()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize("robot", ["nao-0", "t1"])
def test_pictures_show_the_robot_and_where_it_is(robot: str) -> None:
    env = make(robot=robot, render_mode="rgb_array")
    with pytest.raises(RuntimeError, match="reset"):
        env.render()
    env.reset(seed=0)
    first = env.render()
    assert first is not None and first.shape == (400, 960, 3) and first.dtype == np.uint8
    limbs = first.max(axis=2).astype(int) - first.min(axis=2) > 80
    assert limbs.sum() > 500, "they are the only bright colors"
    assert 300 < np.flatnonzero(limbs.any(axis=0)).mean() < 660, "in the middle"
    for _ in range(20):
        env.step(np.full(env.action_space.shape, 0.5, dtype=np.float32))
    later = env.render()
    assert later is not None and (later != first).any(axis=2).sum() > 500
    env.reset(seed=0)
    assert np.array_equal(env.render(), first)
    env.close()


def test_each_robot_of_a_vector_environment_is_drawn_as_it_would_be_alone() -> None:
    envs = gymnasium.make_vec(SPRINT, num_envs=2, robot="nao-1", render_mode="rgb_array")
    singles = [make(robot="nao-1", render_mode="rgb_array") for _ in range(2)]
    envs.reset(seed=3)
    for i, env in enumerate(singles):
        env.reset(seed=3 + i)
    ended = [False, False]
    envs.action_space.seed(0)
    while not all(ended):
        actions = envs.action_space.sample()
        over = np.logical_or(*envs.step(actions)[2:4])
        for i, env in enumerate(singles):
            if ended[i]:
                env.reset()
            else:
                env.step(actions[i])
            ended[i] = bool(over[i])
        if any(over):
            assert all(map(np.array_equal, envs.render() or (), [env.render() for env in singles]))
            break
    envs.step(envs.action_space.sample())
    assert len(envs.render() or ()) == 2
    for each in (envs, *singles):
        each.close()
    with pytest.raises(ValueError, match="render_mode: expected rgb_array"):
        gymnasium.make_vec(SPRINT, num_envs=2, render_mode="human")


def test_without_a_render_mode_nothing_is_drawn() -> None:
    env = make()
    env.reset(seed=0)
    assert env.unwrapped.render() is None
    env.close()
    with pytest.raises(ValueError, match="render_mode: expected rgb_array"):
        TaskEnv(render_mode="human")
