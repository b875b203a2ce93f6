"""The interface between simulators and everything that uses them.

A simulator runs n robots of one kind, each alone in a world of its own, 20 ms a step. Callers use it in the same way
whether it computes in this process or drives servers over the network. To add one, subclass :class:`Simulator`,
describe it with a :class:`SimulatorKind`, and register the kind under the entry-point group ``naosim.simulators``;
:mod:`naosim.conformance` checks that it conforms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from naospec.plugins import SIMULATORS, Plugin
from naospec.settings import SimulatorSettings
from numpy.typing import NDArray

from naosim.robots.description import PerceptorDescription, Shape

if TYPE_CHECKING:
    from collections.abc import Sequence
    from contextlib import AbstractContextManager

    from naosim.robots import Robot

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Bytes = NDArray[np.uint8]

STEP_S = 0.02
"""Simulated time of one step, seconds."""


CONTACT_N = 0.01
"""Force from which a foot counts as on the ground, newtons."""


class SimulatorClosedError(RuntimeError):
    """Use of a simulator after it was closed."""


class ServerLostError(RuntimeError):
    """Loss of more servers than ``RuntimeOptions.max_server_failures``, or of one that cannot be replaced."""


class ServersUnavailableError(ServerLostError):
    """Loss of a server while nothing answers that could start another one."""


@dataclass(frozen=True, slots=True)
class RuntimeOptions:
    """Settings that change how fast a simulator computes and how it handles faults, but not its results."""

    threads: int = 1
    """Threads that step an embedded simulator."""
    standby_servers: bool = False
    """Whether each robot on a server has a second server that prepares its next start."""
    max_server_failures: int = 20
    """Servers that may fail and be replaced."""


DEFAULT_OPTIONS = RuntimeOptions()
"""Options of a simulator that is opened without any."""


BALL = "ball"
"""Name of the ball's body and of the perceptor that reports where it is seen."""

BODIES = ("torso", "left_foot", "right_foot")
"""Bodies of a robot whose motion a simulator reports if the scene asks for it."""

TOUCHING = ("left_foot", "right_foot", "left_shank", "right_shank", "left_hand", "right_hand", "robot")
"""Parts whose contact with the ball is reported; hands with their forearms, and last the whole robot."""

BALL_PERCEPTOR = PerceptorDescription(
    BALL, 3, "m, deg, deg", "distance, azimuth and elevation of the ball from the camera; NaN where it is not reported"
)
"""What a robot perceives of the ball, in addition to ``robot.perceptors``."""


class Ability(StrEnum):
    """What only some simulators can do with a robot; settings name what they need, see :mod:`naospec.abilities`."""

    PUSHES = "pushes"
    """:meth:`Simulator.push`."""
    MASSES = "other masses"
    """:meth:`Simulator.vary` with other masses."""
    FRICTION = "other friction"
    """:meth:`Simulator.vary` with other friction."""
    GRAVITY = "other gravity"
    """:meth:`Simulator.vary` with other gravity."""
    GAINS = "other motor gains"
    """:meth:`Simulator.vary` with other motor gains."""
    CENTRES = "other centres of mass"
    """:meth:`Simulator.vary` with another centre of mass of the torso."""
    STIFFNESS = "other contact stiffness"
    """:meth:`Simulator.vary` with softer contacts."""
    STIFFER = "stiffer contacts"
    """:meth:`Simulator.vary` with stiffer contacts."""
    TORQUES = "motor torques"
    """:meth:`Simulator.torques`."""
    LYING = "lying starts"
    """Starts with ``orientations``."""
    MOVING = "moving starts"
    """:meth:`Simulator.set_motion`."""


