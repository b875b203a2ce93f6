"""Replays: the pose of every body in every step of an episode.

A replay is one JSON file, which a web page can play, and an ``.npz`` file for computing with it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from naosim import robots
from naosim.npz import write_npz
from naosim.robots.description import Shape, ShapeKind
from naosim.simulator import STEP_S
from naospec.files import read_json, together, write_whole

if TYPE_CHECKING:
    from pathlib import Path

    from naosim.robots import Robot

    from naosprint.arrays import Float32Array

FORMAT = 2
"""Version of the replay format."""

_MAX_BYTES = 64_000_000


class ReplayError(ValueError):
    """Replay that is missing, damaged, or of another version."""


@dataclass(frozen=True)
class Replay:
    """One episode, sampled every 20 ms from its start.

    Attributes:
        robot: the robot.
        positions: (T, B, 3) centre of each of :attr:`shapes`, metres, world frame.
        rotations: (T, B, 4) unit quaternions w, x, y, z from a shape's frame into the world's.
        foot_forces: (T, 2) upward force on left and right foot, newtons; 0 without contact.
        end: title of the end that the episode reached; empty for a time limit.
        failed: whether that was a failure.
        objects: shapes of the scene, which follow the robot's, for example the ball.
    """

    robot: Robot
    positions: Float32Array
    rotations: Float32Array
    foot_forces: Float32Array
    end: str
    failed: bool
    objects: tuple[Shape, ...] = ()

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Everything that is drawn, the robot first."""
        return (*self.robot.shapes, *self.objects)

    @property
    def duration_s(self) -> float:
        """Length of the episode in seconds."""
        return (len(self.positions) - 1) * STEP_S

    @property
    def displacement_m(self) -> tuple[float, float]:
        """Displacement of the torso in x and y in metres; 0 for a robot that cannot be drawn."""
        if not self.robot.shapes:
            return 0.0, 0.0
        moved = self.positions[-1, 0] - self.positions[0, 0]
        return float(moved[0]), float(moved[1])

    def moved_m(self, first: int = 0, last: int = -1) -> float:
        """Return the horizontal distance between the torso's positions in two steps, metres."""
        if not self.robot.shapes:
            return 0.0
        x, y = (self.positions[last, 0] - self.positions[first, 0])[:2].tolist()
        return math.hypot(x, y)

    def to_json(self) -> str:
        """Return the replay as one JSON object: positions to 0.1 mm, quaternions to four decimals."""
        frames = len(self.positions)
        document: dict[str, Any] = {
            "format": FORMAT,
            "robot": self.robot.name,
            "dt_s": STEP_S,
            "frames": frames,
            "displacement_m": [round(value, 4) for value in self.displacement_m],
            "end": self.end,
            "failed": self.failed,
            "bodies": [
                {"name": shape.name, "shape": shape.kind, "size_m": list(shape.size_m), "side": shape.side}
                for shape in self.shapes
            ],
            "position_m": _rounded(self.positions.reshape(frames, -1), 4),
            "rotation_wxyz": _rounded(self.rotations.reshape(frames, -1), 4),
            "foot_force_n": _rounded(self.foot_forces, 1),
        }
        return json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n"

    @together()
    def save(self, directory: Path) -> tuple[Path, Path]:
        """Write ``replay.json`` and ``replay.npz`` to ``directory`` and return their paths."""
        text, arrays = directory / "replay.json", directory / "replay.npz"
        write_whole(text, self.to_json())
        content = {
            "robot": np.array(self.robot.name),
            "cycle_s": np.array(STEP_S),
            "body_names": np.array([shape.name for shape in self.shapes]),
            "positions": self.positions,
            "rotations": self.rotations,
            "foot_forces": self.foot_forces,
        }
        write_npz(arrays, content)
        return text, arrays


def load_replay(path: Path) -> Replay:
    """Read a ``replay.json``.

    Raises:
        ReplayError: if it is missing, damaged, or of another version.
    """
    try:
        document = read_json(path, _MAX_BYTES)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ReplayError(f"{path}: not a replay of format {FORMAT}")
        robot, frames = robots.get(str(document["robot"])), int(document["frames"])
        bodies, own = document["bodies"], [shape.name for shape in robot.shapes]
        if [body["name"] for body in bodies[: len(own)]] != own:
            raise ReplayError(f"{path}: bodies: not those of robot {robot.name}")
        objects = tuple(_shape(body) for body in bodies[len(own) :])
        replay = Replay(
            robot=robot,
            positions=np.array(document["position_m"], dtype=np.float32).reshape(frames, len(bodies), 3),
            rotations=np.array(document["rotation_wxyz"], dtype=np.float32).reshape(frames, len(bodies), 4),
            foot_forces=np.array(document["foot_force_n"], dtype=np.float32).reshape(frames, 2),
            end=str(document["end"]),
            failed=bool(document["failed"]),
            objects=objects,
        )
    except ReplayError:
        raise
    except KeyError as error:
        raise ReplayError(f"{path}: {error.args[0]}: missing") from None
    except (OSError, ValueError, TypeError, OverflowError) as error:
        raise ReplayError(f"{path}: unreadable: {error}") from error
    for name in ("positions", "rotations", "foot_forces"):
        if not np.isfinite(getattr(replay, name)).all():
            raise ReplayError(f"{path}: {name}: contains numbers that are not finite")
    return replay


def _shape(body: dict[str, Any]) -> Shape:
    """Return the shape of an object; ValueError if there is no such kind or size."""
    kind, (a, b, c) = body["shape"], (float(length) for length in body["size_m"])
    if kind not in get_args(ShapeKind) or not all(math.isfinite(length) for length in (a, b, c)):
        raise ValueError(f"bodies: {body['name']}: no such shape")
    return Shape(str(body["name"]), kind, (a, b, c))


def _rounded(rows: Float32Array, decimals: int) -> list[list[float]]:
    # adding zero turns -0.0 into 0.0, which is shorter
    return [[round(value, decimals) + 0.0 for value in row] for row in rows.astype(np.float64).tolist()]
