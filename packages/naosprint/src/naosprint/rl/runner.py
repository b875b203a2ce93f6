"""Trainings: from the start, from a checkpoint, or from another policy."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, isfinite, nan
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from naosim.simulator import ServerLostError
from naospec.metrics import format_value

from naosprint import tasks
from naosprint.rl.checkpoint import (
    ENVIRONMENT,
    LEARNER,
    POLICY,
    CheckpointError,
    TrainingState,
    installed_versions,
    process_file,
    read_file,
    read_manifest,
    require_like,
    save_checkpoint,
)
from naosprint.rl.engines import EngineComparison
from naosprint.rl.learner import TrainingDivergedError, learner_kind
from naosprint.rl.plan import Segment, plan
from naosprint.rl.processes import ALONE, Processes
from naosprint.rl.reporter import NullReporter
from naosprint.rl.rollout import TrainingEnvironment
from naosprint.tasks.environment import open_training_environment
from naosprint.threads import set_learner_threads

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from naospec import TrainingSpec

    from naosprint.arrays import AnyArray
    from naosprint.rl.checkpoint import Manifest
    from naosprint.rl.policy import Policy
    from naosprint.rl.reporter import Reporter
    from naosprint.tasks.environment import Environment

__all__ = ["TrainResult", "TrainingDivergedError", "train"]


_SNAPSHOT = "environment.simulator"
"""Name of the simulator's snapshot among the environments' arrays."""

_STATISTICS = "normalizer."
"""Beginning of the names of statistics of observations and returns."""


@dataclass(frozen=True, slots=True)
class TrainResult:
    """How a training ended.

    Attributes:
        status: whether all steps were taken, or the training was asked to stop.
        steps: steps of the last checkpoint.
        checkpoint: the last checkpoint.
    """

    status: Literal["finished", "stopped"]
    steps: int
    checkpoint: Path


@dataclass(slots=True)
class _Progress:
    """Totals of a training."""

    steps: int = 0
    updates: int = 0
    episodes: int = 0
    training_s: float = 0.0
    left_out: set[str] = field(default_factory=set)
    """Metrics that have been named for a value that is no finite number."""


def train(
    spec: TrainingSpec,
    *,
    workdir: Path,
    reporter: Reporter,
    resume: Path | None = None,
    initial_policy: Path | None = None,
    stop: Callable[[], bool] = lambda: False,
    min_checkpoint_s: float = 0.0,
    processes: Processes = ALONE,
) -> TrainResult:
    """Train a policy and write checkpoints to ``workdir``.

    Args:
        spec: what to train and how.
        workdir: directory for checkpoints, ``step-000000000000`` and so on; made if it is missing.
        reporter: receives metrics, checkpoints and log lines.
        resume: checkpoint to continue from; with an embedded simulator and the same numbers of threads the result is
            that of a training that never stopped, bit for bit. Only total_steps and the runtime settings may differ
            from its specification.
        initial_policy: checkpoint whose weights and observation statistics to start from; everything else is new.
        stop: called between steps; once it returns true, the training saves a checkpoint of the last complete update
            and returns. The unfinished rollout is discarded.
        min_checkpoint_s: seconds between two checkpoints, however short the interval in steps is; those at the end of a
            stage and when the training stops are always saved.
        processes: the processes of this training; each calls this function with the same arguments, and reads
            checkpoints from the same folder. Only the first one writes and reports.

    Returns:
        How it ended.

    Raises:
        CheckpointError: if a checkpoint is damaged or does not fit the specification.
        TrainingDivergedError: if a number is no longer finite; the checkpoints so far remain.
        naosim.simulator.ServerLostError: if more servers failed than ``max_server_failures``, or one does not start;
            the last complete update is saved.
        FileNotFoundError: if the simulator's program is missing.
        ValueError: if the specification is impossible on this machine, or with this number of processes.
        ProcessLostError: if another process has ended; the checkpoints so far remain.
    """
    if resume is not None and initial_policy is not None:
        raise ValueError("resume and initial_policy exclude each other: a resumed training has its own policy")
    if processes.size > 1 and not learner_kind(spec.algorithm.name).several_processes:
        raise ValueError(f"algorithm: {spec.algorithm.name} trains in one process only")
    if processes.rank > 0:
        reporter = NullReporter()
    set_learner_threads(spec.runtime.learner_threads)
    segments, index, progress = plan(spec), 0, _Progress()
    if resume is not None:
        manifest = read_manifest(resume)
        _require_same_training(resume, manifest.spec, spec)
        index = manifest.stage
        if index >= len(segments):
            raise CheckpointError(
                f"{resume}: the checkpoint is of stage {index + 1}, the specification has {len(segments)}"
            )
        if manifest.steps >= segments[index].end and index + 1 < len(segments):
            # the end of this stage: the next one starts from its policy
            progress = _Progress(manifest.steps, manifest.updates, manifest.episodes, manifest.training_s)
            index, resume, initial_policy = index + 1, None, resume
    for segment in segments[index:]:
        environment, n_starts = open_training_environment(processes.share(segment.spec))
        try:
            session = _Session(
                spec, segment, progress, environment, n_starts, workdir, reporter, min_checkpoint_s, processes
            )
            session.start(resume, initial_policy)
            result = session.run(stop)
        finally:
            environment.close()
        if result.status == "stopped":
            break
        resume, initial_policy = None, result.checkpoint
    return result


class _Session:
    """One segment of a training: rollouts, updates, reports and checkpoints."""

    def __init__(
        self,
        whole: TrainingSpec,
        segment: Segment,
        progress: _Progress,
        environment: Environment,
        n_starts: int,
        workdir: Path,
        reporter: Reporter,
        min_checkpoint_s: float,
        processes: Processes,
    ) -> None:
        self.whole = whole
        self.processes = processes
        self.segment = segment
        self.spec = spec = segment.spec
        self.progress = progress
        self.first_step = segment.first_step
        self.environment = TrainingEnvironment.from_spec(processes.share(spec), environment, n_starts, processes)
        kind, task = learner_kind(spec.algorithm.name), tasks.get(spec.task.name)
        self.learner = kind.open(spec, self.environment)
        self._listed = [metric for metric in task.metrics if metric.name in task.presentation.listed]
        self._workdir = workdir
        self._reporter = reporter
        self._min_checkpoint_s = min_checkpoint_s
        self._engines = EngineComparison(spec)
        self._trained_before_s = 0.0  # in earlier sessions
        self._saved_at = -inf
        self._earlier = _Progress(progress.steps, progress.updates, progress.episodes)
        self._episodes_elsewhere = 0  # in the other processes
        # the last checkpoint of the segment before is also the state in which this one begins
        border = self.first_step > 0 and (workdir / _name(self.first_step)).exists()
        self._saved_step: int | None = self.first_step if border else None
        self.environment.on_loss = self._report_loss

    @property
    def steps(self) -> int:
        """Environment steps of all stages so far."""
        return self.first_step + int(self.learner.steps)

    @property
    def episodes(self) -> int:
        """Episodes of all stages so far."""
        return self._earlier.episodes + self.environment.window.episodes + self._episodes_elsewhere

    def start(self, resume: Path | None, initial_policy: Path | None) -> None:
        """Begin the first episodes, or continue: from a checkpoint of the segment, or from another policy."""
        if resume is not None:
            self.resume(resume)
            return
        if initial_policy is not None:
            self.warm_start(initial_policy)
        self.learner.begin()

    def run(self, stop: Callable[[], bool]) -> TrainResult:
        """Train until the segment's steps are taken or ``stop`` returns true."""
        spec, learner, progress = self.spec, self.learner, self.progress
        end = self.segment.end
        checkpoint = self._workdir / _name(self.steps)
        self._log(self._title())
        self._trained_before_s = progress.training_s
        began_steps, began_s = self.steps, perf_counter()
        # saving a checkpoint at once verifies early that saving works
        if began_steps == 0:
            checkpoint = self._save(self._state())
        while self.steps < end:
            before = self._state()
            waited_s = self.environment.environment.simulator_s
            began = perf_counter()
            try:
                complete = learner.collect(stop)
            except ServerLostError:
                if self.processes.size == 1:  # others would wait for this one
                    self._save(before)
                raise
            if self.processes.any(not complete):
                checkpoint = self._save(before)
                self._log(f"stopped at {before.steps:,} steps; the last complete update is saved")
                return TrainResult("stopped", before.steps, checkpoint)
            collected = perf_counter()
            # servers drop robots that are silent for a minute
            with self.environment.environment.simulator.keep_alive():
                metrics = learner.update()
                now = perf_counter()
                progress.training_s += now - began
                pace = {
                    "steps_per_s": spec.rollout_steps / (now - began),
                    "collect_s": collected - began,
                    "simulator_s": self.environment.environment.simulator_s - waited_s,
                    "learn_s": now - collected,
                    "eta_s": max(self.whole.planned_steps - self.steps, 0)
                    * (now - began_s)
                    / (self.steps - began_steps),
                }
                interval = spec.runtime.checkpoint_interval_steps
                saved = began_steps if self._saved_step is None else self._saved_step
                due = self.steps // interval > saved // interval and now >= self._saved_at + self._min_checkpoint_s
                due = self.processes.any(due and self.processes.rank == 0) or self.steps >= end
                self._report({**metrics, **(self._compared() if due else {})}, pace)
                if due:
                    checkpoint = self._save(self._state())
                    self._log(f"checkpoint at {self.steps:,} steps: {self._means()}")
        if self._saved_step != self.steps:
            checkpoint = self._save(self._state())
        progress.steps, progress.episodes = self.steps, self.episodes
        progress.updates = self._earlier.updates + learner.updates
        self._log(f"finished at {self.steps:,} steps after {progress.training_s:.0f} s of training")
        return TrainResult("finished", self.steps, checkpoint)

    def resume(self, directory: Path) -> None:
        """Continue from the checkpoint in ``directory``, which belongs to this segment."""
        manifest = read_manifest(directory)
        policy = read_file(directory, manifest, POLICY)
        learner: dict[str, AnyArray] = read_file(directory, manifest, LEARNER)
        self.learner.begin()
        expected = self._state()
        environment, file = None, ENVIRONMENT
        if manifest.processes != self.processes.size:
            # the environments are shared out again; everything else continues
            learner |= {name: expected.learner[name] for name in self.learner.own_state}
            environment = self._shared_out(directory, manifest, expected.environment)
        elif self.processes.rank > 0:
            file = process_file(self.processes.rank)
            own = read_file(directory, manifest, file)
            learner |= {name: own.pop(name) for name in self.learner.own_state}
            environment = own or None
        elif ENVIRONMENT in manifest.files:
            environment = read_file(directory, manifest, ENVIRONMENT)
        if ENVIRONMENT in manifest.files and not any(name.startswith(_STATISTICS) for name in learner):
            # checkpoints from before learners owned the statistics have them among the environments' arrays
            earlier = read_file(directory, manifest, ENVIRONMENT)
            learner |= {name: value for name, value in earlier.items() if name.startswith(_STATISTICS)}
        if environment is not None:
            environment = {name: value for name, value in environment.items() if not name.startswith(_STATISTICS)}
            environment = self.environment.upgraded_state(environment)
        require_like(directory / POLICY, policy, expected.policy)
        learner = dict(self.learner.upgraded_state(learner))
        require_like(directory / LEARNER, learner, expected.learner)
        self.learner.load_policy_state(policy)
        continues = environment is not None and _SNAPSHOT in environment and _SNAPSHOT in expected.environment
        if environment is not None:
            theirs, ours = (np.shape(arrays.get(_SNAPSHOT, ())) for arrays in (environment, expected.environment))
            if theirs != ours and manifest.versions.get("naosim") != installed_versions()["naosim"]:
                continues = False  # a snapshot by another version of the simulator
            both = (environment, expected.environment)
            loaded, needed = both if continues else map(_without_snapshot, both)
            # what a task stores and measures may be NaN, such as the place of a ball that was never seen
            require_like(directory / file, loaded, needed, finite=False)
            self.environment.load_state(environment, new_episodes=not continues)
        if not continues:
            # the simulator cannot return to that state, or the number of processes is another one
            self._reporter.log("warning", "the checkpoint has no state for this simulator; new episodes begin")
            if environment is not None:
                self.learner.begin()  # those after the checkpoint's
        self.learner.load_state(learner, new_episodes=not continues)
        self.learner.steps = manifest.steps - self.first_step
        self.learner.updates = manifest.updates
        self._window_means()
        self._earlier = _Progress(0, 0, manifest.episodes - self.environment.window.episodes - self._episodes_elsewhere)
        self.progress.training_s = manifest.training_s
        self._log(f"resumed at {manifest.steps:,} steps from {directory.name}")
        before, after = manifest.stage_spec.planned_steps, self.spec.planned_steps
        if before != after and (jumps := self.learner.jumps(manifest.stage_spec, self.learner.steps)):
            self._reporter.log(
                "warning",
                f"total_steps is {after:,} instead of {before:,}, which schedules follow at once: {', '.join(jumps)}; "
                "start from the policy instead of resuming for a schedule from its beginning",
            )

    def _shared_out(
        self, directory: Path, manifest: Manifest, expected: Mapping[str, AnyArray]
    ) -> dict[str, AnyArray] | None:
        """Return the arrays of this process's environments from those of all processes before, without snapshots."""
        if ENVIRONMENT not in manifest.files:
            return None
        others = (process_file(rank) for rank in range(1, manifest.processes))
        parts = [read_file(directory, manifest, file) for file in (ENVIRONMENT, *others)]
        found = dict(_without_snapshot(expected))
        for name, ours in found.items():
            theirs = [part[name] for part in parts if name in part]
            shapes = zip(theirs[0].shape, ours.shape, strict=False) if len(theirs) == len(parts) else ()
            # the axis along which there is a number for each environment; what has none begins again
            for axis in [axis for axis, (there, here) in enumerate(shapes) if there != here][:1]:
                rows = np.array_split(np.concatenate(theirs, axis), self.processes.size, axis)
                found[name] = rows[self.processes.rank]
        return found

    def warm_start(self, directory: Path) -> None:
        """Start from the weights and observation statistics of the checkpoint in ``directory``."""
        manifest = read_manifest(directory)
        environment = self.environment.environment
        algorithm = self.spec.algorithm
        if manifest.stage_spec.family != self.spec.family:
            raise CheckpointError(
                f"{directory}: its policy is for robot {manifest.stage_spec.robot.name}, this training is for "
                f"{self.spec.robot.name}; use a robot of family {manifest.stage_spec.family}"
            )
        if manifest.stage_spec.algorithm.name != algorithm.name:
            raise CheckpointError(
                f"{directory}: its policy was trained by algorithm {manifest.stage_spec.algorithm.name}, this training "
                f"uses {algorithm.name}; set algorithm to {manifest.stage_spec.algorithm.name}"
            )
        if (misfit := algorithm.misfit(manifest.stage_spec.algorithm)) is not None:
            name, theirs, ours = misfit
            raise CheckpointError(
                f"{directory}: its policy has {name} {theirs}, this training has {ours}; "
                f"set algorithm.{name} to {theirs}"
            )
        policy: Mapping[str, AnyArray] = read_file(directory, manifest, POLICY)
        try:
            policy = self.learner.adapt_policy(
                policy,
                observations=(manifest.observations, environment.observer.names),
                actions=(manifest.actions, environment.actuation.names),
                critic=(manifest.critic, environment.observer.critic_names),
            )
        except ValueError as error:
            raise CheckpointError(f"{directory}: {error}") from error
        require_like(directory / POLICY, policy, self.learner.policy_state())
        self.learner.load_policy_state(policy)
        self._log(f"started from the policy of {directory.name} at {manifest.steps:,} steps")

    def _compared(self) -> dict[str, float]:
        """Return the metrics of a comparison of the engines, if one is due."""
        if self.processes.rank > 0:
            return {}
        algorithm, environment = self.spec.algorithm, self.environment.environment
        kind = learner_kind(algorithm.name)

        def policy() -> Policy:
            observations, actions = environment.observer.names, environment.actuation.names
            state = self.learner.policy_state()
            return kind.load_policy(state, algorithm, observations=observations, actions=actions)

        return self._engines.compare(policy, self.progress.training_s - self._trained_before_s)

    def _title(self) -> str:
        spec = self.spec
        return (
            f"training {spec.task.name}, robot {spec.robot.name}, simulator {spec.simulator.name}, "
            f"{spec.algorithm.name} with preset {spec.algorithm.preset}{self.segment.title}: "
            f"{spec.algorithm.n_envs} environments x {spec.algorithm.n_steps} steps an update, "
            f"to {self.segment.end:,} steps"
        )

    def _log(self, message: str) -> None:
        self._reporter.log("info", message)

    def _report_loss(self, row: int, reason: str) -> None:
        environment = self.environment.environment
        self._reporter.log(
            "warning",
            f"environment {row}: episode truncated after {environment.steps[row]} steps, its server was lost: "
            f"{reason}; starting another ({environment.simulator.failures} of "
            f"{self.spec.runtime.max_server_failures} allowed so far)",
        )

    def _means(self) -> str:
        means = self.environment.window.means()
        words = [
            f"{metric.title.lower()} {format_value(metric, means[metric.name])}"
            for metric in self._listed
            if metric.name in means
        ]
        return ", ".join(words) or "no episode has ended yet"

    def _state(self) -> TrainingState:
        return TrainingState(
            stage=self.segment.stage,
            steps=self.steps,
            updates=self._earlier.updates + self.learner.updates,
            episodes=self.episodes,
            training_s=self.progress.training_s,
            observations=self.environment.environment.observer.names,
            actions=self.environment.environment.actuation.names,
            policy=self.learner.policy_state(),
            learner=self.learner.state(),
            environment=self.environment.state(),
            critic=self.environment.environment.observer.critic_names,
        )

    def _save(self, state: TrainingState) -> Path:
        path = self._workdir / _name(state.steps)
        if self._saved_step != state.steps:
            if self.processes.size > 1:
                own = {name: state.learner[name] for name in self.learner.own_state}
                state = replace(state, others=self.processes.gather({**state.environment, **own})[1:])
            if self.processes.rank == 0:
                save_checkpoint(path, self.whole, state)
                self._reporter.checkpoint(path, state.steps)
            self.processes.any(False)  # the others may read it from here on
            self._saved_step = state.steps
            self._saved_at = perf_counter()
        return path

    def _window_means(self) -> dict[str, float]:
        """Return the means over the latest episodes of all processes, and count their episodes."""
        window = self.environment.window
        means = window.means()
        if self.processes.size == 1:
            return means
        own = [float(window.episodes), float(bool(means)), *(means.get(name, 0.0) for name in window.names)]
        episodes, filled, *sums = self.processes.sum(np.array(own)).tolist()
        self._episodes_elsewhere = int(episodes) - window.episodes
        return {name: total / filled for name, total in zip(window.names, sums, strict=True)} if filled else {}

    def _report(self, metrics: Mapping[str, float], pace: Mapping[str, float]) -> None:
        """Report one update, without values that are no finite numbers."""
        row: dict[str, float] = {
            "step": float(self.steps),
            "time_s": self.progress.training_s,
            "episodes": float(self.episodes),
            **self.segment.labels,
            **self._window_means(),
            **metrics,
            **pace,
        }
        simulator = self.environment.environment.simulator
        if simulator.failures or simulator.can_fail:
            row["server_failures"] = float(simulator.failures)
        row |= {name: float(count) for name, count in simulator.counters.items()}
        environment = self.environment.environment
        grown = {"disturbance_strength": environment.disturbances.strength, "task_growth": environment.task.growth}
        row |= {name: value for name, value in grown.items() if value is not None}
        self._reporter.metrics(dict(self._finite(row)))

    def _finite(self, row: Mapping[str, float]) -> Iterator[tuple[str, float]]:
        """Yield the values that are finite numbers; name each metric once that has others, which stores cannot hold."""
        for name, value in row.items():
            try:
                number = float(value)
            except (TypeError, ValueError):
                number = nan
            if isfinite(number):
                yield name, number
            elif name not in self.progress.left_out:
                self.progress.left_out.add(name)
                message = f"metric {name} is {value!r} at {self.steps:,} steps: such values are left out from here on"
                self._reporter.log("warning", message)


def _without_snapshot(arrays: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: array for name, array in arrays.items() if name != _SNAPSHOT}


def _name(steps: int) -> str:
    return f"step-{steps:012d}"


def _require_same_training(directory: Path, theirs: TrainingSpec, ours: TrainingSpec) -> None:
    old, new = (_flattened(spec.model_dump(mode="json", exclude={"runtime", "total_steps"})) for spec in (theirs, ours))
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            raise CheckpointError(
                f"{directory}: {name}: the checkpoint was trained with {old.get(name)!r}, the specification has "
                f"{new.get(name)!r}; use the same specification, or start from its policy instead of resuming"
            )


def _flattened(content: Mapping[str, Any]) -> dict[str, Any]:
    return {
        f"{section}.{name}" if name else section: inner
        for section, value in content.items()
        for name, inner in (value.items() if isinstance(value, dict) else [("", value)])
    }
