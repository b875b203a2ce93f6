"""A server with one player of a team, whom the monitor gives something to do."""

from __future__ import annotations

import sys
import time

from naosprint.matches.agents import AgentProcess, Limits
from naosprint.matches.game import GameMonitor, half_launcher
from naosprint.matches.stream import PLAY_MODES, Frame
from naosprint.matches.teams import Team

PLAY_ON = PLAY_MODES.index("PlayOn")
TORSO_M, BALL_M = 0.6735, 0.11
"""Heights of the torso of a robot that stands, and of a ball that rests."""

_HALF_S, _PATIENCE_S = 300.0, 120.0


class Drill:
    """A server with one player.

    Args:
        team: the team.
        name: its name on the server.
        number: the player's number.
        players: players that the team believes to have.
    """

    def __init__(self, team: Team, name: str, number: int, players: int) -> None:
        self._name, self._number = name, number
        self._server = half_launcher(0, _HALF_S).start()
        self._monitor = GameMonitor(self._server, time.monotonic() + _PATIENCE_S)
        self._agent = AgentProcess(team, name, number, players, self._server.address, Limits())
        self._advance()
        while not self._frame.bodies:
            self._advance()

    def close(self) -> None:
        """End server and player."""
        self._monitor.close()
        self._server.stop()
        self._agent.stop()

    def _play_on(self) -> None:
        """Bring the game into play."""
        while self._frame.mode != PLAY_ON:
            self._monitor.send("(kickOff Right)")  # who kicks off must not score with its first touch
            self._wait(0.2)
            self._monitor.send("(dropBall)")
            self._wait(0.2)

    def _move(self, x: float, y: float, yaw_deg: float) -> None:
        """Put the robot somewhere, upright and without speed."""
        place = f"{x:.3f} {y:.3f} {TORSO_M} {yaw_deg:.1f}"
        self._monitor.send(f"(agent (unum {self._number})(team {self._name})(move {place}))")

    def _torso_m(self) -> float:
        (bodies,) = self._frame.bodies.values()
        return float(bodies[0, 3, 2])

    def _advance(self) -> None:
        """Read the next state of the game, in which the player takes part."""
        if not self._agent.alive():
            sys.exit(f"the agent of {self._name}: {self._agent.describe()}")
        self._frame: Frame = self._monitor.next(time.monotonic() + _PATIENCE_S)
        if PLAY_MODES[self._frame.mode] == "GameOver":
            sys.exit("the half is over; give the player less to do on a server")

    def _wait(self, seconds: float) -> None:
        end_s = self._frame.time_s + seconds
        while self._frame.time_s < end_s:
            self._advance()