@dataclass(frozen=True, slots=True)
class Variation:
    """How a robot and its world differ from the nominal ones."""

    masses: float = 0.0
    """Largest fraction by which the mass of a body differs."""
    gains: float = 0.0
    """Largest fraction by which the stiffness and the damping of a motor differ."""
    centre_m: float = 0.0
    """Largest distance by which the torso's centre of mass is shifted along each axis, metres."""
    friction: float = 1.0
    """Factor of the friction between robot and ground."""
    gravity: float = 1.0
    """Factor of gravity."""
    stiffness: float = 1.0
    """Factor of the stiffness of the robot's contacts; their damping has its root as a factor."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Contents of a world besides the robot and the ground."""

    ball: bool = False
    """Whether there is a ball that robots perceive and touch; its motion and that of the bodies is reported."""
    goals: bool = False
    """Whether the field's goals can be touched."""
    bodies: bool = False
    """Whether the motion of :data:`BODIES` is reported without a ball, too."""

    def __contains__(self, other: Scene) -> bool:
        """Return whether a world with this scene has everything of another."""
        return all(getattr(self, each.name) or not getattr(other, each.name) for each in fields(self))

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the bodies whose motion is reported."""
        return (*(BODIES if self.ball or self.bodies else ()), *((BALL,) if self.ball else ()))

    @property
    def perceptors(self) -> tuple[PerceptorDescription, ...]:
        """What robots perceive of the scene, in addition to ``robot.perceptors``."""
        return (BALL_PERCEPTOR,) if self.ball else ()


PLAIN = Scene()
"""A robot alone on the ground."""


@dataclass(frozen=True)
class Starts:
    """States from which episodes begin: k poses that robots have settled in.

    Robots begin at rest. :meth:`Simulator.set_motion` and :meth:`Simulator.place_ball` give an episode a robot that
    moves and a ball in its place.

    Args:
        poses_rad: (k, J) joint angles that the motors hold while the robot settles, simulator order and signs.
        position_m: (2,) x and y of the torso in the world, or (k, 2) of each start.
        heading_rad: direction the torso faces, counter-clockwise from the world's +x, or (k,) of each start. A
            simulator that has one place for all starts raises ValueError.
        orientations: (k, 4) torso quaternions w, x, y, z from which robots are dropped, for starts that are not
            upright; None for upright ones. A simulator that cannot do this raises ValueError.
    """

    poses_rad: Floats
    position_m: tuple[float, float] | Floats = (0.0, 0.0)
    heading_rad: float | Floats = 0.0
    orientations: Floats | None = None

    def __len__(self) -> int:
        """Return the number of starts."""
        return len(self.poses_rad)

    def places(self) -> Floats:
        """Return (k, 3) x, y and heading of each start.

        Raises:
            ValueError: if there are places of another number of starts, or one is not finite.
        """
        out = np.empty((len(self), 3))
        try:
            out[:, :2], out[:, 2] = np.reshape(self.position_m, (-1, 2)), self.heading_rad
        except ValueError as error:
            raise ValueError(f"starts: expected one place, or one for each of {len(self)} starts: {error}") from None
        if not np.isfinite(out).all():
            raise ValueError("starts: expected finite positions and headings")
        return out

    def place(self) -> tuple[float, float, float]:
        """Return x, y and heading of all starts.

        Raises:
            ValueError: if they differ.
        """
        places = self.places()
        if len(places) and (places != places[0]).any():
            raise ValueError("starts: this simulator has one position and heading for all starts")
        x, y, heading = places[0].tolist() if len(places) else (0.0, 0.0, 0.0)
        return x, y, heading


@dataclass(frozen=True)
class BodyState:
    """Motion of one body of each robot's world, world frame; views that the next step overwrites.

    Attributes:
        position: (n, 3) metres, of the body's frame.
        rotation: (n, 3, 3) rotations from the body's frame into the world's.
        velocity: (n, 3) m/s.
        spin: (n, 3) angular velocity, rad/s.
    """

    position: Floats
    rotation: Floats
    velocity: Floats
    spin: Floats


@dataclass(frozen=True)
class RobotMotion:
    """Poses and velocities of k robots, from which episodes can begin in the middle of a step.

    Attributes:
        joints_rad: (k, J) joint angles, simulator order and signs.
        joints_rad_s: (k, J) joint speeds.
        torso_m: (k, 3) positions, world frame.
        torso_wxyz: (k, 4) quaternions from the torso's frame into the world's.
        torso_mps: (k, 3) velocities, world frame.
        torso_rad_s: (k, 3) angular velocities, world frame.
        targets_rad: (k, J) joint angles to which the motors drive until the next command acts.
    """

    joints_rad: Floats
    joints_rad_s: Floats
    torso_m: Floats
    torso_wxyz: Floats
    torso_mps: Floats
    torso_rad_s: Floats
    targets_rad: Floats

    def checked(self, k: int, joints: int) -> RobotMotion:
        """Return it as float64.

        Raises:
            ValueError: if an array is not of k robots with this number of joints, or not finite, or a quaternion 0.
        """
        widths = {"torso_m": 3, "torso_wxyz": 4, "torso_mps": 3, "torso_rad_s": 3}
        names = [each.name for each in fields(self)]
        finite_quaternions("torso_wxyz", self.torso_wxyz, k)
        return RobotMotion(**{name: finite(name, getattr(self, name), (k, widths.get(name, joints))) for name in names})


@dataclass(frozen=True)
class Truth:
    """True poses of the robots; views that the next step overwrites.

    Attributes:
        torso_position: (n, 3) metres, world frame.
        torso_rotation: (n, 3, 3) rotations from the torso's frame into the world's.
        bodies: motion of each body that :attr:`Scene.moving` names.
        contacts: by name of :data:`TOUCHING`, (n,) share of the latest step in which the ball touched it; empty without
            a ball.
    """

    torso_position: Floats
    torso_rotation: Floats
    bodies: Mapping[str, BodyState] = field(default_factory=dict)
    contacts: Mapping[str, Floats] = field(default_factory=dict)


def finite(name: str, values: Floats, shape: tuple[int, ...]) -> Floats:
    """Return values as float64.

    Raises:
        ValueError: if they have another shape or are not finite.
    """
    array: Floats = np.asarray(values, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers of shape {shape}, got shape {array.shape}")
    return array


def finite_quaternions(name: str, values: Floats, k: int) -> Floats:
    """Return (k, 4) quaternions of any length as float64.

    Raises:
        ValueError: if they have another shape, are not finite, or one has no length.
    """
    array = finite(name, values, (k, 4))
    if not array.any(axis=1).all():
        raise ValueError(f"{name}: a quaternion is 0, which is no orientation")
    return array


def halves(n: int, multiple: int = 1) -> tuple[slice, ...]:
    """Return two groups of about n / 2 robots, the first a multiple of a number; one if there are too few robots."""
    middle = -(-n // (2 * multiple)) * multiple
    return (slice(0, middle), slice(middle, n)) if 2 * multiple <= n else (slice(0, n),)


NATIVE_VERSION = 1
"""Version of what a `NativeHandle` refers to."""


@dataclass(frozen=True, slots=True)
class NativeHandle:
    """What compiled code may use of a simulator as long as it exists, if it was built for the same version.

    That is the arrays of `Simulator.perceptors` and `Simulator.truth`, which stay where they are, and the simulator's
    threads, on which compiled code may work between two calls.
    """

    _threads: int = 0
    """Address of its ``Threads`` (packages/naosim/cpp/thread_pool.hpp); 0 without any."""
    version: int = NATIVE_VERSION

    @property
    def is_usable(self) -> bool:
        """Whether this package's compiled code can use it."""
        return self.version == NATIVE_VERSION

    @classmethod
    def threads_of(cls, simulator: Simulator) -> int:
        """Return the threads of a simulator for compiled code; 0 for the caller's own."""
        native = simulator.native
        return native._threads if native is not None and native.is_usable else 0


