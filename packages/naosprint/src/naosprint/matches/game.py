"""One game on a real rcssservermj: two halves with swapped sides, each on a server of its own, ended by the referee."""

from __future__ import annotations

import contextlib
import logging
import math
import socket
import threading
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from naosim.launchers import LauncherUnavailableError, ProcessLauncher
from naosim.mujoco.program import server_launcher
from naosim.mujoco.world import RCSSSMJ_VERSION
from naospec.teams import MAX_HALF_S, MAX_PLAYERS

from naosprint.matches.agents import AgentProcess, Limits, cpu_by_session
from naosprint.matches.containers import AgentContainer, ContainerAgents
from naosprint.matches.endpoints import AgentEndpoints
from naosprint.matches.log import GameLog, HalfRecorder, joined
from naosprint.matches.relay import REFUSAL
from naosprint.matches.stream import PLAY_MODES, Frame, Stream, StreamError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from naosim.launchers import Launcher, ServerHandle

    from naosprint.matches.stream import Player
    from naosprint.matches.teams import Team

logger = logging.getLogger(__name__)

_GAME_OVER = PLAY_MODES.index("GameOver")
_BEFORE = PLAY_MODES.index("BeforeKickOff")
_SETTLE_S = 3.0
"""Simulated seconds from the entry of the last robot to the kick-off; the robots are beamed and stand up in them."""
_LOOK_S, _CPU_S = 1.0, 10.0
"""Wall-clock seconds between two looks at the players, and between two at their processor time."""
_QUIET_S = 30.0
"""Seconds without a frame after which a server has failed: an agent that hangs costs 5, and each has its turn."""
_STILL_FRAMES = 100
"""Frames of the same time after which a server has failed."""


class MatchError(RuntimeError):
    """A game that cannot be played; the message names the team or the server and the reason."""


class ServerFailedError(MatchError):
    """A server that did not start, or that ended during a game, or the relay between it and the agents."""


class TeamFailedError(MatchError):
    """A team without a player on the field, with one that bypassed its endpoint, or whose containers do not start."""


class TooSlowError(MatchError):
    """A half that has taken all of its time; another attempt would take as long."""


@dataclass(frozen=True)
class GameSettings:
    """Settings of a game.

    Attributes:
        players: players of each team, 1 to 7.
        half_s: play time of a half, at most the rule book's 300 s.
        limits: limits of each agent.
        start_s: seconds in which server and agents have to start.
        wall_s: seconds that a half may take at most.
    """

    players: int = 3
    half_s: float = 300.0
    limits: Limits = field(default_factory=Limits)
    start_s: float = 300.0
    wall_s: float = 14_400.0

    def __post_init__(self) -> None:
        """Check.

        Raises:
            ValueError: naming the setting.
        """
        if not 1 <= self.players <= MAX_PLAYERS:
            raise ValueError(f"players: must be 1 to {MAX_PLAYERS}, not {self.players}")
        if not 1.0 <= self.half_s <= MAX_HALF_S:
            raise ValueError(f"seconds: a half has 1 to {MAX_HALF_S} seconds, not {self.half_s:g}")


@dataclass(frozen=True)
class Moment:
    """A running game at one moment.

    Attributes:
        share: share of the game that is over.
        half: number of the half, from 0.
        clock_s: play time in the half.
        mode: name of the play mode.
        goals: goals of both teams so far.
        ball: position of the ball on the field, m.
        players: team, uniform number, position, m, and direction, rad, of each robot on the field.
        clip: log of the frames since the last moment but one, in base64; empty before the kick-off.
    """

    share: float
    half: int
    clock_s: float
    mode: str
    goals: tuple[int, int]
    ball: tuple[float, float]
    players: list[tuple[int, int, float, float, float]]
    clip: str = ""


def play_game(
    teams: tuple[Team, Team],
    names: tuple[str, str],
    first_left: int,
    settings: GameSettings,
    *,
    known: bool = False,
    on_moment: Callable[[Moment], None] = lambda _moment: None,
) -> GameLog:
    """Play a game and return its log.

    A team that does not come back after half-time has no players in the second half; the other then plays on the left.

    Args:
        teams: both teams.
        names: their names for people.
        first_left: team that plays on the left, and kicks off, in the first half; the other does in the second.
        settings: players, time, limits.
        known: whether both teams have played before; if so, one that does not come to the first half has no players.
        on_moment: called about once a second; what it raises ends the game.

    Raises:
        ServerFailedError: a server did not start, or it or the agents' relay ended.
        TeamFailedError: a team that is not known did not enter the field, or neither team did, or a player entered it
            past the endpoints of the agents.
    """
    halves: list[HalfRecorder] = []
    notes = []
    for number in range(2):
        left = first_left if number == 0 else 1 - first_left
        goals = halves[0].score if halves else (0, 0)
        with _Half(teams, names, left, number, settings, goals, has_to_come=number == 0 and not known) as half:
            halves.append(half.play(on_moment))
            notes.append(half.notes())
    summary = {"server": f"rcsssmj {RCSSSMJ_VERSION}", "half_s": settings.half_s, "halves": notes}
    return joined(halves, names, summary)


