"""Observation blocks: the parts that a policy's observation is made of.

A block is a few named numbers. It can be followed by their *rates*, the differences to the step before (not divided by
the step time, and zero at the first observation of an episode). Tasks take the blocks that the robot's description
names, and add their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from naosim.robots.nao import model_of
from naosim.simspark import batch
from naosim.simspark.batch import kinematics_address
from naosim.simulator import BALL, STEP_S

from naosprint.mirror import Mirror
from naosprint.tasks.onboard_pose import OnboardPose
from naosprint.tasks.world import World
from naosprint.terms import (
    Number,
    Store,
    arctan2,
    constant,
    copysign,
    cos,
    given,
    known,
    maximum,
    minimum,
    product,
    sin,
    source,
    square,
    stack,
    where,
)
from naosprint.terms.expressions import centre_of_mass
from naosprint.terms.geometry import along, hinge, turned

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naosprint.arrays import AnyArray, FloatArray, IntArray

PAST = "_ago"
"""Between an observation's name and how many steps ago it was observed."""

TOLD = "told_"
"""Before the name of an observation that a critic has besides the policy's own estimate of it."""

_AXES = ("x", "y", "z")
NEVER = 1e6  # steps since a report that there has not been


class ObservationBlock:
    """A few numbers that a policy observes.

    Args:
        names: their names.
        value: an expression, which runs compiled and can be exported; or a function that is called with the rows of
            some robots and returns (k, width) numbers.
        partners: the names of their mirror images; themselves if left out.
        signs: the signs of their mirror images; 1 if left out.
        spread: their typical standard deviations, with which a training that starts from a policy without these
            observations standardizes them at first; 1 if left out.
        rates: whether their rates follow.
        angular: whether they are angles, whose rates take the short way round.
        stores: what is stored for the value, in order, before it is computed.
        begin: called with the rows of robots whose episode begins, before they are measured.
        update: called with the rows of robots that have taken a step, before they are measured.
        arrays: what the block stores, one row per robot.

    Raises:
        ValueError: if the value, partners, signs or spread are not as many as the names, or a sign is not 1 or -1.
    """

    def __init__(
        self,
        names: Sequence[str],
        value: Number | Callable[[slice | IntArray], FloatArray],
        *,
        partners: Sequence[str] | None = None,
        signs: Sequence[float] | None = None,
        spread: Sequence[float] | None = None,
        rates: bool = False,
        angular: bool = False,
        stores: Sequence[Store] = (),
        begin: Callable[[IntArray], None] | None = None,
        update: Callable[[slice], None] | None = None,
        arrays: Mapping[str, AnyArray] | None = None,
    ) -> None:
        self.names = tuple(names)
        self.value = value
        self.partners = self.names if partners is None else tuple(partners)
        self.signs = (1.0,) * len(self.names) if signs is None else tuple(signs)
        self.spread = (1.0,) * len(self.names) if spread is None else tuple(spread)
        self.rates = rates
        self.angular = angular
        self.stores = tuple(stores)
        self.begin = begin
        self.update = update
        self.arrays: dict[str, AnyArray] = dict(arrays or {})
        if isinstance(names, str):
            raise TypeError(f"observations: {names}: names is a text; a tuple is needed, as ({names!r},)")
        if isinstance(value, Number) and value.width != len(self.names):
            raise ValueError(f"observations: {', '.join(self.names)}: the expression has {value.width} numbers")
        for what, given_for in (("partners", self.partners), ("signs", self.signs), ("spread", self.spread)):
            if len(given_for) != len(self.names):
                raise ValueError(
                    f"observations: {', '.join(self.names)}: {what} has {len(given_for)} entries for "
                    f"{len(self.names)} names; one for each is needed"
                )
        for name, sign, spread_of in zip(self.names, self.signs, self.spread, strict=True):
            if sign not in (-1.0, 1.0) or not 0.0 < spread_of < np.inf:
                raise ValueError(
                    f"observations: {name}: its sign is {sign}, its spread {spread_of}; a sign is 1 or -1, a spread "
                    "positive"
                )

    def measured(self, rows: slice | IntArray) -> FloatArray:
        """Return the numbers of the (k,) robots ``rows``, a row for each, or one row for all.

        Raises:
            ValueError: if a function returns another shape or no numbers; the message names the block.
        """
        values = self.value(rows)
        if not isinstance(self.value, Number):
            k = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
            what = f"observations: {', '.join(self.names)}: the function"
            return require_numbers(values, (k, len(self.names)), what)
        return values


