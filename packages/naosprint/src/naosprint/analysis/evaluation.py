"""Evaluation of a policy: episodes without exploration, and the results that the task defines.

The document of an evaluation, ``evaluation.json``, describes itself: every result has its title, unit, digits and
meaning, so that it can be shown without the task.
"""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from dataclasses import dataclass, fields
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from naosim import kinds
from naosim.npz import write_npz
from naosim.simulator import STEP_S, ServerLostError
from naospec import EvaluationSpec, formats, plugins
from naospec.files import together, write_whole
from naospec.json_text import json_text
from naospec.metrics import EPISODE_METRICS, Result, ResultTable, for_family

from naosprint import tasks
from naosprint.analysis.replay import Replay
from naosprint.rl.policy import load_policy
from naosprint.tasks.environment import open_environment
from naosprint.tasks.episodes import Episodes, Statistics
from naosprint.tasks.observations import require_numbers
from naosprint.terms.randomness import Normals
from naosprint.threads import one_blas_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from naospec import TrainingSpec

    from naosprint.arrays import BoolArray, Float32Array, FloatArray, IntArray
    from naosprint.rl.checkpoint import Manifest
    from naosprint.rl.policy import Policy
    from naosprint.tasks import Task
    from naosprint.tasks.environment import Environment

logger = logging.getLogger(__name__)

FORMAT = formats.CURRENT[formats.Kind.RESULT]
"""Version of the evaluation's document."""

REPLAY_CANDIDATES = 5
"""Number of first episodes of which the median one is kept as a replay."""

_DROPPED = -1  # episode number of samples that no longer count

_UNSEEN = 2**31  # larger than every seed of a training


@dataclass(frozen=True)
class Trajectories:
    """Paths of episodes, padded with NaN to the longest; the sample at index 0 is the start.

    Attributes:
        x, y, height: (k, T) torso position in metres.
        left_foot_force, right_foot_force: (k, T) upward force in newtons; 0 without contact.
        joint_angles: (T', A) perceived joint angles of the first episode in radians, policy convention.
        failed: (k,) whether the episode ended by a failure.
    """

    x: Float32Array
    y: Float32Array
    height: Float32Array
    left_foot_force: Float32Array
    right_foot_force: Float32Array
    joint_angles: Float32Array
    failed: BoolArray

    def save(self, path: Path) -> None:
        """Write the arrays to an ``.npz`` file."""
        write_npz(path, {**{each.name: getattr(self, each.name) for each in fields(self)}, "cycle_s": np.array(STEP_S)})


@dataclass(frozen=True)
class EvaluationRun:
    """Results of an evaluation and some of its trajectories.

    Attributes:
        summary: all results, ready for JSON; a result that no episode supports has the value None.
        trajectories: paths of the first episodes.
        replay: the median one of the first few episodes.
        warnings: names of results whose number is not finite, and what it is instead.
    """

    summary: dict[str, Any]
    trajectories: Trajectories
    replay: Replay
    warnings: tuple[str, ...] = ()

    def to_json(self) -> str:
        """Return the summary as JSON."""
        return json_text(self.summary)

    def result(self, name: str) -> float | None:
        """Return the value of a result.

        Raises:
            KeyError: if there is no result of that name.
        """
        values: dict[str, float | None] = {result["name"]: result["value"] for result in self.summary["results"]}
        return values[name]

    @together()
    def save(self, directory: Path) -> tuple[Path, ...]:
        """Write ``evaluation.json``, ``trajectories.npz`` and the replay to ``directory`` and return their paths."""
        directory.mkdir(parents=True, exist_ok=True)
        results, paths = directory / "evaluation.json", directory / "trajectories.npz"
        write_whole(results, self.to_json())
        self.trajectories.save(paths)
        return (results, paths, *self.replay.save(directory))


