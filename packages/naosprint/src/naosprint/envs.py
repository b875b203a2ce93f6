"""Tasks as Gymnasium environments, for training with other libraries.

``import naosprint`` registers one for every installed task::

    gymnasium.make("naosprint/Sprint-v0", robot="nao-1", start_noise_deg=5.0)
    gymnasium.make_vec("naosprint/Sprint1-v1", num_envs=64)

Observations and rewards are raw: neither normalized nor clipped by what a policy has seen.
"""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from naosim.simulator import STEP_S
from naospec import TrainingSpec, flat
from naospec.sections import as_mapping
from numpy.typing import NDArray

from naosprint.analysis.film import Film
from naosprint.analysis.replay import Replay
from naosprint.arrays import ByteArray, Float32Array
from naosprint.tasks.environment import open_environment

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosprint.arrays import BoolArray, FloatArray, IntArray

OBSERVATION_LIMIT = 1e6
"""Largest magnitude of an observation; far above that of any working robot."""

N_STARTS = 64
"""Starts that episodes begin from; each reset chooses one by the environment's own generator."""

_SECTIONS = ("task", "robot", "simulator")
_STREAMS = 2**31
_FPS = round(1.0 / STEP_S)


def specification(*, registered_task: str | None = None, **settings: Any) -> TrainingSpec:
    """Return the specification whose task, robot and simulator these settings choose.

    Args:
        registered_task: task that the environment's id names; ``task`` may have its settings, but no other name.
        **settings: ``task``, ``robot`` and ``simulator`` as names or as whole sections, and any of their settings by
            short name, for example ``min_height_m``. ``preset`` decides the task settings that are left out.

    Raises:
        pydantic.ValidationError: if a setting is impossible.
        TypeError: if task, robot and simulator have no setting of a name.
        ValueError: if ``task`` is not the one that the environment's id names.
    """
    if registered_task is not None:
        task = {"name": registered_task, **as_mapping(settings.get("task") or {})}
        if task["name"] != registered_task:
            raise ValueError(f"task: the id names {registered_task}, not {task['name']}; use the id of that task")
        settings["task"] = task
    base = {name: as_mapping(settings.pop(name)) for name in _SECTIONS if settings.get(name) is not None}
    paths = {name: setting.path for name, setting in flat.settings().items()}
    for name in settings:
        section, *fields = paths.get(name, name.split("."))
        if name != "preset" and (section not in _SECTIONS or len(fields) != 1):
            hint = "; give it to reset" if name == "seed" else ""
            raise TypeError(f"{name}: not a setting of task, robot or simulator{hint}")
    return TrainingSpec.model_validate(flat.nest(settings, base))


