"""Offer the sprint task to stable-baselines3, without a process per environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from naosprint.episodes import EpisodeWindow
from naosprint.normalisation import Normaliser
from naosprint.starts import choose_starts
from naosprint.symmetry import Mirror

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from naospec import TrainingSpec

    from naosprint.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
    from naosprint.environment import SprintBatch


@dataclass(frozen=True, slots=True)
class Transition:
    """Say what one step of all environments brought; all arrays are the receiver's to keep."""

    observations: Float32Array
    """(n, D) normalised observations to act on next; those of a new episode where one ended."""
    rewards: Float32Array
    """(n,) normalised rewards."""
    dones: BoolArray
    """(n,) whether an episode ended."""
    cut_rows: IntArray
    """(k,) environments whose episode was cut off, rather than ended by a failure: by a time limit, say."""
    cut_observations: Float32Array
    """(k, D) their last normalised observations, to estimate what was still to come."""


class SprintVecEnv(VecEnv):
    """Step all environments of a batch, restart those whose episode ends, and normalise what the learner sees.

    :meth:`advance` is the fast way; :meth:`step` is stable-baselines3's and builds its list of info dictionaries.
    """

    def __init__(
        self, batch: SprintBatch, *, n_starts: int, seed: int, normaliser: Normaliser, bootstrap_at_end: bool = False
    ) -> None:
        self.batch = batch
        self.normaliser = normaliser
        self._bootstrap_at_end = bootstrap_at_end
        self.window = EpisodeWindow()
        self.on_loss: Callable[[int, str], None] = lambda row, reason: None
        """Called with environment and reason when an episode is cut off because its server was lost."""
        self.losses: dict[int, str] = {}
        """Why environments lost their server in the last step, by environment."""
        self._n_starts = n_starts
        self._seed = seed
        self._episode: IntArray = np.zeros(batch.n, dtype=np.int64)
        self._rewards: FloatArray = np.zeros(batch.n)
        self._actions: FloatArray = np.zeros((batch.n, batch.actuation.n_actions))
        width = len(batch.observer.names)
        super().__init__(
            batch.n,
            spaces.Box(-np.inf, np.inf, (width,), np.float32),
            spaces.Box(-1.0, 1.0, (batch.actuation.n_actions,), np.float32),
        )

    @classmethod
    def from_spec(cls, spec: TrainingSpec, batch: SprintBatch, n_starts: int) -> SprintVecEnv:
        """Build the environments' wrapper that ``spec`` asks for."""
        normaliser = Normaliser(
            batch.n,
            len(batch.observer.names),
            observations=spec.normalise_observations,
            observation_clip=spec.observation_clip,
            rewards=spec.normalise_rewards,
            gamma=spec.gamma,
            mirror=Mirror.of_names(batch.observer.names) if spec.symmetric_policy else None,
        )
        return cls(
            batch,
            n_starts=n_starts,
            seed=spec.seed,
            normaliser=normaliser,
            bootstrap_at_end=spec.bootstrap_at_end,
        )

    def reset(self) -> Float32Array:
        """Begin a new episode everywhere and return the (n, D) normalised observations."""
        self._restart(np.arange(self.num_envs))
        observations = self.batch.observations
        self.normaliser.learn_observations(observations)
        return self.normaliser.observations(observations)

    @property
    def groups(self) -> tuple[slice, ...]:
        """Environments that are best stepped together, in turns: see :class:`~naosprint.simulator.Simulator`."""
        return self.batch.simulator.groups

    def advance(self, actions: FloatArray | Float32Array) -> Transition:
        """Take one step with (n, A) actions, which are clipped to [-1, 1]."""
        self.batch.step(np.asarray(actions, dtype=np.float64))
        return self._transition(slice(0, self.num_envs))

    def send(self, actions: FloatArray | Float32Array, group: slice) -> None:
        """Begin a step of one group with (k, A) actions, which are clipped to [-1, 1]."""
        self.batch.send(np.asarray(actions, dtype=np.float64), group)

    def receive(self, group: slice) -> Transition:
        """Finish the step that :meth:`send` has begun; rows of the transition count from the group's first."""
        self.batch.receive(group)
        return self._transition(group)

    def _transition(self, rows: slice) -> Transition:
        """Account for the step that the environments ``rows`` have taken, and restart those whose episode is over."""
        batch = self.batch
        self._rewards[rows] += batch.rewards[rows]
        dones = batch.terminated[rows] | batch.truncated[rows]
        rewards = self.normaliser.rewards(batch.rewards[rows], dones, rows)
        ended = np.flatnonzero(dones)
        cut_rows = ended[~batch.fallen[rows][ended] if self._bootstrap_at_end else batch.truncated[rows][ended]]
        cut_raw = batch.observations[rows][cut_rows]
        self.losses = {}
        if len(ended):
            ended += rows.start
            self.losses = {row: batch.simulator.loss_reason(row) for row in ended[batch.lost[ended]].tolist()}
            # an episode that a broken server cut off, or that was only to practise the start, says nothing of the run
            told = ended[~batch.lost[ended] & ~batch.practises[ended]]
            self.window.add(
                rewards=self._rewards[told],
                distances_m=batch.displacement[told],
                steps=batch.steps[told].astype(np.float64),
                fallen=batch.fallen[told],
                durations_s=batch.elapsed_s()[told],
            )
            for row, reason in self.losses.items():
                self.on_loss(row, reason)
            self._restart(ended)
        observations = batch.observations[rows]
        self.normaliser.learn_observations(observations)
        return Transition(
            observations=self.normaliser.observations(observations),
            rewards=rewards,
            dones=dones,
            cut_rows=cut_rows,
            cut_observations=self.normaliser.observations(cut_raw),
        )

    def state(self) -> dict[str, AnyArray]:
        """Return everything that the environments' future depends on, actions aside."""
        parts = {"batch": self.batch.state(), "normaliser": self.normaliser.state(), "window": self.window.state()}
        state = {f"{part}.{key}": value for part, values in parts.items() for key, value in values.items()}
        state["episode"] = self._episode.copy()
        state["rewards"] = self._rewards.copy()
        return state

    def load_state(self, state: Mapping[str, AnyArray]) -> Float32Array:
        """Take over what :meth:`state` returned, and return the (n, D) normalised observations to act on next."""

        def part(name: str) -> dict[str, AnyArray]:
            return {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(f"{name}.")}

        self.batch.load_state(part("batch"))
        self.normaliser.load_state(part("normaliser"))
        self.window.load_state(part("window"))
        self._episode = np.array(state["episode"], dtype=np.int64)
        self._rewards = np.array(state["rewards"], dtype=np.float64)
        return self.normaliser.observations(self.batch.observations)

    def _restart(self, rows: IntArray) -> None:
        starts, following = (
            choose_starts(self._seed, self._n_starts, rows, self._episode[rows] + ahead) for ahead in (0, 1)
        )
        self.batch.restart(rows, starts, following)
        self._episode[rows] += 1
        self._rewards[rows] = 0.0

    # what stable-baselines3 asks of a vectorised environment

    def step_async(self, actions: np.ndarray[Any, Any]) -> None:
        """Keep (n, A) actions for :meth:`step_wait`."""
        self._actions = np.asarray(actions, dtype=np.float64)

    def step_wait(self) -> tuple[Float32Array, Float32Array, BoolArray, list[dict[str, Any]]]:
        """Take the step and return observations, rewards, dones and one info dictionary per environment."""
        lengths = self.batch.steps + 1
        sums = self._rewards.copy()
        transition = self.advance(self._actions)
        sums += self.batch.rewards
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(transition.dones).tolist():
            infos[row]["episode"] = {"r": float(sums[row]), "l": int(lengths[row]), "t": 0.0}
            infos[row]["TimeLimit.truncated"] = False
        for row, reason in self.losses.items():
            infos[row]["server_lost"] = reason
        for row, observation in zip(transition.cut_rows.tolist(), transition.cut_observations, strict=True):
            infos[row]["TimeLimit.truncated"] = True
            infos[row]["terminal_observation"] = observation
        return transition.observations, transition.rewards, transition.dones, infos

    def close(self) -> None:
        """Close the simulator."""
        self.batch.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Choose starts by another seed from the next episode on."""
        if seed is not None:
            self._seed = seed
        return [self._seed] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the batch, once per environment."""
        value = None if attr_name == "render_mode" else getattr(self.batch, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: the environments share one batch."""
        raise AttributeError(f"{attr_name}: environments of one batch have no attributes of their own")

    def env_method(
        self,
        method_name: str,
        *args: Any,
        indices: Any = None,
        **kwargs: Any,
    ) -> list[Any]:
        """Refuse: the environments share one batch."""
        raise AttributeError(f"{method_name}: environments of one batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for each environment: there is nothing to wrap."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]
