"""A drop-in for rcssserver3d on the embedded engine: agent port and monitor port in one process.

Each robot runs on its own engine, at its own agent's pace: robots hear each other, but do not collide with or see each
other, and no agent waits for another. There is no referee. In sync mode a robot's cycle runs when its agent sends
`(syn)` (or `(scene ...)` or `(init ...)`, which are answered too); in real-time mode 50 times a second.

A client that breaks the protocol is disconnected, with the reason in the log; others are not affected. Memory is
bounded: messages and connections have a limit, the server stops reading from an agent that does not read its replies,
and skips frames for a monitor that does not read.
"""

from __future__ import annotations

import asyncio
import logging
import math
import random
import resource
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from naosim.robots import nao_model
from naosim.simspark import _core, protocol
from naosim.simspark.protocol import ProtocolError
from naosim.simspark.server_game import Game
from naosim.simspark.server_robot import EFFECTORS, Point, ServerRobot
from naosim.simspark.server_scene import describe

logger = logging.getLogger(__name__)

Expression = Sequence[Any]
"""An S-expression: words and tuples of them."""

HANDSHAKE_S = 10.0
"""Time after which an agent that has not requested a robot is disconnected."""

SILENCE_S = 61.0
"""Time after which a silent agent is disconnected in sync mode, as by the real server."""

_BACKLOG_BYTES = 1 << 20
_BEAM_NOISE_M, _BEAM_NOISE_DEG = 0.05, 10.0
_FARTHEST = 1000.0


@dataclass(frozen=True)
class ServerSettings:
    """Settings of `naosim serve`."""

    host: str = "127.0.0.1"
    agent_port: int = protocol.AGENT_PORT
    """0: any free port."""
    monitor_port: int = protocol.MONITOR_PORT
    realtime: bool = False
    digits: int = 2
    """Decimals of the perceptors: 2 as the league's server, 3 as the development version."""
    seed: int | None = None
    """Seed of vision and beam noise; None: random."""
    noise: bool = True
    """Whether vision and the beam effector are noisy."""
    max_agents: int = 64
    max_connections: int = 512
    handshake_s: float = HANDSHAKE_S
    silence_s: float = SILENCE_S

    def __post_init__(self) -> None:
        for name, low, high in (
            ("agent_port", 0, 65535),
            ("monitor_port", 0, 65535),
            ("max_agents", 1, 4096),
            ("max_connections", 1, 65536),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name}: must be from {low} to {high}, not {getattr(self, name)}")
        if self.digits not in (2, 3):
            raise ValueError(f"digits: must be 2 or 3, not {self.digits}")
        if self.agent_port == self.monitor_port != 0:
            raise ValueError("monitor_port: must differ from agent_port")


