"""Booster robots in MuJoCo worlds of this process."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from naosim.mujoco.batch import MujocoBatch
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.mujoco.shapes import body_poses
from naosim.mujoco.world import BALL_JOINT, MujocoWorld, library, world_of
from naosim.simulator import PLAIN, STEP_S, NativeHandle, Simulator, Truth, finite, finite_quaternions, halves

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosim.robots import Robot
    from naosim.simulator import Bytes, Flags, Floats, Ints, RobotMotion, Scene, Starts, Variation

_MUJOCO = BoosterEmbeddedParameters(engine="mujoco")

_SETTLED_TOGETHER = 64
_LOWEST_STANDING = 0.8
_LEAST_UPRIGHT = 0.866  # cosine of 30 degrees
_DROP_M = 0.02


class MujocoSimulator(Simulator):
    """Booster robots in MuJoCo worlds of this process, one world each.

    Starts are simulated once, as on the server: the robot is put down with straight joints and driven into the start's
    pose for ``settle_steps``; after that they are restored from the state it has reached. A robot whose physics diverge
    is :attr:`lost` until it is started again.

    Args:
        robot: a robot of the family ``booster``, with its gains.
        n: number of robots.
        parameters: what is computed.
        threads: threads that step the worlds.
        scene: what the worlds contain besides the robots. A ball lies in a corner until it is placed.

    Raises:
        naosim.mujoco.world.MujocoUnavailableError: if MuJoCo is missing or has another version.
    """

    def __init__(
        self,
        robot: Robot,
        n: int,
        parameters: BoosterEmbeddedParameters = _MUJOCO,
        *,
        threads: int = 1,
        scene: Scene = PLAIN,
    ) -> None:
        super().__init__(robot, n, scene)
        self.parameters = parameters
        self.world: MujocoWorld = world_of(robot, engine=parameters.engine, scene=scene)
        self._threads = threads
        self.batch = self._new_batch(n)
        self.perceptors = self.batch.perceptors
        self.truth = Truth(self.batch.position, self.batch.rotation, self.batch.bodies, self.batch.contacts)
        self.latency_steps = 1 + parameters.action_delay
        self._starts: Floats | None = None
        self._failures = 0
        self._varied: Any = None  # model in which variations are computed
        self.groups = halves(n)
        self._begun: set[int] = set()
        self._pending: dict[int, tuple[Floats, Flags]] = {}
        self.native = NativeHandle(self.batch.threads_address)

    def _new_batch(self, n: int) -> MujocoBatch:
        settings = self.parameters
        return MujocoBatch(
            self.world,
            n,
            delay=settings.action_delay,
            truncate=settings.truncate,
            threads=self._threads,
        )

    # steps

    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Begin a step in the background; one of some robots begins in :meth:`step_wait`.

        Raises:
            ValueError: if the targets have a wrong shape or are not finite.
        """
        self.require_open()
        self.require_group(rows)
        targets = np.asarray(targets_rad, dtype=np.float64)
        if targets.shape != (rows.stop - rows.start, self.world.joints):
            raise ValueError(
                f"targets_rad: expected shape {(rows.stop - rows.start, self.world.joints)}, got {targets.shape}"
            )
        if active is None:
            self.batch.begin(targets, rows.start)
            self._begun.add(rows.start)
        elif np.isfinite(targets[active]).all():
            self._pending[rows.start] = targets.copy(), active
        else:
            raise ValueError("targets_rad: expected finite numbers")

    def step_wait(self, rows: slice) -> None:
        """Finish the step that :meth:`step_async` began."""
        self.require_open()
        self.require_group(rows)
        if rows.start in self._begun:
            self._begun.discard(rows.start)
            self.batch.finish(rows.start)
        elif rows.start in self._pending:
            targets, active = self._pending.pop(rows.start)
            self.batch.step(targets, rows.start, active)

    # starts

    def load_starts(self, starts: Starts) -> None:
        """Simulate the starts and keep the states of the settled robots.

        Raises:
            ValueError: if poses or orientations are malformed, or a robot does not stand after settling although its
                start is upright.
        """
        self.require_open()
        poses = np.asarray(starts.poses_rad, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] != self.world.joints or not np.isfinite(poses).all():
            raise ValueError(f"starts: expected finite poses of shape (k, {self.world.joints}), got {poses.shape}")
        places = starts.places()
        chunks = [slice(k, min(k + _SETTLED_TOGETHER, len(poses))) for k in range(0, len(poses), _SETTLED_TOGETHER)]
        orientations = starts.orientations
        if orientations is not None:
            orientations = finite_quaternions("orientations", orientations, len(poses))
        self._starts = np.concatenate(
            [
                self._settled(
                    replace(
                        starts,
                        poses_rad=poses[chunk],
                        position_m=places[chunk, :2],
                        heading_rad=places[chunk, 2],
                        orientations=None if orientations is None else orientations[chunk],
                    )
                )
                for chunk in chunks
            ]
        )

    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Move robots to starts; ``following`` needs no preparation."""
        del following
        self.require_open()
        self.require_starts(starts, 0 if self._starts is None else len(self._starts))
        assert self._starts is not None
        self._failures += int(np.count_nonzero(self.batch.diverged[rows]))
        for row, start in zip(rows.tolist(), starts.tolist(), strict=True):
            self.batch.load(row, self._starts[start])

    def _settled(self, starts: Starts) -> Floats:
        """Return the states of robots that have settled in (at most 64) starts."""
        batch = self._new_batch(len(starts))
        places = starts.places()
        straight = np.zeros(self.world.joints)
        for row, pose in enumerate(starts.poses_rad):
            x, y, half = float(places[row, 0]), float(places[row, 1]), float(places[row, 2]) / 2.0
            quaternion = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
            height = float(self.robot.data["beam_height_m"])
            if starts.orientations is not None:
                quaternion = starts.orientations[row] / np.linalg.norm(starts.orientations[row])
                height = self._height_above_ground(quaternion) + _DROP_M
            batch.place(row, (x, y, height), quaternion, straight, pose)
        for _ in range(self.parameters.settle_steps):
            batch.step(starts.poses_rad)
        if starts.orientations is None:
            self._require_standing(batch)
        states = batch.save()
        if self.scene.ball:
            # an episode begins in a cycle with vision or in one without: the first number of a state is its time
            states[1::2, 0] += STEP_S
        return states

    def _require_standing(self, batch: MujocoBatch) -> None:
        height, upright = batch.position[:, 2], batch.rotation[:, 2, 2]
        down = ~((height > _LOWEST_STANDING * self.robot.standing_height_m) & (upright > _LEAST_UPRIGHT))
        if down.any():
            raise ValueError(
                f"starts: {self.robot.name} does not stand after {self.parameters.settle_steps} steps in "
                f"{np.count_nonzero(down)} of {batch.n} start poses (torso height {np.nanmin(height):.2f} m); "
                "use stiffer ankles (robot.kp.ankle_pitch: 150), less noise in the poses, or fewer "
                "simulator.settle_steps"
            )

    def _height_above_ground(self, quaternion: Floats) -> float:
        """Return the torso height at which a robot with straight joints touches the ground."""
        mujoco = library()
        model, data = self.world.model, self.world.new_data()
        data.qpos[self.world.torso :] = 0.0
        data.qpos[self.world.torso + 3 : self.world.torso + 7] = quaternion
        mujoco.mj_kinematics(model, data)
        boxes = model.geom_aabb[self.world.geoms]  # centre and half lengths, geom frame
        down = data.geom_xmat[self.world.geoms].reshape(-1, 3, 3)[:, 2]
        centres = data.geom_xpos[self.world.geoms, 2] + np.einsum("gi,gi->g", down, boxes[:, :3])
        return float(-np.min(centres - np.einsum("gi,gi->g", np.abs(down), boxes[:, 3:])))

    # the beginning of an episode

    def place_ball(
        self, rows: Ints, position_m: Floats, velocity_mps: Floats | None = None, spin_rad_s: Floats | None = None
    ) -> None:
        """Place the ball; robots that have it in view perceive it at once."""
        if not self.scene.ball:
            super().place_ball(rows, position_m, velocity_mps, spin_rad_s)
        self.require_open()
        still = np.zeros((len(rows), 3))
        position = finite("position_m", position_m, still.shape)
        velocity = still if velocity_mps is None else finite("velocity_mps", velocity_mps, still.shape)
        spin = still if spin_rad_s is None else finite("spin_rad_s", spin_rad_s, still.shape)
        for row, *ball in zip(rows.tolist(), position, velocity, spin, strict=True):
            self.batch.place_ball(row, *ball)

    def motion(self, rows: Ints) -> RobotMotion:
        """Return poses and velocities of robots."""
        self.require_open()
        return self.batch.motion(rows.tolist())

    def set_motion(self, rows: Ints, motion: RobotMotion) -> None:
        """Give robots other poses and velocities, which they perceive at once."""
        self.require_open()
        checked = motion.checked(len(rows), self.world.joints)
        for k, row in enumerate(rows.tolist()):
            self.batch.set_motion(row, checked, k)

    # for viewers

    def bodies(self) -> Floats:
        """Return (n, B, 7) poses of :attr:`shapes`."""
        self.require_open()
        first = self.world.torso
        poses = body_poses(self.world, np.array([data.qpos[first:] for data in self.batch.data]))
        if not self.scene.ball:
            return poses
        balls = np.array([data.qpos[BALL_JOINT : BALL_JOINT + 7] for data in self.batch.data])
        return np.concatenate([poses, balls[:, None]], axis=1)

    def foot_forces(self) -> Floats:
        """Return the (n, 2) upward forces on left and right foot in newtons, 5 ms before the end of the step."""
        forces: Floats = self.batch.foot_frames[:, -1]
        return forces

    def torques(self) -> Floats:
        """Return the (n, J) torques in N m that the motors demanded in the last 5 ms."""
        return self.batch.torques

    def foot_frames(self) -> Floats:
        """Return the (n, 4, 2) upward forces on left and right foot in newtons, every 5 ms of the last step."""
        return self.batch.foot_frames

    # disturbances

    def push(self, velocities_mps: Floats, rows: slice) -> None:
        """Add (k, 2) horizontal velocities in m/s, world frame, to those of the torsos of the robots ``rows``.

        Raises:
            ValueError: if they have a wrong shape or are not finite.
        """
        self.require_open()
        first, robots = 6 if self.world.ball else 0, self.batch.data[rows]
        added = finite("velocities_mps", velocities_mps, (len(robots), 2))
        pushed = np.flatnonzero(added.any(axis=1)).tolist()
        for data, (x, y) in zip((robots[k] for k in pushed), added[pushed].tolist(), strict=True):
            data.qvel[first] += x
            data.qvel[first + 1] += y

    def vary(self, variations: Sequence[Variation], rng: np.random.Generator, rows: Ints | None = None) -> None:
        """Give robots other bodies, gains, contacts, friction and gravity."""
        self.require_open()
        numbers = range(self.n) if rows is None else rows.tolist()
        for row, variation in zip(numbers, variations, strict=True):
            varied = self.world.varied(variation, rng, self._varied)
            self._varied = varied.model
            self.batch.set_world(row, varied)

    # worlds can diverge

    @property
    def lost(self) -> Flags:
        """(n,) robots whose physics diverged; they stand still until they are started again."""
        return self.batch.diverged

    @property
    def failures(self) -> int:
        """Number of diverged robots that have been started again."""
        return self._failures

    @property
    def counters(self) -> Mapping[str, int]:
        """Substeps that the fast engine left to ``mj_step``."""
        return {"left_to_mujoco": self.batch.left_to_mujoco} if self.world.kernel else {}

    def loss_reason(self, row: int) -> str:
        """Return why the physics of the robot ``row`` diverged; empty if they did not."""
        if not self.batch.diverged[row]:
            return ""
        return f"the physics diverged: {self.batch.warning(row) or 'the state is not finite'}"

    # snapshots

    def snapshot(self) -> Bytes:
        """Return the complete state of every robot as (n, S) bytes."""
        self.require_open()
        return self.batch.save().view(np.uint8)

    def restore(self, state: Bytes) -> None:
        """Return to a snapshot.

        Raises:
            ValueError: if it is not a snapshot of the same number of these robots.
        """
        self.require_open()
        rows = np.ascontiguousarray(state)
        if rows.dtype != np.uint8 or rows.shape != (self.n, 8 * self.batch.row_size):
            raise ValueError(f"state: expected bytes of shape {(self.n, 8 * self.batch.row_size)}, got {rows.shape}")
        for row, values in enumerate(rows.view(np.float64)):
            self.batch.load(row, values)