def _first_second(number: int, half_s: float) -> float:
    """Return what the server's clock shows when a half begins."""
    return MAX_HALF_S * (number + 1) - half_s


def half_launcher(number: int, half_s: float) -> Launcher:
    """Return the launcher of a server that plays the last ``half_s`` seconds of a half and then ends the game."""
    launcher = server_launcher()
    if not isinstance(launcher, ProcessLauncher):
        raise MatchError("matches need a server that is a process of this machine; unset NAOSPRINT_RCSSSERVERMJ")
    more = ("--rules", "ssim", "--phase", str(number), "--time", f"{_first_second(number, half_s):g}")
    return ProcessLauncher(replace(launcher.program, arguments=(*launcher.program.arguments, *more)), launcher.command)


class _Half:
    """One half: a server, its monitor and the agents."""

    def __init__(
        self,
        teams: tuple[Team, Team],
        titles: tuple[str, str],
        left: int,
        number: int,
        settings: GameSettings,
        goals: tuple[int, int],
        *,
        has_to_come: bool,
    ) -> None:
        self._has_to_come = has_to_come
        """Whether the game fails if a team does not come."""
        self._teams, self._left, self._number, self._settings = teams, left, number, settings
        self._titles = titles
        """Names of both teams for people."""
        self._goals = goals
        """Goals of both teams in the half before."""
        self._order = (left, 1 - left)
        """Teams in the order in which they enter: the first plays on the left."""
        self._shown = [0, 0]
        """Numbers of the frames that there were at the last two moments."""
        self._names = tuple("left" if team == left else "right" for team in range(2))
        self._launcher = half_launcher(number, settings.half_s)
        self._server: ServerHandle | None = None
        self._monitor: GameMonitor | None = None
        self._agents: dict[tuple[str, int], AgentProcess | AgentContainer] = {}
        self._containers: ContainerAgents | None = None
        """Where the agents of teams with an image come from."""
        self._endpoints: AgentEndpoints | None = None
        self._entered: set[Player] = set()
        """Players whose agents have come through their endpoints."""
        self._latest_s, self._still = 0.0, 0
        """Time of the last frame, and the number of frames before it of the same time."""
        self._on_field: Collection[Player] = ()
        """Players on the field in the last frame of play."""
        self._lost: list[dict[str, Any]] = []
        self._cpu_cycles, self._cpu_at = 0, 0.0

    def __enter__(self) -> _Half:
        return self

    def __exit__(self, *_: object) -> None:
        if self._monitor is not None:
            self._monitor.close()
        if self._server is not None:
            self._server.stop()  # first, so that no agent's end counts as a loss
        for agent in self._agents.values():
            agent.stop()
        if self._containers is not None:
            self._containers.close()
        if self._endpoints is not None:
            self._endpoints.close()

    def play(self, on_moment: Callable[[Moment], None]) -> HalfRecorder:
        """Start everything, play until the referee ends the half, and return its frames."""
        settings = self._settings
        self._server = self._launcher.start()
        self._monitor = monitor = GameMonitor(self._server, time.monotonic() + settings.start_s)
        roster = [(team, number) for team in range(2) for number in range(1, settings.players + 1)]
        players = [(self._names[team], number) for team, number in roster]
        in_image = [self._teams[team].image is not None for team, _ in roster]
        self._endpoints = endpoints = AgentEndpoints(self._server.address, dict(zip(players, in_image, strict=True)))
        first = self._enter(monitor, endpoints)
        recorder = HalfRecorder(roster, players, self._left)
        kick_off_at, kicked_off = first.time_s + _SETTLE_S, False
        deadline, looked_at, frame = time.monotonic() + settings.wall_s, 0.0, first
        while frame.mode != _GAME_OVER:
            frame = self._next(monitor, endpoints, _QUIET_S + 5.0 * len(self._agents))
            if not kicked_off and frame.time_s >= kick_off_at:
                monitor.send("(kickOff Left)")
                kicked_off = True
            if frame.mode != _BEFORE:
                recorder.add(frame)
            now = time.monotonic()
            if now - looked_at > _LOOK_S:
                looked_at = now
                self._look(frame)
                on_moment(self._moment(frame, recorder))
            if now > deadline:
                raise TooSlowError(
                    f"the half took more than {settings.wall_s:,.0f} s of wall-clock time; use faster agents, fewer "
                    "players or shorter halves"
                )
        self._look(frame)
        return recorder

    def _next(self, monitor: GameMonitor, endpoints: AgentEndpoints, wait_s: float) -> Frame:
        """Return the next frame.

        Raises:
            ServerFailedError: the server's time goes back or stands still, since its simulation has started again, or
                the relay has ended, without which no agent can play.
            TeamFailedError: a player on the field has not come through its endpoint.
        """
        frame = monitor.next(time.monotonic() + wait_s)
        self._still = self._still + 1 if frame.time_s == self._latest_s else 0
        if frame.time_s < self._latest_s or self._still > _STILL_FRAMES:
            raise ServerFailedError(
                f"the server's simulation started again: its time is {frame.time_s:g} s after {self._latest_s:g} s"
            )
        self._latest_s = frame.time_s
        if failure := endpoints.failure():
            raise ServerFailedError(failure)
        if frame.mode != _GAME_OVER:
            self._on_field = frame.bodies
        if frame.bodies.keys() - self._entered:
            self._entered = endpoints.entered()
        for side, number in sorted(frame.bodies.keys() - self._entered):
            team = f"team {'AB'[self._names.index(side)]}" if side in self._names else f"team {side!r} of no agent"
            raise TeamFailedError(
                f"{team}: player {number} entered the field past the endpoints of the agents; an agent connects to the "
                "port that its command gets, once"
            )
        return frame

    def _enter(self, monitor: GameMonitor, endpoints: AgentEndpoints) -> Frame:
        """Start the agents, the left team's first; return the frame after the last has entered."""
        frame = self._next(monitor, endpoints, self._settings.start_s)
        came: set[Player] = set()  # one that the server has dropped since does not come again
        for team in self._order:
            name = self._names[team]
            for number in range(1, self._settings.players + 1):
                self._agents[name, number] = self._start(team, number, endpoints)
            last = team == self._order[1]
            deadline = time.monotonic() + self._settings.start_s
            while True:
                frame = self._next(monitor, endpoints, deadline - time.monotonic() + _QUIET_S)
                here = any(side == name for side, _ in frame.bodies)
                came |= frame.bodies.keys()
                coming = {
                    player for player, agent in self._agents.items() if agent.alive() and not self._refusal(player)
                }
                late = time.monotonic() > deadline
                if not here and (late or not any(side == name for side, _ in coming)):
                    if not self._has_to_come and (frame.bodies or not last):
                        if not last:
                            self._left = self._order[1]  # the team that enters first plays on the left
                        break
                    first = name, 1
                    words = self._agents[first].describe() + (self._refusal(first) or endpoints.refused(first))
                    raise TeamFailedError(f"team {'AB'[team]}: no player entered the field; player 1: {words}")
                if here and (late or not last or coming <= came):
                    break
        return frame

    def _start(self, index: int, number: int, endpoints: AgentEndpoints) -> AgentProcess | AgentContainer:
        """Start an agent of a team; raise TeamFailedError if its containers cannot be started."""
        team, name = self._teams[index], self._names[index]
        players, limits = self._settings.players, self._settings.limits
        if team.image is None:
            return AgentProcess(team, name, number, players, endpoints.address((name, number)), limits)
        try:
            self._containers = self._containers or ContainerAgents()
            return self._containers.start(team, name, number, players, endpoints.folder((name, number)), limits)
        except LauncherUnavailableError as error:
            raise ServerFailedError(f"team {'AB'[index]}: {error}") from error
        except OSError as error:
            raise TeamFailedError(f"team {'AB'[index]}: {error}") from error

    def _look(self, frame: Frame) -> None:
        """Note players that are no longer on the field."""
        noted = {(each["side"], each["number"]) for each in self._lost}
        for player, agent in self._agents.items():
            alive, refusal = agent.alive(), self._refusal(player).removeprefix("; ")
            stayed = frame.mode == _GAME_OVER and player in self._on_field  # agents may end with the half
            if player in noted or (stayed and not refusal):
                continue
            if refusal or player not in frame.bodies or not alive:
                side, number = player
                reason = refusal or (self._absence(player) if alive else agent.describe())
                team, clock_s = self._names.index(side), self._clock_s(frame)
                self._lost.append({"side": side, "team": team, "number": number, "clock_s": clock_s, "reason": reason})
                if alive:
                    agent.stop()
        if time.monotonic() - self._cpu_at > _CPU_S or frame.mode == _GAME_OVER:
            used_s = cpu_by_session()
            for agent in self._agents.values():
                agent.note_cpu(used_s)
            self._cpu_at = time.monotonic()
        self._cpu_cycles = round(frame.time_s / 0.02)

    def _absence(self, player: Player) -> str:
        """Return why a player is not on the field whose agent runs."""
        assert self._endpoints is not None
        if player in self._endpoints.entered():
            return "dropped by the server after 5 s without a message"
        return f"did not enter the field in {self._settings.start_s:g} s{self._endpoints.refused(player)}"

    def _refusal(self, player: Player) -> str:
        """Return why the endpoint of a player closed its connection, to follow other words; empty if it did not."""
        assert self._endpoints is not None
        try:
            why = self._endpoints.folder(player).with_name(REFUSAL.format(*player)).read_text(encoding="ascii")
        except FileNotFoundError:
            return ""
        return f"; its endpoint closed the connection: {why}"

    def _clock_s(self, frame: Frame) -> float:
        """Return the play time in the half; the server's clock counts both halves of 300 s."""
        half_s = self._settings.half_s
        return min(half_s, max(0.0, frame.clock_s - _first_second(self._number, half_s)))

    def _moment(self, frame: Frame, recorder: HalfRecorder) -> Moment:
        """Return what people see of the half now."""
        share = min(1.0, len(recorder) * 0.04 / self._settings.half_s)
        clip = recorder.clip(self._shown.pop(0), self._titles, self._number, self._goals)
        self._shown.append(len(recorder))
        players = []
        for (side, number), bodies in frame.bodies.items():
            if len(bodies):
                (forward_x, forward_y, _), (x, y, _) = bodies[0, 0].tolist(), bodies[0, 3].tolist()
                heading = round(math.atan2(forward_y, forward_x), 2)
                players.append((self._names.index(side), number, round(x, 2), round(y, 2), heading))
        x, y, _ = frame.ball_m.tolist()
        goals = frame.score if self._left == 0 else frame.score[::-1]
        return Moment(
            share=(self._number + share) / 2,
            half=self._number,
            clock_s=self._clock_s(frame),
            mode=PLAY_MODES[frame.mode],
            goals=(self._goals[0] + goals[0], self._goals[1] + goals[1]),
            ball=(round(x, 2), round(y, 2)),
            players=players,
            clip=clip,
        )

    def notes(self) -> dict[str, Any]:
        """Return what happened besides the frames."""
        enforced: set[str] = set.intersection(*(set(agent.enforced) for agent in self._agents.values()))
        return {
            "left": self._left,
            "lost": self._lost,
            "enforced": sorted(enforced),
            "cpu_s": [
                {"team": self._names.index(name), "number": number, "s": round(agent.cpu_s, 2)}
                for (name, number), agent in self._agents.items()
            ],
            "cycles": self._cpu_cycles,
        }


