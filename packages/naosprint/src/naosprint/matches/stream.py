"""What a rcssservermj sends to its monitors: every second cycle the game's state and the poses of all bodies."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PLAY_MODES = (
    *("BeforeKickOff", "KickOff_Left", "KickOff_Right", "PlayOn", "KickIn_Left", "KickIn_Right"),
    *("corner_kick_left", "corner_kick_right", "goal_kick_left", "goal_kick_right"),
    *("offside_left", "offside_right", "GameOver", "Goal_Left", "Goal_Right", "free_kick_left", "free_kick_right"),
    *("direct_free_kick_left", "direct_free_kick_right", "penalty_kick_left", "penalty_kick_right"),
    *("penalty_shoot_left", "penalty_shoot_right"),
)
"""Names of the play modes; messages contain the index."""

_STATE = re.compile(
    r"\(\(gs 1 0\)\(time ([-\d.e]+)\)\(half (\d)\)\(score_left (\d+)\)\(score_right (\d+)\)\(play_mode (\d+)\)"
)
_TIME = re.compile(r"\(\(gt 1 0\)([-\d.e]+)\)")
_AGENT = re.compile(r" DSC\(agent (\S+) (\d+)\)")
_NODE, _TRANSFORM, _BALL = "(nd", " TRF(SLT ", " DSC(ball)"

Player = tuple[str, int]
"""Name of the team, uniform number."""


class StreamError(ValueError):
    """A message that is not what the server of the pinned version sends."""


@dataclass
class Frame:
    """State of the game in one cycle.

    Attributes:
        time_s: simulated seconds since the server's start.
        clock_s: play time.
        mode: index of the play mode.
        score: goals of left and right.
        ball_m: (3,) position.
        bodies: by player, (B, 4, 3): the rows are the axes of a body in its parent, and its position there. The first
            is the torso in the world; each of the others has one joint, in the robot's order.
    """

    time_s: float
    clock_s: float
    mode: int
    score: tuple[int, int]
    ball_m: NDArray[np.float64]
    bodies: dict[Player, NDArray[np.float32]]


class Stream:
    """Reader of a monitor's messages; each is a change of the one before, or a full state."""

    def __init__(self) -> None:
        self._nodes = 0
        self._ball = -1
        self._index: dict[Player, list[int]] = {}
        self._poses: dict[Player, NDArray[np.float32]] = {}
        self._place = np.zeros(3)

    def read(self, message: str) -> Frame:
        """Return the state after a message.

        Raises:
            StreamError: if the message is not understood.
        """
        state, time = _STATE.search(message), _TIME.search(message)
        begin, end = message.find("((sg 1 0)"), message.find("((gs 1 0)")
        if state is None or time is None or begin < 0 or end < begin:
            raise StreamError(f"not a message of rcssservermj to a monitor: {message[:80]!r}")
        header, *nodes = message[begin:end].split(_NODE)
        if header.endswith("full"):
            self._learn(nodes)
        elif len(nodes) != self._nodes:
            raise StreamError(f"{len(nodes)} nodes changed, of a scene with {self._nodes}")
        self._apply(nodes)
        clock, _, left, right, mode = state.groups()
        return Frame(
            time_s=float(time[1]),
            clock_s=float(clock),
            mode=int(mode),
            score=(int(left), int(right)),
            ball_m=self._place.copy(),
            bodies={player: poses.copy() for player, poses in self._poses.items()},
        )

    def _learn(self, nodes: list[str]) -> None:
        """Find the ball and the robots' bodies in a full state.

        A body is a node with a transformation and at least one child with a transformation: another body or a shape.
        """
        parents, stack = [], [-1]
        for i, node in enumerate(nodes):
            parents.append(stack[-1])
            stack.append(i)
            closed = node.count(")") - node.count("(")
            del stack[len(stack) - max(0, min(closed, len(stack) - 1)) :]
        placed = [node.startswith(_TRANSFORM) for node in nodes]
        bodies = {parent for i, parent in enumerate(parents) if placed[i] and parent >= 0 and placed[parent]}
        self._nodes, self._index, self._poses = len(nodes), {}, {}
        owner: list[Player | None] = []
        for i, node in enumerate(nodes):
            found = _AGENT.match(node)
            own = owner[parents[i]] if parents[i] >= 0 else None
            if found is not None:
                own = (found[1], int(found[2]))
                self._index[own] = []
            elif own is not None and i in bodies:
                self._index[own].append(i)
            elif node.startswith(_BALL):
                self._ball = i + 1
            owner.append(own)
        for player, index in self._index.items():
            self._poses[player] = np.zeros((len(index), 4, 3), np.float32)

    def _apply(self, nodes: list[str]) -> None:
        if 0 <= self._ball < len(nodes) and nodes[self._ball].startswith(_TRANSFORM):
            self._place = _numbers(nodes[self._ball])[3].astype(np.float64)
        for player, index in self._index.items():
            poses = self._poses[player]
            for row, i in enumerate(index):
                if nodes[i].startswith(_TRANSFORM):
                    poses[row] = _numbers(nodes[i])


def _numbers(node: str) -> NDArray[np.float32]:
    """Return the (4, 3) axes and position of a node's transformation."""
    text = node[len(_TRANSFORM) : node.index(")")]
    return np.array(text.split(), np.float32).reshape(4, 4)[:, :3]
