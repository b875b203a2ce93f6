"""Many NAO robots, each alone on its field, stepped together by the compiled engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naosim.robots import nao_model
from naosim.robots.nao_model import RobotModel, Vector
from naosim.simspark import _core

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

DIGITS = (2, 3, None)
"""Decimals of the perceptors: 2 as the league's server prints, 3 as a development version, None for full precision."""

BODY_STATE = 13
"""Values per body: position xyz (m), quaternion wxyz, velocity xyz (m/s), angular velocity xyz (rad/s); world frame."""

WHOLE: int = _core.Batch.whole
"""Environments that share vector registers on the widest processor. Steps in the background are of multiples of them on
every processor, so that a training has the same groups everywhere, and with them the same bits."""

_NOT_FINITE = -2

_SHAPES = {"box": 1, "sphere": 2, "capsule": 3}
_LIMBS = {"rarm": 0, "larm": 1, "rleg": 2, "lleg": 3}
_SENSORS = ("rf", "lf", "rf1", "lf1")
_TABLE_FIELDS = (
    *("mass", "inertia", "parent", "shape", "half", "radius", "half_length", "offset", "anchor", "parent_anchor"),
    *("axis", "low", "high", "max_speed", "joint", "limb"),
)


@dataclass(frozen=True)
class Perceptors:
    """Contents of the reply to the last command, with the server's latency and rounding.

    Joint angles, gyro and touch describe the state before the cycle that the command started; the accelerometer is one
    cycle older still. Arrays are views that every step overwrites.
    """

    joint_angles: Floats
    """(n, joints), degrees, in the robot's joint order."""
    gyro: Floats
    """(n, 3), angular velocity in the torso's frame, degrees/s."""
    accel: Floats
    """(n, 3), proper acceleration in the torso's frame, m/s^2; (0, 0, 9.81) at rest."""
    foot_left: Floats
    """(n, 6), point of attack (m) and force (N) in the foot's frame; NaN where the server sends none (no contact)."""
    foot_right: Floats
    toe_left: Floats
    """As the feet, for robot type 4; zero for the others."""
    toe_right: Floats
    time: Floats
    """(n,), s."""


class BatchTruth:
    """Present state, as a trainer sees it on the monitor port. Arrays are in world coordinates."""

    def __init__(self, core: _core.Batch, views: dict[str, Floats], n: int, bodies: int) -> None:
        self._core = core
        self._shape = (n, bodies, BODY_STATE)
        self.torso_position = views["torso_position"]
        """(n, 3), m; a view that every step overwrites."""
        self.torso_rotation = views["torso_rotation"]
        """(n, 3, 3), columns are the torso's right, front and up; a view that every step overwrites."""

    @property
    def bodies(self) -> Floats:
        """Return a copy of all body states, shape (n, bodies, 13); see `BODY_STATE`."""
        out = np.empty(self._shape)
        self._core.get_bodies(out)
        return out

    @property
    def enabled(self) -> Flags:
        """Return which bodies are awake (ODE's auto-disable), shape (n, bodies)."""
        out = np.empty(self._shape[:2], dtype=np.uint8)
        self._core.get_enabled(out)
        return out.view(np.bool_)

    @property
    def centre_of_mass(self) -> Floats:
        """Return the robots' centres of mass, shape (n, 3), m."""
        out = np.empty((self._shape[0], 3))
        self._core.centre_of_mass(out)
        return out