class Connection(asyncio.Protocol):
    """Connection of one client; subclasses interpret its messages."""

    kind = "client"
    limit = protocol.MAX_MESSAGE

    def __init__(self, server: Server) -> None:
        self.server = server
        self.heard_at = server.now()
        self.name = "?"
        self._framer = protocol.Framer(self.limit)
        self._reader = _core.CommandReader([])
        self._speeds = np.zeros(0)  # that the reader sets
        self._transport: asyncio.Transport | None = None
        self._pumping = False
        self._choked = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start, or refuse the client if there are too many connections."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        peer = transport.get_extra_info("peername")
        self.name = f"{self.kind} {peer[0]}:{peer[1]}" if peer else self.kind
        if not self.server.admit(self):
            self.close("too many connections")
            return
        self.opened()

    def data_received(self, data: bytes) -> None:
        """Receive bytes and process the complete messages."""
        if self._transport is None:
            return
        self.heard_at = self.server.now()
        self._framer.feed(data)
        self._attend()

    def _attend(self) -> None:
        self._pump()

    def _pump(self) -> None:
        # One message with a cycle at a time, so that a client that sends many does not block the others.
        self._pumping = False
        try:
            while self._transport is not None and not self._choked:
                payload = self._framer.pop()
                if payload is None:
                    break
                if self.handle(payload):
                    if not len(self._framer):
                        break
                    self._pumping = True
                    self._transport.pause_reading()
                    asyncio.get_running_loop().call_soon(self._pump)
                    return
        except (ProtocolError, ValueError) as error:
            self.close(str(error))
            return
        except FloatingPointError:
            self.close("the robot's state is no longer finite")
            return
        if self._transport is not None and not self._choked and not self._transport.is_closing():
            self._transport.resume_reading()

    def pause_writing(self) -> None:
        """Stop listening to a client that does not read."""
        self._choked = True
        if self._transport is not None:
            self._transport.pause_reading()

    def resume_writing(self) -> None:
        """Listen again."""
        self._choked = False
        if self._transport is not None and not self._pumping:
            self._pump()

    def connection_lost(self, exc: Exception | None) -> None:
        """Unregister the client."""
        if self._transport is not None:
            logger.info("%s: %s", self.name, f"lost ({exc})" if exc else "left")
            self._forget()

    def close(self, reason: str) -> None:
        """Disconnect the client."""
        if self._transport is None:
            return
        logger.warning("%s: closed: %s", self.name, reason)
        transport = self._transport
        self._forget()
        transport.abort()

    def _forget(self) -> None:
        self._transport = None
        self.server.dismiss(self)
        self.closed()

    def write(self, data: bytes) -> None:
        """Send bytes, unless the client is gone."""
        if self._transport is not None:
            self._transport.write(data)

    @property
    def backlog(self) -> int:
        """Return how many bytes wait for the client to read."""
        return self._transport.get_write_buffer_size() if self._transport is not None else 0

    def opened(self) -> None:
        """Greet the client."""

    def closed(self) -> None:
        """Clean up after the client."""

    def handle(self, payload: bytes) -> bool:
        """Process one message; return whether that ran a cycle."""
        raise NotImplementedError


