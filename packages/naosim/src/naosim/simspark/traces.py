"""Recordings of a running rcssserver3d and how closely the engine reproduces them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from naosim.npz import read_npz
from naosim.robots import nao_model
from naosim.simspark.batch import BODY_STATE, BatchSimulator, Floats

MAX_BYTES = 500_000_000
"""Most bytes of a recording's arrays; an hour of a robot is about half of it."""

DIGIT = 1e-3
"""The recording server printed three decimals."""

OFF_M = 1e-3
"""Distance of the torso from the recorded one from which a free run counts as off, m."""


class NaoTraceError(ValueError):
    """Unusable trace file; the message names the file and the field."""


@dataclass(frozen=True)
class NaoTrace:
    """One recording; see `load`."""

    name: str
    robot_type: int
    command: Floats
    """(T, joints), rad/s, sent before cycle t."""
    state: Floats
    """(T + 1, bodies, 13), row t before cycle t's step."""
    enabled: NDArray[np.bool_]
    """(T, bodies), awake before the step."""
    perceptors: dict[str, Floats]
    """As received in the reply to cycle t: `joint_angles` (T, joints), `gyro`, `accel` (T, 3), feet and toes (T, 6)."""
    beam: tuple[float, float, float, float]
    """Where the robot was beamed one cycle before cycle 0: x, y, z (m) and yaw (degrees)."""

    @property
    def cycles(self) -> int:
        """Return the number of recorded cycles."""
        return len(self.command)


_PERCEPTORS = {"joint_angles": "angle", "gyro": "gyro", "accel": "accel", "foot_left": "foot_l", "foot_right": "foot_r"}
_TOE_PERCEPTORS = {"toe_left": "toe_l", "toe_right": "toe_r"}


def load(path: Path) -> NaoTrace:
    """Read a recording from an `.npz` file.

    Raises:
        TraceError: the file is missing, damaged or inconsistent.
    """
    try:
        data = read_npz(Path(path), kinds="fiubU", max_bytes=MAX_BYTES)
    except FileNotFoundError as error:
        raise NaoTraceError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise NaoTraceError(f"{path}: not a readable .npz file of plain arrays ({error})") from error
    perceptors = _PERCEPTORS | {name: key for name, key in _TOE_PERCEPTORS.items() if key in data}
    needed = ["command", "state", "enabled", "meta", *_PERCEPTORS.values()]
    for key in needed:
        if key not in data:
            raise NaoTraceError(f"{path}: field {key!r} is missing")
    try:
        meta: dict[str, Any] = json.loads(str(data["meta"]))
        robot_type = int(meta.get("robot_type", 0))
        beam = tuple(float(x) for x in meta.get("beam", (0, 0, 0.4, 0)))
        model = nao_model.model(robot_type)
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise NaoTraceError(f"{path}: field 'meta' is not usable ({error})") from error
    if len(beam) != 4 or not np.isfinite(beam).all():
        raise NaoTraceError(f"{path}: field 'meta.beam' must be four finite numbers")
    joints, bodies = list(model.joint_names), list(model.body_names)
    for key, expected in (("joints", joints), ("bodies", bodies)):
        if list(meta.get(key, expected)) != expected:
            raise NaoTraceError(f"{path}: field 'meta.{key}' is not in the order of robot type {robot_type}")
    cycles = len(data["command"]) if data["command"].ndim else 0
    shapes = {
        "command": (cycles, len(joints)),
        "state": (cycles + 1, len(bodies), BODY_STATE),
        "enabled": (cycles, len(bodies)),
        "angle": (cycles, len(joints)),
        "gyro": (cycles, 3),
        "accel": (cycles, 3),
        "foot_l": (cycles, 6),
        "foot_r": (cycles, 6),
    } | {key: (cycles, 6) for key in _TOE_PERCEPTORS.values() if key in data}
    for key, shape in shapes.items():
        if data[key].shape != shape or data[key].dtype.kind not in "fbiu" or cycles == 0:
            raise NaoTraceError(
                f"{path}: field {key!r} must be numbers of shape {shape}, not {data[key].dtype} of {data[key].shape}"
            )
        if key not in ("foot_l", "foot_r", "toe_l", "toe_r", "enabled") and not np.isfinite(data[key]).all():
            raise NaoTraceError(f"{path}: field {key!r} contains values that are not finite")
    return NaoTrace(
        Path(path).stem,
        robot_type,
        np.asarray(data["command"], np.float64),
        np.asarray(data["state"], np.float64),
        np.asarray(data["enabled"]).astype(bool),
        {name: np.asarray(data[key], np.float64) for name, key in perceptors.items()},
        (beam[0], beam[1], beam[2], beam[3]),
    )