class Observer:
    """The observations of n robots, assembled from blocks.

    Args:
        n: robots.
        blocks: what is observed at a step, in order.
        history: earlier steps that are observed besides the present one, the latest first; those before an episode are
            like its first.
        critic: what a critic observes besides.

    Attributes:
        names: names of the D observations of a policy.
        critic_names: names of the C observations that only a critic has.
        width: observations of a policy at one step.
        observations: (n, D + C) the latest observations.
        values: (n, V) the latest values of the observations whose rates follow.
        mirror: their mirror image.
    """

    def __init__(
        self,
        n: int,
        blocks: Sequence[ObservationBlock],
        history: int = 0,
        critic: Sequence[ObservationBlock] = (),
    ) -> None:
        self.blocks = (*blocks, *critic)
        self.history = history
        names, partners, signs = _numbers(blocks)
        self.width = len(names)
        for ago in range(1, history + 1):
            names += [f"{name}{PAST}{ago}" for name in names[: self.width]]
            partners += [f"{name}{PAST}{ago}" for name in partners[: self.width]]
            signs += signs[: self.width]
        if not names:
            raise ValueError("observations: none of the task's blocks has a number; a policy needs one at least")
        self.names = tuple(names)
        for numbers, more in zip((names, partners, signs), _numbers(critic), strict=True):
            numbers += more  # type: ignore[operator]
        self.critic_names = tuple(names[len(self.names) :])
        doubled = {name for name in names if names.count(name) > 1}
        if doubled:
            raise ValueError(f"observations: {', '.join(sorted(doubled))}: two blocks have a number of this name")
        self._require_names_of_arrays()
        self.observations: FloatArray = np.zeros((n, len(names)))
        self._mirror = (partners, signs)
        self._places: list[tuple[ObservationBlock, int, int]] = []
        first = value = 0
        for number, block in enumerate(self.blocks):
            first = len(self.names) if number == len(blocks) else first
            self._places.append((block, first, value))
            first += len(block.names) * (2 if block.rates else 1)
            value += len(block.names) if block.rates else 0
        self._plain = [(block, slice(at, at + len(block.names))) for block, at, _ in self._places if not block.rates]
        self._rated = [(block, slice(at, at + len(block.names))) for block, _, at in self._places if block.rates]
        value_columns = [at + k for block, at, _ in self._places if block.rates for k in range(len(block.names))]
        widths = [len(block.names) for block, _, _ in self._places if block.rates for _ in block.names]
        angular = [k for block, at in self._rated if block.angular for k in range(at.start, at.stop)]
        self._value_columns = np.array(value_columns, dtype=np.int64)
        self._rate_columns = self._value_columns + np.array(widths, dtype=np.int64)
        self._angular = np.array(angular, dtype=np.int64)
        self.values: FloatArray = np.zeros((n, value))

    def places(self) -> list[tuple[ObservationBlock, int, int]]:
        """Return each block with its first column, and with that of its values among those whose rates follow."""
        return self._places

    @property
    def spreads(self) -> dict[str, float]:
        """Typical standard deviations of the observations that differ from 1, by name."""
        pairs = (pair for block in self.blocks for pair in zip(block.names, block.spread, strict=True))
        return {name: spread for name, spread in pairs if spread != 1.0}

    @property
    def mirror(self) -> Mirror:
        """Mirror image of an observation.

        Raises:
            ValueError: if a block names a mirror image that is not observed.
        """
        return Mirror.of_names((*self.names, *self.critic_names), *self._mirror)

    def begin(self, rows: IntArray, remembered: Mapping[str, FloatArray] = {}) -> None:  # never changed
        """Compute the first observation of an episode for the robots ``rows``; the others do not change.

        Args:
            rows: (k,) robots.
            remembered: (k, ...) values by name of what blocks store, of robots that were in motion before.
        """
        for block in self.blocks:
            for store in block.stores:
                store.apply(store.begin, rows)
            if block.begin is not None:
                block.begin(rows)
            for name in remembered.keys() & block.arrays.keys():
                block.arrays[name][rows] = remembered[name]
        values = self._measure(rows)
        self.values[rows] = values
        first = np.zeros((len(rows), self.observations.shape[1]))
        first[:, self._value_columns] = values
        for block, at in self._plain:
            first[:, at] = block.measured(rows)
        for past in range(self.width, len(self.names), self.width):
            first[:, past : past + self.width] = first[:, : self.width]
        self.observations[rows] = first

    def update(self, rows: slice) -> None:
        """Compute the observations of the robots ``rows`` after a step."""
        for block in self.blocks:
            for store in block.stores:
                store.apply(store.update, rows)
            if block.update is not None:
                block.update(rows)
        values = self._measure(rows)
        rates = values - self.values[rows]
        if len(self._angular):
            # the short way round, also where an angle passes from pi to -pi
            turns = rates[:, self._angular]
            rates[:, self._angular] = (turns + np.pi) % (2.0 * np.pi) - np.pi
        self.values[rows] = values
        observations = self.observations[rows]
        past = len(self.names) - self.width
        if past:
            observations[:, self.width : len(self.names)] = observations[:, :past].copy()
        observations[:, self._value_columns] = values
        observations[:, self._rate_columns] = rates
        for block, at in self._plain:
            observations[:, at] = block.measured(rows)

    def _measure(self, rows: slice | IntArray) -> FloatArray:
        k = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
        values = np.empty((k, self.values.shape[1]))
        for block, at in self._rated:
            values[:, at] = block.measured(rows)
        return values

    def _require_names_of_arrays(self) -> None:
        """Refuse blocks whose arrays would replace each other in a checkpoint."""
        found: dict[str, AnyArray] = {}
        for block in self.blocks:
            for name, array in block.arrays.items():
                if name in ("observations", "features") or found.setdefault(name, array) is not array:
                    raise ValueError(
                        f"observations: {', '.join(block.names)}: another array is named {name!r} in checkpoints; "
                        "give the block's own another name"
                    )

    def state(self) -> dict[str, AnyArray]:
        """Return everything that the next observation depends on."""
        state: dict[str, AnyArray] = {"observations": self.observations.copy(), "features": self.values.copy()}
        for block in self.blocks:
            state.update({name: array.copy() for name, array in block.arrays.items()})
        return state

    def load_state(self, state: Mapping[str, AnyArray]) -> None:
        """Restore what :meth:`state` returned."""
        self.observations[:] = state["observations"]
        self.values[:] = state["features"]
        for block in self.blocks:
            for name, array in block.arrays.items():
                array[:] = state[name]