def evaluate(
    checkpoint: Path,
    spec: EvaluationSpec,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> EvaluationRun:
    """Run the policy of a checkpoint and return the results.

    The same checkpoint and specification give the same results with an embedded simulator, whatever the number of
    environments, since random numbers follow from seed and episode: on every x86-64 processor
    for a NAO, on the same machine for a Booster and for a NAO with onboard sensing. At most as many servers are started
    as the machine's cores can run, and an episode whose server fails is run again on a new one.

    Args:
        checkpoint: checkpoint directory.
        spec: how to evaluate.
        threads: threads of the embedded simulator; they change no result.
        progress: called with the episodes done and their total whenever some are done.
        stop: called between steps; once it returns true, the evaluation ends with :class:`InterruptedError`.

    Raises:
        CheckpointError: if the checkpoint is damaged.
        InterruptedError: if ``stop`` returned true.
        FileNotFoundError: if the simulator's program is missing.
        naosim.simulator.ServerLostError: if more servers failed than the training's ``max_server_failures``, or one
            episode lost its robot more often, which one that diverges does in every run.
        ValueError: if the policy does not fit the task, or the task returns results that it does not declare.
    """
    policy, manifest = load_policy(checkpoint)
    setting = spec.applied_to(manifest.stage_spec)
    seed = _held_out(spec.seed, manifest.spec)
    n = min(spec.n_envs, spec.episodes)
    most = kinds.get(setting.simulator.name).max_robots()
    environment = open_environment(setting, n if most is None else min(n, most), threads=threads, seed=seed)
    try:
        _require_fit(environment, manifest)
        _require_grown(environment.task)
        starts = environment.task.starts(spec.episodes, seed, setting.task.start_noise_deg)
        environment.load_starts(starts)
        world = environment.world
        rng = None if spec.deterministic else Normals(seed + 0xAC7, world.streams, world.steps)
        with one_blas_thread():
            most_losses = setting.runtime.max_server_failures
            recorder = _Recorder(environment, policy, spec.episodes, len(starts), rng, most_losses)
            recorder.run(progress, stop)
        failures, counters = environment.simulator.failures, dict(environment.simulator.counters)
    finally:
        environment.close()
    episodes = recorder.episodes()
    statistics = Statistics(spec.confidence, spec.bootstrap_resamples, spec.seed)
    task = tasks.get(setting.task.name)
    found, tables = _summarized(environment.task, episodes, statistics)
    _require_declared(task, [result.metric.name for result in found])
    shown = for_family(world.robot.family, [result.metric for result in found])
    results = [result for result in found if result.metric in shown]
    summary = {
        "format": FORMAT,
        "checkpoint": {"step": manifest.steps, "spec_sha256": manifest.spec_sha256},
        "training": manifest.spec.model_dump(mode="json"),
        "evaluation": spec.model_dump(mode="json"),
        "task": {"name": task.name, "version": task.version, "settings": setting.task.model_dump(mode="json")},
        "robot": setting.robot.name,
        "simulator": setting.simulator.name,
        **_engine(setting),
        "episodes": len(episodes),
        "server_failures": failures,
        **{name: count for name, count in counters.items() if count},
        "results": [result.to_json() for result in results],
        "headline": list(task.presentation.headline),
        "tables": [table.to_json() for table in tables],
    }
    named = [*results, *(result for table in tables for column in table.columns.values() for result in column)]
    warnings = {
        f"result {result.metric.name} is {result.value}: stored without a value"
        for result in named
        if result.value is not None and not isfinite(result.value)
    }
    return EvaluationRun(
        summary,
        _trajectories(recorder, episodes, spec.trajectories),
        _replay(recorder, episodes, setting),
        tuple(sorted(warnings)),
    )


def _engine(setting: TrainingSpec) -> dict[str, str]:
    """Return the engine of a simulator that has several."""
    engine = getattr(setting.simulator, "engine", None)
    return {} if engine is None else {"engine": engine}


def _require_fit(environment: Environment, manifest: Manifest) -> None:
    observations = manifest.observations
    if environment.observer.names == observations:
        return
    differing = sorted(set(observations).symmetric_difference(environment.observer.names))
    names = ", ".join(differing[:8]) or "the same in another order"
    raise ValueError(
        f"task {environment.task.name}: the policy was trained with other observations: {names}; tasks that fit it: "
        f"{', '.join(_fitting(manifest))}"
    )


def _fitting(manifest: Manifest) -> list[str]:
    """Return the tasks with a policy's observations."""
    found = [manifest.stage_spec.task.name]
    for name in plugins.names(plugins.TASKS):
        # tasks of other robots, and plug-ins that are broken, fit nothing
        with contextlib.suppress(OSError, ValueError, plugins.BrokenPluginError):
            setting = EvaluationSpec(task=name, simulator="embedded").applied_to(manifest.stage_spec)
            with contextlib.closing(open_environment(setting, 1, threads=1)) as environment:
                if environment.observer.names == manifest.observations:
                    found.append(name)
    return sorted(set(found))


def _require_grown(task: Task) -> None:
    """Refuse to evaluate a task at the beginning of a curriculum of its own: results would be of an easier one."""
    if task.growth is not None and task.growth < 1.0:
        raise ValueError(
            f"task {task.name}: growth is {task.growth:g} in an evaluation; override for_evaluation of its settings, "
            "so that an evaluation asks for all of it (growth: None)"
        )


def _summarized(
    task: Task, episodes: Episodes, statistics: Statistics
) -> tuple[Sequence[Result], Sequence[ResultTable]]:
    """Return results and tables of a task, which may come from another package."""
    match task.summarize(episodes, statistics):
        case [[*found], [*tables]] if all(isinstance(result, Result) for result in found):
            return found, tables
        case other:
            raise ValueError(
                f"task {task.name}: summarize has to return results and tables of results, as (results, ()), each in a "
                f"tuple or list; it returned {type(other).__name__}: {str(other)[:100]}"
            )


def _require_declared(task: type[Task], results: Sequence[str]) -> None:
    """Check the names of an evaluation's results, by which studies, lists and comparisons find them."""
    declared = {metric.name for metric in (*EPISODE_METRICS, *task.metrics, *task.results)}
    if unknown := sorted(set(results) - declared):
        raise ValueError(
            f"task {task.name}: summarize returned {', '.join(unknown)}; declare each in the task's metrics or results"
        )
    if twice := sorted({name for name in results if results.count(name) > 1}):
        raise ValueError(f"task {task.name}: summarize returned {', '.join(twice)} more than once; return one result")


def _held_out(seed: int, training: TrainingSpec) -> int:
    """Return a seed whose starts, states and commands the training has not seen: itself, unless it has it, too."""
    seen = seed == training.seed or any(seed == stage.seed for stage in training.stages)
    return seed + _UNSEEN if seen else seed


class _Recorder:
    """The episodes of an evaluation, each run by the next free environment."""

    def __init__(
        self,
        environment: Environment,
        policy: Policy,
        episodes: int,
        n_starts: int,
        rng: Normals | None,
        most_losses: int,
    ) -> None:
        self.environment = environment
        self.policy = policy
        self.n_episodes = episodes
        self.n_starts = n_starts
        self.rng = rng
        self.most_losses = most_losses
        self._losses: Counter[int] = Counter()  # of robots, by episode
        self.ends: dict[str, BoolArray] = {
            end.name: np.zeros(episodes, dtype=np.bool_) for end in environment.task.ends
        }
        self.shown = min(REPLAY_CANDIDATES, episodes)
        self.bodies: list[list[FloatArray]] = [[] for _ in range(self.shown)]
        self.angles: list[FloatArray] = []
        # one entry per sample of every environment, split into episodes at the end
        self._owners: list[IntArray] = []
        self._samples: list[FloatArray] = []
        self._episode: IntArray = np.arange(environment.n)

    def run(self, progress: Callable[[int, int], None] | None, stop: Callable[[], bool]) -> None:
        """Run all episodes."""
        environment, episode = self.environment, self._episode
        n = environment.n
        active: BoolArray = np.ones(n, dtype=np.bool_)
        following, done = n, 0
        self._begin(np.arange(n))
        while active.any():
            if stop():
                raise InterruptedError(f"stopped after {done} of {self.n_episodes} episodes")
            actions = self.policy.act(environment.observations, self.rng)
            environment.step(actions, None if bool(active.all()) else active)
            lost = np.flatnonzero(active & environment.lost)
            if len(lost):
                for row in lost.tolist():
                    reason, number = environment.simulator.loss_reason(row), int(episode[row])
                    self._losses[number] += 1
                    if self._losses[number] > self.most_losses:
                        times = self._losses[number]
                        raise ServerLostError(f"episode {number} lost its robot {times} times, lastly because {reason}")
                    logger.warning("episode %d is run again, its robot was lost: %s", number, reason)
                self._drop(lost)
                self._begin(lost)
            running = np.flatnonzero(active & ~environment.lost)
            self._record(running)
            ended = running[(environment.terminated | environment.truncated)[running]]
            if not len(ended):
                continue
            for name, flags in self.ends.items():
                flags[episode[ended]] = environment.ends[name][ended]
            done += len(ended)
            fresh = ended[: max(0, self.n_episodes - following)]
            active[ended[len(fresh) :]] = False
            episode[fresh] = np.arange(following, following + len(fresh))
            following += len(fresh)
            if len(fresh):
                self._begin(fresh)
            if progress is not None:
                progress(done, self.n_episodes)

    def episodes(self) -> Episodes:
        """Return every step of every episode."""
        owner = np.concatenate(self._owners)
        order = np.argsort(owner, kind="stable")
        cuts = np.searchsorted(owner[order], np.arange(self.n_episodes))
        split = np.split(np.concatenate(self._samples)[order], cuts)[1:]
        return Episodes(
            x=[run[:, 0] for run in split],
            y=[run[:, 1] for run in split],
            height=[run[:, 2] for run in split],
            up=[run[:, 3] for run in split],
            feet=[run[:, 4:6] for run in split],
            airborne=[run[:, 6] > 0.0 for run in split],
            trace=[run[:, 7:] for run in split],
            ends=self.ends,
            max_steps=self.environment.task.max_steps,
        )

    def _begin(self, rows: IntArray) -> None:
        episodes = self._episode[rows]
        self.environment.restart(rows, episodes % self.n_starts, episodes=episodes)
        self._record(rows)

    def _record(self, rows: IntArray) -> None:
        environment, episode = self.environment, self._episode
        simulator, world = environment.simulator, environment.world
        feet = simulator.foot_forces()[rows]
        airborne = simulator.airborne()[rows]
        up = world.rotation(rows)[:, 2, 2]
        task = environment.task
        what = f"task {task.name}: trace_row, for {', '.join(task.trace) or 'no name in trace'},"
        trace = require_numbers(task.trace_row(rows), (len(rows), len(task.trace)), what)
        self._owners.append(episode[rows].copy())
        self._samples.append(np.column_stack([world.position(rows), up, feet, airborne, trace]))
        first = np.flatnonzero(episode[rows] == 0)
        if len(first):
            row = rows[first[0]]
            self.angles.append(environment.actuation.angles(world.perceptors["joint_angles"][row : row + 1])[0])
        watched = rows[episode[rows] < self.shown]
        if len(watched):
            poses = simulator.bodies() if simulator.shapes else np.zeros((environment.n, 0, 7))
            for row in watched.tolist():
                self.bodies[int(episode[row])].append(poses[row].copy())

    def _drop(self, rows: IntArray) -> None:
        """Remove the samples of the unfinished episodes of ``rows``."""
        for number in self._episode[rows].tolist():
            for owner in self._owners:
                owner[owner == number] = _DROPPED
            if number == 0:
                self.angles.clear()
            if number < self.shown:
                self.bodies[number].clear()


def _replay(recorder: _Recorder, episodes: Episodes, spec: TrainingSpec) -> Replay:
    """Return the median one of the first episodes by distance covered, or by final height where nothing repeats."""

    def rank(number: int) -> tuple[float, int]:
        x, height = episodes.x[number], episodes.height[number]
        reached = x[-1] - x[0] if tasks.get(spec.task.name).presentation.repeats else height[-1]
        return round(float(reached), 1), -len(x)  # episodes that ended alike differ in their lengths

    median = sorted(range(recorder.shown), key=rank)[recorder.shown // 2]
    reached = [end for end in recorder.environment.task.ends if episodes.ends[end.name][median]]
    return Replay(
        robot=recorder.environment.simulator.robot,
        positions=np.array(recorder.bodies[median])[:, :, :3].astype(np.float32),
        rotations=np.array(recorder.bodies[median])[:, :, 3:7].astype(np.float32),
        foot_forces=episodes.feet[median].astype(np.float32),
        end=reached[0].title if reached else "",
        failed=any(end.failure for end in reached),
        objects=recorder.environment.simulator.shapes[len(recorder.environment.simulator.robot.shapes) :],
    )


def _trajectories(recorder: _Recorder, episodes: Episodes, count: int) -> Trajectories:
    kept = range(min(count, len(episodes)))
    failures = [end.name for end in recorder.environment.task.ends if end.failure]
    longest = max((len(episodes.x[i]) for i in kept), default=0)

    def padded(rows: list[FloatArray]) -> Float32Array:
        table = np.full((len(kept), longest), np.nan, dtype=np.float32)
        for i in kept:
            table[i, : len(rows[i])] = rows[i]
        return table

    return Trajectories(
        x=padded(episodes.x),
        y=padded(episodes.y),
        height=padded(episodes.height),
        left_foot_force=padded([feet[:, 0] for feet in episodes.feet]),
        right_foot_force=padded([feet[:, 1] for feet in episodes.feet]),
        joint_angles=np.array(recorder.angles, dtype=np.float32),
        failed=np.array([any(episodes.ends[name][i] for name in failures) for i in kept], dtype=np.bool_),
    )
