"""Environments for learners: they restart automatically and yield raw observations and rewards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from naospec.metrics import EPISODE_METRICS

from naosprint.rl.learner import TrainingDivergedError
from naosprint.rl.processes import ALONE, Processes
from naosprint.rl.window import EpisodeWindow
from naosprint.tasks.environment import PERCEIVED, STORES
from naosprint.tasks.starts import choose_starts

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from naospec import TrainingSpec

    from naosprint.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
    from naosprint.tasks.environment import Environment


@dataclass(frozen=True, slots=True)
class Transition:
    """Outcome of one step of some environments; the arrays are the receiver's to keep.

    The observations to act on next are :attr:`TrainingEnvironment.observations`, those of a new episode where one
    ended.

    Attributes:
        rewards: (k,) raw rewards.
        dones: (k,) whether an episode ended.
        ended: (m,) rows of the environments whose episode ended, counted from the first of these environments.
        last_observations: (m, D) the last raw observations of these episodes.
        failed: (m,) whether they ended by a failure.
        truncated: (m,) whether they were truncated, so that the task itself would go on.
    """

    rewards: FloatArray
    dones: BoolArray
    ended: IntArray
    last_observations: FloatArray
    failed: BoolArray
    truncated: BoolArray


class TrainingEnvironment:
    """Environments that restart when their episode ends.

    Attributes:
        environment: the environments.
        processes: the processes of the training, of which this one has these environments.
        window: metrics of the latest episodes.
        on_loss: called with row and reason when an episode is truncated because its robot was lost.
        groups: environments that are best stepped together; see ``naosim.simulator.Simulator.groups``.
    """

    def __init__(
        self,
        environment: Environment,
        *,
        n_starts: int,
        seed: int,
        processes: Processes = ALONE,
    ) -> None:
        self.environment = environment
        self.processes = processes
        self.n = environment.n
        self.n_actions = environment.actuation.n_actions
        self.n_observations = environment.observations.shape[1]
        self.window = EpisodeWindow(
            [metric.name for metric in (*EPISODE_METRICS, *environment.task.metrics) if metric.live]
        )
        self.on_loss: Callable[[int, str], None] = lambda row, reason: None
        self.groups = environment.simulator.groups
        self._n_starts = n_starts
        self._seed = seed
        self._episode: IntArray = np.zeros(self.n, dtype=np.int64)
        self._rewards: FloatArray = np.zeros(self.n)
        none = np.zeros(0, np.bool_)
        self._nothing_ended = (np.zeros(0, np.int64), np.zeros((0, self.n_observations)), none, none)

    @classmethod
    def from_spec(
        cls, spec: TrainingSpec, environment: Environment, n_starts: int, processes: Processes = ALONE
    ) -> TrainingEnvironment:
        """Return the environments for a training, or the share of them that this process has."""
        return cls(environment, n_starts=n_starts, seed=spec.seed, processes=processes)

    def reset(self) -> None:
        """Begin a new episode everywhere."""
        self._restart(np.arange(self.n))

    @property
    def observations(self) -> FloatArray:
        """(n, D) raw observations to act on next; the next step overwrites them."""
        return self.environment.observations

    def step_async(self, actions: FloatArray | Float32Array, rows: slice) -> None:
        """Begin a step of one group with (k, A) actions."""
        self.environment.step_async(actions, rows)

    def step_wait(self, rows: slice) -> Transition:
        """Finish the step that :meth:`step_async` began for these environments.

        Raises:
            TrainingDivergedError: if a reward is not finite; the message names the term.
        """
        environment = self.environment
        environment.step_wait(rows)
        rewards = environment.rewards[rows].copy()
        if not np.isfinite(rewards).all():
            row = rows.start + int(np.flatnonzero(~np.isfinite(rewards))[0])
            raise TrainingDivergedError(
                f"{environment.not_finite(row)} of environment {row} is not finite after {environment.steps[row]} "
                "steps of its episode"
            )
        self._rewards[rows] += rewards
        dones = environment.terminated[rows] | environment.truncated[rows]
        (ended,) = dones.nonzero()
        if not len(ended):
            return Transition(rewards, dones, *self._nothing_ended)
        transition = Transition(
            rewards=rewards,
            dones=dones,
            ended=ended,
            last_observations=environment.observations[rows][ended],
            failed=environment.failed[rows][ended],
            truncated=environment.truncated[rows][ended],
        )
        self._record(ended + rows.start)
        self._restart(ended + rows.start)
        return transition

    def _record(self, ended: IntArray) -> None:
        """Measure the episodes that ended and report lost robots."""
        environment = self.environment
        # an episode of a lost robot, or one that was truncated to train the start, is not a whole run
        lost = environment.lost[ended]
        whole = ended[~(lost | environment.short[ended])]
        if len(whole):
            general = np.stack([self._rewards[whole], environment.steps[whole].astype(np.float64)], axis=1)
            self.window.add(np.concatenate([general, environment.measured(whole)], axis=1))
        for row in ended[lost].tolist():
            self.on_loss(row, environment.simulator.loss_reason(row))

    def _restart(self, rows: IntArray) -> None:
        episodes, following = self._episode[rows], None
        starts = choose_starts(self._seed, self._n_starts, rows, episodes)
        if self.environment.simulator.prepares_starts:
            following = choose_starts(self._seed, self._n_starts, rows, episodes + 1)
        self.environment.restart(rows, starts, following)
        self._episode[rows] += 1
        self._rewards[rows] = 0.0

    def state(self) -> dict[str, AnyArray]:
        """Return everything that the environments' future depends on, except actions."""
        parts = {
            "environment": self.environment.state(),
            "window": self.window.state(),
        }
        state = {f"{part}.{key}": value for part, values in parts.items() for key, value in values.items()}
        state["episode"] = self._episode.copy()
        state["rewards"] = self._rewards.copy()
        return state

    def upgraded_state(self, state: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
        """Return what :meth:`state` of an earlier version returned as this version's.

        Earlier ones lack what stores keep and the task does not name, and the noise that motors follow for one step:
        these continue as they are now.
        """
        added = (f"environment.{STORES}", f"environment.{PERCEIVED}")
        kept = {name: value for name, value in self.state().items() if name.startswith(added)}
        return {**kept, **state}

    def load_state(self, state: Mapping[str, AnyArray], *, new_episodes: bool = False) -> None:
        """Restore what :meth:`state` returned.

        Args:
            state: arrays by name.
            new_episodes: whether to restore only what outlives episodes, so that the next reset begins those after
                the ones of the state; for simulators that cannot return to it.
        """

        def part(name: str) -> dict[str, AnyArray]:
            return {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(f"{name}.")}

        self.environment.load_state(part("environment"), new_episodes=new_episodes)
        self.window.load_state(part("window"))
        self._episode = np.array(state["episode"], dtype=np.int64)
        self._rewards = np.array(state["rewards"], dtype=np.float64)

    def close(self) -> None:
        """Close the simulator."""
        self.environment.close()