class _Robots:
    """Robots that do a task, each with a generator that everything random follows from.

    Attributes:
        seeded: (n,) robots whose generator is new; with the next episode their random numbers begin again.

    Raises:
        ValueError: if there is no such ``render_mode``, or the simulator does not report the bodies to draw.
    """

    def __init__(self, n: int, threads: int, render_mode: str | None, settings: dict[str, Any]) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected rgb_array or None, got {render_mode!r}")
        self.spec = specification(**settings)
        self.environment = open_environment(self.spec, n, threads=threads)
        weakref.finalize(self, self.environment.close)  # also where a program ends without it
        self._poses: list[list[FloatArray]] = [[] for _ in range(n)] if render_mode else []
        try:
            if render_mode and not self.environment.simulator.shapes:
                raise ValueError(
                    "render_mode: this simulator does not report the robot's bodies; use simulator='embedded'"
                )
            starts = self.environment.task.starts(N_STARTS, 0, self.spec.task.start_noise_deg)
            self.environment.load_starts(starts)
        except BaseException:
            self.environment.close()
            raise
        self._n_starts = len(starts)
        self.seeded: BoolArray = np.ones(n, dtype=np.bool_)
        self._metrics = [metric.name for metric in self.environment.task.metrics if metric.live]
        width, n_actions = len(self.environment.observer.names), self.environment.actuation.n_actions
        self.observation_space = spaces.Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, (width,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (n_actions,), np.float32)

    def observations(self) -> Float32Array:
        """Return the (n, D) observations."""
        return np.clip(self.environment.observations, -OBSERVATION_LIMIT, OBSERVATION_LIMIT).astype(np.float32)

    def restart(self, rows: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """Begin an episode with each of the robots ``rows``, from the start that its generator draws."""
        starts = np.zeros(len(self.seeded), dtype=np.int64)
        starts[rows] = [generators[row].integers(self._n_starts) for row in rows.tolist()]
        going, new = rows[~self.seeded[rows]], rows[self.seeded[rows]]
        self.environment.restart(going, starts[going])
        streams = [generators[row].integers(_STREAMS) for row in new.tolist()]
        self.environment.restart(new, starts[new], episodes=np.array(streams, dtype=np.int64))
        self.seeded[new] = False
        if self._poses:
            for row in rows.tolist():
                self._poses[row].clear()
            self._watch(rows)

    def step(self, actions: Float32Array, active: BoolArray | None = None) -> None:
        """Take one step of 20 ms with every active robot, with (n, A) actions.

        Raises:
            ValueError: if they are not as many numbers, or those of an active robot not finite.
            ResetNeeded: if a robot has not begun an episode.
        """
        values, shape = np.asarray(actions, dtype=np.float64), (len(self.seeded), *self.action_space.shape)
        if values.shape != shape:
            raise ValueError(f"actions: expected {shape[0]} x {shape[1]} numbers, got an array of shape {values.shape}")
        taken = np.ones(len(values), dtype=np.bool_) if active is None else active
        for row, column in np.argwhere(~np.isfinite(values) & taken[:, None]).tolist():
            name = self.environment.actuation.names[column]
            raise ValueError(f"actions: robot {row}, joint {name}: must be a finite number, not {values[row, column]}")
        if self.seeded.any():
            raise ResetNeeded("step: call reset first")
        self.environment.step(values, active)
        if self._poses:
            self._watch(np.flatnonzero(taken))

    def _watch(self, rows: IntArray) -> None:
        """Keep the poses of these robots, which are drawn."""
        bodies = self.environment.simulator.bodies()
        for row in rows.tolist():
            self._poses[row].append(bodies[row].copy())

    def info(self, row: int) -> dict[str, Any]:
        """Return the end and the task's metrics of an episode that has just ended."""
        environment = self.environment
        if environment.lost[row]:
            return {"server_lost": environment.simulator.loss_reason(row)}
        values = environment.task.measure(np.array([row]))[0]
        reached = [name for name, flags in environment.ends.items() if flags[row]]
        metrics = dict(zip(self._metrics, values.tolist(), strict=True))
        return {**metrics, "end": reached[0] if reached else "time_limit"}

    def picture(self, row: int) -> ByteArray:
        """Return the (H, W, 3) picture of a robot now. Raises RuntimeError before its first episode."""
        if not self._poses[row]:
            raise RuntimeError("render: call reset first")
        simulator, drawn = self.environment.simulator, np.array(self._poses[row], dtype=np.float32)
        replay = Replay(
            robot=simulator.robot,
            positions=drawn[:, :, :3],
            rotations=drawn[:, :, 3:7],
            foot_forces=np.zeros((len(drawn), 2), dtype=np.float32),
            end="",
            failed=False,
            objects=simulator.shapes[len(simulator.robot.shapes) :],
        )
        return Film(replay).picture(len(drawn) - 1)


class TaskEnv(gymnasium.Env[Float32Array, Float32Array]):
    """One robot that does a task.

    When an episode ends, ``info`` has the task's metrics of it and ``end``, the name of the end that was reached.

    Args:
        render_mode: ``rgb_array`` for pictures of the robot by :meth:`render`.
        **settings: see :func:`specification`.

    Raises:
        ValueError: if the simulator, a server, does not report where the robot's bodies are, or if there is no such
            ``render_mode``.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": ["rgb_array"],
        "render_fps": _FPS,
    }

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        self.render_mode = render_mode
        self._robots = _Robots(1, 1, render_mode, settings)
        self.observation_space = self._robots.observation_space
        self.action_space = self._robots.action_space

    @property
    def specification(self) -> TrainingSpec:
        """Task, robot and simulator with all their settings."""
        return self._robots.spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Begin an episode and return its first observation.

        Start, commands, disturbances and all else that is random follow from the environment's generator, and episodes
        after a reset with a seed are those after every other reset with it.
        """
        super().reset(seed=seed, options=options)
        self._robots.seeded |= seed is not None
        self._robots.restart(np.array([0]), [self.np_random])
        return self._robots.observations()[0], {}

    def step(self, action: Float32Array) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        """Take one step of 20 ms with the (A,) action in [-1, 1]."""
        environment = self._robots.environment
        self._robots.step(np.asarray(action)[None])
        terminated, truncated = bool(environment.terminated[0]), bool(environment.truncated[0])
        info = self._robots.info(0) if terminated or truncated else {}
        return self._robots.observations()[0], float(environment.rewards[0]), terminated, truncated, info

    def render(self) -> ByteArray | None:
        """Return the (H, W, 3) picture of the robot now, with time, distance and speed; None without a render mode.

        Raises:
            RuntimeError: if no episode has begun.
        """
        return None if self.render_mode is None else self._robots.picture(0)

    def close(self) -> None:
        """Close the simulator."""
        self._robots.environment.close()


class TaskVectorEnv(VectorEnv[Float32Array, Float32Array, NDArray[Any]]):
    """Robots that do a task in one simulator: the episodes of as many :class:`TaskEnv`, but faster.

    A robot whose episode has ended begins the next one in the next step, whose action is ignored
    (``AutoresetMode.NEXT_STEP``).

    Args:
        num_envs: number of robots.
        threads: threads of an embedded simulator.
        render_mode: as that of :class:`TaskEnv`, for a picture of each robot.
        **settings: see :func:`specification`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": _FPS,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, num_envs: int = 1, threads: int = 1, render_mode: str | None = None, **settings: Any) -> None:
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._robots = _Robots(num_envs, threads, render_mode, settings)
        self.single_observation_space = self._robots.observation_space
        self.single_action_space = self._robots.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators, self._seeds = map(list, zip(*(seeding.np_random() for _ in range(num_envs)), strict=True))
        self._ended: BoolArray = np.zeros(num_envs, dtype=np.bool_)

    @property
    def specification(self) -> TrainingSpec:
        """Task, robot and simulator with all their settings."""
        return self._robots.spec

    @property  # type: ignore[misc] # Gymnasium's own vector environments do so, too
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Generator of each robot."""
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Seeds of the generators, with which a reset begins the same episodes."""
        return tuple(self._seeds)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Begin an episode with every robot.

        Args:
            seed: seed of the first robot's generator, of which each following robot's is one more; or one seed each.
            options: ``reset_mask``, (n,) flags of the robots that begin one; the others continue. More is ignored.

        Raises:
            ValueError: if there are not as many seeds or flags as robots.
        """
        chosen = np.asarray((options or {}).get("reset_mask", self._ended | True))
        if chosen.shape != self._ended.shape or chosen.dtype != np.bool_:
            raise ValueError(f"reset_mask: expected {self.num_envs} flags, got {chosen.dtype} of shape {chosen.shape}")
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed: expected {self.num_envs} seeds, got {len(seeds)}")
            for row, one in enumerate(seeds):
                if one is not None and chosen[row]:
                    self._robots.seeded[row] = True
                    self._generators[row], self._seeds[row] = seeding.np_random(one)
        self._robots.restart(np.flatnonzero(chosen), self._generators)
        self._ended &= ~chosen
        return self._robots.observations(), {}

    def step(
        self, actions: Float32Array
    ) -> tuple[Float32Array, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Take one step of 20 ms with the (n, A) actions in [-1, 1]."""
        environment, again = self._robots.environment, self._ended
        if not again.all():
            self._robots.step(actions, ~again if again.any() else None)
        rewards = np.where(again, 0.0, environment.rewards)
        terminated, truncated = environment.terminated & ~again, environment.truncated & ~again
        infos: dict[str, Any] = {}
        for row in np.flatnonzero(terminated | truncated).tolist():
            infos = self._add_info(infos, self._robots.info(row), row)
        self._robots.restart(np.flatnonzero(again), self._generators)
        self._ended = terminated | truncated
        return self._robots.observations(), rewards, terminated, truncated, infos

    def render(self) -> tuple[ByteArray, ...] | None:
        """Return a (H, W, 3) picture of each robot, as :meth:`TaskEnv.render` does."""
        return None if self.render_mode is None else tuple(map(self._robots.picture, range(self.num_envs)))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the simulator."""
        del kwargs
        self._robots.environment.close()
