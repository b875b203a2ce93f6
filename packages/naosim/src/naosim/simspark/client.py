"""Many robots on rcssserver3d servers, driven as if they were a `BatchSimulator`; see `naosim.fleet`.

The trainer's connection gives the ground truth. Servers send a pose again once it has changed by more than 0.005
(metres or matrix elements), so poses are only accurate to 0.005 unless `exact` requests full frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from naosim.fields import RCSSSERVER3D
from naosim.fleet import Fleet, Motion, Rows
from naosim.launchers import Address, Launcher
from naosim.robots import nao_model
from naosim.robots.nao_model import RobotModel
from naosim.simspark import _core, protocol
from naosim.simspark.batch import Floats, Perceptors

_QUIET_S = 0.1
"""Silence after which a server in sync mode is waiting for its agent."""

_GREETING_QUIET_S = 0.02
"""The same while a robot is being created, when one more cycle does no harm."""

_LANDING_CYCLES = 15
"""Maximum number of cycles until a trainer's move is visible."""

_LIFT_M = 1.0
_GAIN = 20.0
"""rad/s of joint speed a rad of error, while a robot is untangled in the air."""

_NUDGE = 1e-3
"""rad/s: any motor that turns wakes a robot."""

_UNTANGLED_DEG, _BEND_DEG = 1.0, 4.0
_STOP_DEG, _RESTING_DEG = 0.02, 2.0
"""Distance to its stop at which a joint rests on it, and to its target at which it is left there."""

_UNTANGLE_CYCLES = 150
_FREEZE_CYCLES = 150
"""3 s: after these no joint is frozen by the self-collision rule, and the clock may be set back."""

_CLOCK_S = 200.0
"""The game's clock is set back once it is later than this: a half ends after 300 s."""

_PARKED_BALL = (0.0, 9.5, RCSSSERVER3D.ball_radius_m)


class RemoteTruth:
    """Poses of the robots, as the monitor ports report them. Arrays are views that every step overwrites."""

    def __init__(self, views: dict[str, Floats]) -> None:
        self.torso_position = views["torso_position"]
        """(n, 3), m."""
        self.torso_rotation = views["torso_rotation"]
        """(n, 3, 3), columns are the torso's right, front and up."""
        self.ball = views["ball"]
        """(n, 3), m."""


