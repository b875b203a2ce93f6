"""Environments for learners: they restart automatically and normalize observations and rewards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from naosprint.rl.normalization import Normalizer
from naosprint.rl.processes import ALONE, Processes
from naosprint.rl.window import EpisodeWindow
from naosprint.tasks.base import EPISODE_METRICS
from naosprint.tasks.starts import choose_starts

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from naospec import TrainingSpec

    from naosprint.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
    from naosprint.tasks.environment import Environment

_NO_OBSERVATIONS: Float32Array = np.zeros((0, 0), np.float32)


@dataclass(frozen=True, slots=True)
class Transition:
    """Outcome of one step of some environments; the arrays are the receiver's to keep.

    Attributes:
        observations: (k, D) normalized observations to act on next; those of a new episode where one ended.
        rewards: (k,) normalized rewards.
        dones: (k,) whether an episode ended.
        bootstrapped: (m,) rows of environments whose episode ended and whose next value is estimated.
        last_observations: (m, D) their last normalized observations, to estimate the value of the next state.
    """

    observations: Float32Array
    rewards: Float32Array
    dones: BoolArray
    bootstrapped: IntArray
    last_observations: Float32Array


class TrainingEnvironment:
    """Environments that restart when their episode ends.

    Attributes:
        environment: the environments.
        normalizer: statistics of observations and returns.
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
        normalizer: Normalizer,
        bootstrap_at_end: bool = False,
        processes: Processes = ALONE,
    ) -> None:
        self.environment = environment
        self.processes = processes
        self.normalizer = normalizer
        self.n = environment.n
        self.n_actions = environment.actuation.n_actions
        self.n_observations = len(environment.observer.names)
        self.window = EpisodeWindow(
            [metric.name for metric in (*EPISODE_METRICS, *environment.task.metrics) if metric.live]
        )
        self.on_loss: Callable[[int, str], None] = lambda row, reason: None
        self.groups = environment.simulator.groups
        self._bootstrap_at_end = bootstrap_at_end
        self._n_starts = n_starts
        self._seed = seed
        self._episode: IntArray = np.zeros(self.n, dtype=np.int64)
        self._rewards: FloatArray = np.zeros(self.n)

    @classmethod
    def from_spec(
        cls, spec: TrainingSpec, environment: Environment, n_starts: int, processes: Processes = ALONE
    ) -> TrainingEnvironment:
        """Return the environments for a training, or the share of them that this process has."""
        settings = spec.algorithm
        normalizer = Normalizer(
            environment.n,
            len(environment.observer.names),
            observations=settings.normalize_observations,
            observation_clip=settings.observation_clip,
            rewards=settings.normalize_rewards,
            gamma=settings.gamma,
            mirror=environment.observer.mirror if settings.symmetric_policy else None,
            threads=environment.simulator.threads_address,
        )
        return cls(
            environment,
            n_starts=n_starts,
            seed=spec.seed,
            normalizer=normalizer,
            bootstrap_at_end=settings.bootstrap_at_end,
            processes=processes,
        )

    def reset(self) -> Float32Array:
        """Begin a new episode everywhere and return the (n, D) normalized observations."""
        self._restart(np.arange(self.n))
        observations = self.environment.observations
        self.normalizer.update_observations(observations)
        return self.normalizer.observations(observations)

    def observations(self) -> Float32Array:
        """Return the (n, D) observations to act on next, by the present statistics."""
        return self.normalizer.observations(self.environment.observations)

    def step_async(self, actions: FloatArray | Float32Array, rows: slice) -> None:
        """Begin a step of one group with (k, A) actions."""
        self.environment.step_async(actions, rows)

    def step_wait(self, rows: slice, out: Float32Array | None = None) -> Transition:
        """Finish the step that :meth:`step_async` began; rows of the transition count from the group's first.

        Args:
            rows: the group.
            out: (k, D) array for the transition's observations; a new one by default.
        """
        environment = self.environment
        environment.step_wait(rows)
        self._rewards[rows] += environment.rewards[rows]
        dones = environment.terminated[rows] | environment.truncated[rows]
        rewards = self.normalizer.rewards(environment.rewards[rows], dones, rows)
        ended = np.flatnonzero(dones)
        follows = ~environment.failed[rows] if self._bootstrap_at_end else environment.truncated[rows]
        bootstrapped = ended[follows[ended]]
        last_raw = environment.observations[rows][bootstrapped]
        if len(ended):
            ended += rows.start
            self._record(ended)
            self._restart(ended)
        observations = environment.observations[rows]
        self.normalizer.update_observations(observations)
        return Transition(
            observations=self.normalizer.observations(observations, out),
            rewards=rewards,
            dones=dones,
            bootstrapped=bootstrapped,
            last_observations=self.normalizer.observations(last_raw) if len(last_raw) else _NO_OBSERVATIONS,
        )

    def _record(self, ended: IntArray) -> None:
        """Measure the episodes that ended and report lost robots."""
        environment = self.environment
        # an episode of a lost robot, or one that was truncated to train the start, is not a whole run
        lost = environment.lost[ended]
        whole = ended[~(lost | environment.short[ended])]
        if len(whole):
            general = np.stack([self._rewards[whole], environment.steps[whole].astype(np.float64)], axis=1)
            self.window.add(np.concatenate([general, environment.task.measure(whole)], axis=1))
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
            "normalizer": self.normalizer.state(),
            "window": self.window.state(),
        }
        state = {f"{part}.{key}": value for part, values in parts.items() for key, value in values.items()}
        state["episode"] = self._episode.copy()
        state["rewards"] = self._rewards.copy()
        return state

    def load_state(self, state: Mapping[str, AnyArray]) -> Float32Array:
        """Restore what :meth:`state` returned, and return the (n, D) normalized observations to act on next."""

        def part(name: str) -> dict[str, AnyArray]:
            return {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(f"{name}.")}

        self.environment.load_state(part("environment"))
        self.normalizer.load_state(part("normalizer"))
        self.window.load_state(part("window"))
        self._episode = np.array(state["episode"], dtype=np.int64)
        self._rewards = np.array(state["rewards"], dtype=np.float64)
        return self.observations()

    def close(self) -> None:
        """Close the simulator."""
        self.environment.close()
