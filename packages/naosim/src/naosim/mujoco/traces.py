"""Recordings of a running rcssservermj, and how exactly the embedded world reproduces them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from naosim.mujoco.batch import PERCEPTORS, MujocoBatch
from naosim.mujoco.world import BALL_JOINT, Floats, set_gains, world_of
from naosim.npz import read_npz
from naosim.robots.booster import ROBOTS
from naosim.robots.description import Robot
from naosim.simulator import BALL, PLAIN, Scene

_PERCEPTOR_KEYS = dict(
    zip(PERCEPTORS, ("p_angle", "p_speed", "p_quat", "p_pos", "p_gyro", "p_acc"), strict=True),
)
_STATE_KEYS = ("qpos", "qvel", "qacc_warmstart", "sensordata")


MAX_BYTES = 500_000_000
"""Most bytes of a recording's arrays."""


class MujocoTraceError(ValueError):
    """A recording that cannot be used; the message names the file and the field."""


@dataclass(frozen=True)
class MujocoTrace:
    """One recording of T cycles of a robot with J joints.

    Attributes:
        name: the file's name.
        robot: the recorded robot.
        command: (T, J, 5) target deg, target speed deg/s, kp, kd, torque N m.
        beam: (T, 3) x m, y m, theta deg of a beam before the step; NaN if there is none.
        move: (T, 4) x, y, z m, theta deg of the monitor's move after the step; NaN if there is none.
        ball: (T, 6) position m and velocity m/s of the monitor's ball command after the step; NaN if there is none.
        states: (T + 1, ...) ``qpos``, ``qvel``, ``qacc_warmstart``, ``sensordata`` before every step.
        time: (T + 1,) simulated seconds.
        perceptors: (T + 1, width) by name; NaN where the ball is not reported. The ball is missing in recordings whose
            messages were kept without it.
    """

    name: str
    robot: Robot
    command: Floats
    beam: Floats
    move: Floats
    ball: Floats
    states: dict[str, Floats]
    time: Floats
    perceptors: dict[str, Floats]


def is_recording(path: Path) -> bool:
    """Return whether a file is a recording of rcssservermj rather than of rcssserver3d."""
    try:
        return "qacc_warmstart" in read_npz(Path(path), kinds="fiubU", max_bytes=MAX_BYTES, skip="message")
    except (OSError, ValueError):
        return False


def load(path: Path) -> MujocoTrace:
    """Read a recording from an ``.npz`` file.

    Raises:
        TraceError: if the file is missing, damaged or inconsistent.
    """
    try:
        data = read_npz(Path(path), kinds="fiubU", max_bytes=MAX_BYTES, skip="message")
    except FileNotFoundError as error:
        raise MujocoTraceError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise MujocoTraceError(f"{path}: not a readable .npz file of plain arrays ({error})") from error
    for key in ("meta", "command", "beam", "move", "time", *_STATE_KEYS, *_PERCEPTOR_KEYS.values()):
        if key not in data:
            raise MujocoTraceError(f"{path}: field {key!r} is missing")
    try:
        meta: dict[str, Any] = json.loads(str(data["meta"]))
        robot = next(robot for robot in ROBOTS if robot.data["model"] == meta["robot"])
        effectors = list(meta["effectors"])
    except (ValueError, TypeError, KeyError, StopIteration, RecursionError) as error:
        raise MujocoTraceError(f"{path}: field 'meta' is not usable ({error!r})") from error
    if effectors != [joint.effector for joint in robot.joints]:
        raise MujocoTraceError(f"{path}: field 'meta.effectors' is not in the order of {robot.name}")
    joints, cycles = len(robot.joints), len(np.atleast_1d(data["command"]))
    data.setdefault("ball", np.full((cycles, 6), np.nan))
    perceived = _PERCEPTOR_KEYS | ({BALL: "p_ball"} if "p_ball" in data else {})
    widths = dict.fromkeys(PERCEPTORS[:2], joints) | {"torso_quat": 4, "torso_pos": 3, "gyro": 3, "accel": 3, BALL: 3}
    shapes = {"command": (cycles, joints, 5), "beam": (cycles, 3), "move": (cycles, 4), "time": (cycles + 1,)}
    shapes["ball"] = (cycles, 6)
    shapes |= {"qpos": (cycles + 1, 14 + joints), "sensordata": (cycles + 1, 13 + 2 * joints)}
    shapes |= {key: (cycles + 1, 12 + joints) for key in ("qvel", "qacc_warmstart")}
    shapes |= {key: (cycles + 1, widths[name]) for name, key in perceived.items()}
    for key, shape in shapes.items():
        values = data[key]
        if values.shape != shape or values.dtype != np.float64:
            raise MujocoTraceError(
                f"{path}: field {key!r} must be float64 of shape {shape}, not {values.dtype} of {values.shape}"
            )
        if key not in ("beam", "move", "ball", "p_ball") and not np.isfinite(values).all():
            raise MujocoTraceError(f"{path}: field {key!r} contains values that are not finite")
    return MujocoTrace(
        Path(path).stem,
        robot,
        data["command"],
        data["beam"],
        data["move"],
        data["ball"],
        {key: data[key] for key in _STATE_KEYS},
        data["time"],
        {name: data[key] for name, key in perceived.items()},
    )