class Agent(Connection):
    """Connection of an agent, which plays one robot."""

    kind = "agent"

    def __init__(self, server: Server) -> None:
        super().__init__(server)
        self.robot: ServerRobot | None = None
        self._noted: set[str] = set()

    def _attend(self) -> None:
        # Trainers first: what was sent to the monitor port before this message is to be seen in its cycle.
        if not self._pumping:
            self._pumping = True
            asyncio.get_running_loop().call_soon(self._pump)

    def handle(self, payload: bytes) -> bool:
        """Execute an agent's commands, and run a cycle if the message requests one."""
        answer = False
        for expression in self._reader.read(payload, self._speeds):
            answer |= self._obey(expression)
        if not answer or self.robot is None or self.server.settings.realtime:
            return False
        self.cycle()
        return True

    def cycle(self) -> None:
        """Run a cycle and send what the robot perceived."""
        if self.robot is None:
            return
        game = self.server.game
        self.write(self.robot.cycle(game.ball.position, game.play_mode, game.scores))
        self.server.cycled(self)

    def closed(self) -> None:
        """Take the robot off the field."""
        if self.robot is not None:
            self.server.leave(self, self.robot)

    def _obey(self, expression: Expression) -> bool:
        tag = expression[0] if expression else ""
        if tag == "scene":
            self._scene(expression)
        elif tag == "init":
            self._init(expression)
        elif tag == "beam":
            self._beam(_numbers(expression, 3, "beam"))
        elif tag == "say":
            self._say(expression)
        elif tag == "pass" or tag in EFFECTORS:
            self._note(tag, "has no effect here")
        elif tag != "syn":
            raise ProtocolError(f"unknown effector {str(tag)[:40]!r}")
        return tag in ("syn", "scene", "init")

    def _note(self, tag: str, remark: str) -> None:
        """Log a remark on an effector once."""
        if tag not in self._noted:
            self._noted.add(tag)
            logger.info("%s: %s %s", self.name, tag, remark)

    def _scene(self, expression: Expression) -> None:
        if self.robot is not None:
            raise ProtocolError("scene: the robot exists already")
        kind = 0
        if len(expression) not in (2, 3) or not str(expression[1]).startswith("rsg/agent/nao/nao"):
            raise ProtocolError("scene: use rsg/agent/nao/nao.rsg or rsg/agent/nao/nao_hetero.rsg with a type, 0 to 4")
        if len(expression) == 3:
            kind = next((k for k in nao_model.ROBOT_TYPES if str(k) == expression[2]), -1)
            if kind < 0:
                raise ProtocolError(f"scene: robot type {str(expression[2])[:20]!r} is unknown; use 0 to 4")
        self.robot = robot = self.server.enter(self, kind)
        self._reader, self._speeds = robot.commands, robot.speeds[0]
        logger.info("%s: robot of type %d", self.name, kind)

    def _init(self, expression: Expression) -> None:
        robot = self.robot
        if robot is None:
            raise ProtocolError("init: send (scene ...) first")
        if robot.side:
            raise ProtocolError("init: the robot has a team already")
        values = _texts(expression)
        number, team = values.get("unum", "0"), values.get("teamname", "")
        if not number.isdecimal() or len(number) > 3:
            raise ProtocolError("init: unum must be a whole number")
        game = self.server.game
        side, number_given = game.join(team, int(number))
        robot.join(team, side, number_given)
        robot.beam(*game.entry(side))
        self.server.scene_changed()
        logger.info("%s: number %d of team %s (%s)", self.name, number_given, team, protocol.SIDES[side])

    def _beam(self, values: list[float]) -> None:
        robot, server = self.robot, self.server
        if robot is None or server.game.play_mode not in ("BeforeKickOff", "Goal_Left", "Goal_Right"):
            return
        noise = [server.random.uniform(-1, 1) if server.settings.noise else 0.0 for _ in range(3)]
        x = min(max(values[0] + _BEAM_NOISE_M * noise[0], -protocol.FIELD_LENGTH / 2), 0.0)
        y = min(max(values[1] + _BEAM_NOISE_M * noise[1], -_FARTHEST), _FARTHEST)
        sign = -1.0 if robot.side == 2 else 1.0
        yaw = math.fmod(values[2] + _BEAM_NOISE_DEG * noise[2], 360.0) + (0.0, -90.0, 90.0)[robot.side]
        robot.beam((sign * x, sign * y, 0.4), yaw)

    def _say(self, expression: Expression) -> None:
        text = expression[1] if len(expression) == 2 else ""
        heard = isinstance(text, str) and 0 < len(text) <= protocol.SAY_LENGTH and text.isascii() and text.isprintable()
        if heard and self.robot is not None and self.robot.side:
            self.server.broadcast(self.robot, text)
        else:
            self._note("say:", f"only a player's single ASCII words of 1 to {protocol.SAY_LENGTH} are heard")


