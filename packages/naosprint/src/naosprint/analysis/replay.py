"""Keep an episode as it looked: where every body was in every cycle.

A replay is one JSON file, so that a web page can play it, and an ``.npz`` file for those who compute with it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from naosim.robots import nao_model

from naosprint.actuation import CYCLE_S

if TYPE_CHECKING:
    from pathlib import Path

    from naosprint.arrays import Float32Array, FloatArray

FORMAT = 1
"""Version of the replay format."""

_MAX_BYTES = 64_000_000


class ReplayError(ValueError):
    """Say what is wrong with a replay, and where."""


@dataclass(frozen=True)
class Replay:
    """Hold one episode, sampled every cycle of 20 ms from its start.

    Attributes:
        robot_type: the robot that ran.
        positions: (T, B, 3) centre of each body, metres, world frame; bodies in the order of the robot's table.
        rotations: (T, B, 4) unit quaternions w, x, y, z that turn a body's frame into the world's.
        foot_forces: (T, 2) upward force on left and right foot, newtons; 0 without contact.
        fallen: whether it ended with a fall.
        arrived: whether it ended at the finish line.
    """

    robot_type: int
    positions: Float32Array
    rotations: Float32Array
    foot_forces: Float32Array
    fallen: bool
    arrived: bool

    @classmethod
    def from_bodies(
        cls, robot_type: int, bodies: FloatArray, foot_forces: FloatArray, *, fallen: bool, arrived: bool
    ) -> Replay:
        """Build a replay from (T, B, 13) body states of the simulator and (T, 2) foot forces."""
        return cls(
            robot_type=robot_type,
            positions=bodies[:, :, :3].astype(np.float32),
            rotations=bodies[:, :, 3:7].astype(np.float32),
            foot_forces=foot_forces.astype(np.float32),
            fallen=fallen,
            arrived=arrived,
        )

    @property
    def duration_s(self) -> float:
        """Length of the episode in seconds."""
        return (len(self.positions) - 1) * CYCLE_S

    @property
    def distance_m(self) -> float:
        """Forward displacement of the torso in metres."""
        return float(self.positions[-1, 0, 0] - self.positions[0, 0, 0])

    def to_json(self) -> str:
        """Return the replay as one JSON object.

        Positions are in millimetre tenths, quaternions in four decimals: finer than a screen shows.
        """
        model = nao_model.model(self.robot_type)
        frames = len(self.positions)
        document: dict[str, Any] = {
            "format": FORMAT,
            "robot_type": self.robot_type,
            "dt_s": CYCLE_S,
            "frames": frames,
            "distance_m": round(self.distance_m, 4),
            "fallen": self.fallen,
            "arrived": self.arrived,
            "bodies": [
                {"name": body.name, "shape": body.shape.kind, "size_m": list(body.shape.size)} for body in model.bodies
            ],
            "position_m": _rounded(self.positions.reshape(frames, -1), 4),
            "rotation_wxyz": _rounded(self.rotations.reshape(frames, -1), 4),
            "foot_force_n": _rounded(self.foot_forces, 1),
        }
        return json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n"

    def save(self, directory: Path) -> tuple[Path, Path]:
        """Write ``replay.json`` and ``replay.npz`` to ``directory`` and return their paths."""
        text, arrays = directory / "replay.json", directory / "replay.npz"
        text.write_text(self.to_json())
        np.savez_compressed(
            arrays,
            robot_type=np.array(self.robot_type),
            cycle_s=np.array(CYCLE_S),
            body_names=np.array(nao_model.model(self.robot_type).body_names),
            positions=self.positions,
            rotations=self.rotations,
            foot_forces=self.foot_forces,
        )
        return text, arrays


def load_replay(path: Path) -> Replay:
    """Read a ``replay.json``.

    Raises:
        ReplayError: if it is missing, damaged, or of another version.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ReplayError(f"{path}: larger than {_MAX_BYTES} bytes")
        document = json.loads(path.read_bytes())
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ReplayError(f"{path}: not a replay of format {FORMAT}")
        robot_type, frames = int(document["robot_type"]), int(document["frames"])
        n_bodies = len(nao_model.model(robot_type).bodies)
        if [body["name"] for body in document["bodies"]] != list(nao_model.model(robot_type).body_names):
            raise ReplayError(f"{path}: bodies: not those of robot type {robot_type}")
        replay = Replay(
            robot_type=robot_type,
            positions=np.array(document["position_m"], dtype=np.float32).reshape(frames, n_bodies, 3),
            rotations=np.array(document["rotation_wxyz"], dtype=np.float32).reshape(frames, n_bodies, 4),
            foot_forces=np.array(document["foot_force_n"], dtype=np.float32).reshape(frames, 2),
            fallen=bool(document["fallen"]),
            arrived=bool(document["arrived"]),
        )
    except ReplayError:
        raise
    except KeyError as error:
        raise ReplayError(f"{path}: {error.args[0]}: missing") from None
    except (OSError, ValueError, TypeError) as error:
        raise ReplayError(f"{path}: unreadable: {error}") from error
    for name in ("positions", "rotations", "foot_forces"):
        if not np.isfinite(getattr(replay, name)).all():
            raise ReplayError(f"{path}: {name}: holds numbers that are not finite")
    return replay


def _rounded(rows: Float32Array, decimals: int) -> list[list[float]]:
    # adding zero turns -0.0 into 0.0, which is shorter
    return [[round(value, decimals) + 0.0 for value in row] for row in rows.astype(np.float64).tolist()]