def _start(trace: NaoTrace) -> BatchSimulator:
    """Return one robot at cycle 0 of the trace: one cycle after its beam, in the exact recorded state."""
    sim = BatchSimulator(1, trace.robot_type, digits=3)
    x, y, z, yaw = trace.beam
    sim.beam((x, y, z), yaw)
    sim.step(np.zeros((1, len(sim.model.joints))))
    if not np.array_equal(sim.truth.enabled[0], trace.enabled[0]):
        sim.set_enabled(trace.enabled[:1])
    sim.set_bodies(trace.state[:1])
    return sim


def one_step(trace: NaoTrace) -> tuple[Floats, dict[str, Floats], NDArray[np.bool_]]:
    """Step from every recorded state to the next.

    Returns:
        Position errors (T, bodies) in m, perceptor errors in printed units of 0.001 by name, and whether sleep agrees
        (T, bodies).
    """
    sim = _start(trace)
    model = sim.model
    wakes = np.zeros((len(model.bodies), len(model.joints)), dtype=bool)
    for k, joint in enumerate(model.joints):
        wakes[model.body_index[joint.body], k] = True
    position = np.empty(trace.state.shape[:2])[:-1]
    errors = {name: np.empty_like(values) for name, values in trace.perceptors.items()}
    awake = np.empty_like(trace.enabled)
    for t in range(trace.cycles):
        sim.set_bodies(trace.state[t : t + 1])
        # the recording samples after the cycle's commands, which wake the commanded parts, and before its step
        awake[t] = (sim.truth.enabled[0] | (wakes @ (trace.command[t] != 0.0))) == trace.enabled[t]
        sim.step(trace.command[t : t + 1])
        position[t] = np.linalg.norm(sim.truth.bodies[0, :, :3] - trace.state[t + 1, :, :3], axis=-1)
        for name, recorded in trace.perceptors.items():
            ours = getattr(sim.perceptors, name)[0]
            same = np.isnan(ours) & np.isnan(recorded[t])
            errors[name][t] = np.where(same, 0.0, np.abs(ours - recorded[t]) / DIGIT)
    return position, errors, awake


def free_run(trace: NaoTrace) -> Floats:
    """Run freely from cycle 0; return the torso's distance to the recorded one after each cycle, shape (T,), m."""
    sim = _start(trace)
    off = np.empty(trace.cycles)
    for t in range(trace.cycles):
        sim.step(trace.command[t : t + 1])
        off[t] = np.linalg.norm(sim.truth.torso_position[0] - trace.state[t + 1, 0, :3])
    return off


def check(path: Path) -> dict[str, Any]:
    """Compare the engine with one recording.

    Returns:
        `trace`, `robot_type`, `cycles`, `position_error_m` {`median`, `p99`, `max`} over all bodies and cycles of
        one-step runs, `perceptors_within_digit` (share of values within one unit of the last printed digit),
        `free_run_first_cycle_off_1mm` (or None), `free_run_max_m`, `asleep_agrees` (share).

    Raises:
        TraceError: the file cannot be used.
    """
    trace = load(path)
    position, perceptors, awake = one_step(trace)
    units = np.concatenate([values.ravel() for values in perceptors.values()])
    off = free_run(trace)
    first = np.flatnonzero(off > OFF_M)
    return {
        "trace": trace.name,
        "robot_type": trace.robot_type,
        "cycles": trace.cycles,
        "position_error_m": {
            "median": float(np.median(position)),
            "p99": float(np.percentile(position, 99)),
            "max": float(position.max()),
        },
        # a NaN on one side only compares false: it counts as wrong
        "perceptors_within_digit": float(np.mean(units <= 1.0 + 1e-6)),
        "free_run_first_cycle_off_1mm": int(first[0]) if len(first) else None,
        "free_run_max_m": float(off.max()),
        "asleep_agrees": float(awake.mean()),
    }