class BatchSimulator:
    """`n` independent robots of one type, stepped in lockstep, 20 ms a cycle.

    Results do not depend on `n`, on the order of the batch, on the number of threads or on the processor's vector
    width, bit for bit.

    Args:
        n: number of environments.
        robot_type: 0 to 4.
        threads: threads that step the batch, the caller's included; they live as long as the simulator.
        digits: decimals of the perceptors (2, 3, or None for full precision).
        self_collision: whether limbs that overlap freeze their motors, as in the league's rules.
        kernel: `avx512`, `avx2` or `generic`; None selects the fastest that the processor supports.

    Raises:
        ValueError: an argument is out of range; the message names it.
    """

    def __init__(
        self,
        n: int,
        robot_type: int = 0,
        *,
        threads: int = 1,
        digits: int | None = 2,
        self_collision: bool = True,
        kernel: str | None = None,
    ) -> None:
        for name, value, top in (("n", n, 1_000_000), ("threads", threads, 1024)):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= top:
                raise ValueError(f"{name}: must be a whole number from 1 to {top}, not {value!r}")
        if digits not in DIGITS:
            raise ValueError(f"digits: must be 2, 3 or None, not {digits!r}")
        self.model: RobotModel = nao_model.model(robot_type)
        self.n = int(n)
        self.robot_type = self.model.robot_type
        self.threads = int(threads)
        self.digits = digits
        self._core = _core.Batch(
            engine_table(self.model),
            self.n,
            self.threads,
            -1 if digits is None else digits,
            self_collision,
            kernel or "",
        )
        views: dict[str, Floats] = self._core.views()
        self.truth = BatchTruth(self._core, views, self.n, len(self.model.bodies))
        self.perceptors = Perceptors(**{name: views[name] for name in Perceptors.__dataclass_fields__})

    @property
    def kernel(self) -> str:
        """Return the instruction set in use."""
        return str(self._core.kernel)

    @property
    def threads_address(self) -> int:
        """Return the address of the batch's threads; see ``naosim.simulator.NativeHandle``."""
        return int(self._core.threads)

    @property
    def statistics(self) -> dict[str, int]:
        """Return counts since construction: groups of eight stepped, linear solves, rounds of single pivots."""
        return dict(zip(("steps", "solves", "fallback"), self._core.statistics, strict=True))

    def step(self, speeds: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Send joint speeds and run one cycle.

        Args:
            speeds: (n, joints), rad/s; clamped to each joint's limit, ignored for a joint at its stop.
            mask: (n,), which environments to step; the others keep still. Default all.

        Raises:
            ValueError: wrong shape, or a speed is not finite; nothing has been stepped then.
            FloatingPointError: an environment's state is no longer finite; the message names it, the others step.
        """
        commands = self._array("speeds", speeds, (self.n, len(self.model.joints)))
        lanes = self._lanes(mask)
        if not np.isfinite(commands).all():
            wrong = ~np.isfinite(commands) if mask is None else ~np.isfinite(commands) & np.asarray(mask, bool)[:, None]
            if wrong.any():
                environment, joint = (int(k) for k in np.argwhere(wrong)[0])
                raise ValueError(
                    f"speeds[{environment}, {joint}]: environment {environment}, "
                    f"joint {self.model.joints[joint].name}: "
                    f"must be a finite number, not {commands[environment, joint]}"
                )
        self._require_finite(self._core.step(commands, lanes))

    def drive(self, targets_rad: ArrayLike, gain: float, max_speed: Floats, mask: ArrayLike | None = None) -> None:
        """Drive joints to target angles by a proportional controller and run one cycle.

        Args:
            targets_rad: (n, joints); speed = gain * (target - perceived angle).
            gain: 1/s.
            max_speed: (joints,) largest speeds, rad/s.
            mask: (n,), which environments to step; the others keep still. Default all.

        Raises:
            ValueError: wrong shape, or a target or angle is not finite; nothing has been stepped then.
            FloatingPointError: an environment's state is no longer finite; the message names it, the others step.
        """
        targets = self._array("targets_rad", targets_rad, (self.n, len(self.model.joints)))
        failed = self._core.drive(targets, gain, max_speed, self._lanes(mask))
        if failed == _NOT_FINITE:
            self._raise_not_finite(targets, 0, None if mask is None else np.asarray(mask, bool))
        self._require_finite(failed)

    def begin_drive(self, targets_rad: ArrayLike, gain: float, max_speed: Floats, first: int) -> None:
        """Begin what :meth:`drive` does for the environments from ``first`` on, in the background.

        Until :meth:`finish_drive` has returned, nothing else may use these environments.

        Args:
            targets_rad: (k, joints); speed = gain * (target - perceived angle).
            gain: 1/s.
            max_speed: (joints,) largest speeds, rad/s.
            first: a multiple of :data:`WHOLE`, as is ``first + k`` unless it is ``n``.

        Raises:
            ValueError: wrong shape or rows, or a target or angle is not finite; nothing has begun then.
            RuntimeError: these environments have not finished what they began.
        """
        targets = np.ascontiguousarray(targets_rad, dtype=np.float64)
        if self._core.begin_drive(targets, gain, max_speed, first) == _NOT_FINITE:
            self._raise_not_finite(targets, first, None)

    def finish_drive(self, first: int) -> None:
        """Finish what :meth:`begin_drive` began.

        Raises:
            FloatingPointError: an environment's state is no longer finite; the message names it, the others step.
            RuntimeError: nothing has begun.
        """
        failed = self._core.finish_drive(first)
        self._require_finite(failed)

    def _raise_not_finite(self, targets: Floats, first: int, mask: NDArray[np.bool_] | None) -> None:
        wrong = ~np.isfinite(targets + self.perceptors.joint_angles[first : first + len(targets)])
        if mask is not None:
            wrong &= mask[:, None]
        row, joint = (int(k) for k in np.argwhere(wrong)[0])
        raise ValueError(
            f"targets_rad[{row}, {joint}]: environment {first + row}, "
            f"joint {self.model.joints[joint].name}: target and perceived angle must be finite numbers, not "
            f"{targets[row, joint]} and {self.perceptors.joint_angles[first + row, joint]}"
        )

    @staticmethod
    def _require_finite(failed: int) -> None:
        if failed >= 0:
            raise FloatingPointError(f"environment {failed}: its state is no longer finite; reset or restore it")

    def reset(self, mask: ArrayLike | None = None) -> None:
        """Reset robots to their spawn state: at the origin, all angles and the clock at 0."""
        self._core.reset(self._lanes(mask))

    def beam(self, position: ArrayLike, yaw_deg: ArrayLike = 0.0, mask: ArrayLike | None = None) -> None:
        """Move robots as the trainer's `move` does: upright, pose kept, all bodies at rest.

        Args:
            position: (3,) or (n, 3), the torso's centre, m.
            yaw_deg: scalar or (n,); 0 faces world +y, -90 faces +x.
            mask: (n,), which environments; default all.

        Raises:
            ValueError: wrong shape or not finite.
        """
        where, yaw = _finite("position", position), _finite("yaw_deg", yaw_deg)
        if where.shape not in ((3,), (self.n, 3)):
            raise ValueError(f"position: must have shape (3,) or ({self.n}, 3), not {where.shape}")
        if yaw.shape not in ((), (self.n,)):
            raise ValueError(f"yaw_deg: must be one number or have shape ({self.n},), not {yaw.shape}")
        positions = np.ascontiguousarray(np.broadcast_to(where, (self.n, 3)))
        yaws = np.ascontiguousarray(np.broadcast_to(yaw, (self.n,)))
        self._core.beam(positions, yaws, self._lanes(mask))

    def set_bodies(self, bodies: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Set all body states; motors, clocks and sleep counters stay as they are.

        Args:
            bodies: (n, bodies, 13), see `BODY_STATE`.
            mask: (n,), which environments; default all.

        Raises:
            ValueError: wrong shape, a value that is not finite, or a quaternion of length zero.
        """
        states = self._array("bodies", bodies, (self.n, len(self.model.bodies), BODY_STATE))
        # beyond these sizes the equations overflow
        wrong = ~(np.isfinite(states) & (np.abs(states) < 1e6))
        wrong[..., 3] |= np.linalg.norm(states[..., 3:7], axis=-1) < 1e-6
        if mask is not None:
            wrong &= np.asarray(mask, bool).reshape(-1, 1, 1)
        if wrong.any():
            environment, body, field = (int(k) for k in np.argwhere(wrong)[0])
            raise ValueError(
                f"bodies[{environment}, {body}, {field}]: environment {environment}, {self.model.bodies[body].name}: "
                f"must be finite and in range, not {states[environment, body, field]}"
            )
        self._core.set_bodies(states, self._lanes(mask))

    def set_enabled(self, enabled: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Wake bodies or put them to sleep, (n, bodies) of bool; woken ones sleep after ten quiet steps."""
        flags = np.ascontiguousarray(np.asarray(enabled, dtype=bool)).view(np.uint8)
        if flags.shape != (self.n, len(self.model.bodies)):
            raise ValueError(f"enabled: must have shape {(self.n, len(self.model.bodies))}, not {flags.shape}")
        self._core.set_enabled(flags, self._lanes(mask))

    def snapshot(self, mask: ArrayLike | None = None) -> NDArray[np.uint8]:
        """Return the whole state of the chosen environments, shape (k, size), hidden state included."""
        chosen = self._indices(mask)
        out = np.empty((len(chosen), self._core.snapshot_size), dtype=np.uint8)
        for row, environment in zip(out, chosen, strict=True):
            self._core.snapshot(int(environment), row)
        return out

    def restore(self, snapshot: NDArray[np.uint8], mask: ArrayLike | None = None) -> None:
        """Restore environments, bit for bit, from snapshots of the same robot type.

        Args:
            snapshot: (k, size) for k chosen environments, or one row for all of them.
            mask: (n,), which environments; default all.

        Raises:
            ValueError: wrong shape or type.
        """
        chosen = self._indices(mask)
        rows = np.atleast_2d(np.asarray(snapshot))
        if rows.dtype != np.uint8 or rows.shape[1] != self._core.snapshot_size:
            raise ValueError(
                f"snapshot: must be uint8 of shape (k, {self._core.snapshot_size}), not {rows.dtype} of {rows.shape}"
            )
        if len(rows) not in (1, len(chosen)):
            raise ValueError(f"snapshot: {len(rows)} rows for {len(chosen)} environments; give one row, or one each")
        rows = np.ascontiguousarray(rows)
        for k, environment in enumerate(chosen):
            self._core.restore(int(environment), rows[k if len(rows) > 1 else 0])

    def restore_from(self, rows: NDArray[np.int64], snapshots: NDArray[np.uint8], chosen: NDArray[np.int64]) -> None:
        """Restore the (k,) environments ``rows``, bit for bit, from the (k,) ``chosen`` ones of (m, size) snapshots.

        Raises:
            ValueError: wrong shape, or an index is out of range.
        """
        self._core.restore_from(rows, snapshots, chosen)

    def _indices(self, mask: ArrayLike | None) -> NDArray[np.intp]:
        lanes = self._lanes(mask)
        return np.arange(self.n) if lanes is None else np.flatnonzero(lanes)

    def _lanes(self, mask: ArrayLike | None) -> NDArray[np.uint8] | None:
        if mask is None:
            return None
        lanes = np.ascontiguousarray(mask)
        if lanes.dtype != np.bool_ or lanes.shape != (self.n,):
            raise ValueError(f"mask: must be bool of shape ({self.n},), not {lanes.dtype} of {lanes.shape}")
        return lanes.view(np.uint8)

    @staticmethod
    def _array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
        array = np.ascontiguousarray(value, dtype=np.float64)
        if array.shape != shape:
            raise ValueError(f"{name}: must have shape {shape}, not {array.shape}")
        return array


def centre_of_mass(robot_type: int, joint_angles_deg: ArrayLike) -> Floats:
    """Return the centre of mass in the torso's frame by forward kinematics.

    Args:
        robot_type: 0 to 4.
        joint_angles_deg: (n, joints), degrees.

    Returns:
        (n, 3), m.

    Raises:
        ValueError: unknown type, wrong shape, or an angle that is not finite.
    """
    kinematics = _kinematics(robot_type)
    angles = np.ascontiguousarray(_finite("joint_angles_deg", joint_angles_deg))
    joints = len(nao_model.model(robot_type).joints)
    if angles.ndim != 2 or angles.shape[1] != joints:
        raise ValueError(f"joint_angles_deg: must have shape (n, {joints}), not {angles.shape}")
    out = np.empty((len(angles), 3))
    kinematics.centre_of_mass_from_angles(angles, out)
    return out


def kinematics_address(robot_type: int) -> int:
    """Return the address of a table with the function behind :func:`centre_of_mass`, for other compiled modules.

    It is ``Kinematics`` in packages/naosim/cpp/batch.hpp, and stays valid.
    """
    return int(_kinematics(robot_type).kinematics)


def _kinematics(robot_type: int) -> _core.Batch:
    kinematics = _KINEMATICS.get(robot_type)
    if kinematics is None:
        table = engine_table(nao_model.model(robot_type))
        kinematics = _KINEMATICS[robot_type] = _core.Batch(table, 1, 1, -1, False, "")
    return kinematics


_KINEMATICS: dict[int, _core.Batch] = {}


def _finite(name: str, value: ArrayLike) -> Floats:
    array = np.asarray(value, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: must be finite")
    return array


_SPAWN = (0.0, -1.0, 1.5)
"""Position at which the server creates a robot, m."""


def _as_built(offset: Vector) -> Floats:
    # The server's scene language computes part positions as decimals of six significant digits around the spawn point
    # and stores them in single precision. That moves joint anchors by up to 2e-6 m, so it is part of the robot.
    return np.array([np.float32(f"{at + o:.6g}") for at, o in zip(_SPAWN, offset, strict=True)], dtype=np.float64)


def engine_table(model: RobotModel) -> dict[str, Floats]:
    """Return a robot table as the arrays the engine takes, as the server builds it from the same numbers."""
    bodies = model.bodies
    built = {body.name: _as_built(body.offset) for body in bodies}
    index = model.body_index
    by_body = {joint.body: (k, joint) for k, joint in enumerate(model.joints)}
    table: dict[str, list[object]] = {key: [] for key in _TABLE_FIELDS}
    for body in bodies:
        k, joint = by_body.get(body.name, (-1, None))
        size = body.shape.size
        table["mass"].append(body.mass)
        table["inertia"].append(body.inertia)
        table["shape"].append(_SHAPES[body.shape.kind] if body.shape.collides else 0)
        table["half"].append([s / 2 for s in size] if body.shape.kind == "box" else [0, 0, 0])
        table["radius"].append(0.0 if body.shape.kind == "box" else size[0])
        table["half_length"].append(size[1] / 2 if body.shape.kind == "capsule" else 0.0)
        table["offset"].append(built[body.name] - built["torso"])
        table["limb"].append(_LIMBS[body.limb] if body.limb else -1)
        table["joint"].append(k)
        if joint is None:
            table["parent"].append(-1)
            for key in ("anchor", "parent_anchor", "axis"):
                table[key].append((0.0, 0.0, 0.0))
            for key in ("low", "high", "max_speed"):
                table[key].append(0.0)
            continue
        parent = bodies[index[joint.parent]]
        table["parent"].append(index[joint.parent])
        local = np.array([np.float32(f"{a:.6g}") for a in joint.anchor], dtype=np.float64)
        anchor = (built[body.name] + local).astype(np.float32).astype(np.float64)
        table["anchor"].append(anchor - built[body.name])
        table["parent_anchor"].append(anchor - built[parent.name])
        table["axis"].append(joint.axis)
        table["low"].append(np.deg2rad(joint.low_deg))
        table["high"].append(np.deg2rad(joint.high_deg))
        table["max_speed"].append(np.float32(joint.max_speed))
    arrays = {key: np.ascontiguousarray(values, dtype=np.float64) for key, values in table.items()}
    sensors = dict(model.touch_sensors)
    arrays["touch_body"] = np.array(
        [index[sensors[name]] if name in sensors else -1 for name in _SENSORS], dtype=np.float64
    )
    arrays["collision_pairs"] = np.array(
        [[index[a], index[b]] for a, b in model.collision_pairs], dtype=np.float64
    ).ravel()
    return arrays
