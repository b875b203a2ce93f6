"""Judge a policy by the figures of the paper, and by those that it leaves out.

The paper takes the speed from a start line on, over episodes that have at least 200 samples beyond it. That hides
early falls, so the same figures over all episodes stand beside it.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from naospec import EvaluationSpec, task

from naosprint.actuation import CYCLE_S
from naosprint.environment import open_batch
from naosprint.policy import load_policy
from naosprint.replay import Replay
from naosprint.servers import most_servers
from naosprint.starts import draw_start_poses
from naosprint.statistics import bootstrap_mean, wilson
from naosprint.threads import one_blas_thread

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from naosprint.arrays import BoolArray, Float32Array, FloatArray, IntArray
    from naosprint.environment import SprintBatch
    from naosprint.policy import Policy

logger = logging.getLogger(__name__)

_FORGOTTEN = -1  # episode number of samples that no longer count

REPLAY_CANDIDATES = 5
"""Episodes from the first of which the middle one is kept as a replay."""

START_LINES_M = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)
"""Distances of the start lines from the start, metres."""

PAPER_MIN_SAMPLES = 200
"""Samples beyond a start line that an episode needs to count in the paper's speed."""

PAPER_FALL_HEIGHT_M = 0.33
"""Torso height at the end below which the paper's statistics call it a fall, metres."""

CHALLENGE_LINE_M = 0.5
"""Run challenge: the clock starts this far from the start, metres."""

CHALLENGE_START_S = 4.0
"""Run challenge: the clock starts at the latest after this time, seconds."""

CHALLENGE_RUN_S = 20.0
"""Run challenge: longest time on the clock, seconds."""

CHALLENGE_FALL_HEIGHT_M = 0.25
"""Run challenge: torso height of a fall, metres."""

CHALLENGE_FALL_UP = 0.6
"""Run challenge: upward component of the torso's up-vector below which it has fallen."""

CHALLENGE_PENALTY_M = 2.0
"""Run challenge: distance that a fall costs, metres."""


@dataclass(frozen=True)
class Trajectories:
    """Hold the paths of episodes, padded with NaN to the longest; the sample at index 0 is the start."""

    x: Float32Array
    """(k, T) torso's world x, metres."""
    y: Float32Array
    """(k, T) torso's world y, metres."""
    height: Float32Array
    """(k, T) torso's height, metres."""
    left_foot_force: Float32Array
    """(k, T) upward force on the left foot, newtons; 0 without contact."""
    right_foot_force: Float32Array
    """(k, T) upward force on the right foot, newtons; 0 without contact."""
    joint_angles: Float32Array
    """(T', A) perceived joint angles of the first episode, radians, in the policies' convention."""

    def save(self, path: Path) -> None:
        """Write the arrays to an ``.npz`` file."""
        np.savez_compressed(
            path,
            x=self.x,
            y=self.y,
            height=self.height,
            left_foot_force=self.left_foot_force,
            right_foot_force=self.right_foot_force,
            joint_angles=self.joint_angles,
            cycle_s=np.array(CYCLE_S),
        )


@dataclass(frozen=True)
class Evaluation:
    """Hold the figures of an evaluation and some of its trajectories."""

    summary: dict[str, Any]
    """All figures, ready for JSON; a figure that no episode supports is None."""
    trajectories: Trajectories
    replay: Replay
    """The middle one of the first episodes, as it looked."""

    def to_json(self) -> str:
        """Return all figures as JSON."""
        return json.dumps(self.summary, indent=2, allow_nan=False) + "\n"

    def save(self, directory: Path) -> tuple[Path, ...]:
        """Write ``evaluation.json``, ``trajectories.npz`` and the replay to ``directory`` and return their paths."""
        directory.mkdir(parents=True, exist_ok=True)
        figures, paths = directory / "evaluation.json", directory / "trajectories.npz"
        figures.write_text(self.to_json())
        self.trajectories.save(paths)
        return (figures, paths, *self.replay.save(directory))


@dataclass(frozen=True)
class _Runs:
    """Hold every sample of every episode, one array per episode; index 0 is the start."""

    x: list[FloatArray]
    y: list[FloatArray]
    height: list[FloatArray]
    up: list[FloatArray]
    """Upward component of the torso's up-vector."""
    feet: list[FloatArray]
    """(samples, 2) upward force on left and right foot."""
    airborne: list[BoolArray]
    """Whether both feet carry less than 0.01 N."""
    fallen: BoolArray
    """(episodes,) by the task's own height."""
    arrived: BoolArray
    """(episodes,)"""
    joint_angles: FloatArray
    """(samples, A) of the first episode."""
    bodies: list[FloatArray]
    """(samples, B, 13) body states of each of the first few episodes."""


