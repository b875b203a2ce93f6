"""The world of rcssservermj with one robot, built from the model files of the package ``rcsssmj``.

The server attaches its robots to a world with a ball, goals, visuals and textures. What cannot touch a lone robot is
left out here; the ball stays, because it takes part in the same constraint solver as the robot, and without it the last
bits of the robot's motion differ. The same holds for the order of the bodies, and for the pose in which the robot was
attached, which enters the weights of the constraints.
"""

from __future__ import annotations

import copy
import ctypes
import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from naosim.fields import RCSSSERVERMJ
from naosim.simulator import BALL, PLAIN, TOUCHING, Scene, Variation

if TYPE_CHECKING:
    from naosim.mujoco.settings import Engine
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

BALL_JOINT = 0
"""Where the ball's coordinates begin in ``qpos`` and ``qvel``."""

SHANKS = {"T1": ("Shank_Left", "Shank_Right"), "K1": ("Left_Shank", "Right_Shank")}
FOREARMS = {"T1": ("AL3", "AR3"), "K1": ("Left_Arm_3", "Right_Arm_3")}


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


@cache
def library() -> Any:
    """Import MuJoCo and return it; the versions are read once, which takes milliseconds.

    Raises:
        MujocoUnavailableError: if it or ``rcsssmj`` is missing or has another version.
    """
    require_package("mujoco")
    require_package("rcsssmj")
    import mujoco

    return mujoco


_VARIED = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "geom_friction",
    "geom_solref",
    "actuator_gainprm",
    "actuator_biasprm",
)
"""Arrays of a model that variations change, besides gravity."""

_COMPUTED = (
    "actuator_acc0",
    "body_invweight0",
    "body_subtreemass",
    "dof_M0",
    "dof_invweight0",
    "dof_length",
    "light_poscom0",
)
"""Arrays of a model that MuJoCo computes from these (``mj_setConst``), besides its statistics."""


def own_arrays(model: Any) -> list[Floats]:
    """Return views of everything in a model that differs between variations of a world."""
    # mjStatistic of mujoco.h begins with four numbers and the centre; Python has a view of the centre only
    centre = model.stat.center
    statistics = np.ctypeslib.as_array((ctypes.c_double * 7).from_address(centre.ctypes.data - 4 * centre.itemsize))
    return [getattr(model, name) for name in (*_VARIED, *_COMPUTED)] + [model.opt.gravity, statistics]