class Monitor(Connection):
    """Connection of a monitor: receives the scene and sends a trainer's commands."""

    kind = "monitor"
    limit = protocol.MAX_TRAINER_MESSAGE

    def __init__(self, server: Server) -> None:
        super().__init__(server)
        self.wants_all = True
        self._actions: dict[str, Callable[[Expression], None]] = {
            "agent": self._agent,
            "ball": self._ball,
            "playMode": self._play_mode,
            "kickOff": self._kick_off,
            "dropBall": lambda _: self._drop_ball(),
            "time": self._time,
            "score": self._score,
            "select": self._select,
            "repos": self._repos,
            "kill": self._kill,
            "killsim": lambda _: self.server.stop("killsim"),
            "reqfullstate": lambda _: self.server.request_full_state(),
        }

    def opened(self) -> None:
        """Send the whole scene at once."""
        self.server.show(self)

    def pause_writing(self) -> None:
        """Keep the connection: many trainers never read."""

    def resume_writing(self) -> None:
        """Nothing was paused."""

    def handle(self, payload: bytes) -> bool:
        """Execute trainer commands; log and skip unknown ones."""
        for expression in self._reader.read(payload, self._speeds):
            tag = str(expression[0]) if expression else ""
            action = self._actions.get(tag)
            if action is None:
                if tag not in ("getAck", "init"):
                    logger.warning("%s: unknown trainer command %r", self.name, tag[:40])
                continue
            try:
                action(expression)
            except ProtocolError as error:
                logger.warning("%s: %s", self.name, error)
        return False

    def _find(self, expression: Expression, *, else_selected: bool = False) -> tuple[Agent, ServerRobot] | None:
        values = _texts(expression)
        number, team = values.get("unum", ""), values.get("team", "")
        side = {"Left": 1, "Right": 2}.get(team, 0)
        selected = self.server.selected if else_selected and not (number and team) else None
        for agent, robot in self.server.players():
            if agent is selected or (robot.side == side and str(robot.uniform_number) == number):
                return agent, robot
        logger.warning("%s: there is no robot %s of team %s", self.name, number[:10] or "?", team[:10] or "?")
        return None

    def _agent(self, expression: Expression) -> None:
        found = self._find(expression)
        if found is None:
            return
        _, robot = found
        for item in _parts(expression):
            if item[0] == "move":
                x, y, z, yaw = _numbers(item, 4, "agent: move")
                robot.beam(_place((x, y, z), "agent: move"), math.fmod(yaw, 360.0))
            elif item[0] == "pos":
                robot.shift(_place(_numbers(item, 3, "agent: pos"), "agent: pos"))
            elif item[0] == "rot":
                x, y, z = (math.fmod(angle, 360.0) for angle in _numbers(item, 3, "agent: rot"))
                robot.turn((x, y, z))

    def _select(self, expression: Expression) -> None:
        server = self.server
        if len(expression) == 1:
            players = [agent for agent, _ in server.players()]
            after = players.index(server.selected) + 1 if server.selected in players else 0
            server.select(players[after % len(players)] if players else None)
        elif ("unum", "-1") in expression:
            server.select(None)
        else:
            found = self._find(expression)
            server.select(found[0] if found else server.selected)

    def _repos(self, expression: Expression) -> None:
        if found := self._find(expression, else_selected=True):
            _, robot = found
            robot.shift(self.server.game.sideline(robot.side, robot.uniform_number))

    def _ball(self, expression: Expression) -> None:
        ball = self.server.game.ball
        for item in _parts(expression):
            if item[0] == "pos":
                ball.position = _place(_numbers(item, 3, "ball: pos"), "ball: pos")
            elif item[0] == "vel":
                ball.velocity = _place(_numbers(item, 3, "ball: vel"), "ball: vel")

    def _play_mode(self, expression: Expression) -> None:
        mode = str(expression[1]) if len(expression) == 2 else ""
        if mode not in protocol.PLAY_MODES:
            raise ProtocolError(f"playMode: {mode[:40]!r} is unknown")
        self.server.game.play_mode = mode

    def _kick_off(self, expression: Expression) -> None:
        team = str(expression[1]) if len(expression) == 2 else ""
        if team not in ("Left", "Right", "None"):
            raise ProtocolError(f"kickOff: must be Left, Right or None, not {team[:20]!r}")
        side = team if team != "None" else self.server.random.choice(("Left", "Right"))
        self.server.game.play_mode = f"KickOff_{side}"

    def _drop_ball(self) -> None:
        game, ball = self.server.game, self.server.game.ball
        ball.velocity = (0.0, 0.0, 0.0)
        x, y, _ = ball.position
        farthest = protocol.FIELD_WIDTH / 2 - protocol.BALL_RADIUS
        ball.position = (x, min(max(y, -farthest), farthest), protocol.BALL_RADIUS)
        game.play_mode = "PlayOn"

    def _time(self, expression: Expression) -> None:
        (time,) = _numbers(expression, 1, "time")
        if not 0 <= time <= 1e6:
            raise ProtocolError("time: must be from 0 to 1,000,000 s")
        self.server.set_time(time)

    def _score(self, expression: Expression) -> None:
        values = _texts(expression)
        left, right = values.get("left", ""), values.get("right", "")
        if not left.isdecimal() or not right.isdecimal() or len(left + right) > 8:
            raise ProtocolError("score: give (left n)(right n)")
        self.server.game.scores = (int(left), int(right))

    def _kill(self, expression: Expression) -> None:
        if found := self._find(expression, else_selected=True):
            found[0].close("killed by the trainer")


