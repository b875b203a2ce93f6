"""Log of a game: where all robots and the ball were, score, clock and play mode, 25 times a second, in one file."""

from __future__ import annotations

import base64
import io
import json
from dataclasses import dataclass, field
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from naosim import robots
from naosim.mujoco.world import world_of
from naosim.npz import read_npz

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from naosprint.matches.stream import Frame, Player

FORMAT = 1
LEFT, RIGHT = 0, 1
CLIP_FRAMES = 26
"""Most frames of what is shown of a running game: about two seconds, every second frame."""
_MAX_BYTES = 2_000_000_000
_MM, _RAD, _QUATERNION = 1e-3, 2e-4, 1e-4
"""Units of the numbers in a file, which are integers of 16 bits."""
_ARRAYS = ("half", "clock_s", "mode", "score", "ball", "torso", "quaternion", "joints", "present")


@dataclass
class GameLog:
    """A game. With T frames and R robots; teams are 0 and 1 in the order of the match, on whatever side they play.

    Attributes:
        teams: names of both teams.
        robots: of each robot its team and uniform number.
        sides: side of team 0 in each half, `LEFT` or `RIGHT`.
        half: (T,) number of the half, from 0.
        clock_s: (T,) play time since the start of the half.
        mode: (T,) index of `naosprint.matches.stream.PLAY_MODES`.
        score: (T, 2) goals of each team so far.
        ball_m: (T, 3) position.
        torso_m: (T, R, 3) positions.
        quaternion: (T, R, 4) orientation w, x, y, z.
        joints_rad: (T, R, J) angles; J is 0 if a robot is neither a T1 nor a K1.
        present: (T, R) whether the robot is on the field.
        notes: what happened: lost players with the reason, limits that were enforced, processor time, versions.
    """

    teams: tuple[str, str]
    robots: list[tuple[int, int]]
    sides: list[int]
    half: NDArray[np.uint8]
    clock_s: NDArray[np.float32]
    mode: NDArray[np.uint8]
    score: NDArray[np.uint8]
    ball_m: NDArray[np.float32]
    torso_m: NDArray[np.float32]
    quaternion: NDArray[np.float32]
    joints_rad: NDArray[np.float32]
    present: NDArray[np.bool_]
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def goals(self) -> tuple[int, int]:
        """Goals of both teams."""
        return (int(self.score[-1, 0]), int(self.score[-1, 1]))

    def save(self, path: Path | IO[bytes]) -> None:
        """Write it to a file."""
        meta = {"format": FORMAT, "teams": self.teams, "robots": self.robots, "sides": self.sides, "notes": self.notes}
        arrays = {
            "half": self.half,
            "clock_s": self.clock_s,
            "mode": self.mode,
            "score": self.score,
            "ball": _packed(self.ball_m, _MM),
            "torso": _packed(self.torso_m, _MM),
            "quaternion": _packed(self.quaternion, _QUATERNION),
            "joints": _packed(self.joints_rad, _RAD),
            "present": self.present,
        }
        text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
        np.savez_compressed(path, allow_pickle=False, meta=text, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path) -> GameLog:
        """Read it from a file.

        Raises:
            OSError: if it cannot be read.
            ValueError: if it is no log of a game.
        """
        try:
            arrays = read_npz(path, max_bytes=_MAX_BYTES)
        except ValueError as error:
            raise ValueError(f"{path}: not the log of a game ({error})") from None
        try:
            meta = json.loads(arrays["meta"].tobytes())
            if meta["format"] != FORMAT:
                raise ValueError(f"{path}: format {meta['format']} of a game's log, this version reads {FORMAT}")
            found = {name: arrays[name] for name in _ARRAYS}
        except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError):
            raise ValueError(f"{path}: not the log of a game") from None
        return cls(
            teams=tuple(meta["teams"]),
            robots=[tuple(each) for each in meta["robots"]],
            sides=meta["sides"],
            notes=meta["notes"],
            half=found["half"],
            clock_s=found["clock_s"],
            mode=found["mode"],
            score=found["score"],
            ball_m=_unpacked(found["ball"], _MM),
            torso_m=_unpacked(found["torso"], _MM),
            quaternion=_unpacked(found["quaternion"], _QUATERNION),
            joints_rad=_unpacked(found["joints"], _RAD),
            present=found["present"],
        )


