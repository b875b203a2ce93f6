"""The world of rcssservermj with one robot, built from the model files of the package ``rcsssmj``.

The server attaches its robots to a world with a ball, goals, visuals and textures. What cannot touch a lone robot is
left out here; the ball stays, because it takes part in the same constraint solver as the robot, and without it the last
bits of the robot's motion differ. The same holds for the order of the bodies, and for the pose in which the robot was
attached, which enters the weights of the constraints.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from naosim.fields import RCSSSERVERMJ

if TYPE_CHECKING:
    from naosim.robots import Robot
    from naosim.robots.booster import BoosterParameters

Floats = NDArray[np.float64]

MUJOCO_VERSION = "3.5.0"
RCSSSMJ_VERSION = "0.2.1"
"""The versions that the league uses; other versions of MuJoCo give different last bits."""

SUBSTEPS = 4
"""Physics steps of 5 ms in a step of 20 ms."""

UNIFORM_NUMBER = 2
"""Number with which the robot enters the field; it decides where it was attached."""

PARKED_BALL_M = (25.0, 16.0)
"""Position of the ball, metres: a corner of the field that no robot reaches."""

FEET = ("left_foot_link", "right_foot_link")
"""Bodies that touch the ground while the robot runs."""

PREFIX = "robot-"


class MujocoUnavailableError(FileNotFoundError):
    """MuJoCo or the league's models are not installed, or in another version."""


def require_package(package: str) -> None:
    """Raise MujocoUnavailableError unless ``mujoco`` or ``rcsssmj`` is installed in the league's version."""
    wanted = {"mujoco": MUJOCO_VERSION, "rcsssmj": RCSSSMJ_VERSION}[package]
    try:
        found = metadata.version(package)
    except metadata.PackageNotFoundError:
        found = ""
    if found != wanted:
        state = f"{found} is installed" if found else "it is not installed"
        raise MujocoUnavailableError(
            f"{package}: version {wanted} is needed, {state}; "
            f"run 'pip install mujoco=={MUJOCO_VERSION} rcsssmj=={RCSSSMJ_VERSION}'"
        )


def missing_packages() -> str:
    """Return which package is missing or has another version, with its remedy; empty if none is."""
    try:
        require_package("mujoco")
        require_package("rcsssmj")
    except MujocoUnavailableError as error:
        return str(error)
    return ""


def library() -> Any:
    """Import MuJoCo and return it.

    Raises:
        MujocoUnavailableError: if it or ``rcsssmj`` is missing or has another version.
    """
    require_package("mujoco")
    require_package("rcsssmj")
    import mujoco

    return mujoco


@dataclass(frozen=True)
class World:
    """A compiled world with one robot.

    Attributes:
        model: the ``MjModel``, with the robot's gains.
        joints: number of the robot's joints.
        torso: where the torso's seven coordinates begin in ``qpos``; the joints follow them. The ball's come before, if
            there is a ball.
        friction: (J,) Coulomb friction of the joints in N m, to be applied as torques; empty if the model has it as a
            constraint.
    """

    model: Any
    joints: int
    torso: int
    friction: Floats

    @property
    def ball(self) -> bool:
        """Whether there is a ball."""
        return self.torso > 0

    @property
    def first_speed(self) -> int:
        """Where the joints' speeds begin in ``qvel``."""
        return int(self.model.nv) - self.joints

    def with_gains(self, kp: Floats, kd: Floats) -> World:
        """Return the world with (J,) motor gains in N m/rad and N m s/rad."""
        model = copy.copy(self.model)
        set_gains(model, kp, kd)
        return replace(self, model=model)

    def varied(self, mass_variation: float, friction: float, gravity: float, rng: np.random.Generator) -> World:
        """Return the world with other masses of the robot's bodies; friction and gravity are multiplied."""
        mujoco = library()
        model = copy.copy(self.model)
        bodies = [body for body in range(model.nbody) if model.body(body).name.startswith(PREFIX)]
        factors = 1.0 + mass_variation * rng.uniform(-1.0, 1.0, len(bodies))
        model.body_mass[bodies] *= factors
        model.body_inertia[bodies] *= factors[:, None]
        model.geom_friction[self.geoms, 0] *= friction
        model.opt.gravity *= gravity
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return replace(self, model=model)

    def new_data(self, ball_position: tuple[float, float] = PARKED_BALL_M) -> Any:
        """Return an ``MjData`` with the robot where it was attached and the ball on the ground."""
        data = library().MjData(self.model)
        if self.ball:
            data.qpos[:2] = ball_position
        return data

    @cached_property
    def geoms(self) -> NDArray[np.int64]:
        """Indices of the robot's colliding geoms."""
        names = (self.model.body(body).name for body in self.model.geom_bodyid)
        return np.array([geom for geom, name in enumerate(names) if name.startswith(PREFIX)], dtype=np.int64)


