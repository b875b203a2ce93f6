"""Elements of rcssserver3d's network protocol: messages, limits, the field's landmarks and lines, play modes.

A message is a length of four bytes, most significant first, and that many bytes of S-expressions. Field coordinates are
the server's: origin at the centre spot, x towards the right team's goal, y to the left team's left, z up; metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from naosim.fields import RCSSSERVER3D
from naosim.robots.nao_model import RobotModel

AGENT_PORT = 3100
MONITOR_PORT = 3200

MAX_MESSAGE = 8192
"""Bytes of the largest message to or from an agent."""

MAX_TRAINER_MESSAGE = 65536
"""Bytes of the largest message from a monitor."""

PLAY_MODES = (
    *("BeforeKickOff", "KickOff_Left", "KickOff_Right", "PlayOn", "KickIn_Left", "KickIn_Right"),
    *("corner_kick_left", "corner_kick_right", "goal_kick_left", "goal_kick_right", "offside_left", "offside_right"),
    *("GameOver", "Goal_Left", "Goal_Right", "free_kick_left", "free_kick_right"),
    *("direct_free_kick_left", "direct_free_kick_right", "pass_left", "pass_right"),
)
"""In the order of the monitor port's numbers."""

SIDES = ("none", "left", "right")

FIELD_LENGTH, FIELD_WIDTH = RCSSSERVER3D.length_m, RCSSSERVER3D.width_m
GOAL_WIDTH, GOAL_HEIGHT, GOAL_DEPTH = RCSSSERVER3D.goal.width_m, RCSSSERVER3D.goal.height_m, RCSSSERVER3D.goal.depth_m
BALL_RADIUS = RCSSSERVER3D.ball_radius_m
VISION_INTERVAL = 3
"""Cycles from one See to the next."""

SAY_LENGTH = 20
"""Maximum length of a message between players, characters."""

Landmark = tuple[str, tuple[float, float, float]]


def _landmarks() -> tuple[Landmark, ...]:
    x, y, post = FIELD_LENGTH / 2, FIELD_WIDTH / 2, GOAL_WIDTH / 2
    # in the order of the server's scene, where the right goal is the left one turned round
    goals = [("G1L", -x, post), ("G2L", -x, -post), ("G2R", x, -post), ("G1R", x, post)]
    flags = [("F1L", -x, y), ("F2L", -x, -y), ("F1R", x, y), ("F2R", x, -y)]
    return tuple((name, (at, to, GOAL_HEIGHT)) for name, at, to in goals) + tuple(
        (name, (at, to, 0.0)) for name, at, to in flags
    )


def _lines() -> NDArray[np.float64]:
    x, y = FIELD_LENGTH / 2, FIELD_WIDTH / 2
    ((depth, width),), radius = RCSSSERVER3D.areas_m, RCSSSERVER3D.circle_radius_m
    box, side = x - depth, width / 2
    lines = [(0.0, -y, 0.0, y), (x, -y, x, y), (-x, -y, -x, y), (x, y, -x, y), (x, -y, -x, -y)]
    for sign in (1.0, -1.0):
        lines.append((sign * box, side, sign * box, -side))
        lines += [(sign * box, s, sign * x, s) for s in (side, -side)]
    ring = [(radius * math.cos(k * math.pi / 5), radius * math.sin(k * math.pi / 5)) for k in range(11)]
    lines += [(*a, *b) for a, b in pairwise(ring)]
    return np.array([(a, b, 0.0, c, d, 0.0) for a, b, c, d in lines])


LANDMARKS = _landmarks()
"""Corner flags `F1L` ... and goal posts `G1L` ..., with their positions."""

LINES = _lines()
"""Field lines, shape (21, 6): both ends; the centre circle is ten chords."""


class ProtocolError(ValueError):
    """Message that violates the protocol; the error's message states where."""


def frame(payload: bytes) -> bytes:
    """Return a message with its length as prefix."""
    return len(payload).to_bytes(4, "big") + payload


class Framer:
    """Splitter of a stream of bytes into messages of at most `limit` bytes."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._buffer = bytearray()

    def __len__(self) -> int:
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add what was received."""
        self._buffer += data

    def __iter__(self) -> Iterator[bytes]:
        return iter(self.pop, None)

    def pop(self) -> bytes | None:
        """Return the next complete message, or None.

        Raises:
            ProtocolError: a message longer than the limit is announced.
        """
        if len(self._buffer) < 4:
            return None
        size = int.from_bytes(self._buffer[:4], "big")
        if size > self._limit:
            raise ProtocolError(f"a message of {size} bytes is announced, {self._limit} are allowed")
        if len(self._buffer) < 4 + size:
            return None
        payload = bytes(self._buffer[4 : 4 + size])
        del self._buffer[: 4 + size]
        return payload


def percept_order(model: RobotModel) -> list[tuple[str, str, int]]:
    """Return the order in which an agent message lists a robot's joints, touch sensors and See.

    Returns:
        (`j`, joint, its index), (`t`, sensor, its index in rf lf rf1 lf1) and (`s`, `See`, 0).
    """
    sensors = {body: name for name, body in model.touch_sensors}
    number = {name: k for k, name in enumerate(("rf", "lf", "rf1", "lf1"))}
    by_body = {joint.body: joint.name for joint in model.joints}
    order: list[tuple[str, str, int]] = []
    # the server lists parts as its scene does: head, right arm, left arm, right leg, left leg
    arm, leg = ("shoulder", "upperarm", "elbow", "lowerarm"), ("hip1", "hip2", "thigh", "shank", "ankle", "foot", "toe")
    limbs = [f"{side}{part}" for limb in (arm, leg) for side in "rl" for part in limb]
    for body in ("neck", "head", *limbs):
        if body not in by_body:
            continue
        if body in sensors:
            order.append(("t", sensors[body], number[sensors[body]]))
        order.append(("j", by_body[body], model.joint_index[by_body[body]]))
        if body == "head":
            order.append(("s", "See", 0))
    return order
