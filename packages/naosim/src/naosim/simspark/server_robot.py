"""One robot of the server: an engine of its own, its commands and its perceptors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from naosim.robots import nao_model
from naosim.simspark import _core, protocol
from naosim.simspark.batch import BatchSimulator
from naosim.simspark.server_scene import Actor

Point = tuple[float, float, float]

EFFECTORS = frozenset(joint.effector for kind in nao_model.ROBOT_TYPES for joint in nao_model.model(kind).joints)
"""Hinge effectors of any robot type."""

SPAWN = (0.0, -1.0, 1.5)
"""Position in the air at which robots are created, m."""

_PARTS = {"rlowerarm": "rlowerarm", "llowerarm": "llowerarm", "rfoot": "rfoot", "lfoot": "lfoot"}
_HEARING = 2
"""Hearing capacity: a message uses all of it, a cycle restores 1, so one message in two cycles is heard."""


class ServerRobot:
    """One robot, alone on its field, and the writer of its agent messages."""

    def __init__(self, robot_type: int, *, digits: int, seed: int, noise: bool) -> None:
        self.engine = BatchSimulator(1, robot_type, digits=digits)
        self.engine.beam(SPAWN)
        self.model = self.engine.model
        self.team = ""
        self.side = 0
        self.uniform_number = 0
        self.selected = False
        self.game_time = 0.0
        self.cycles = 0
        self.speeds: NDArray[np.float64] = np.zeros((1, len(self.model.joints)))
        effectors = [joint.effector for joint in self.model.joints]
        self.commands = _core.CommandReader(effectors)
        self._writer = _core.PerceptorWriter(protocol.percept_order(self.model), digits)
        self._vision = _core.Vision(list(protocol.LANDMARKS), protocol.LINES, digits, seed, noise)
        self._digits = digits
        self._head = self.model.body_index["head"]
        self._parts = [(name, self.model.body_index[body]) for name, body in _PARTS.items()]
        self._touch: NDArray[np.float64] = np.full((4, 6), np.nan)
        self._news = b""
        self._heard: dict[str, tuple[str, str, str]] = {}
        self._hearing = {"mate": _HEARING, "opponent": _HEARING}
        self._introduced = False

    @property
    def actor(self) -> Actor:
        """Return the robot as a monitor sees it."""
        return Actor(self.model, self.side, self.uniform_number, self.selected)

    @property
    def poses(self) -> NDArray[np.float64]:
        """Return all body states, shape (bodies, 13)."""
        bodies: NDArray[np.float64] = self.engine.truth.bodies[0]
        return bodies

    @property
    def position(self) -> NDArray[np.float64]:
        """Return where the torso is, shape (3,), m."""
        position: NDArray[np.float64] = self.engine.truth.torso_position[0]
        return position

    def join(self, team: str, side: int, uniform_number: int) -> None:
        """Set the robot's team and number."""
        self.team, self.side, self.uniform_number = team, side, uniform_number

    def beam(self, position: Point, yaw_deg: float) -> None:
        """Move the robot to a position, upright and at rest; its pose is kept."""
        self.engine.beam(position, yaw_deg)

    def shift(self, position: Point) -> None:
        """Move the torso's centre to a position without turning the robot, and set all velocities to 0."""
        bodies = self.engine.truth.bodies
        bodies[0, :, :3] += np.asarray(position) - bodies[0, 0, :3]
        bodies[0, :, 7:] = 0.0
        self.engine.set_bodies(bodies)

    def turn(self, angles_deg: Point) -> None:
        """Turn the torso to Rx Ry Rz about its centre, pose kept; everything comes to rest."""
        bodies = self.engine.truth.bodies
        half = np.deg2rad(angles_deg) / 2
        to = np.array([1.0, 0.0, 0.0, 0.0])
        for axis in range(3):
            factor = np.zeros(4)
            factor[0], factor[1 + axis] = np.cos(half[axis]), np.sin(half[axis])
            to = _product(to, factor)
        by = _product(to, bodies[0, 0, 3:7] * (1, -1, -1, -1))
        centre = bodies[0, 0, :3].copy()
        bodies[0, :, :3] = centre + (bodies[0, :, :3] - centre) @ _rotation(by).T
        bodies[0, :, 3:7] = _product(by, bodies[0, :, 3:7])
        bodies[0, :, 7:] = 0.0
        self.engine.set_bodies(bodies)

    def hear(self, who: str, team: str, direction: str, text: str) -> None:
        """Deliver a message to the robot; `who` is `self`, `mate` or `opponent`."""
        if who in self._hearing:
            if self._hearing[who] < _HEARING:
                return
            self._hearing[who] -= _HEARING
        self._heard[who] = (team, direction, text)

    def cycle(self, ball: Point, play_mode: str, scores: tuple[int, int]) -> bytes:
        """Run one cycle with the commands given so far.

        Returns:
            The message for the agent, its length in front: what was perceived before the cycle.

        Raises:
            FloatingPointError: the robot's state is no longer finite.
        """
        self.cycles += 1
        see = self._see(ball) if self.cycles % protocol.VISION_INTERVAL == 0 else b""
        self.engine.step(self.speeds)
        p = self.engine.perceptors
        for k, touch in enumerate((p.foot_right, p.foot_left, p.toe_right, p.toe_left)):
            if k < len(self.model.touch_sensors):
                self._touch[k] = touch[0]
        now = self._number(float(p.time[0]))
        news = self._news or self._game_state(play_mode, scores)
        head = f"(time (now {now}))".encode() + news
        message = self._writer.write(head, see, p.gyro[0], p.accel[0], p.joint_angles[0], self._touch)
        if play_mode not in ("BeforeKickOff", "GameOver"):
            self.game_time += nao_model.CYCLE_S
        # perceived at the end of this cycle, sent in the next message
        self._news = self._game_state(play_mode, scores) + self._hear()
        return message

    def _number(self, value: float) -> str:
        return f"{value:.{self._digits}f}"

    def _game_state(self, play_mode: str, scores: tuple[int, int]) -> bytes:
        introduction = ""
        if self.side and not self._introduced:
            self._introduced = True
            introduction = f"(unum {self.uniform_number}) (team {protocol.SIDES[self.side]}) "
        score = f"(sl {scores[0]}) (sr {scores[1]})"
        return f"(GS {introduction}{score} (t {self._number(self.game_time)}) (pm {play_mode}))".encode()

    def _hear(self) -> bytes:
        time = self._number(self.game_time)
        out = []
        for who in ("self", "mate", "opponent"):
            if who in self._hearing:
                self._hearing[who] = min(self._hearing[who] + 1, _HEARING)
            if who in self._heard:
                team, direction, text = self._heard.pop(who)
                out.append(f"(hear {team} {time} {direction} {text})")
        return "".join(out).encode()

    def _see(self, ball: Point) -> bytes:
        poses = self.poses
        head = poses[self._head]
        own = f"(team {self.team}) (id {self.uniform_number})" if self.team else ""
        parts = [(name, _point(poses[row])) for name, row in self._parts] if own else []
        return self._vision.see(np.ascontiguousarray(head[:3]), _rotation(head[3:7]), [("B", ball)], own, parts)


def _point(pose: NDArray[np.float64]) -> Point:
    return (float(pose[0]), float(pose[1]), float(pose[2]))


def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply quaternions, shapes (..., 4), real part first."""
    real = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(axis=-1, keepdims=True)
    rest = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([real, rest], axis=-1)


def _rotation(q: NDArray[np.float64]) -> NDArray[np.float64]:
    w, x, y, z = (float(c) for c in q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