class Simulator(ABC):
    """n robots of one kind, stepped together.

    Subclasses set :attr:`n` and :attr:`robot` through ``super().__init__`` and implement the abstract methods. The
    defaults suit a simulator in this process that cannot lose robots and has no snapshots.

    Attributes:
        n: number of robots.
        robot: their description.
        scene: contents of their worlds.
        groups: robots that are best stepped together. While one group computes, the caller can process another.
        perceptors: by name, (n, width) arrays in the units of ``robot.perceptors`` and ``scene.perceptors``. NaN where
            a perceptor reports nothing. Valid until the next call.
        truth: the robots' poses; valid until the next call.
        native: what compiled code may use of it; None for nothing.
        prepares_starts: whether :meth:`start` makes use of the starts of the episodes that follow.
        latency_steps: steps after which ``joint_angles`` first shows the effect of a command: 1 if the reply to a
            command already does.
        motors_follow_perceptors: whether motors are driven by the perceived ``joint_angles``, so that noise on these
            moves the robot, and is part of what the next step depends on.
    """

    perceptors: Mapping[str, Floats]
    truth: Truth
    latency_steps: int = 1
    motors_follow_perceptors: bool = False
    prepares_starts: bool = False
    native: NativeHandle | None = None

    def __init__(self, robot: Robot, n: int, scene: Scene = PLAIN) -> None:
        self.robot = robot
        self.n = n
        self.scene = scene
        self.groups: tuple[slice, ...] = (slice(0, n),)
        self.closed = False
        self._nothing_lost: Flags = np.zeros(n, dtype=np.bool_)

    # one step

    @abstractmethod
    def step_async(self, targets_rad: Floats, rows: slice, active: Flags | None = None) -> None:
        """Begin a step of the robots ``rows``; :meth:`step_wait` finishes it.

        Args:
            targets_rad: (k, J) joint angles to drive to, simulator order and signs, k = rows.stop - rows.start.
            rows: one of :attr:`groups`, or all robots.
            active: (k,) robots that take the step; the others keep still. None for all.
        """

    @abstractmethod
    def step_wait(self, rows: slice) -> None:
        """Finish the step that :meth:`step_async` began for these rows."""

    def step(self, targets_rad: Floats, active: Flags | None = None) -> None:
        """Take one step of all robots with (n, J) target angles; only those of the (n,) mask, if one is given."""
        everyone = slice(0, self.n)
        self.step_async(targets_rad, everyone, active)
        self.step_wait(everyone)

    # starts

    @abstractmethod
    def load_starts(self, starts: Starts) -> None:
        """Replace the starts that :meth:`start` chooses from.

        Raises:
            ValueError: if a start is impossible in this simulator.
        """

    @abstractmethod
    def start(self, rows: Ints, starts: Ints, following: Ints | None = None) -> None:
        """Move the (k,) robots ``rows`` to the (k,) ``starts``; the others do not change.

        Args:
            rows: (k,) robots.
            starts: (k,) indices of loaded starts.
            following: (k,) the starts of the episodes after these, if they are known, for simulators that prepare them.

        Raises:
            RuntimeError: if no starts have been loaded.
            IndexError: if one of ``starts`` has not been loaded.
            ServerLostError: if lost robots cannot be moved to a new server.
        """

    # the beginning of an episode, after its start

    def place_ball(
        self, rows: Ints, position_m: Floats, velocity_mps: Floats | None = None, spin_rad_s: Floats | None = None
    ) -> None:
        """Place the ball in the worlds of the (k,) robots ``rows``.

        What robots perceive of it may show in a later step, as on the server.

        Args:
            rows: (k,) robots.
            position_m: (k, 3) of its centre.
            velocity_mps: (k, 3); at rest if left out.
            spin_rad_s: (k, 3) angular velocity; none if left out.

        Raises:
            ValueError: if there is no ball, or the simulator cannot move it so.
        """
        raise ValueError(f"ball: there is none in this {type(self).__name__}; open it with Scene(ball=True)")

    def motion(self, rows: Ints) -> RobotMotion:
        """Return poses and velocities of the (k,) robots ``rows``, from which :meth:`set_motion` lets others begin.

        Raises:
            ValueError: if robots can begin at rest only.
        """
        raise ValueError(f"motion: robots of {type(self).__name__} begin at rest only; use the embedded simulator")

    def set_motion(self, rows: Ints, motion: RobotMotion) -> None:
        """Give the (k,) robots ``rows`` other poses and velocities; the ball does not move.

        Raises:
            ValueError: if robots can begin at rest only, or a number is not finite.
        """
        raise ValueError(f"motion: robots of {type(self).__name__} begin at rest only; use the embedded simulator")

    # for viewers

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Everything that is drawn: the robot's shapes, then the ball if there is one."""
        if not self.scene.ball:
            return self.robot.shapes
        return (*self.robot.shapes, Shape(BALL, "sphere", (self.robot.field.ball_radius_m, 0.0, 0.0)))

    def bodies(self) -> Floats:
        """Return (n, B, 7) poses of :attr:`shapes`: position in metres and quaternion w, x, y, z, world frame."""
        raise NotImplementedError(f"{type(self).__name__} does not report body poses")

    def foot_forces(self) -> Floats:
        """Return the (n, 2) upward forces on left and right foot in newtons, zero without contact."""
        return np.zeros((self.n, 2))

    def airborne(self) -> Flags:
        """Return the (n,) robots of which neither foot touches the ground."""
        return np.asarray((self.foot_forces() < CONTACT_N).all(axis=1))

    def foot_frames(self) -> Floats:
        """Return the (n, F, 2) upward forces on left and right foot in newtons, at each measurement of the last step.

        A simulator that measures once a step returns :meth:`foot_forces`.
        """
        return self.foot_forces()[:, None]

    def flight(self) -> Flags:
        """Return the (n,) robots with both feet off the ground in two successive measurements of the latest step.

        With one measurement a step, that is :meth:`airborne`.
        """
        off: Flags = np.asarray((self.foot_frames() < CONTACT_N).all(axis=2))
        return np.asarray((off[:, :-1] & off[:, 1:]).any(axis=1)) if off.shape[1] > 1 else self.airborne()

    def torques(self) -> Floats:
        """Return the (n, J) torques in N m that the motors demanded last; the motors limit them.

        Compiled code needs the same array at every call.

        Raises:
            ValueError: if the simulator does not report torques.
        """
        raise ValueError(f"torque_penalty: {type(self).__name__} does not report motor torques; set it to 0")

    def torque_shares(self, rows: slice | Ints) -> Floats:
        """Return the (k, J) share of its torque limit that each motor applied last, from -1 to 1.

        Raises:
            ValueError: if the simulator does not report torques.
        """
        limits = np.array([joint.max_torque for joint in self.robot.joints])
        return np.asarray(np.clip(self.torques()[rows] / limits, -1.0, 1.0))

    # disturbances

    def push(self, velocities_mps: Floats, rows: slice) -> None:
        """Add (k, 2) horizontal velocities in m/s, world frame, to those of the torsos of the robots ``rows``.

        Raises:
            ValueError: if the simulator cannot push robots, or the velocities have a wrong shape or are not finite.
        """
        raise ValueError(f"push_mps: {type(self).__name__} cannot push robots; set it to 0")

    def draw_by_episode(self, rows: Ints, episodes: Ints) -> None:
        """Take the random numbers of robots from the episodes that they are about to begin, not from the robots.

        Simulators without random numbers of their own have nothing to do.
        """
        del rows, episodes

    def vary(self, variations: Sequence[Variation], rng: np.random.Generator, rows: Ints | None = None) -> None:
        """Change the robots' bodies and worlds from now on.

        Args:
            variations: one for each robot.
            rng: draws what differs from joint to joint and from body to body.
            rows: (k,) robots; default all.

        Raises:
            ValueError: if the simulator has fixed bodies and a fixed world, or cannot have these.
        """
        raise ValueError(
            f"mass_variation, gain_variation, centre_of_mass_m, friction_min, friction_max, stiffness_min, "
            f"stiffness_max, gravity_min: {type(self).__name__} cannot change masses, gains, contacts or gravity; "
            "leave them out"
        )

    # lost robots

    @property
    def lost(self) -> Flags:
        """(n,) robots whose server or world was lost; they stand still until they are started again."""
        return self._nothing_lost

    @property
    def can_fail(self) -> bool:
        """Whether robots can be lost at all."""
        return False

    @property
    def failures(self) -> int:
        """Number of lost robots that have been started again."""
        return 0

    @property
    def counters(self) -> Mapping[str, int]:
        """What the simulator counts besides: numbers of events by the name under which trainings report them."""
        return {}

    def loss_reason(self, row: int) -> str:
        """Return why the robot ``row`` is lost; empty if it is not."""
        del row
        return ""

    def keep_alive(self) -> AbstractContextManager[None]:
        """Return a context in which robots are not lost although nothing is stepped."""
        return nullcontext()

    # snapshots

    def snapshot(self) -> Bytes | None:
        """Return the complete state of every robot as (n, S) bytes; None if the simulator cannot."""
        return None

    def restore(self, state: Bytes) -> None:
        """Return to a snapshot.

        Raises:
            RuntimeError: if the simulator has no snapshots.
        """
        del state
        raise RuntimeError(f"{type(self).__name__} cannot return to a snapshot")

    # closing

    def close(self) -> None:
        """Release the simulator's resources; it may be called twice."""
        self.closed = True

    # checks for subclasses

    def require_open(self) -> None:
        """Raise SimulatorClosedError if the simulator has been closed."""
        if self.closed:
            raise SimulatorClosedError(f"{type(self).__name__} is closed")

    def require_whole(self) -> None:
        """Raise ValueError unless groups, perceptors and truth are of all robots, as wide as described."""
        name, n = type(self).__name__, self.n
        if [row for group in self.groups for row in range(*group.indices(n))] != list(range(n)):
            raise ValueError(f"{name}: groups: expected each of {n} robots in one, in order, got {self.groups}")
        perceptors, truth = getattr(self, "perceptors", {}), getattr(self, "truth", None)
        for each in (*self.robot.perceptors, *self.scene.perceptors):
            self._require_array(f"perceptors[{each.name!r}]", perceptors.get(each.name), (n, each.width))
        self._require_array("truth.torso_position", getattr(truth, "torso_position", None), (n, 3))
        self._require_array("truth.torso_rotation", getattr(truth, "torso_rotation", None), (n, 3, 3))

    def require_reports(self) -> None:
        """Raise ValueError unless what robots that have been started report has its shape and type."""
        name, n = type(self).__name__, self.n
        counters: object = self.counters
        self._require_array("lost", self.lost, (n,), "b")
        self._require_array("foot_forces()", self.foot_forces(), (n, 2))
        if self.shapes and type(self).bodies is Simulator.bodies:
            raise ValueError(f"{name}: bodies(): missing, but there are shapes to draw; write it, or leave them out")
        if self.shapes and not self.can_fail:  # poses of servers' robots may need a package that a training does not
            self._require_array("bodies()", self.bodies(), (n, len(self.shapes), 7))
        if not isinstance(counters, Mapping):
            raise ValueError(f"{name}: counters: expected a mapping of names to numbers, got {type(counters).__name__}")
        for counter, count in counters.items():
            if not isinstance(counter, str) or not isinstance(count, int | np.integer):
                raise ValueError(f"{name}: counters: expected a whole number by a name, got {count!r} by {counter!r}")

    def _require_array(self, what: str, array: object, shape: tuple[int, ...], kind: str = "f") -> None:
        if isinstance(array, np.ndarray) and array.shape == shape and array.dtype.kind == kind:
            return
        found = "nothing" if array is None else type(array).__name__
        if isinstance(array, np.ndarray):
            found = f"{array.dtype} of shape {array.shape}"
        numbers = "flags (bool)" if kind == "b" else "floating-point numbers"
        raise ValueError(f"{type(self).__name__}: {what}: expected an array of {numbers} of shape {shape}, got {found}")

    def require_group(self, rows: slice) -> None:
        """Raise ValueError unless ``rows`` is one of :attr:`groups` or all robots."""
        if rows not in self.groups and rows != slice(0, self.n):
            raise ValueError(f"rows: expected one of {self.groups} or slice(0, {self.n}), got {rows}")

    def require_starts(self, starts: Ints, loaded: int) -> None:
        """Raise RuntimeError if no starts have been loaded, IndexError if one of ``starts`` is not among them."""
        if not loaded:
            raise RuntimeError("no starts: call load_starts first")
        if len(starts) and not (starts.min() >= 0 and starts.max() < loaded):
            raise IndexError(f"starts: expected indices from 0 to {loaded - 1}, got {starts.tolist()}")


