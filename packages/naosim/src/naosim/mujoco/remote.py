"""Booster robots on rcssservermj servers, one server each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosim.fleet_simulator import FleetSimulator
from naosim.mujoco.client import MujocoFleet
from naosim.mujoco.shapes import body_poses, sole_heights
from naosim.mujoco.world import PARKED_BALL_M, gains, library, world_of
from naosim.simulator import BALL, PLAIN, STEP_S, BodyState, Truth, finite

if TYPE_CHECKING:
    from naosim.fleet import Motion
    from naosim.launchers import Launcher
    from naosim.robots import Robot
    from naosim.simulator import Flags, Floats, Ints, Scene, Starts

_REPLY_TIMEOUT_S = 10.0
_START_TIMEOUT_S = 90.0

_STALE_STEPS, _LATEST_STEPS = 2.5, 10.0
"""Steps in which reports may be of the ball before it was placed: certainly, and if the report is from elsewhere."""

_NEAR_BALL_M = 0.5


class RemoteMujocoSimulator(FleetSimulator):
    """Booster robots on rcssservermj servers, all driven from this process.

    At a start the robot is beamed, upright with straight joints, and driven into the start's pose for ``settle_steps``,
    as in the embedded simulator. Position and orientation of the torso are those that the robot perceives: exact, but
    5 ms old and truncated to three decimals. The server reports no contacts: :meth:`foot_forces` is always zero, and a
    robot counts as :meth:`airborne` when both soles are above the ground by the perceived pose.

    The motion of bodies is what the robot perceives, too: torso and feet by forward kinematics, the ball where it was
    reported last, velocities and spins from the last two poses. The ball's spin is unknown, and contacts with it are
    always zero.

    Args:
        launcher: starts the servers.
        robot: a robot of the family ``booster``, with its gains.
        n: number of robots.
        settle_steps: steps between the beam and the start of an episode.
        max_failures: number of servers that may be replaced.
        standby_servers: whether there are two servers per robot.
        scene: what is perceived besides the robot; a server always has ball and goals.

    Raises:
        naosim.simulator.ServerLostError: if a server does not start; the message states why.
    """

    def __init__(
        self,
        launcher: Launcher,
        robot: Robot,
        n: int,
        *,
        settle_steps: int,
        max_failures: int,
        standby_servers: bool = False,
        scene: Scene = PLAIN,
    ) -> None:
        self._remote = MujocoFleet(
            launcher,
            robot,
            2 * n if standby_servers else n,
            timeout_s=_REPLY_TIMEOUT_S,
            start_timeout_s=_START_TIMEOUT_S,
            max_failures=max_failures,
            ball=scene.ball,
        )
        self._world = world_of(robot, scene=scene) if scene.moving else None
        self._heard = [(-1, 0)] * n  # server and number of messages when bodies were updated
        self._unseen_s = np.zeros(n)  # since the ball was reported or placed
        self._placed: Flags = np.zeros(n, dtype=np.bool_)  # and has not been reported since
        self._settle_steps = settle_steps
        self._acting = np.repeat(robot.nominal[None], n, axis=0)  # targets of the step that the last reply shows
        super().__init__(
            self._remote,
            robot,
            n,
            sources=self._remote.perceptors,
            truth=Truth(self._remote.perceptors["torso_pos"], self._remote.rotation),
            scene=scene,
        )

    def _commands_of(self, targets_rad: Floats, rows: slice) -> Floats:
        targets = np.asarray(targets_rad, dtype=np.float64)
        shape = (rows.stop - rows.start, len(self.robot.joints))
        if targets.shape != shape:
            raise ValueError(f"targets_rad: expected shape {shape}, got {targets.shape}")
        return targets

    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Send commands to the servers of these robots; they compute meanwhile.

        Raises:
            ValueError: if the targets have a wrong shape or are not finite.
        """
        before = self._commands[self._servers[rows]]
        super().step_async(targets_rad, rows, active)
        stepped = np.arange(rows.start, rows.stop)
        # the reply to this command shows what the one before it did
        self._acting[stepped if active is None else stepped[active]] = before if active is None else before[active]

    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Move robots to starts; standby servers prepare the ``following`` ones.

        Raises:
            naosim.simulator.ServerLostError: if more servers fail than are allowed, or a new one does not start.
        """
        super().start(rows, starts, following)
        for body in self.truth.bodies.values():
            body.velocity[rows] = body.spin[rows] = 0.0
        self._acting[rows] = self._commands[self._servers[rows]]

    def _require_possible(self, starts: Starts) -> None:
        if starts.orientations is not None:
            raise ValueError(
                "starts: rcssservermj beams robots upright only; use the embedded simulator for other orientations"
            )
        farthest = float(starts.places()[:, 0].max(initial=0.0))
        if farthest > 0.0:
            raise ValueError(
                f"starts: rcssservermj beams the left team to its own half, not to x = {farthest:g} m; "
                "use a position with x <= 0"
            )
        poses = np.asarray(starts.poses_rad)
        if poses.ndim != 2 or poses.shape[1] != len(self.robot.joints) or not np.isfinite(poses).all():
            raise ValueError(f"starts: expected finite poses of shape (k, {len(self.robot.joints)}), got {poses.shape}")

    def _starting(self, server: int, start: int) -> Motion:
        """Move a server's robot to a start: yield the target angles of each cycle."""
        assert self._starts is not None
        if self.scene.ball:
            self._remote.place_ball(server, np.array([*PARKED_BALL_M, self.robot.field.ball_radius_m]), np.zeros(3))
        x, y, heading = self._starts.places()[start].tolist()
        return self._remote.starting(server, self._starts.poses_rad[start], (x, y), heading, self._settle_steps)

    # the scene

    def _refresh(self, rows: slice | Ints) -> None:
        super()._refresh(rows)
        if self._world is not None:
            self._follow(np.arange(self.n)[rows])

    def _follow(self, rows: Ints) -> None:
        """Update the motion of the bodies of those robots that have perceived something new."""
        mujoco, world = library(), self._world
        assert world is not None
        data, bodies = world.new_data(), self.truth.bodies
        for row, coordinates in zip(rows.tolist(), self._coordinates()[rows], strict=True):
            server = int(self._servers[row])
            heard = (server, self._remote.messages(server))
            if self._heard[row] == heard:
                continue
            self._heard[row] = heard
            data.qpos[world.torso :] = coordinates
            mujoco.mj_kinematics(world.model, data)
            for name, body in zip(self.scene.moving, world.moving, strict=True):
                if name != BALL:
                    _move(bodies[name], row, data.xpos[body], data.xmat[body].reshape(3, 3), STEP_S)
            if self.scene.ball:
                camera = data.site_xmat[world.camera].reshape(3, 3)
                self._follow_ball(row, data.site_xpos[world.camera], camera)

    def _follow_ball(self, row: int, position: Floats, rotation: Floats) -> None:
        """Take in the report of one robot's ball, with its camera's pose."""
        ball, report = self.truth.bodies[BALL], self.perceptors[BALL][row]
        self._unseen_s[row] += STEP_S
        if np.isfinite(report[0]):
            place = position + rotation @ _of_polar(report)
            steps = self._unseen_s[row] / STEP_S
            if self._placed[row] and (
                steps < _STALE_STEPS
                or (steps < _LATEST_STEPS and np.linalg.norm(place - ball.position[row]) > _NEAR_BALL_M)
            ):
                report[:] = np.nan  # where the ball was before it was placed
            else:
                _move(ball, row, place, np.eye(3), self._unseen_s[row])
                self._unseen_s[row], self._placed[row] = 0.0, False
        ball.spin[row] = np.nan

    def place_ball(
        self, rows: Ints, position_m: Floats, velocity_mps: Floats | None = None, spin_rad_s: Floats | None = None
    ) -> None:
        """Place the ball by the monitor; it is there, and perceived, after the next step.

        Raises:
            ValueError: if there is no ball, or it should spin.
        """
        if not self.scene.ball:
            super().place_ball(rows, position_m, velocity_mps, spin_rad_s)
        self.require_open()
        if spin_rad_s is not None and np.any(spin_rad_s):
            raise ValueError("spin_rad_s: rcssservermj places balls without spin; leave it out")
        still = np.zeros((len(rows), 3))
        position = finite("position_m", position_m, still.shape)
        velocity = still if velocity_mps is None else finite("velocity_mps", velocity_mps, still.shape)
        ball = self.truth.bodies[BALL]
        for row, place, speed in zip(rows.tolist(), position, velocity, strict=True):
            self._remote.place_ball(int(self._servers[row]), place, speed)
            ball.position[row], ball.velocity[row] = place, speed
            self._unseen_s[row], self._placed[row] = 0.0, True

    # for viewers and tasks

    def bodies(self) -> Floats:
        """Return (n, B, 7) poses of :attr:`shapes` by forward kinematics from what the robots perceive.

        Raises:
            naosim.mujoco.world.MujocoUnavailableError: if MuJoCo is missing here or has another version.
        """
        self.require_open()
        poses = body_poses(world_of(self.robot), self._coordinates())
        if not self.scene.ball:
            return poses
        balls = np.column_stack([self.truth.bodies[BALL].position, np.tile([1.0, 0.0, 0.0, 0.0], (self.n, 1))])
        return np.concatenate([poses, balls[:, None]], axis=1)

    def airborne(self) -> Flags:
        """Return the (n,) robots whose soles are both above the ground, by the perceived pose."""
        self.require_open()
        above = sole_heights(world_of(self.robot), self._coordinates()) > 0.0
        return np.asarray(above.all(axis=1))

    def torques(self) -> Floats:
        """Return the (n, J) torques in N m that the motors demanded last, as perceived."""
        angles, speeds = (np.radians(self.perceptors[name]) for name in ("joint_angles", "joint_speeds"))
        kp, kd = gains(self.robot)
        return np.asarray(kp * (self._acting - angles) - kd * speeds)

    def _coordinates(self) -> Floats:
        """Return (n, 7 + J) torso positions and quaternions, and joint angles in radians, as perceived."""
        quaternions = self.perceptors["torso_quat"]
        quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
        angles = np.radians(self.perceptors["joint_angles"])
        return np.concatenate((self.truth.torso_position, quaternions, angles), axis=1)


def _of_polar(report: Floats) -> Floats:
    """Return x, y and z of a report of distance in metres, azimuth and elevation in degrees.

    The server truncates: the middle of the interval is half a digit farther from zero.
    """
    distance, azimuth, elevation = report + np.copysign(0.005, report)
    azimuth, elevation = np.radians(azimuth), np.radians(elevation)
    level = np.cos(elevation)
    return np.asarray(
        distance * np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]), dtype=np.float64
    )


def _move(body: BodyState, row: int, position: Floats, rotation: Floats, elapsed_s: float) -> None:
    """Give a body a new pose, and the velocity and spin that brought it there."""
    turn = rotation @ body.rotation[row].T
    body.velocity[row] = (position - body.position[row]) / elapsed_s
    body.spin[row] = (
        np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2 / elapsed_s
    )
    body.position[row], body.rotation[row] = position, rotation
