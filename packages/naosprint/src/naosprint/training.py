"""Train a sprint policy, from the start, from a checkpoint, or from another policy."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Literal

from naosim.simulator import ServerLostError

from naosprint.checkpoint import (
    ENVIRONMENT,
    LEARNER,
    POLICY,
    CheckpointError,
    TrainingState,
    read_file,
    read_manifest,
    require_like,
    save_checkpoint,
)
from naosprint.environment import open_training_batch
from naosprint.learner import SprintPPO, TrainingDivergedError
from naosprint.threads import set_learner_threads
from naosprint.transfer import refit
from naosprint.vec_env import SprintVecEnv

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from naospec import TrainingSpec

    from naosprint.arrays import AnyArray
    from naosprint.reporter import Reporter

__all__ = ["TrainResult", "TrainingDivergedError", "train"]

_STATISTICS = ("observation_mean", "observation_variance", "observation_count")

# what an update records, and the name under which it is reported
_LEARNER_FIGURES = {
    "train/policy_gradient_loss": "policy_loss",
    "train/value_loss": "value_loss",
    "train/approx_kl": "approx_kl",
    "train/clip_fraction": "clip_fraction",
    "train/explained_variance": "explained_variance",
    "train/std": "action_std",
}


@dataclass(frozen=True, slots=True)
class TrainResult:
    """Say how a training ended."""

    status: Literal["finished", "stopped"]
    """Whether all steps were taken, or the training was asked to stop."""
    steps: int
    """Steps that the last checkpoint stands for."""
    checkpoint: Path
    """The last checkpoint."""


def train(
    spec: TrainingSpec,
    *,
    workdir: Path,
    reporter: Reporter,
    resume: Path | None = None,
    initial_policy: Path | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> TrainResult:
    """Train a policy and leave checkpoints in ``workdir``.

    Args:
        spec: what to train and how.
        workdir: directory for checkpoints, ``step-000000000000`` and so on; made if it is missing.
        reporter: receives figures, checkpoints and log lines.
        resume: checkpoint to continue from; with the embedded simulator and the same numbers of threads the result is
            that of a training that never stopped, bit for bit. Only total_steps, checkpoint_interval_steps,
            max_server_failures and the numbers of threads may differ from its specification.
        initial_policy: checkpoint whose weights and observation statistics to start from; everything else is new.
        stop: asked between steps; once it says so, the training saves a checkpoint of the last complete update and
            returns. What the unfinished rollout had collected is given up.

    Returns:
        How it ended.

    Raises:
        CheckpointError: if a checkpoint is damaged or does not fit the specification.
        TrainingDivergedError: if a number is no longer finite; the checkpoints so far remain.
        naosim.ServerLostError: if more servers failed than ``max_server_failures``, or one does not start; the last
            complete update is saved.
        FileNotFoundError: if the server's program is not here.
        ValueError: if the specification cannot be met.
    """
    if resume is not None and initial_policy is not None:
        raise ValueError("resume and initial_policy exclude each other: a resumed training has its own policy")
    set_learner_threads(spec.torch_threads)
    batch, n_starts = open_training_batch(spec)
    try:
        env = SprintVecEnv.from_spec(spec, batch, n_starts)
        session = _Session(spec, env, workdir, reporter)
        if resume is not None:
            session.resume(resume)
        else:
            if initial_policy is not None:
                session.take_policy(initial_policy)
            session.ppo.begin()
        return session.run(stop)
    finally:
        batch.close()


class _Session:
    """Carry one training through rollouts, updates, reports and checkpoints."""

    def __init__(self, spec: TrainingSpec, env: SprintVecEnv, workdir: Path, reporter: Reporter) -> None:
        self.spec = spec
        self.env = env
        self.ppo = SprintPPO(spec, env)
        self._workdir = workdir
        self._reporter = reporter
        self._updates = 0
        self._training_s = 0.0
        self._saved_step: int | None = None
        env.on_loss = self._note_loss

    def run(self, stop: Callable[[], bool]) -> TrainResult:
        """Train until all steps are taken or ``stop`` says so."""
        spec, ppo = self.spec, self.ppo
        checkpoint = self._workdir / _name(ppo.num_timesteps)
        self._log(
            f"training {spec.task}, robot type {spec.robot_type}, {spec.simulator}, preset {spec.preset}: "
            f"{spec.n_envs} environments x {spec.n_steps} steps an update, to {spec.planned_steps:,} steps"
        )
        began_steps, began_s = ppo.num_timesteps, perf_counter()
        # a first checkpoint at once shows that saving works before hours depend on it
        if began_steps == 0:
            checkpoint = self._save(self._state())
        while ppo.num_timesteps < spec.planned_steps:
            before = self._state()
            began = perf_counter()
            try:
                complete = ppo.collect_rollouts(self.env, None, ppo.rollout_buffer, spec.n_steps, stop)
            except ServerLostError:
                self._save(before)
                raise
            if not complete:
                checkpoint = self._save(before)
                self._log(f"stopped at {before.steps:,} steps; the last complete update is saved")
                return TrainResult("stopped", before.steps, checkpoint)
            # servers drop robots that say nothing for a minute
            with self.env.batch.simulator.keep_alive():
                ppo.train()
                self._updates += 1
                self._training_s += perf_counter() - began
                self._report(began, began_steps, began_s)
                steps = ppo.num_timesteps
                interval = spec.checkpoint_interval_steps
                if steps // interval > before.steps // interval or steps >= spec.planned_steps:
                    checkpoint = self._save(self._state())
                    self._log(f"checkpoint at {steps:,} steps: {self._progress()}")
        if self._saved_step != ppo.num_timesteps:
            checkpoint = self._save(self._state())
        self._log(f"finished at {ppo.num_timesteps:,} steps after {self._training_s:.0f} s of training")
        return TrainResult("finished", ppo.num_timesteps, checkpoint)

    def resume(self, directory: Path) -> None:
        """Continue from the checkpoint in ``directory``."""
        manifest = read_manifest(directory)
        _require_same_training(directory, manifest.spec, self.spec)
        policy = read_file(directory, manifest, POLICY)
        learner = read_file(directory, manifest, LEARNER)
        self.ppo.begin()
        expected = self._state()
        require_like(directory / POLICY, policy, expected.policy)
        require_like(directory / LEARNER, learner, expected.learner)
        self.ppo.load_policy_state(_weights(policy))
        if ENVIRONMENT in manifest.files and expected.environment is not None:
            environment = read_file(directory, manifest, ENVIRONMENT)
            require_like(directory / ENVIRONMENT, environment, expected.environment)
            observations = self.env.load_state(environment)
        else:
            # this simulator cannot go back to where it was: new episodes, everything else continues
            self._reporter.log("warning", "the simulator's state is not part of the checkpoint; new episodes begin")
            self.env.normaliser.load_statistics({**self.env.normaliser.state(), **_statistics(policy)})
            observations = self.env.normaliser.observations(self.env.batch.observations)
        self.ppo.load_learner_state(learner, observations)
        self.ppo.num_timesteps = manifest.steps
        self._updates = manifest.updates
        self._training_s = manifest.training_s
        self._log(f"resumed at {manifest.steps:,} steps from {directory.name}")

    def take_policy(self, directory: Path) -> None:
        """Start from the weights and observation statistics of the checkpoint in ``directory``."""
        manifest = read_manifest(directory)
        batch = self.env.batch
        if manifest.spec.hidden_sizes != self.spec.hidden_sizes:
            theirs = list(manifest.spec.hidden_sizes)
            raise CheckpointError(
                f"{directory}: its policy has hidden_sizes {theirs}, this training has {list(self.spec.hidden_sizes)}; "
                f"set hidden_sizes to {theirs}"
            )
        policy: Mapping[str, AnyArray] = read_file(directory, manifest, POLICY)
        if (manifest.observations, manifest.actions) != (batch.observer.names, batch.actuation.names):
            policy = refit(
                policy,
                observations=(manifest.observations, batch.observer.names),
                actions=(manifest.actions, batch.actuation.names),
                rest=batch.actuation.rest,
            )
        require_like(directory / POLICY, policy, self._policy_arrays())
        self.ppo.load_policy_state(_weights(policy))
        normaliser = self.env.normaliser
        normaliser.load_statistics({**normaliser.state(), **_statistics(policy)})
        self._log(f"started from the policy of {directory.name} at {manifest.steps:,} steps")

    def _log(self, message: str) -> None:
        self._reporter.log("info", message)

    def _note_loss(self, row: int, reason: str) -> None:
        batch = self.env.batch
        self._reporter.log(
            "warning",
            f"environment {row}: episode cut off after {batch.steps[row]} steps, its server was lost: {reason}; "
            f"starting another ({batch.simulator.failures} of {self.spec.max_server_failures} allowed so far)",
        )

    def _progress(self) -> str:
        means = self.env.window.means()
        words = {"distance_m": "{:.2f} m", "speed_mps": "{:.2f} m/s", "fall_rate": "falls {:.0%}"}
        figures = [word.format(means[name]) for name, word in words.items() if name in means]
        return ", ".join(figures) or "no episode has ended yet"

    def _policy_arrays(self) -> dict[str, AnyArray]:
        statistics = self.env.normaliser.state()
        return {**self.ppo.policy_state(), **{name: statistics[name] for name in _STATISTICS}}

    def _state(self) -> TrainingState:
        environment = self.env.state()
        return TrainingState(
            steps=self.ppo.num_timesteps,
            updates=self._updates,
            episodes=self.env.window.episodes,
            training_s=self._training_s,
            observations=self.env.batch.observer.names,
            actions=self.env.batch.actuation.names,
            policy=self._policy_arrays(),
            learner=self.ppo.learner_state(),
            environment=environment if "batch.simulator" in environment else None,
        )

    def _save(self, state: TrainingState) -> Path:
        path = self._workdir / _name(state.steps)
        if self._saved_step != state.steps:
            save_checkpoint(path, self.spec, state)
            self._saved_step = state.steps
            self._reporter.checkpoint(path, state.steps)
        return path

    def _report(self, began: float, began_steps: int, began_s: float) -> None:
        ppo, spec = self.ppo, self.spec
        now = perf_counter()
        steps = ppo.num_timesteps
        overall = (steps - began_steps) / (now - began_s)
        figures = ppo.figures()
        row: dict[str, float] = {
            "step": float(steps),
            "time_s": self._training_s,
            "episodes": float(self.env.window.episodes),
            **self.env.window.means(),
            **{ours: figures[theirs] for theirs, ours in _LEARNER_FIGURES.items()},
            "entropy": -figures["train/entropy_loss"],
            "learning_rate": figures["train/learning_rate"],
            "steps_per_s": spec.rollout_steps / (now - began),
            "collect_s": ppo.collect_s,
            "learn_s": ppo.learn_s,
            "eta_s": max(spec.planned_steps - steps, 0) / overall,
        }
        if spec.simulator == "rcssserver3d":
            row["server_failures"] = float(self.env.batch.simulator.failures)
        self._reporter.metrics(row)


def _name(steps: int) -> str:
    return f"step-{steps:012d}"


def _weights(policy: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: value for name, value in policy.items() if name not in _STATISTICS}


def _statistics(policy: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: policy[name] for name in _STATISTICS}


_MAY_DIFFER = frozenset(
    {"total_steps", "checkpoint_interval_steps", "simulator_threads", "torch_threads", "max_server_failures"}
)


def _require_same_training(directory: Path, theirs: TrainingSpec, ours: TrainingSpec) -> None:
    for name in type(ours).model_fields:
        old, new = getattr(theirs, name), getattr(ours, name)
        if name not in _MAY_DIFFER and old != new:
            raise CheckpointError(
                f"{directory}: {name}: the checkpoint was trained with {old!r}, the specification says {new!r}; "
                "use the same specification, or start from its policy instead of resuming"
            )
