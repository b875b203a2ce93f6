"""NAOs in the embedded engine, in this process."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosim.robots.nao import model_of
from naosim.simspark.batch import WHOLE, BatchSimulator
from naosim.simspark.control import GAIN, settle
from naosim.simspark.vision import LandmarkVision
from naosim.simulator import CONTACT_N, NativeHandle, Simulator, Truth, halves

if TYPE_CHECKING:
    from naosim.robots import Robot
    from naosim.simulator import Bytes, Flags, Floats, Ints, Starts


class EmbeddedSimulator(Simulator):
    """NAOs in the embedded engine.

    Starts are simulated once, by dropping the robot with straight joints and driving it into the start's pose for
    60 cycles, and restored from a snapshot after that.

    Args:
        robot: a NAO.
        n: number of robots.
        sensor_digits: decimals of the perceptors: 2, 3, or None for all.
        threads: threads of the engine.
    """

    # a reply describes the state before the cycle that its command starts
    latency_steps = 2
    motors_follow_perceptors = True

    def __init__(self, robot: Robot, n: int, *, sensor_digits: int | None = 2, threads: int = 1) -> None:
        super().__init__(robot, n)
        model = model_of(robot)
        self._type, self._max_speed = model.robot_type, model.max_speed
        self._threads, self._digits = threads, sensor_digits
        self._engine = BatchSimulator(n, self._type, threads=threads, digits=sensor_digits)
        perceptors, truth = self._engine.perceptors, self._engine.truth
        names = [each.name for each in robot.perceptors]
        self._vision = LandmarkVision(n, sensor_digits) if "vision" in names else None
        self._head = model.body_index["head"]
        self.perceptors = {name: getattr(perceptors, name) for name in names if name != "vision"}
        if self._vision is not None:
            self.perceptors["vision"] = self._vision.seen
        self.truth = Truth(truth.torso_position, truth.torso_rotation)
        if self._vision is None:  # which sees all robots at once
            self.groups = halves(n, WHOLE)
        self._begun: set[int] = set()
        self._pending: dict[int, tuple[Floats, Flags | None]] = {}
        self._starts: Bytes | None = None
        self.native = NativeHandle(self._engine.threads_address)

    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Begin a step in the background; one of some robots, or with vision, begins in :meth:`step_wait`."""
        self.require_open()
        self.require_group(rows)
        if active is None and self._vision is None:
            self._engine.begin_drive(targets_rad, GAIN, self._max_speed, rows.start)
            self._begun.add(rows.start)
        else:
            self._pending[rows.start] = np.array(targets_rad, dtype=np.float64), active

    def step_wait(self, rows: slice) -> None:
        """Finish the step that :meth:`step_async` began."""
        self.require_open()
        self.require_group(rows)
        if rows.start in self._begun:
            self._begun.discard(rows.start)
            self._engine.finish_drive(rows.start)
        elif rows.start in self._pending:
            targets, active = self._pending.pop(rows.start)
            every, chosen = np.zeros((self.n, targets.shape[-1])), np.zeros(self.n, dtype=np.bool_)
            every[rows], chosen[rows] = targets, True if active is None else active
            if self._vision is not None:
                # a reply shows what was in sight before its cycle
                seeing = self._vision.due(np.flatnonzero(chosen))
                if len(seeing):
                    self._vision.see(seeing, self.bodies()[seeing, self._head])
            self._engine.drive(every, GAIN, self._max_speed, chosen)

    def load_starts(self, starts: Starts) -> None:
        """Simulate the starts and keep snapshots of the settled robots.

        Raises:
            ValueError: if starts are not upright, or have places of their own.
        """
        self.require_open()
        if starts.orientations is not None:
            raise ValueError("starts: the NAO's simulators support upright starts only; omit orientations")
        engine = BatchSimulator(len(starts), self._type, threads=self._threads, digits=self._digits)
        x, y, heading = starts.place()
        settle(engine, starts.poses_rad, (x, y), heading)
        self._starts = np.array(engine.snapshot())

    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Move robots to starts; ``following`` needs no preparation."""
        del following
        self.require_open()
        self.require_starts(starts, 0 if self._starts is None else len(self._starts))
        assert self._starts is not None
        self._engine.restore_from(rows, self._starts, starts)
        if self._vision is not None:
            self._vision.begin(rows)

    def draw_by_episode(self, rows: Ints, episodes: Ints) -> None:
        """Take the noise of what robots see from their episodes."""
        if self._vision is not None:
            self._vision.draw_by_episode(rows, episodes)

    def bodies(self) -> Floats:
        """Return (n, B, 7) poses of ``robot.shapes``: position in metres and quaternion w, x, y, z, world frame."""
        self.require_open()
        return self._engine.truth.bodies[..., :7]

    def foot_forces(self) -> Floats:
        """Return the (n, 2) upward forces on left and right foot in newtons, zero without contact."""
        return upward_forces(self.perceptors["foot_left"], self.perceptors["foot_right"])

    def airborne(self) -> Flags:
        """Return the (n,) robots whose feet both report no force in any direction."""
        return unloaded(self.perceptors["foot_left"]) & unloaded(self.perceptors["foot_right"])

    def snapshot(self) -> Bytes:
        """Return the complete state of every robot as (n, S) bytes."""
        self.require_open()
        state = np.array(self._engine.snapshot())
        if self._vision is None:
            return state
        parts = (self._vision.counters, self._vision.seen)
        return np.concatenate([state, *(np.ascontiguousarray(part).view(np.uint8) for part in parts)], axis=1)

    def restore(self, state: Bytes) -> None:
        """Return to a snapshot.

        Raises:
            ValueError: if it is not a snapshot of the same number of these robots; nothing has changed then.
        """
        self.require_open()
        if state.ndim != 2 or len(state) != self.n:
            raise ValueError(f"state: expected bytes of {self.n} robots, got shape {state.shape}")
        parts = () if self._vision is None else (self._vision.counters, self._vision.seen)
        ends = np.cumsum([0, *(part.strides[0] for part in parts)])
        first = max(0, state.shape[1] - int(ends[-1]))
        self._engine.restore(np.ascontiguousarray(state[:, :first]))
        for part, start, end in zip(parts, ends, ends[1:], strict=False):
            saved = np.ascontiguousarray(state[:, first + start : first + end])
            part[:] = saved.view(part.dtype)


def upward_forces(left: Floats, right: Floats) -> Floats:
    """Return the (n, 2) upward forces of two (n, 6) foot perceptors, zero without contact."""
    return np.nan_to_num(np.stack([left[:, 5], right[:, 5]], axis=1), nan=0.0)


def unloaded(foot: Floats) -> Flags:
    """Return which of (n, 6) foot perceptors report a force below ``CONTACT_N``."""
    forces = np.nan_to_num(foot[:, 3:], nan=0.0)
    return np.asarray((forces * forces).sum(axis=1) < CONTACT_N**2)