def check(path: Path) -> dict[str, Any]:
    """Replay a recording from its first state without looking at the later ones, and compare all of them.

    Returns:
        ``trace``, ``robot``, ``cycles``, ``differences``: the largest absolute difference of each array, by name;
        ``exact``: whether all are 0; ``first_difference``: the first cycle after which something differs, or None.

    Raises:
        TraceError: if the file cannot be used.
        naosim.mujoco.world.MujocoUnavailableError: if MuJoCo is missing or has another version.
    """
    trace = load(path)
    scene = Scene(ball=True, goals=True) if BALL in trace.perceptors else PLAIN
    batch = MujocoBatch(world_of(trace.robot, scene=scene), 1, delay=0)
    data, model, first = batch.data[0], batch.world.model, batch.world.torso
    recorded = len(trace.states["sensordata"][0])
    data.qpos[:], data.qvel[:] = trace.states["qpos"][0], trace.states["qvel"][0]
    data.qacc_warmstart[:], data.time = trace.states["qacc_warmstart"][0], trace.time[0]
    differences = dict.fromkeys((*_STATE_KEYS, "time", *trace.perceptors), 0.0)
    first_difference = None
    for t, command in enumerate(trace.command):
        if np.isfinite(trace.beam[t]).all():
            x, y, theta = trace.beam[t].tolist()
            _place(data, first, (-abs(x), y, float(trace.robot.data["beam_height_m"])), math.radians(theta))
        angle, speed, kp, kd, torque = command.T
        set_gains(model, kp, kd)
        data.ctrl[0::3], data.ctrl[1::3], data.ctrl[2::3] = torque, np.radians(angle), np.radians(speed)
        batch.step_unchanged()
        if np.isfinite(trace.move[t]).all():
            x, y, z, theta = trace.move[t].tolist()
            _place(data, first, (x, y, z), math.radians(theta))
        if np.isfinite(trace.ball[t]).all():
            data.qpos[BALL_JOINT : BALL_JOINT + 7] = (*trace.ball[t, :3], 1.0, 0.0, 0.0, 0.0)
            data.qvel[BALL_JOINT : BALL_JOINT + 6] = (*trace.ball[t, 3:], 0.0, 0.0, 0.0)
        ours = {
            "qpos": data.qpos,
            "qvel": data.qvel,
            "qacc_warmstart": data.qacc_warmstart,
            "sensordata": data.sensordata[:recorded],
            "time": np.array([data.time]),
            **{name: batch.perceptors[name][0] for name in trace.perceptors},
        }
        theirs = trace.states | trace.perceptors | {"time": trace.time}
        for name, values in ours.items():
            largest = _largest(values, theirs[name][t + 1])
            differences[name] = max(differences[name], largest if math.isfinite(largest) else math.inf)
        if first_difference is None and any(differences.values()):
            first_difference = t
    return {
        "trace": trace.name,
        "robot": trace.robot.name,
        "cycles": len(trace.command),
        "differences": differences,
        "exact": not any(differences.values()),
        "first_difference": first_difference,
    }


def _largest(ours: Floats, theirs: Floats) -> float:
    """Return the largest difference; infinite where only one of two numbers is missing."""
    if (np.isnan(ours) != np.isnan(theirs)).any():
        return math.inf
    return float(np.max(np.nan_to_num(np.abs(ours - theirs))))


def _place(data: Any, first: int, position: tuple[float, float, float], heading_rad: float) -> None:
    """Place the robot as the server does: upright, all joints at 0, at rest."""
    data.qpos[first : first + 3] = position
    data.qpos[first + 3 : first + 7] = (math.cos(heading_rad / 2), 0.0, 0.0, math.sin(heading_rad / 2))
    data.qpos[first + 7 :] = 0.0
    data.qvel[max(0, first - 1) :] = 0.0