def _packed(values: NDArray[Any], unit: float) -> NDArray[np.int16]:
    return np.clip(np.rint(values / unit), -32768, 32767).astype(np.int16)


def _unpacked(values: NDArray[Any], unit: float) -> NDArray[np.float32]:
    return (values * unit).astype(np.float32)


class HalfRecorder:
    """Frames of one half.

    Args:
        robots: team and uniform number of every robot.
        players: the same robots by the names of the server.
        left: team that plays on the left.
    """

    def __init__(self, robots: Sequence[tuple[int, int]], players: Sequence[Player], left: int) -> None:
        self.robots, self.players, self.left = list(robots), list(players), left
        self._rows: list[tuple[float, int, tuple[int, int], Any]] = []
        self._poses: list[tuple[NDArray[np.float32], NDArray[np.bool_]]] = []
        self._angles: list[NDArray[np.float32]] = []

    def add(self, frame: Frame) -> None:
        """Record a frame."""
        score = frame.score if self.left == 0 else frame.score[::-1]
        self._rows.append((frame.clock_s, frame.mode, (score[0], score[1]), frame.ball_m))
        bodies = [frame.bodies.get(player) for player in self.players]
        present = np.array([each is not None and len(each) > 0 for each in bodies])
        torso = np.zeros((len(bodies), 7), np.float32)
        torso[:, 3] = 1.0
        angles = []
        for row, each in zip(torso, bodies, strict=True):
            if each is not None and len(each) > 0:
                row[:3], row[3:] = each[0, 3], _quaternion(each[0, :3].T)
            angles.append(joint_angles(each))
        widest = max((len(each) for each in angles), default=0)
        self._angles.append(np.array([np.pad(each, (0, widest - len(each))) for each in angles], np.float32))
        self._poses.append((torso, present))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._rows)

    @property
    def score(self) -> tuple[int, int]:
        """Goals of both teams in this half."""
        return self._rows[-1][2] if self._rows else (0, 0)

    def arrays(self, frames: slice = slice(None)) -> dict[str, NDArray[Any]]:
        """Return frames, all of them if none are named, as arrays; the clock begins with 0."""
        rows, poses, angles = self._rows[frames], self._poses[frames], self._angles[frames]
        clock = np.array([row[0] for row in rows], np.float32)
        widest = max((each.shape[1] for each in angles), default=0)
        return {
            "clock_s": clock - self._rows[0][0],
            "mode": np.array([row[1] for row in rows], np.uint8),
            "score": np.array([row[2] for row in rows], np.uint8),
            "ball_m": np.array([row[3] for row in rows], np.float32),
            "torso_m": np.array([torso[:, :3] for torso, _ in poses], np.float32),
            "quaternion": np.array([torso[:, 3:] for torso, _ in poses], np.float32),
            "joints_rad": np.array(
                [np.pad(each, ((0, 0), (0, widest - each.shape[1]))) for each in angles], np.float32
            ),
            "present": np.array([present for _, present in poses]),
        }

    def clip(self, first: int, teams: tuple[str, str], half: int, goals: tuple[int, int]) -> str:
        """Return the frames since ``first``, at most `CLIP_FRAMES` of them, as a log in base64; empty without any.

        Its notes have the index of the first frame in the half, and the step between two.

        Args:
            first: index of a frame of the half.
            teams: names of both teams.
            half: number of the half, from 0.
            goals: goals of both teams in the half before.
        """
        count = len(self) - first
        if count <= 0:
            return ""
        step = 2
        while step * CLIP_FRAMES < count:
            step *= 2  # the game is faster than its clock
        first = -(-first // step) * step
        arrays = self.arrays(slice(first, None, step))
        frames = len(arrays["mode"])
        if not frames:
            return ""
        arrays["score"] += np.array(goals, np.uint8)
        log = GameLog(
            teams=teams,
            robots=self.robots,
            sides=[LEFT if self.left == 0 else RIGHT],
            half=np.full(frames, half, np.uint8),
            notes={"first": first, "step": step},
            **arrays,
        )
        file = io.BytesIO()
        log.save(file)
        return base64.b64encode(file.getvalue()).decode()


def joined(halves: Sequence[HalfRecorder], teams: tuple[str, str], notes: dict[str, Any]) -> GameLog:
    """Return the log of a game from its halves.

    Raises:
        ValueError: if a half has no frame.
    """
    if not halves or not all(map(len, halves)):
        raise ValueError("a half without a frame")
    parts: list[Mapping[str, NDArray[Any]]] = [half.arrays() for half in halves]
    total = np.zeros(2, np.int64)
    for part in parts:
        part["score"][:] = part["score"] + total
        total = part["score"][-1].astype(np.int64)
    widest = max(part["joints_rad"].shape[2] for part in parts)
    for part in parts:
        missing = widest - part["joints_rad"].shape[2]
        part["joints_rad"] = np.pad(part["joints_rad"], ((0, 0), (0, 0), (0, missing)))  # type: ignore[index]
    half = np.repeat(np.arange(len(parts), dtype=np.uint8), [len(part["mode"]) for part in parts])
    return GameLog(
        teams=teams,
        robots=halves[0].robots,
        sides=[LEFT if each.left == 0 else RIGHT for each in halves],
        half=half,
        notes=notes,
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
    )


def joint_angles(bodies: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """Return the (J,) angles of a robot's joints from its (B, 4, 3) bodies, none if it is neither a T1 nor a K1."""
    model = _MODELS.get(len(bodies)) if bodies is not None else None
    if model is None or bodies is None:
        return np.zeros(0, np.float32)
    rest, axes = _rest(model)
    turned = np.einsum("jab,jbc->jac", rest.transpose(0, 2, 1), bodies[1:, :3].transpose(0, 2, 1))
    skew = np.stack(
        [turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0], turned[:, 1, 0] - turned[:, 0, 1]],
        axis=1,
    )
    sine = 0.5 * np.einsum("ja,ja->j", skew, axes)
    cosine = 0.5 * (np.trace(turned, axis1=1, axis2=2) - 1.0)
    angles: NDArray[np.float32] = np.arctan2(sine, cosine).astype(np.float32)
    return angles


_MODELS = {24: "t1", 23: "k1"}
"""Robot by its number of bodies, the torso included."""
_RESTS: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}