def evaluate(
    checkpoint: Path,
    spec: EvaluationSpec,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Run the policy of a checkpoint and return the figures of its runs.

    The same checkpoint and specification give the same figures on the same machine with the embedded simulator. On
    rcssserver3d no more servers are started than the machine's cores can keep busy, and an episode whose server fails
    is run again on a new one.

    Args:
        checkpoint: checkpoint directory.
        spec: how to judge.
        threads: threads of the embedded engine; they change no figure.
        progress: called with the episodes done and their total whenever some are done.
        stop: asked between steps; once it says so, the evaluation ends with :class:`InterruptedError`.

    Raises:
        CheckpointError: if the checkpoint is damaged.
        InterruptedError: if ``stop`` said so.
        FileNotFoundError: if the server's program is not here.
        naosim.ServerLostError: if more servers failed than the training's ``max_server_failures``.
    """
    policy, manifest = load_policy(checkpoint)
    trained = manifest.spec
    the_task = task(spec.task)
    # the evaluation's task decides where an episode ends, the training's specification what a fall is
    setting = trained if spec.simulator is None else trained.model_copy(update={"simulator": spec.simulator})
    n = min(spec.n_envs, spec.episodes)
    if setting.simulator == "rcssserver3d":
        n = min(n, most_servers())
    batch = open_batch(setting, n, task=the_task, threads=threads)
    try:
        poses = draw_start_poses(batch.actuation, spec.episodes, spec.start_noise_deg, spec.seed)
        batch.load_starts(poses)
        rng = None if spec.deterministic else np.random.default_rng([0xAC7, spec.seed])
        with one_blas_thread():
            runs = _run(batch, policy, spec.episodes, len(poses), rng, progress, stop)
        failures = batch.simulator.failures
    finally:
        batch.close()
    summary = {
        "checkpoint": {"step": manifest.steps, "spec_sha256": manifest.spec_sha256},
        "training": trained.model_dump(mode="json"),
        "evaluation": spec.model_dump(mode="json"),
        "server_failures": failures,
        **_figures(runs, spec, the_task.max_steps),
    }
    return Evaluation(summary, _trajectories(runs, spec.trajectories), _replay(runs, trained.robot_type))


def _run(
    batch: SprintBatch,
    policy: Policy,
    episodes: int,
    n_starts: int,
    rng: np.random.Generator | None,
    progress: Callable[[int, int], None] | None,
    stop: Callable[[], bool],
) -> _Runs:
    """Run all episodes, handing the next one to whichever environment is free."""
    n = batch.n
    # one entry per sample of every environment, cut into episodes at the end
    episode: IntArray = np.arange(n)
    active: BoolArray = np.ones(n, dtype=np.bool_)
    fallen: BoolArray = np.zeros(episodes, dtype=np.bool_)
    arrived: BoolArray = np.zeros(episodes, dtype=np.bool_)
    owners: list[IntArray] = []
    samples: list[FloatArray] = []
    angles: list[FloatArray] = []
    shown = min(REPLAY_CANDIDATES, episodes)
    bodies: list[list[FloatArray]] = [[] for _ in range(shown)]

    def record(rows: IntArray) -> None:
        truth, feet = batch.simulator.truth, batch.observer
        position = truth.torso_position[rows]
        loads = feet.foot_loads()[rows]
        up = truth.torso_rotation[rows, 2, 2]
        airborne = feet.both_feet_off[rows]
        owners.append(episode[rows].copy())
        samples.append(np.column_stack([position, up, loads, airborne]))
        first = np.flatnonzero(episode[rows] == 0)
        if len(first):
            row = rows[first[0]]
            angles.append(batch.actuation.angles(batch.simulator.perceptors.joint_angles[row : row + 1])[0])
        watched = rows[episode[rows] < shown]
        if len(watched):
            states = truth.bodies
            for row in watched.tolist():
                bodies[int(episode[row])].append(states[row].copy())

    def begin(rows: IntArray) -> None:
        batch.restart(rows, episode[rows] % n_starts)
        record(rows)

    def forget(rows: IntArray) -> None:
        """Drop what the unfinished episodes of ``rows`` left."""
        for number in episode[rows].tolist():
            for owner in owners:
                owner[owner == number] = _FORGOTTEN
            if number == 0:
                angles.clear()
            if number < shown:
                bodies[number].clear()

    begin(np.arange(n))
    following = n
    done = 0
    while active.any():
        if stop():
            raise InterruptedError(f"stopped after {done} of {episodes} episodes")
        actions = policy.act(batch.observations, rng)
        everyone = bool(active.all())
        batch.step(actions, None if everyone else active)
        lost = np.flatnonzero(active & batch.lost)
        if len(lost):
            for row in lost.tolist():
                logger.warning(
                    "episode %d is run again, its server was lost: %s", episode[row], batch.simulator.loss_reason(row)
                )
            forget(lost)
            begin(lost)
        running = np.flatnonzero(active & ~batch.lost)
        record(running)
        ended = running[(batch.terminated | batch.truncated)[running]]
        if not len(ended):
            continue
        fallen[episode[ended]] = batch.fallen[ended]
        arrived[episode[ended]] = batch.arrived[ended]
        done += len(ended)
        fresh = ended[: max(0, episodes - following)]
        active[ended[len(fresh) :]] = False
        episode[fresh] = np.arange(following, following + len(fresh))
        following += len(fresh)
        if len(fresh):
            begin(fresh)
        if progress is not None:
            progress(done, episodes)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    cuts = np.searchsorted(owner[order], np.arange(episodes))
    split = np.split(np.concatenate(samples)[order], cuts)[1:]
    return _Runs(
        x=[run[:, 0] for run in split],
        y=[run[:, 1] for run in split],
        height=[run[:, 2] for run in split],
        up=[run[:, 3] for run in split],
        feet=[run[:, 4:6] for run in split],
        airborne=[run[:, 6] > 0.0 for run in split],
        fallen=fallen,
        arrived=arrived,
        joint_angles=np.array(angles),
        bodies=[np.array(states) for states in bodies],
    )


def _figures(runs: _Runs, spec: EvaluationSpec, max_steps: int) -> dict[str, Any]:
    rng = np.random.default_rng([0xB007, spec.seed])
    n = len(runs.x)

    def spread(values: FloatArray) -> dict[str, Any]:
        """Describe a sample by mean, spread, ends and the bootstrap interval of its mean."""
        if not len(values):
            return {"episodes": 0, "mean": None, "sd": None, "min": None, "max": None, "ci": None}
        interval = bootstrap_mean(values, confidence=spec.confidence, resamples=spec.bootstrap_resamples, rng=rng)
        return {
            "episodes": len(values),
            "mean": float(values.mean()),
            "sd": float(values.std()),
            "min": float(values.min()),
            "max": float(values.max()),
            "ci": list(interval),
        }

    def share(flags: BoolArray) -> dict[str, Any]:
        count = int(flags.sum())
        return {"count": count, "rate": count / n, "ci": list(wilson(count, n, spec.confidence))}

    steps = np.array([len(x) - 1 for x in runs.x], dtype=np.float64)
    distance = np.array([x[-1] - x[0] for x in runs.x])
    deviation = np.array([_deviation_deg(x, y) for x, y in zip(runs.x, runs.y, strict=True)])
    airborne = np.array([flags[1:].mean() for flags in runs.airborne])
    low_at_end = np.array([height[-1] < PAPER_FALL_HEIGHT_M for height in runs.height])
    by_line: list[dict[str, Any]] = [
        {
            "line_m": line,
            "paper": spread(_speeds_beyond(runs.x, line, PAPER_MIN_SAMPLES)),
            "all": spread(_speeds_beyond(runs.x, line, 2)),
        }
        for line in START_LINES_M
    ]
    top = max((entry["paper"] for entry in by_line), key=lambda figures: figures["mean"] or 0.0)
    challenge = np.array([_challenge(runs, i) for i in range(n)])
    return {
        "episodes": n,
        "distance_m": spread(distance),
        "speed_mps": spread(distance / (steps * CYCLE_S)),
        "steps": spread(steps),
        "falls": share(runs.fallen),
        "arrivals": share(runs.arrived),
        "time_limits": share(steps >= max_steps),
        "paper": {
            "top_speed_mps": top["mean"],
            "top_speed_sd_mps": top["sd"],
            "fastest_episode_mps": max((e["paper"]["max"] or 0.0 for e in by_line), default=None),
            "deviation_deg": {"mean": float(deviation.mean()), "sd": float(deviation.std())},
            "low_at_end": share(low_at_end),
        },
        "speed_by_line": by_line,
        "both_feet_off_ground": spread(airborne),
        "run_challenge": {
            "score": spread(challenge[:, 0]),
            "speed_mps": spread(challenge[:, 1]),
            "off_ground": spread(challenge[:, 2]),
            "falls": share(challenge[:, 3] > 0.0),
        },
    }


def _speeds_beyond(xs: list[FloatArray], line_m: float, min_samples: int) -> FloatArray:
    """Return each episode's mean speed in m/s over its samples beyond a line, if it has enough of them."""
    speeds = []
    for x in xs:
        beyond = np.flatnonzero(x >= x[0] + line_m)
        if len(beyond) < min_samples:
            continue
        first, last = beyond[0], beyond[-1]
        speeds.append((x[last] - x[first]) / ((last - first) * CYCLE_S))
    return np.array(speeds)


def _deviation_deg(x: FloatArray, y: FloatArray) -> float:
    """Return the angle in degrees between the running direction and the line from start to end."""
    return float(np.degrees(np.arctan2(abs(y[-1] - y[0]), abs(x[-1] - x[0]))))


def _challenge(runs: _Runs, i: int) -> tuple[float, float, float, float]:
    """Score one episode by the league's run challenge: speed plus share of time with both feet off the ground.

    The challenge starts at x = -13.5 and ends at 14.5; a sprint from -14 to 14 is the same 28 m, half a metre to the
    left. A fall costs 2 m and the whole running time.

    Returns:
        Score, speed in m/s, share of cycles off the ground, and 1 for a fall.
    """
    x = runs.x[i] - runs.x[i][0]
    late = np.arange(len(x)) * CYCLE_S > CHALLENGE_START_S
    started = np.flatnonzero((x > CHALLENGE_LINE_M) | late)
    first = int(started[0]) if len(started) else len(x) - 1
    last = min(len(x) - 1, first + round(CHALLENGE_RUN_S / CYCLE_S))
    down = (runs.height[i][: last + 1] < CHALLENGE_FALL_HEIGHT_M) | (runs.up[i][: last + 1] < CHALLENGE_FALL_UP)
    fell = bool(down.any()) or (bool(runs.fallen[i]) and last == len(x) - 1)
    if down.any():
        last = max(int(np.flatnonzero(down)[0]), first)
    duration = CHALLENGE_RUN_S if fell else max((last - first) * CYCLE_S, CYCLE_S)
    reached = x[last] - (CHALLENGE_PENALTY_M if fell else 0.0)
    speed = max(reached - CHALLENGE_LINE_M, 0.0) / duration
    off_ground = float(runs.airborne[i][first : last + 1].mean())
    return speed + off_ground, speed, off_ground, float(fell)


def _replay(runs: _Runs, robot_type: int) -> Replay:
    """Choose the middle one of the first episodes by distance covered, then by speed."""
    count = len(runs.bodies)
    # an episode's distance says how it went; those that arrive differ in their steps
    order = sorted(range(count), key=lambda i: (round(runs.x[i][-1] - runs.x[i][0], 1), -len(runs.x[i])))
    middle = order[count // 2]
    return Replay.from_bodies(
        robot_type,
        runs.bodies[middle],
        runs.feet[middle],
        fallen=bool(runs.fallen[middle]),
        arrived=bool(runs.arrived[middle]),
    )


def _trajectories(runs: _Runs, count: int) -> Trajectories:
    kept = range(min(count, len(runs.x)))
    longest = max((len(runs.x[i]) for i in kept), default=0)

    def padded(rows: list[FloatArray]) -> Float32Array:
        table = np.full((len(kept), longest), np.nan, dtype=np.float32)
        for i in kept:
            table[i, : len(rows[i])] = rows[i]
        return table

    return Trajectories(
        x=padded(runs.x),
        y=padded(runs.y),
        height=padded(runs.height),
        left_foot_force=padded([feet[:, 0] for feet in runs.feet]),
        right_foot_force=padded([feet[:, 1] for feet in runs.feet]),
        joint_angles=runs.joint_angles.astype(np.float32),
    )
