"""State shared by all robots of a server: teams, play mode, score and ball. The trainer is the referee."""

from __future__ import annotations

import math

from naosim.robots.nao_model import CYCLE_S
from naosim.simspark import protocol

_MASS, _DRAG = 0.026, 0.01
_GRAVITY = 9.81
_BOUNCE, _BOUNCE_SPEED = 0.8, 0.8
TEAM_SIZE = 11


class Ball:
    """Ball without a kicker: gravity, drag and bounces on the ground; it passes through robots."""

    def __init__(self) -> None:
        self.position = (0.0, 0.0, protocol.BALL_RADIUS)
        self.velocity = (0.0, 0.0, 0.0)

    def step(self) -> None:
        """Advance by one cycle."""
        if self.velocity == (0.0, 0.0, 0.0) and self.position[2] <= protocol.BALL_RADIUS:
            return
        keep = 1.0 - _DRAG / _MASS * CYCLE_S
        vx, vy, vz = (keep * v for v in self.velocity)
        x, y, z = self.position
        vz -= _GRAVITY * CYCLE_S
        z += vz * CYCLE_S
        if z < protocol.BALL_RADIUS:
            z = protocol.BALL_RADIUS
            vz = -_BOUNCE * vz if -vz > _BOUNCE_SPEED else 0.0
        if vz == 0.0 and math.hypot(vx, vy) < 1e-3:
            vx = vy = 0.0
        self.velocity = (vx, vy, vz)
        self.position = (x + vx * CYCLE_S, y + vy * CYCLE_S, z)


class Game:
    """State of the game."""

    def __init__(self) -> None:
        self.play_mode = protocol.PLAY_MODES[0]
        self.scores = (0, 0)
        self.teams: list[str] = []
        self.ball = Ball()
        self._numbers: dict[int, set[int]] = {1: set(), 2: set()}
        self._joined = {1: 0, 2: 0}

    def join(self, team: str, uniform_number: int) -> tuple[int, int]:
        """Add a player.

        Returns:
            Side (1 left, 2 right) and number; number 0 asks for the lowest free one.

        Raises:
            ProtocolError: the name cannot be used, two teams are there already, or the number is taken.
        """
        if not team or not team.isascii() or not team.isprintable():
            raise protocol.ProtocolError("init: teamname must be printable ASCII")
        if team not in self.teams:
            if len(self.teams) == 2:
                raise protocol.ProtocolError(f"init: two teams play already, {team} cannot join")
            self.teams.append(team)
        side = self.teams.index(team) + 1
        taken = self._numbers[side]
        number = uniform_number or next((k for k in range(1, TEAM_SIZE + 1) if k not in taken), 0)
        if not 1 <= number <= TEAM_SIZE or number in taken:
            raise protocol.ProtocolError(f"init: number {number} of team {team} is not available")
        taken.add(number)
        self._joined[side] += 1
        return side, number

    def leave(self, side: int, uniform_number: int) -> None:
        """Free a player's number."""
        if side:
            self._numbers[side].discard(uniform_number)

    def entry(self, side: int) -> tuple[tuple[float, float, float], float]:
        """Return where the player of a side who joined last enters: place of the torso (m) and yaw (degrees)."""
        radius = 0.4
        sign = -1.0 if side == 1 else 1.0
        rows = int((protocol.FIELD_WIDTH - 2 * radius) / (3 * radius)) + 1
        column, row = divmod((self._joined[side] - 1) % (rows * 8), rows)
        x = sign * (protocol.FIELD_LENGTH / 2 - 2 * radius) + 2 * radius * column
        y = protocol.FIELD_WIDTH / 2 - 2 * radius - 3 * radius * row
        return (x, y, radius), 90.0 * sign

    def sideline(self, side: int, uniform_number: int) -> tuple[float, float, float]:
        """Return where a referee puts a player outside the field: beside it, away from the ball, m."""
        x = (-0.6 if side == 1 else 0.6) * (7 - uniform_number)
        y = protocol.FIELD_WIDTH / 2 + 0.5
        return (x, y if self.ball.position[1] < 0 else -y, 1.0)