def _rest(robot: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (J, 3, 3) orientations of bodies in their parents at angle 0, and (J, 3) axes of their joints."""
    if robot not in _RESTS:
        world = world_of(robots.get(robot))
        model = world.model
        joints = model.njnt - 2  # without the free ones of ball and torso
        bodies = model.jnt_bodyid[-joints:]
        matrices = [_matrix(model.body_quat[body]) for body in bodies]
        _RESTS[robot] = (np.array(matrices), np.array(model.jnt_axis[-joints:]))
    return _RESTS[robot]


def _matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    w, x, y, z = quaternion
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: NDArray[np.float64] = np.eye(3) + 2.0 * (w * cross + cross @ cross)
    return matrix


def _quaternion(matrix: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the quaternion of a rotation by the largest of its four components."""
    m = matrix.astype(np.float64)
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    k = int(squares.argmax())
    products = {
        0: (squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]),
        1: (m[2, 1] - m[1, 2], squares[1], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]),
        2: (m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], squares[2], m[1, 2] + m[2, 1]),
        3: (m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[3]),
    }[k]
    q = np.array(products) / (2.0 * np.sqrt(squares[k]))
    quaternion: NDArray[np.float64] = q / np.linalg.norm(q)
    return quaternion if quaternion[0] >= 0 else -quaternion