def require_numbers(values: object, shape: tuple[int, ...], what: str) -> FloatArray:
    """Return as float64 what a function of some robots returned, which NumPy would otherwise repeat for all.

    Raises:
        ValueError: if it has another shape, or no real numbers.
    """
    array = np.asarray(values)
    if array.shape != shape:
        raise ValueError(f"{what} returned an array of shape {array.shape}; {shape}, a row a robot, is needed")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{what} returned an array of {array.dtype}; real numbers are needed")
    return array.astype(np.float64, copy=False)


def _numbers(blocks: Sequence[ObservationBlock]) -> tuple[list[str], list[str], list[float]]:
    """Return names, mirror images and their signs of all numbers of some blocks."""
    names: list[str] = []
    partners: list[str] = []
    signs: list[float] = []
    for block in blocks:
        for suffix in ("", "_rate") if block.rates else ("",):
            names += [f"{name}{suffix}" for name in block.names]
            partners += [f"{name}{suffix}" for name in block.partners]
            signs += block.signs
    return names, partners, signs


def blocks(world: World, names: Sequence[str]) -> list[ObservationBlock]:
    """Return the blocks of these names.

    Raises:
        ValueError: if there is no block of a name; the message lists those that exist.
    """
    for name in names:
        if name not in BLOCKS:
            raise ValueError(f"observations: unknown block {name!r}: choose one of {', '.join(sorted(BLOCKS))}")
    return [BLOCKS[name](world) for name in names]


def _step(world: World) -> ObservationBlock:
    """Return the number of steps of the episode."""
    return ObservationBlock(("step",), world.step)


def _joints(world: World, prefix: str = "") -> dict[str, tuple[str, ...] | tuple[float, ...]]:
    by_name = {joint.name: joint for joint in world.robot.joints}
    chosen = [by_name[name] for name in world.actuation.names]
    return {
        "names": tuple(prefix + joint.name for joint in chosen),
        "partners": tuple(prefix + joint.mirror for joint in chosen),
        "signs": tuple(joint.mirror_sign for joint in chosen),
    }