class GameMonitor:
    """Connection to the monitor port of a server that has run its first cycle."""

    def __init__(self, server: ServerHandle, deadline: float) -> None:
        self._server, self._stream, self._buffer = server, Stream(), bytearray()
        pause = threading.Event()
        while True:
            if not server.alive() or time.monotonic() > deadline:
                raise ServerFailedError(f"the server does not start: {server.describe()}")
            try:
                if server.owns(server.address.monitor_port):
                    self._socket = socket.create_connection((server.address.host, server.address.monitor_port), 5.0)
                    return
            except OSError as error:
                logger.debug("monitor port: %s", error)
            pause.wait(0.1)

    def next(self, deadline: float) -> Frame:
        """Return the next frame; raise ServerFailedError if the server ends or is silent for too long."""
        text = self._message(deadline)
        try:
            return self._stream.read(text)
        except StreamError as error:
            raise ServerFailedError(str(error)) from error

    def send(self, text: str) -> None:
        """Send a command."""
        try:
            self._socket.sendall(len(text).to_bytes(4, "big") + text.encode())
        except OSError as error:
            raise ServerFailedError(f"the server ended: {error}; {self._server.describe()}") from error

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._socket.close()

    def _message(self, deadline: float) -> str:
        size = int.from_bytes(self._bytes(4, deadline), "big")
        return self._bytes(size, deadline).decode()

    def _bytes(self, count: int, deadline: float) -> bytes:
        while len(self._buffer) < count:
            self._socket.settimeout(1.0)
            try:
                data = self._socket.recv(1 << 18)
            except TimeoutError:
                if not self._server.alive() or time.monotonic() > deadline:
                    raise ServerFailedError(f"the server sends nothing: {self._server.describe()}") from None
                continue
            except OSError:
                data = b""
            if not data:
                raise ServerFailedError(f"the server ended: {self._server.describe()}")
            self._buffer += data
        taken = bytes(self._buffer[:count])
        del self._buffer[:count]
        return taken