class Server:
    """Server of agents and monitors, which runs until it is stopped."""

    def __init__(self, settings: ServerSettings | None = None) -> None:
        self.settings = settings or ServerSettings()
        self.game = Game()
        self.random = random.Random(self.settings.seed)  # noqa: S311 - sensor noise
        self.selected: Agent | None = None
        """Robot that a trainer has selected; commands without a name are for it."""
        self.agent_port = 0
        self.monitor_port = 0
        self._connections: set[Connection] = set()
        self._monitors: list[Monitor] = []
        self._robots: dict[Agent, ServerRobot] = {}
        """Robots on the field, in order of arrival."""
        self._time = 0.0
        self._writer: _core.SceneWriter | None = None
        self._shown: dict[str, str] = {}
        self._stopped = asyncio.Event()

    @staticmethod
    def now() -> float:
        """Return a monotonic time, s."""
        return asyncio.get_running_loop().time()

    async def run(self, ready: Callable[[Server], None] | None = None) -> None:
        """Listen until `stop`; call `ready` once both ports are open.

        Raises:
            OSError: a port is not available.
        """
        loop = asyncio.get_running_loop()
        settings = self.settings
        agents = await loop.create_server(lambda: Agent(self), settings.host, settings.agent_port, backlog=1024)
        try:
            monitors = await loop.create_server(
                lambda: Monitor(self), settings.host, settings.monitor_port, backlog=1024
            )
        except OSError:
            agents.close()
            raise
        self.agent_port = agents.sockets[0].getsockname()[1]
        self.monitor_port = monitors.sockets[0].getsockname()[1]
        mode = "real time" if settings.realtime else "sync mode"
        logger.info(
            "listening on %s: agents %d, monitors %d, %s", settings.host, self.agent_port, self.monitor_port, mode
        )
        if ready is not None:
            ready(self)
        ticking = asyncio.create_task(self._tick())
        try:
            await self._stopped.wait()
        finally:
            ticking.cancel()
            agents.close()
            monitors.close()
            for connection in list(self._connections):
                connection.close("the server stops")

    def stop(self, reason: str) -> None:
        """End `run`."""
        logger.info("stopping: %s", reason)
        self._stopped.set()

    def admit(self, connection: Connection) -> bool:
        """Register a connection, if the limit allows it."""
        if len(self._connections) >= self.settings.max_connections:
            return False
        self._connections.add(connection)
        if isinstance(connection, Monitor):
            self._monitors.append(connection)
        return True

    def dismiss(self, connection: Connection) -> None:
        """Unregister a connection."""
        self._connections.discard(connection)
        if isinstance(connection, Monitor) and connection in self._monitors:
            self._monitors.remove(connection)

    def players(self) -> list[tuple[Agent, ServerRobot]]:
        """Return the agents whose robots have a team, in order of arrival, and these robots."""
        return [(agent, robot) for agent, robot in self._robots.items() if robot.side]

    def enter(self, agent: Agent, robot_type: int) -> ServerRobot:
        """Build a robot for an agent, and place it on the field.

        Raises:
            ProtocolError: there are too many robots.
        """
        if len(self._robots) >= self.settings.max_agents:
            raise ProtocolError(f"scene: {self.settings.max_agents} robots exist already")
        seed = self.random.getrandbits(63)
        robot = ServerRobot(robot_type, digits=self.settings.digits, seed=seed, noise=self.settings.noise)
        robot.game_time = self._game_time()
        self._robots[agent] = robot
        self.scene_changed()
        return robot

    def leave(self, agent: Agent, robot: ServerRobot) -> None:
        """Take an agent's robot off the field."""
        del self._robots[agent]
        if agent is self.selected:
            self.selected = None
        self.game.leave(robot.side, robot.uniform_number)
        self.scene_changed()

    def select(self, agent: Agent | None) -> None:
        """Select one robot, or none."""
        self.selected = agent
        for other, robot in self._robots.items():
            robot.selected = other is agent
        self.scene_changed()

    def broadcast(self, speaker: ServerRobot, text: str) -> None:
        """Deliver a message to all robots."""
        for _, robot in self.players():
            if robot is speaker:
                robot.hear("self", speaker.team, "self", text)
                continue
            dx, dy, _ = speaker.position - robot.position
            flip = -1.0 if robot.side == 2 else 1.0
            direction = math.degrees(math.atan2(flip * dy, flip * dx))
            who = "mate" if robot.side == speaker.side else "opponent"
            robot.hear(who, speaker.team, f"{direction:.{self.settings.digits}f}", text)

    def set_time(self, time: float) -> None:
        """Set the game's clock, s."""
        self._time = time
        for robot in self._robots.values():
            robot.game_time = time

    def scene_changed(self) -> None:
        """Send everything again: a robot entered, left or joined a team."""
        self._writer = None
        self.request_full_state()

    def request_full_state(self) -> None:
        """Make the next frame of every monitor a full one."""
        for monitor in self._monitors:
            monitor.wants_all = True

    def cycled(self, agent: Agent) -> None:
        """Record that a robot's cycle has run: the ball moves with the first robot, and monitors see the result."""
        if agent is next(iter(self._robots)):
            self.game.ball.step()
        if self._monitors:
            self._publish()

    def show(self, monitor: Monitor) -> None:
        """Send a monitor the whole scene."""
        monitor.wants_all = False
        monitor.write(self._frame(full=True))

    def _game_time(self) -> float:
        return max((robot.game_time for robot in self._robots.values()), default=self._time)

    def _publish(self) -> None:
        frames: dict[bool, bytes] = {}
        for monitor in list(self._monitors):
            if monitor.backlog > _BACKLOG_BYTES:
                monitor.wants_all = True
                continue
            full = monitor.wants_all
            monitor.wants_all = False
            if full not in frames:
                frames[full] = self._frame(full)
            monitor.write(frames[full])

    def _frame(self, full: bool) -> bytes:
        robots = self._robots.values()
        if self._writer is None:
            steps, poses = describe([robot.actor for robot in robots])
            self._writer = _core.SceneWriter(steps, poses)
        ball = np.array([[*self.game.ball.position, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]])
        poses_now = np.concatenate([ball, *(robot.poses for robot in robots)])
        return self._writer.write(self._values(full), full, poses_now)

    def _values(self, full: bool) -> bytes:
        game = self.game
        values = {f"team_{side}": name for side, name in zip(("left", "right"), game.teams, strict=False)}
        values |= {"half": "1", "score_left": f"{game.scores[0]}", "score_right": f"{game.scores[1]}"}
        values["play_mode"] = f"{protocol.PLAY_MODES.index(game.play_mode)}"
        news = values.items() if full else values.items() - self._shown.items()
        if not full:  # a full frame may be for one monitor only; the others still need the changes
            self._shown = values
        text = "".join(f"({name} {values[name]})" for name in values if (name, values[name]) in news)
        return f"({_GAME_VALUES if full else ''}(time {self._game_time():g}){text})".encode()

    async def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        next_at = loop.time()
        checked_at = next_at
        while True:
            next_at = max(next_at + nao_model.CYCLE_S, loop.time() - 10 * nao_model.CYCLE_S)
            await asyncio.sleep(next_at - loop.time())
            if self.settings.realtime:
                for agent in list(self._robots):
                    if agent.backlog > _BACKLOG_BYTES:
                        agent.close("it does not read its messages")
                        continue
                    try:
                        agent.cycle()
                    except FloatingPointError:
                        agent.close("the robot's state is no longer finite")
            if not self._robots:
                self.game.ball.step()
                if self._monitors:
                    self._publish()
            if loop.time() - checked_at > 1.0 or self.settings.silence_s < 1.0 or self.settings.handshake_s < 1.0:
                checked_at = loop.time()
                self._drop_silent(checked_at)

    def _drop_silent(self, now: float) -> None:
        for connection in list(self._connections):
            if not isinstance(connection, Agent):
                continue
            silent = now - connection.heard_at
            if connection.robot is None and silent > self.settings.handshake_s:
                connection.close(f"no scene requested within {self.settings.handshake_s:g} s")
            elif connection.robot is not None and not self.settings.realtime and silent > self.settings.silence_s:
                connection.close(f"silent for {self.settings.silence_s:g} s")