def radians(world: World, perceptor: str) -> Number:
    """Return angles or speeds of the joints that a policy moves, in radians and in the policy convention."""
    signs: list[float] = world.actuation.sign.tolist()
    return world.perceived(perceptor)[world.actuation.index.tolist()] * (np.pi / 180.0) * signs


def _joint_angles(world: World) -> ObservationBlock:
    """Perceived joint angles in radians, in the policy convention, with rates if no joint speed is perceived."""
    return ObservationBlock(
        **_joints(world),  # type: ignore[arg-type]
        value=radians(world, "joint_angles"),
        rates="joint_speeds" not in world.perceptors,
    )


def _joint_speeds(world: World) -> ObservationBlock:
    """Perceived joint speeds in rad/s, in the policy convention."""
    return ObservationBlock(
        **_joints(world, "speed_"),  # type: ignore[arg-type]
        value=radians(world, "joint_speeds"),
    )


def _last_action(world: World) -> ObservationBlock:
    """Latest action."""
    return ObservationBlock(**_joints(world, "action_"), value=world.action)  # type: ignore[arg-type]


def _yaw(world: World) -> ObservationBlock:
    """Angle in radians from the running direction to the torso's front, counter-clockwise, with its rate."""
    return ObservationBlock(("yaw",), given("yaw", world.true_yaw), signs=(-1.0,), rates=True, angular=True)


def _heading(world: World) -> ObservationBlock:
    """Sine and cosine of the angle from the running direction to the torso's front."""
    yaw = seen_yaw(world)
    return ObservationBlock(("heading_sin", "heading_cos"), stack(sin(yaw), cos(yaw)), signs=(-1.0, 1.0))


def _height(world: World) -> ObservationBlock:
    """Height of the torso in metres: perceived if possible, else the true one, with its rate."""
    if "torso_pos" in world.perceptors:
        return ObservationBlock(("height",), world.perceived("torso_pos")[2])
    return ObservationBlock(("height",), given("height", world.true_position[2]), rates=True)


def _onboard_pose(world: World) -> ObservationBlock:
    """Yaw and height as a player estimates them, with rates; see :mod:`naosprint.tasks.onboard_pose`."""
    estimate = OnboardPose(world)
    return ObservationBlock(
        ("yaw", "height"),
        stack(estimate.yaw, estimate.height),
        signs=(-1.0, 1.0),
        rates=True,
        angular=True,
        stores=estimate.stores,
        arrays=estimate.arrays,
    )


def _told_pose(world: World) -> ObservationBlock:
    """Return true yaw and height, with rates, for critics and teachers of robots that estimate them."""
    return ObservationBlock(
        (f"{TOLD}yaw", f"{TOLD}height"),
        stack(world.true_yaw, world.true_position[2]),
        signs=(-1.0, 1.0),
        rates=True,
        angular=True,
    )


def _centre_of_mass(world: World) -> ObservationBlock:
    """Centre of mass in metres in the torso's frame, by forward kinematics from the perceived angles, with rates."""
    kind = model_of(world.robot).robot_type
    return ObservationBlock(
        tuple(f"com_{axis}" for axis in _AXES),
        centre_of_mass(
            world.perceived("joint_angles"), kinematics_address(kind), lambda angles: batch.centre_of_mass(kind, angles)
        ),
        signs=_vector_signs(world),
        rates=True,
    )


def _gyro(world: World) -> ObservationBlock:
    """Angular velocity in rad/s in the torso's frame; with rates for robots that perceive no joint speeds."""
    return ObservationBlock(
        tuple(f"gyro_{axis}" for axis in _AXES),
        world.perceived("gyro") * (np.pi / 180.0),
        signs=tuple(-sign for sign in _vector_signs(world)),  # axial vectors turn the other way
        rates="joint_speeds" not in world.perceptors,
    )


def _accel(world: World) -> ObservationBlock:
    """Acceleration in m/s^2 in the torso's frame, with rates."""
    return ObservationBlock(
        tuple(f"accel_{axis}" for axis in _AXES),
        world.perceived("accel"),
        signs=_vector_signs(world),
        rates="joint_speeds" not in world.perceptors,
    )