class RemoteBatch(Fleet):
    """One NAO on each of n servers; commands are joint speeds in rad/s.

    Args:
        servers: a launcher, which starts n servers and new ones for those that fail, or the addresses of servers that
            run already, which cannot be replaced.
        n: number of servers; only with a launcher.
        robot_type: 0 to 4.
        team: name of the robots' team; they play number `uniform_number` on the left.
        uniform_number: 1 to 11.
        timeout_s: time without a reply after which a server has failed.
        start_timeout_s: the same for the start of a server and its first answers.
        max_failures: number of servers that may be replaced before `replace` raises.
        exact: request the full scene in every cycle; much slower, exact to six digits.

    Raises:
        ValueError: an argument is out of range.
        ServerLostError: a server did not start; the message states why.
    """

    command_name: ClassVar[str] = "speeds"
    silence_s: ClassVar[float] = 20.0

    def __init__(
        self,
        servers: Launcher | Sequence[Address],
        n: int | None = None,
        robot_type: int = 0,
        *,
        team: str = "naosim",
        uniform_number: int = 1,
        timeout_s: float = 10.0,
        start_timeout_s: float = 60.0,
        max_failures: int = 100,
        exact: bool = False,
    ) -> None:
        self.model: RobotModel = nao_model.model(robot_type)
        super().__init__(
            servers,
            n,
            len(self.model.joints),
            timeout_s=timeout_s,
            start_timeout_s=start_timeout_s,
            max_failures=max_failures,
        )
        if not team or not team.isalnum() or not team.isascii():
            raise ValueError(f"team: must be letters and digits, not {team!r}")
        if not 1 <= uniform_number <= 11:
            raise ValueError(f"uniform_number: must be from 1 to 11, not {uniform_number}")
        self.robot_type = robot_type
        self._team, self._number, self._exact = team, uniform_number, exact
        self._exchange: _core.Exchange = _core.Exchange(
            self.n,
            list(self.model.joint_names),
            [joint.effector for joint in self.model.joints],
            [name for name, _ in protocol.LANDMARKS],
        )
        views: dict[str, Floats] = self._exchange.views()
        self._game_time = views["game_time"]
        self.perceptors = Perceptors(**{name: views[name] for name in Perceptors.__dataclass_fields__})
        self.vision = views["vision"]
        """(n, 24), distance in m, theta and phi in degrees of each landmark in the head's frame in the latest message;
        NaN for those that it has not."""
        self.truth = RemoteTruth(views)
        self._nudge = self._idle.copy()
        self._nudge[:, self.model.joint_index["hj1"]] = _NUDGE
        self._middle_deg = (self.model.low_deg + self.model.high_deg) / 2.0
        self._start()

    def _dispatch(self, commands: Floats, rows: Rows) -> None:
        if self._exact:
            for row in np.flatnonzero(~self.failed if rows is None else rows.view(np.bool_) & ~self.failed):
                self._trainer(int(row), "(reqfullstate)")
        super()._dispatch(commands, rows)

    def perceptor(self, name: str) -> Floats:
        """Return the (n, width) array of the perceptor of this name, which every step overwrites."""
        array: Floats = self.vision if name == "vision" else getattr(self.perceptors, name)
        return array

    def beam(self, position: ArrayLike, yaw_deg: ArrayLike = 0.0, mask: ArrayLike | None = None) -> None:
        """Move robots as the trainer's `move` does and wait until they are there.

        A cycle or two pass meanwhile, with joints held still except for the head, whose motion keeps the robot awake: a
        sleeping robot that is moved stays in the air. Robots that are put in the air therefore sink a little.

        Args:
            position: (3,) or (n, 3), the torso's centre, m.
            yaw_deg: scalar or (n,); 0 faces world +y, -90 faces +x.
            mask: (n,), which environments; default all.

        Raises:
            ValueError: wrong shape or not finite.
        """
        where = np.broadcast_to(np.asarray(position, dtype=np.float64), (self.n, 3))
        yaw = np.broadcast_to(np.asarray(yaw_deg, dtype=np.float64), (self.n,))
        if not (np.isfinite(where).all() and np.isfinite(yaw).all()):
            raise ValueError("position, yaw_deg: must be finite")
        self.run_motions({row: self.beaming(row, where[row], float(yaw[row])) for row in self._able(mask)})

    def reset(self, mask: ArrayLike | None = None) -> None:
        """Untangle robots: hold them in the air until all joints are at 0; the caller then beams them down.

        Every joint has to reach its angle, so that no limb remains frozen by the self-collision rule.
        """
        self.run_motions({row: self.untangling(row) for row in self._able(mask)})

    def beaming(self, row: int, where: Floats, yaw_deg: float) -> Motion:
        """Beam one environment as `beam` does: yield the joint speeds of each cycle."""
        self._move(row, where, yaw_deg, show=True)
        for _ in range(_LANDING_CYCLES):
            yield self._nudge[row]
            if self._is_at(row, where, yaw_deg):
                break
        else:
            self._fail(row, f"the trainer's move has not shown up within {_LANDING_CYCLES} cycles")
            return
        # one that was about to fall asleep has done so in the first cycle; the second wakes it
        yield self._nudge[row]

    def untangling(self, row: int, pose_rad: Floats | None = None) -> Motion:
        """Untangle one environment as `reset` does: yield the joint speeds of each cycle.

        Args:
            row: which environment.
            pose_rad: (joints,) angles that the joints have in the end, rad; default all 0.
        """
        late = self._game_time[row] > _CLOCK_S
        lifted = np.array([0.0, 0.0, self.model.standing_height + _LIFT_M])
        angles_deg = self.perceptors.joint_angles[row]
        pose = np.zeros(len(self.model.joints)) if pose_rad is None else np.rad2deg(pose_rad)
        bent = pose + np.copysign(_BEND_DEG, self._middle_deg - pose)
        target = bent
        for cycle in range(_UNTANGLE_CYCLES):
            self._move(row, lifted, -90.0)
            error = np.deg2rad(target - angles_deg)
            yield np.clip(_GAIN * error, -self.model.max_speed, self.model.max_speed)
            # the server ignores commands of a joint that rests on its stop, until something shakes it
            resting = (angles_deg < self.model.low_deg + _STOP_DEG) | (angles_deg > self.model.high_deg - _STOP_DEG)
            near = np.abs(target - angles_deg) < _UNTANGLED_DEG
            near |= resting & (np.abs(pose - angles_deg) < _RESTING_DEG)
            there = bool(near.all())
            if there and target is not bent and not (late and cycle < _FREEZE_CYCLES - 1):
                break
            if there:
                target = pose
        if late:
            self._trainer(row, "(time 0)(playMode PlayOn)")

    def _trainer(self, row: int, command: str) -> None:
        self._exchange.post(row, True, command.encode())

    def _move(self, row: int, where: Floats, yaw_deg: float, *, show: bool = False) -> None:
        x, y, z = (float(c) for c in where)
        place = f"{x:.6f} {y:.6f} {z:.6f} {yaw_deg:.6f}"
        full = "(reqfullstate)" if show and not self._exact else ""
        self._trainer(row, f"(agent (unum {self._number})(team Left)(move {place})){full}")

    def _is_at(self, row: int, where: Floats, yaw_deg: float) -> bool:
        offset = np.abs(self.truth.torso_position[row] - where)
        rotation = self.truth.torso_rotation[row]
        yaw = np.deg2rad(yaw_deg)
        ahead = -np.sin(yaw) * rotation[0, 1] + np.cos(yaw) * rotation[1, 1]
        near = max(offset[:2]) < 0.05 and offset[2] < 0.08
        return bool(near and rotation[2, 2] > 0.99 and ahead > 0.99)

    def _enter(self, row: int, address: Address, deadline: float) -> None:
        monitor = self._connect_port(row, address.host, address.monitor_port, deadline)
        try:
            agent = self._connect_port(row, address.host, address.agent_port, deadline)
        except OSError:
            monitor.close()
            raise
        self._exchange.attach(row, agent.detach(), monitor.detach())
        self._shake_hands(row, deadline)

    def _shake_hands(self, row: int, deadline: float) -> None:
        exchange = self._exchange
        only = np.zeros(self.n, dtype=np.uint8)
        only[row] = 1

        def ask(text: str) -> None:
            exchange.post(row, False, text.encode())
            exchange.collect(only, 1, 1, max(0.1, deadline - time.monotonic()))

        def bring_about(text: str, done: Callable[[], object], failing: str) -> None:
            # A server runs some cycles for a new agent without a (syn), then answers a (syn) only when the next one
            # arrives.
            exchange.post(row, False, text.encode() + b"(syn)")
            while not exchange.failure(row):
                exchange.drain(row, _GREETING_QUIET_S, max(0.1, deadline - time.monotonic()))
                if done():
                    return
                if time.monotonic() > deadline:
                    exchange.fail(row, failing)
                exchange.post(row, False, b"(syn)")

        exchange.choose(row, 1, self._number)
        bring_about(
            f"(scene rsg/agent/nao/nao_hetero.rsg {self.robot_type})",
            lambda: exchange.counts(row)[2],
            "the server does not build the robot",
        )
        bring_about(
            f"(init (unum {self._number})(teamname {self._team}))",
            lambda: exchange.game(row)[0],
            "the server does not give the robot a team",
        )
        if exchange.failure(row):
            return
        side, number, _mode = exchange.game(row)
        joints = exchange.counts(row)[2]
        if joints != len(self.model.joints):
            exchange.fail(
                row, f"the robot has {joints} of the {len(self.model.joints)} joints of type {self.robot_type}"
            )
        if (side, number) != (1, self._number):
            exchange.fail(row, f"the robot is number {number}, side {side}; {self._number} on the left was requested")
        x, y, z = _PARKED_BALL
        self._trainer(row, f"(playMode PlayOn)(ball (pos {x} {y} {z})(vel 0 0 0))")
        exchange.drain(row, _QUIET_S, max(0.1, deadline - time.monotonic()))
        messages, frames = exchange.counts(row)[:2]
        for _ in range(4):
            ask("(syn)")
        exchange.drain(row, _QUIET_S, max(0.1, deadline - time.monotonic()))
        more_messages, more_frames = (
            now - before for now, before in zip(exchange.counts(row), (messages, frames), strict=False)
        )
        if not exchange.failure(row) and (more_messages, more_frames) != (4, 4):
            exchange.fail(
                row,
                f"in 4 cycles {more_messages} messages and {more_frames} monitor frames came; set "
                "$agentSyncMode = true, $agentStep = 0.02 and $monitorStep = 0.02",
            )
        for _ in range(_LANDING_CYCLES):
            if exchange.failure(row) or (exchange.scene_complete(row) and exchange.counts(row)[3]):
                return
            self._trainer(row, "(reqfullstate)")
            ask("(syn)")
        exchange.fail(row, "the robot does not show up on the monitor port")