class SimulatorKind(ABC, Plugin):
    """One entry of the group ``naosim.simulators``: what a specification's section ``simulator`` can name.

    Attributes:
        name: how specifications refer to it.
        summary: one line for users.
    """

    plugin_group: ClassVar[str] = SIMULATORS
    name: ClassVar[str]
    summary: ClassVar[str]

    @abstractmethod
    def supports(self, robot: Robot) -> bool:
        """Return whether it can run this robot."""

    def refusal(self, robot: Robot, scene: Scene) -> str:
        """Return why it cannot open this scene with a robot that it supports; empty if it can.

        By default only :data:`PLAIN` is possible.
        """
        if scene == PLAIN:
            return ""
        return f"simulator: {self.name} has no ball, no goals and reports no motion of bodies for {robot.name}"

    def abilities(self, robot: Robot) -> frozenset[Ability]:
        """Return what it can do with a robot that it supports, whatever its parameters; by default nothing of it."""
        del robot
        return frozenset()

    def require_scene(self, robot: Robot, scene: Scene) -> None:
        """Raise ValueError if :meth:`refusal` has a reason."""
        refusal = self.refusal(robot, scene)
        if refusal:
            raise ValueError(refusal)

    def parameters(self, robot: Robot) -> type[SimulatorSettings]:
        """Return the settings that it takes for this robot."""
        del robot
        return SimulatorSettings

    @abstractmethod
    def open(
        self,
        robot: Robot,
        n: int,
        parameters: SimulatorSettings,
        options: RuntimeOptions = DEFAULT_OPTIONS,
        scene: Scene = PLAIN,
    ) -> Simulator:
        """Open it for n robots.

        Args:
            robot: the robot, with its own parameters applied.
            n: number of robots.
            parameters: an instance of ``self.parameters(robot)``.
            options: how fast and how robustly it runs.
            scene: one that :meth:`refusal` accepts.

        Raises:
            ValueError: if it cannot open this scene, or this machine cannot run this number of robots; the message
                states what to change.
            FileNotFoundError: if a program is missing; the message states how to install it.
        """

    def max_robots(self) -> int | None:
        """Return the most robots that this machine can run; None without a limit."""
        return None

    def unavailable(self, robot: Robot, environment: Mapping[str, str]) -> str:
        """Return why this machine cannot run a robot that :meth:`supports` accepts; empty if it can.

        Args:
            robot: the robot.
            environment: variables that name programs, usually ``os.environ``.
        """
        del robot, environment
        return ""