def _foot(side: str, other: str, kind: str) -> Callable[[World], ObservationBlock]:
    part = slice(0, 3) if kind == "origin" else slice(3, 6)

    def block(world: World) -> ObservationBlock:
        """Centre of pressure in metres in the foot's frame, or force in newtons; zero without contact; with rates."""
        values = world.perceived(f"foot_{side}")[part]
        return ObservationBlock(
            tuple(f"{side}_foot_{kind}_{axis}" for axis in _AXES),
            where(known(values), values, 0.0),
            partners=tuple(f"{other}_foot_{kind}_{axis}" for axis in _AXES),
            signs=_vector_signs(world),
            rates=True,
        )

    return block


def _foot_counters(world: World) -> ObservationBlock:
    """Return the steps since the right and the left foot last touched down."""
    arrays = {"counters": np.zeros((world.n, 2), dtype=np.int64), "feet_loaded": np.zeros((world.n, 2), dtype=np.bool_)}
    counters, before = (source(array, name) for name, array in arrays.items())
    forces = (square(world.perceived(f"foot_{side}")[3:]) for side in ("left", "right"))
    # a comparison with NaN, which stands for no contact, is false
    loaded = stack(*(force[0] + force[1] + force[2] > 0.0 for force in forces))
    return ObservationBlock(
        ("right_foot_counter", "left_foot_counter"),
        counters[[1, 0]],
        partners=("left_foot_counter", "right_foot_counter"),
        stores=[
            Store(counters, begin=constant(0.0), update=where(loaded & ~before, 0.0, counters + 1.0)),
            Store(before, begin=loaded, update=loaded),
        ],
        arrays=arrays,
    )