_GAME_VALUES = (
    f"(FieldLength {protocol.FIELD_LENGTH:g})(FieldWidth {protocol.FIELD_WIDTH:g})(FieldHeight 40)"
    f"(GoalWidth {protocol.GOAL_WIDTH:g})(GoalDepth {protocol.GOAL_DEPTH:g})(GoalHeight {protocol.GOAL_HEIGHT:g})"
    f"(BorderSize 0)(FreeKickDistance 2)(WaitBeforeKickOff 30)(AgentRadius 0.4)(BallRadius {protocol.BALL_RADIUS:g})"
    "(BallMass 0.026)(RuleGoalPauseTime 3)(RuleKickInPauseTime 1)(RuleHalfTime 300)(PassModeMinOppBallDist 1)"
    f"(PassModeDuration 4)(play_modes {' '.join(protocol.PLAY_MODES)})"
)


def _parts(expression: Expression) -> Iterator[Expression]:
    """Yield the expressions in an expression that are not empty."""
    return (item for item in expression[1:] if isinstance(item, tuple) and item)


def _texts(expression: Expression) -> dict[str, str]:
    """Return the second word by the first of what has two: ``{"unum": "1"}`` of ``(agent (unum 1))``."""
    return {str(item[0]): str(item[1]) for item in _parts(expression) if len(item) == 2}


def _numbers(expression: Expression, count: int, what: str) -> list[float]:
    values = []
    for word in expression[1:]:
        try:
            value = float(word)
        except (TypeError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise ProtocolError(f"{what}: {str(word)[:40]!r} is not a number")
        values.append(value)
    if len(values) != count:
        raise ProtocolError(f"{what}: {count} numbers are needed, not {len(values)}")
    return values


def _place(values: Sequence[float], what: str) -> Point:
    if any(abs(value) > _FARTHEST for value in values):
        raise ProtocolError(f"{what}: must be within {_FARTHEST:g}")
    return (values[0], values[1], values[2])


def serve(settings: ServerSettings) -> None:
    """Run a server in this process until SIGINT, SIGTERM or a trainer's `(killsim)`.

    Raises:
        OSError: a port is not available.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = settings.max_connections + 256
    if soft != resource.RLIM_INFINITY and soft < wanted and (hard == resource.RLIM_INFINITY or hard >= wanted):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))

    async def main() -> None:
        server = Server(settings)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, server.stop, signal.Signals(number).name)
        await server.run()

    asyncio.run(main())