@dataclass(frozen=True)
class MujocoWorld:
    """A compiled world with one robot.

    Attributes:
        model: the ``MjModel``, with the robot's gains.
        joints: number of the robot's joints.
        torso: where the torso's seven coordinates begin in ``qpos``; the joints follow them. The ball's come before, if
            there is a ball.
        scene: what is reported besides the robot. An exact world has a ball in every scene, since it takes part in the
            constraint solver.
    """

    model: Any
    joints: int
    torso: int
    scene: Scene = PLAIN
    robot: str = "T1"
    """Model of the robot, ``T1`` or ``K1``."""
    kernel: bool = False
    """Whether the robot's kernel steps the world instead of ``mj_step``."""
    stiffness: float = 1.0
    """Factor of the stiffness of the robot's contacts; their damping has its root as a factor."""

    @property
    def ball(self) -> bool:
        """Whether there is a ball."""
        return self.torso > 0

    @property
    def first_speed(self) -> int:
        """Where the joints' speeds begin in ``qvel``."""
        return int(self.model.nv) - self.joints

    def with_gains(self, kp: Floats, kd: Floats) -> MujocoWorld:
        """Return the world with (J,) motor gains in N m/rad and N m s/rad."""
        model = copy.copy(self.model)
        set_gains(model, kp, kd)
        return replace(self, model=model)

    def varied(self, variation: Variation, rng: np.random.Generator, used: Any = None) -> MujocoWorld:
        """Return the world with another robot and other ground.

        Args:
            variation: what differs, and how much.
            rng: draws how.
            used: model of an earlier variation of this world, which is changed; without one the model is copied, with
                its meshes, which take up to 21 MB.

        Raises:
            ValueError: if contacts cannot be so stiff with MuJoCo's steps.
        """
        mujoco = library()
        if used is None:
            model = copy.copy(self.model)
        else:
            model = used
            for name in _VARIED:
                getattr(model, name)[:] = getattr(self.model, name)
            model.opt.gravity[:] = self.model.opt.gravity
        bodies = [body for body in range(model.nbody) if model.body(body).name.startswith(PREFIX)]
        factors = 1.0 + variation.masses * rng.uniform(-1.0, 1.0, len(bodies))
        model.body_mass[bodies] *= factors
        model.body_inertia[bodies] *= factors[:, None]
        if variation.gains:
            kp, kd = 1.0 + variation.gains * rng.uniform(-1.0, 1.0, (2, self.joints))
            stiffness, damping = motor_gains(model)
            set_gains(model, kp * stiffness, kd * damping)
        if variation.centre_m:
            model.body_ipos[model.body(PREFIX + "torso").id] += variation.centre_m * rng.uniform(-1.0, 1.0, 3)
        model.geom_friction[self.geoms, 0] *= variation.friction
        model.opt.gravity *= variation.gravity
        model.geom_solref[:] = contact_parameters(self, variation.stiffness)
        mujoco.mj_setConst(model, self._scratch)
        return replace(self, model=model, stiffness=variation.stiffness)

    def new_data(self, ball_position: tuple[float, float] = PARKED_BALL_M) -> Any:
        """Return an ``MjData`` with the robot where it was attached and the ball on the ground."""
        data = library().MjData(self.model)
        if self.ball:
            data.qpos[:2] = ball_position
        return data

    @cached_property
    def _scratch(self) -> Any:
        """``MjData`` in which MuJoCo computes constants of variations; making one takes a millisecond."""
        return library().MjData(self.model)

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Indices of the bodies whose motion is reported."""
        names = {"torso": "torso", "left_foot": FEET[0], "right_foot": FEET[1]}
        ids = {name: self.model.body(PREFIX + body).id for name, body in names.items()}
        ids |= {BALL: self.model.body("ball").id} if self.ball else {}
        return tuple(ids[name] for name in self.scene.moving)

    @cached_property
    def camera(self) -> int:
        """Index of the site from which the robot sees."""
        return int(self.model.site(PREFIX + "camera").id)

    @cached_property
    def geoms(self) -> NDArray[np.int64]:
        """Indices of the robot's colliding geoms."""
        names = (self.model.body(body).name for body in self.model.geom_bodyid)
        return np.array([geom for geom, name in enumerate(names) if name.startswith(PREFIX)], dtype=np.int64)


def contact_parameters(world: MujocoWorld, factor: float) -> Floats:
    """Return the (G, 2) ``geom_solref`` with which a robot's contacts are ``factor`` times as stiff.

    Their time constants are shortened, and their damping has the root of the factor as a factor.

    Raises:
        ValueError: if a time constant were below two steps, which is MuJoCo's limit.
    """
    parameters, limit = world.model.geom_solref.copy(), 2.0 * world.model.opt.timestep
    if factor == 1.0:
        return np.asarray(parameters)
    times = np.maximum(parameters[world.geoms, 0], limit)
    most = float(np.min((times / limit) ** 2))
    if factor > most * (1.0 + 1e-9):
        raise ValueError(
            f"stiffness_max: contacts of robot {world.robot.lower()} can be at most {most:g} times as stiff with "
            f"MuJoCo's steps of {500.0 * limit:g} ms, got {factor:g}; use a smaller stiffness_max"
        )
    parameters[world.geoms, 0] = times / math.sqrt(factor)
    return np.asarray(parameters)


def set_gains(model: Any, kp: Floats, kd: Floats) -> None:
    """Set (J,) motor gains of a model's position and velocity actuators, as the server does."""
    model.actuator_gainprm[1::3, 0], model.actuator_biasprm[1::3, 1] = kp, -kp
    model.actuator_gainprm[2::3, 0], model.actuator_biasprm[2::3, 2] = kd, -kd


def motor_gains(model: Any) -> tuple[Floats, Floats]:
    """Return (J,) stiffness in N m/rad and (J,) damping in N m s/rad of a model's motors."""
    return model.actuator_gainprm[1::3, 0], model.actuator_gainprm[2::3, 0]