def _gravity(world: World) -> ObservationBlock:
    """Direction of the world's z axis in the torso's frame, from the perceived orientation."""
    w, x, y, z = _quaternion(world)
    return ObservationBlock(
        tuple(f"gravity_{axis}" for axis in _AXES),
        stack(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        signs=_vector_signs(world),
    )


def _velocity(world: World) -> ObservationBlock:
    """Velocity in m/s in the torso's frame, from the difference of the last two perceived positions."""
    arrays = {"velocity": np.zeros((world.n, 3)), "velocity_position": np.zeros((world.n, 3))}
    velocity, before = (source(array, name) for name, array in arrays.items())
    position = world.perceived("torso_pos")
    moved = (position - before) / STEP_S
    a, b, c = moved[0], moved[1], moved[2]
    w, x, y, z = _quaternion(world)
    # columns of the rotation from the torso's frame into the world's, times the velocity
    own = stack(
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c,
        2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c,
        2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )
    return ObservationBlock(
        tuple(f"velocity_{axis}" for axis in _AXES),
        velocity,
        signs=_vector_signs(world),
        stores=[Store(velocity, begin=constant(0.0), update=own), Store(before, begin=position, update=position)],
        arrays=arrays,
    )


def _ball(world: World) -> ObservationBlock:
    """Ball in metres and m/s before and left of the torso, and how old that is, from the perceived reports.

    A report is turned into a place on the field by the perceived pose of the torso and the angles of the head. Between
    reports the place is remembered; the velocity is that between the last two. The age is that of the last report, 0 to
    1 for a second and more; without any report the other numbers are 0.
    """
    camera, joints = world.robot.camera, world.robot.joint_names
    if BALL not in world.perceptors or camera is None:
        raise ValueError(
            f"observations: ball: robot {world.robot.name} perceives none; give the task a scene with a ball"
        )
    arrays = {
        "ball_place": np.zeros((world.n, 2)),
        "ball_velocity": np.zeros((world.n, 2)),
        "ball_seen": np.full(world.n, NEVER),  # steps since the last report
    }
    place, velocity, age = (source(array, name) for name, array in arrays.items())
    report = world.perceived(BALL)
    seen, before = known(report[0]), age < NEVER
    # the server truncates: the middle of the interval is half a digit farther from zero
    middle = report + copysign(0.005, report)
    distance, azimuth, elevation = middle[0], middle[1] * (np.pi / 180.0), middle[2] * (np.pi / 180.0)
    level = distance * cos(elevation)
    polar = stack(level * cos(azimuth), level * sin(azimuth), distance * sin(elevation))
    angles = world.perceived("joint_angles") * (np.pi / 180.0)
    turn = hinge((0.0, 0.0, 1.0), angles[joints.index("head_yaw")])
    nod = hinge((0.0, 1.0, 0.0), angles[joints.index("head_pitch")])
    in_head = constant(camera.pitch_m) + product(nod, constant(camera.camera_m) + polar)
    ball = constant(camera.yaw_m) + product(turn, in_head)
    position = world.perceived("torso_pos")[:2]
    found = source(np.zeros((world.n, 2)), "ball_found")
    elapsed = where(before, maximum(age, 1.0), 1.0) * STEP_S
    nothing, heading = constant([0.0, 0.0]), seen_yaw(world)
    report_now = where(seen, position + turned(world.perceived("torso_quat"), ball)[:2], nothing)
    return ObservationBlock(
        ("ball_forward", "ball_left", "ball_forward_velocity", "ball_left_velocity", "ball_age"),
        stack(along(heading, (place - position) * before), along(heading, velocity), minimum(age * STEP_S, 1.0)),
        signs=(1.0, -1.0, 1.0, -1.0, 1.0),
        spread=(0.3, 0.2, 0.5, 0.5, 0.05),
        stores=[
            Store(age, update=age + 1.0),
            Store(found, begin=report_now, update=report_now),
            Store(
                velocity,
                begin=nothing,
                update=where(seen, where(before, (found - place) / elapsed, nothing), velocity),
            ),
            Store(place, begin=found, update=where(seen, found, place)),
            Store(age, begin=where(seen, 0.0, NEVER), update=where(seen, 0.0, age)),
        ],
        arrays=arrays,
    )


def _ground_velocity(world: World, prefix: str = "") -> ObservationBlock:
    """Forward and lateral velocity in m/s on the field, from the difference of the last two true positions."""
    arrays = {f"{prefix}ground_{name}": np.zeros((world.n, 2)) for name in ("velocity", "position")}
    velocity, before = (source(array, name) for name, array in arrays.items())
    position = given("position", world.true_position[:2])
    return ObservationBlock(
        (f"{prefix}forward_velocity", f"{prefix}lateral_velocity"),
        velocity,
        signs=(1.0, -1.0),
        stores=[
            Store(velocity, begin=constant(0.0), update=(position - before) / STEP_S),
            Store(before, begin=position, update=position),
        ],
        arrays=arrays,
    )


def _true_height(world: World) -> ObservationBlock:
    """Return the true height of the torso in metres."""
    return ObservationBlock(("true_height",), world.true_position[2])


def _true_velocity(world: World) -> ObservationBlock:
    """Return the true forward and lateral velocity in m/s on the field."""
    return _ground_velocity(world, "true_")


def _quaternion(world: World) -> tuple[Number, Number, Number, Number]:
    """Return w, x, y and z of the perceived orientation."""
    quaternion = world.perceived("torso_quat")
    return quaternion[0], quaternion[1], quaternion[2], quaternion[3]


def seen_yaw(world: World) -> Number:
    """Return the angle in radians from the world's +x to the torso's front, counter-clockwise, as perceived."""
    if "torso_quat" not in world.perceptors:
        return given("yaw", world.true_yaw)
    w, x, y, z = _quaternion(world)
    if world.robot.front_axis == 0:
        return arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return arctan2(1 - 2 * (x * x + z * z), 2 * (x * y - w * z))


def _vector_signs(world: World) -> tuple[float, ...]:
    """Return the signs that a vector in the torso's frame gets in a mirror: its lateral component changes sign."""
    lateral = 1 - world.robot.front_axis
    return tuple(-1.0 if axis == lateral else 1.0 for axis in range(3))


BLOCKS: dict[str, Callable[[World], ObservationBlock]] = {
    "step": _step,
    "joint_angles": _joint_angles,
    "joint_speeds": _joint_speeds,
    "last_action": _last_action,
    "yaw": _yaw,
    "heading": _heading,
    "height": _height,
    "onboard_pose": _onboard_pose,
    "told_pose": _told_pose,
    "centre_of_mass": _centre_of_mass,
    "gyro": _gyro,
    "accel": _accel,
    "left_foot_origin": _foot("left", "right", "origin"),
    "left_foot_force": _foot("left", "right", "force"),
    "right_foot_origin": _foot("right", "left", "origin"),
    "right_foot_force": _foot("right", "left", "force"),
    "foot_counters": _foot_counters,
    "gravity": _gravity,
    "velocity": _velocity,
    "ball": _ball,
    "true_height": _true_height,
    "true_velocity": _true_velocity,
    "ground_velocity": _ground_velocity,
}
"""Blocks by name."""
