"""Many worlds of one robot, stepped together by the loop in C++."""

from __future__ import annotations

import copy
import ctypes
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from naosim.mujoco.humanoid import SHARED, Parts, shared_numbers, topology_difference, varied_numbers
from naosim.mujoco.world import BALL_JOINT, SUBSTEPS, MujocoWorld, contact_parameters, library, motor_gains, own_arrays
from naosim.simulator import TOUCHING, BodyState, RobotMotion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Floats = NDArray[np.float64]

PERCEPTORS = ("joint_angles", "joint_speeds", "torso_quat", "torso_pos", "gyro", "accel")


class MujocoBatch:
    """n worlds of one model.

    Args:
        world: the world; all share its model.
        n: number of worlds.
        delay: steps by which commands are delayed, 0 or 1.
        truncate: round perceptors toward zero as the server does: torso pose to three decimals, the rest to two.
        threads: threads that step the worlds.
        isa: instruction set of the kernel: ``generic``, ``avx2``, ``avx512``; empty for the best.
        substeps: substeps of 5 ms in a step; the server's steps have four.

    Attributes:
        perceptors: (n, width) arrays by name, in the units of ``robot.perceptors``; every step overwrites them.
        position: (n, 3) torso positions in metres, full precision.
        rotation: (n, 3, 3) rotations from the torso's frame into the world's.
        bodies: motion of the bodies that the world's scene names, at the end of the step.
        contacts: by part of the robot, (n,) share of the step in which the ball touched it.
        torques: (n, J) torques in N m that the motors demand, whatever their limits, in the last 5 ms.
        foot_frames: (n, substeps, 2) upward forces of the ground on left and right foot in newtons, every 5 ms.
        diverged: (n,) worlds whose state is no longer finite; they are not stepped.
        data: the ``MjData`` of every world.
        kp: (n, J) stiffness of the motors in N m/rad.
        kd: (n, J) their damping in N m s/rad.
    """

    def __init__(
        self,
        world: MujocoWorld,
        n: int,
        *,
        delay: int,
        truncate: bool = True,
        threads: int = 1,
        isa: str = "",
        substeps: int = SUBSTEPS,
    ) -> None:
        from naosim.mujoco._mujoco import Worlds

        self._mujoco = mujoco = library()
        self.n = n
        self.world = world
        self._threads = threads
        self._own: dict[int, Floats] = {}  # numbers of the worlds that differ, by row
        self._models: list[Any] = []  # into which they are copied: one for each thread, and one for this class
        self.kp, self.kd = (np.repeat(each[None], n, axis=0) for each in motor_gains(world.model))
        self.data = [world.new_data() for _ in range(n)]
        signature = int(mujoco.mjtState.mjSTATE_INTEGRATION.value)
        self._worlds = Worlds(
            functions=_functions(),
            owners=[world.model, *self.data],
            model=world.model._address,
            joints=world.joints,
            positions=world.model.nq,
            torso=world.torso,
            state=mujoco.mj_stateSize(world.model, signature),
            signature=signature,
            parts=len(TOUCHING) if world.scene.ball else 0,
            data=_addresses(data._address for data in self.data),
            ctrl=_addresses(data.ctrl.ctypes.data for data in self.data),
            sensordata=_addresses(data.sensordata.ctypes.data for data in self.data),
            qpos=_addresses(data.qpos.ctypes.data for data in self.data),
            speeds=_addresses(data.qvel[world.first_speed :].ctypes.data for data in self.data),
            xpos=_addresses(data.xpos.ctypes.data for data in self.data),
            xmat=_addresses(data.xmat.ctypes.data for data in self.data),
            kp=self.kp,
            kd=self.kd,
            bodies=list(world.moving),
            substeps=substeps,
            delay=delay,
            truncate=truncate,
            threads=threads,
        )
        self._kernel = world.kernel
        if self._kernel:
            difference = topology_difference(world)
            if difference:
                raise ValueError(f"engine: fast cannot step this robot because {difference}; use engine: mujoco")
            warm = _addresses(data.qacc_warmstart.ctypes.data for data in self.data)
            parts = Parts(world)
            self._worlds.use_kernel(
                world.robot.lower(),
                isa,
                shared_numbers(world),
                warm,
                world.model.opt.timestep,
                parts.geoms.start,
                parts.ball,
                [parts.number(body) for body in world.moving],
            )
            for row in range(n):
                self._worlds.set_numbers(row, varied_numbers(world))
        views = self._worlds.views()
        names = (*PERCEPTORS, *(each.name for each in world.scene.perceptors))
        self.perceptors: Mapping[str, Floats] = MappingProxyType({name: views[name] for name in names})
        motion = [views[f"body_{name}"] for name in ("position", "rotation", "velocity", "spin")]
        self.bodies = {name: BodyState(*(view[k] for view in motion)) for k, name in enumerate(world.scene.moving)}
        self.contacts: dict[str, Floats] = dict(zip(TOUCHING, views["contacts"], strict=False))
        self.position: Floats = views["position"]
        self.rotation: Floats = views["rotation"]
        self.torques: Floats = views["torques"]
        self.foot_frames: Floats = views["foot_frames"]
        self.diverged: NDArray[np.bool_] = views["diverged"].view(np.bool_)

    def step(self, targets_rad: Floats, first: int = 0, active: NDArray[np.bool_] | None = None) -> None:
        """Step the worlds from ``first`` on with (k, J) target angles; only those of the (k,) mask, if one is given.

        Raises:
            ValueError: if a shape is wrong.
        """
        mask = None if active is None else np.ascontiguousarray(active, dtype=np.bool_).view(np.uint8)
        self._worlds.step(np.ascontiguousarray(targets_rad, dtype=np.float64), first, mask)

    def begin(self, targets_rad: Floats, first: int) -> None:
        """Begin to step the worlds from ``first`` on with (k, J) target angles, in the background.

        Until :meth:`finish` has returned, nothing else may use these worlds.

        Raises:
            ValueError: if a shape is wrong, or a target is not finite.
            RuntimeError: if these worlds have not finished the step before.
        """
        self._worlds.begin(np.ascontiguousarray(targets_rad, dtype=np.float64), first)

    def finish(self, first: int) -> None:
        """Finish what :meth:`begin` began.

        Raises:
            RuntimeError: if nothing has begun.
        """
        self._worlds.finish(first)

    def step_unchanged(self) -> None:
        """Step all worlds with the actuators' controls as they are in :attr:`data`."""
        self._worlds.step_unchanged()

    def step_bare(self, cycles: int) -> None:
        """Call ``mj_step`` four times a cycle and nothing else, in this thread."""
        self._worlds.step_bare(cycles)

    def set_world(self, row: int, world: MujocoWorld) -> None:
        """Give one world the numbers of another with the same bodies and joints.

        Raises:
            ValueError: if it differs in what a kernel has once for all robots of a batch.
        """
        shared = [name for name in SHARED if not np.array_equal(*(getattr(w.model, name) for w in (world, self.world)))]
        if not np.allclose(world.model.geom_solref, contact_parameters(self.world, world.stiffness), rtol=1e-12):
            shared.append("geom_solref")
        if self._kernel and shared:
            raise ValueError(
                f"world: {', '.join(shared)} differ, which robots of a batch share in the fast engine; only masses, "
                "centres of mass, gains, friction, gravity and the stiffness of contacts may"
            )
        if not self._models:
            self._models = [copy.copy(self.world.model) for _ in range(self._threads + 1)]
            arrays = [own_arrays(model) for model in self._models[1:]]
            self._worlds.use_models(
                owners=self._models[1:],
                models=_addresses(model._address for model in self._models[1:]),
                parts=_addresses(array.ctypes.data for one in arrays for array in one),
                counts=[array.size for array in arrays[0]],
            )
        self._own[row] = np.concatenate([np.ravel(array) for array in own_arrays(world.model)])
        self._worlds.set_own(row, self._own[row])
        self.kp[row], self.kd[row] = motor_gains(world.model)
        if self._kernel:
            self._worlds.set_numbers(row, varied_numbers(world))

    def model(self, row: int) -> Any:
        """Return the model of a world, to be used before the next call."""
        if row not in self._own:
            return self.world.model
        arrays = own_arrays(self._models[0])
        parts = np.split(self._own[row], np.cumsum([array.size for array in arrays])[:-1])
        for array, numbers in zip(arrays, parts, strict=True):
            array[...] = numbers.reshape(array.shape)
        return self._models[0]

    @property
    def left_to_mujoco(self) -> int:
        """Number of substeps that the kernel left to ``mj_step``; see docs/explanation/engine.md."""
        return self._worlds.left_to_mujoco

    @property
    def collided_by_mujoco(self) -> int:
        """Number of substeps in which MuJoCo found some of a robot's contacts for the kernel."""
        return self._worlds.collided_by_mujoco

    def warning(self, row: int) -> str:
        """Return the last warning that MuJoCo gave about a world since it was loaded."""
        return self._worlds.warning(row)

    @property
    def threads_address(self) -> int:
        """Address of the batch's threads; see ``naosim.simulator.NativeHandle``."""
        return self._worlds.threads

    @property
    def row_size(self) -> int:
        """Number of values in a world's state: integration state, sensor data, kernel's memory and pending command."""
        return self._worlds.row_size

    def save(self) -> Floats:
        """Return the (n, row_size) states."""
        out = np.empty((self.n, self.row_size))
        for row in range(self.n):
            self._worlds.save(row, out[row])
        return out

    def load(self, row: int, state: Floats) -> None:
        """Restore a world from its (row_size,) state."""
        self._worlds.load(row, state)

    def place_ball(self, row: int, position: Floats, velocity: Floats, spin: Floats) -> None:
        """Place the ball, as the server's monitor does; if it is in view, the robot perceives it at once.

        Args:
            row: which world.
            position: (3,) metres.
            velocity: (3,) m/s.
            spin: (3,) angular velocity in rad/s.
        """
        data, ball, camera = self.data[row], BALL_JOINT, self.world.camera
        data.qpos[ball : ball + 7] = (*position, 1.0, 0.0, 0.0, 0.0)
        data.qvel[ball : ball + 6] = (*velocity, *spin)
        self._mujoco.mj_kinematics(self.model(row), data)
        rotation = data.site_xmat[camera].reshape(3, 3)
        data.sensordata[-3:] = rotation.T @ (position - data.site_xpos[camera])
        self._worlds.refresh(row)

    def motion(self, rows: Sequence[int]) -> RobotMotion:
        """Return poses and velocities of robots."""
        torso, first = self.world.torso, self.world.first_speed
        data = [self.data[row] for row in rows]
        qpos, qvel = np.array([each.qpos[torso:] for each in data]), np.array([each.qvel[first - 6 :] for each in data])
        rotation = self.rotation[list(rows)]
        return RobotMotion(
            joints_rad=qpos[:, 7:],
            joints_rad_s=qvel[:, 6:],
            torso_m=qpos[:, :3],
            torso_wxyz=qpos[:, 3:7],
            torso_mps=qvel[:, :3],
            torso_rad_s=np.einsum("kij,kj->ki", rotation, qvel[:, 3:6]),
            targets_rad=self.save()[list(rows), -self.world.joints :],
        )

    def set_motion(self, row: int, motion: RobotMotion, k: int) -> None:
        """Give a robot the k-th of some poses and velocities, which it perceives at once."""
        mujoco, data, state = self._mujoco, self.data[row], np.empty(self.row_size)
        torso, first = self.world.torso, self.world.first_speed
        rotation = np.empty(9)
        quaternion = motion.torso_wxyz[k] / np.linalg.norm(motion.torso_wxyz[k])
        mujoco.mju_quat2Mat(rotation, quaternion)
        data.qpos[torso:] = np.concatenate([motion.torso_m[k], quaternion, motion.joints_rad[k]])
        spin = rotation.reshape(3, 3).T @ motion.torso_rad_s[k]
        data.qvel[first - 6 :] = np.concatenate([motion.torso_mps[k], spin, motion.joints_rad_s[k]])
        data.qacc_warmstart[first - 6 :] = 0.0
        data.ctrl[1::3] = motion.targets_rad[k]
        mujoco.mj_forward(self.model(row), data)
        self._worlds.forget(row)
        self._worlds.save(row, state)
        state[-self.world.joints :] = motion.targets_rad[k]
        self._worlds.load(row, state)

    def place(
        self, row: int, position: tuple[float, float, float], quaternion: Floats, joints: Floats, targets: Floats
    ) -> None:
        """Place a robot at rest, with (J,) joint angles and (J,) target angles as its pending command."""
        data, world = self.data[row], self.world
        state = np.empty(self.row_size)
        data.qpos[world.torso : world.torso + 3] = position
        data.qpos[world.torso + 3 : world.torso + 7] = quaternion
        data.qpos[world.torso + 7 :] = joints
        data.qvel[:] = data.qacc_warmstart[:] = data.ctrl[:] = 0.0
        data.ctrl[1::3] = targets
        data.sensordata[:] = 0.0
        self._worlds.forget(row)
        self._worlds.save(row, state)
        state[-world.joints :] = targets
        self._worlds.load(row, state)


def _addresses(values: Any) -> NDArray[np.uint64]:
    return np.fromiter(values, dtype=np.uint64)


def _functions() -> dict[str, int]:
    """Return the addresses of what the loop uses of the library that the Python package has loaded."""
    mujoco = library()
    loaded = ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))  # loaded already
    steps = ("mj_step", "mj_getState", "mj_setState")
    motion = ("kinematics", "collision", "comPos", "comVel", "objectVelocity")
    names = (*steps, *(f"mj_{name}" for name in motion))
    functions = {name: ctypes.cast(getattr(loaded, name), ctypes.c_void_p).value or 0 for name in names}
    return functions | {"mju_user_warning": ctypes.addressof(ctypes.c_void_p.in_dll(loaded, "mju_user_warning"))}