def gains(robot: Robot) -> tuple[Floats, Floats]:
    """Return (J,) stiffness in N m/rad and (J,) damping in N m s/rad of a robot's joints."""
    parameters: BoosterParameters = robot.parameters  # type: ignore[assignment]
    kp, kd = zip(*(parameters.gains(name) for name in robot.joint_names), strict=True)
    return np.array(kp), np.array(kd)


def world_of(robot: Robot, *, engine: Engine = "mujoco", scene: Scene = PLAIN) -> MujocoWorld:
    """Return the world of a robot with its gains."""
    world = compiled(robot.data["model"], engine, scene)
    return world.with_gains(*gains(robot))


@cache
def compiled(robot: str, engine: Engine, scene: Scene = PLAIN) -> MujocoWorld:
    """Return the world of a robot, ``T1`` or ``K1``, with gains of 1; it is compiled once in a process.

    The fast world has a ball only in a scene with one, and the robot's kernel steps it.
    """
    mujoco, exact = library(), engine == "mujoco"
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
    if not exact and not scene.ball:
        world.delete(world.body("ball"))
    if scene.goals:
        _add_goals(world, mujoco.mjtGeom)
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
    if scene.ball:
        _add_ball_sensors(world, robot, mujoco)
    model = world.compile()
    # a world that diverges stays where it is, for the caller to see, instead of being reset automatically
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    if not exact:
        # one robot is one island: to look for islands costs time and changes nothing
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND.value
    return MujocoWorld(model, model.nu // 3, 7 if exact or scene.ball else 0, scene, robot, kernel=not exact)


def _add_ball_sensors(world: Any, robot: str, mujoco: Any) -> None:
    """Add what is noted of the ball, last in sensordata: parts that touch it, and its place in the camera's frame."""
    body, subtree, site = (getattr(mujoco.mjtObj, f"mjOBJ_{name}") for name in ("BODY", "XBODY", "SITE"))
    parts = [(body, name) for name in (*FEET, *SHANKS[robot])]
    parts += [(subtree, name) for name in (*FOREARMS[robot], "torso")]
    for name, (kind, part) in zip(TOUCHING, parts, strict=True):
        world.add_sensor(
            name=f"ball-{name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname="ball",
            reftype=kind,
            refname=PREFIX + part,
            intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value, 0, 1],
        )
    place = {"objtype": site, "objname": "B-vismarker", "reftype": site, "refname": PREFIX + "camera"}
    world.add_sensor(name="ball-seen", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, **place)


def _add_goals(world: Any, kinds: Any) -> None:
    """Add the goals in the server's order: posts, bars and nets are solid, a net is a box as thick as a post."""
    goal = RCSSSERVERMJ.goal
    radius, side, top = goal.post_radius_m, goal.width_m / 2, goal.height_m
    half = math.sqrt(0.5)  # the server's quaternions have seven digits, which MuJoCo normalizes
    for end, sign in (("left", -1.0), ("right", 1.0)):
        body = world.worldbody.add_body(name=f"goal-{end}", pos=(sign * RCSSSERVERMJ.length_m / 2, 0.0, 0.0))
        back, middle = sign * goal.depth_m, sign * goal.depth_m / 2

        def bar(
            length: float, pos: tuple[float, float, float], quat: tuple[float, ...] = (1, 0, 0, 0), to: Any = body
        ) -> None:
            to.add_geom(type=kinds.mjGEOM_CYLINDER, pos=pos, size=(radius, length / 2, 0), quat=quat)

        for x in (0.0, back):
            for y in (-side, side):
                bar(top, (x, y, top / 2))
        across, along = (0.0, 0.0, half, half), (0.0, half, 0.0, half)
        for x in (0.0, back):
            bar(goal.width_m, (x, 0.0, top), across)
        for y in (-side, side):
            bar(goal.depth_m, (middle, y, top), along)
        bar(goal.width_m, (back, 0.0, 0.0), across)
        for y in (-side, side):
            bar(goal.depth_m, (middle, y, 0.0), along)
        nets = [((middle, 0.0, top), (goal.depth_m / 2, side, radius)), ((back, 0.0, top / 2), (radius, side, top / 2))]
        nets += [((middle, y, top / 2), (goal.depth_m / 2, radius, top / 2)) for y in (-side, side)]
        for pos, size in nets:
            body.add_geom(type=kinds.mjGEOM_BOX, pos=pos, size=size)