def set_gains(model: Any, kp: Floats, kd: Floats) -> None:
    """Set (J,) motor gains of a model's position and velocity actuators, as the server does."""
    model.actuator_gainprm[1::3, 0], model.actuator_biasprm[1::3, 1] = kp, -kp
    model.actuator_gainprm[2::3, 0], model.actuator_biasprm[2::3, 2] = kd, -kd


def gains(robot: Robot) -> tuple[Floats, Floats]:
    """Return (J,) stiffness in N m/rad and (J,) damping in N m s/rad of a robot's joints."""
    parameters: BoosterParameters = robot.parameters  # type: ignore[assignment]
    kp, kd = zip(*(parameters.gains(name) for name in robot.joint_names), strict=True)
    return np.array(kp), np.array(kd)


def torque_shares(robot: Robot, targets: Floats, angles: Floats, speeds: Floats) -> Floats:
    """Return the (k, J) share of its torque limit that each motor applies, from -1 to 1.

    Args:
        robot: the robot, with its gains.
        targets: (k, J) target angles in radians.
        angles: (k, J) joint angles in radians.
        speeds: (k, J) joint speeds in rad/s.
    """
    kp, kd = gains(robot)
    limits = np.array([joint.max_torque for joint in robot.joints])
    shares: Floats = np.clip((kp * (targets - angles) - kd * speeds) / limits, -1.0, 1.0)
    return shares


def world_of(robot: Robot, *, exact: bool = True) -> World:
    """Return the world of a robot with its gains."""
    world = compiled(robot.data["model"], exact)
    return world.with_gains(*gains(robot))


@cache
def compiled(robot: str, exact: bool) -> World:
    """Return the world of a robot, ``T1`` or ``K1``, with gains of 1; it is compiled once in a process.

    A world that is not exact has neither ball nor air, and the joints' friction is not part of the constraint solver,
    which takes most of a step: it has 10 instead of 33 rows while a T1 runs. A cycle later, joint speeds differ by
    0.3 % of their root mean square.
    """
    mujoco = library()
    resources = Path(metadata.distribution("rcsssmj").locate_file("rcsssmj/resources"))  # type: ignore[arg-type]
    world = mujoco.MjSpec.from_file(str(resources / "environments/soccer/world.xml"))
    spec = mujoco.MjSpec.from_file(str(resources / f"robots/{robot}/robot.xml"))
    meshes = set()
    for geom in list(spec.geoms):
        if not geom.contype and not geom.conaffinity:
            spec.delete(geom)
        elif geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            meshes.add(geom.meshname)
    for mesh in list(spec.meshes):
        if mesh.name not in meshes:
            spec.delete(mesh)
    for geom in world.geoms:
        geom.material = ""
    for element in (*world.materials, *world.textures):
        world.delete(element)
    if not exact:
        world.delete(world.body("ball"))
    torso = spec.body("torso")
    torso.pos[0] = -(2 * UNIFORM_NUMBER + 1)
    torso.pos[1] = RCSSSERVERMJ.width_m / 2 + RCSSSERVERMJ.border_m
    torso.quat[:] = (math.cos(-math.pi / 4), 0.0, 0.0, math.sin(-math.pi / 4))
    world.worldbody.add_frame().attach_body(torso, PREFIX, "")
    for foot in FEET:
        # last in sensordata: the ground's force on the foot, in the world's axes
        world.add_sensor(
            name=foot,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname="pitch",
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=PREFIX + foot,
            intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FORCE.value, 3, 1],
        )
    model = world.compile()
    # a world that diverges stays where it is, for the caller to see, instead of being reset automatically
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    joints, friction = model.nu // 3, np.zeros(0)
    if not exact:
        model.opt.density = model.opt.viscosity = 0.0
        # one robot is one island: to look for islands costs time and changes nothing
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND.value
        if model.dof_frictionloss.any():
            friction = model.dof_frictionloss[-joints:].copy()
            model.dof_frictionloss[:] = 0.0
    return World(model, joints, 7 if exact else 0, friction)
