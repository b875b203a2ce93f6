"""Yaw and height of a NAO's torso, estimated from what a player perceives.

Orientation: the gyroscope has no noise, so that the torso's turns since the start are known almost exactly; what is
unknown is the orientation at the start. The accelerometer gives a first guess of it, and every sight of the field
corrects it, each by less than the one before.

Height: the accelerometer's vertical part is integrated twice. While a foot touches the ground, the height of the torso
above its sole corrects the result.

What is perceived is one or two steps old, so both are extrapolated to the present.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from naosim.robots.nao import model_of
from naosim.simspark.protocol import LANDMARKS
from naosim.simulator import STEP_S

from naosprint.terms import (
    Number,
    Store,
    absolute,
    arctan2,
    constant,
    cos,
    given,
    known,
    maximum,
    minimum,
    product,
    sin,
    source,
    sqrt,
    square,
    stack,
    total,
    where,
)
from naosprint.terms.geometry import hinge, normalized, quaternion_product, rotation_of

if TYPE_CHECKING:
    from naosprint.arrays import AnyArray
    from naosprint.tasks.world import World

GRAVITY = 9.81
"""m/s^2."""

SOLE_HEIGHT_M = 0.016
"""Height of a sole that touches the ground, by the joint angles, in a run: hinges and ground give way to impacts."""

HEIGHT_GAIN, CLIMB_GAIN = 0.15, 0.01
"""Share of the difference between both heights that corrects height and vertical speed in a step."""

MIN_SIGHT_GAIN = 0.02
"""Smallest gain of a correction by vision; the n-th correction of a run has gain 1/n until then."""

MIN_SIGHTS = 3
"""Landmarks that a correction needs."""

LEVEL = 10.0
"""Regularization of the tilt: with landmarks at this mean square distance, m^2, half of it is corrected."""

FIRST_CLIMB_GAIN = CLIMB_GAIN / STEP_S
"""Share of the difference that corrects the vertical speed, 1/s."""

_FAR = 1e9
_LEGS = ("hip1", "hip2", "thigh", "shank", "ankle", "foot")
_HEAD = ("neck", "head")


class OnboardPose:
    """Estimates for n robots.

    Attributes:
        yaw: angle in radians from the running direction, counter-clockwise, at present.
        height: height in metres, at present.
        stores: what is stored, in order.
        arrays: where, by name, one row per robot.
    """

    def __init__(self, world: World) -> None:
        n = world.n
        self._world, self._model = world, model_of(world.robot)
        self.arrays: dict[str, AnyArray] = {
            "onboard_pose": np.zeros((n, 2)),  # yaw and height
            "onboard_orientation": np.zeros((n, 4)),  # quaternion w x y z when the joint angles were taken
            "onboard_up": np.zeros((n, 3)),  # the world's z axis in the torso's frame, a step earlier
            "onboard_soles": np.zeros((n, 2)),  # height of left and right sole relative to the torso, then
            "onboard_climb": np.zeros((n, 2)),  # height and vertical speed of the torso, then
            "onboard_sights": np.zeros(n),
        }
        pose, orientation, up, soles, climb, sights = (source(array, name) for name, array in self.arrays.items())
        self.yaw, self.height = pose[0], pose[1]
        self._orientation, self._sights = orientation, sights
        self._turned = source(np.zeros((n, 4)), "onboard_turned")  # the orientation before vision corrects it
        accel, rotation = world.perceived("accel"), rotation_of(orientation)
        rate = world.perceived("gyro") * (np.pi / 180.0)
        heights = self._sole_heights(rotation)
        ahead = rotation_of(_after_step(orientation, rate))
        # the accelerometer is a step older than the gyroscope, and so is the contact that a force sensor reports
        speed = climb[1] + STEP_S * (total(up * accel) - GRAVITY)
        level = climb[0] + STEP_S * speed
        error = self._ground_error(soles, level)
        self.stores = (
            Store(self._turned, update=_after_step(orientation, rate)),
            *self._see(climb),
            Store(orientation, begin=self._first_guess(accel)),
            Store(climb, update=stack(level + HEIGHT_GAIN * error, speed + FIRST_CLIMB_GAIN * error)),
            Store(up, begin=rotation[6:], update=rotation[6:]),
            Store(soles, begin=heights, update=heights),
            Store(climb, begin=stack(-1.0 * minimum(soles[0], soles[1]), 0.0)),
            Store(
                pose,
                begin=stack(0.0, climb[0]),
                update=stack(arctan2(ahead[4], ahead[1]), climb[0] + STEP_S * climb[1]),
            ),
        )

    def _first_guess(self, accel: Number) -> Number:
        """Return the orientation of a robot that stands still and faces the running direction as far as it knows."""
        up = accel / maximum(sqrt(total(square(accel))), 1e-9)
        upright = normalized(stack(1.0 + up[2], up[1], -1.0 * up[0], 0.0))
        turned = rotation_of(upright)
        half = -0.5 * arctan2(turned[4], turned[1])
        return quaternion_product(stack(cos(half), 0.0, 0.0, sin(half)), upright)

    def _ground_error(self, soles: Number, height: Number) -> Number:
        """Return by how much the height above the ground that a foot touches differs from ``height``; 0 in the air."""
        left, right = (known(self._world.perceived(f"foot_{side}")[0]) for side in ("left", "right"))
        lowest = minimum(where(left, soles[0], _FAR), where(right, soles[1], _FAR))
        return where(left | right, SOLE_HEIGHT_M - lowest - height, 0.0)

    def _sole_heights(self, rotation: Number) -> Number:
        """Return the heights of the lowest point of left and right sole relative to the torso, metres."""
        size = [length / 2.0 for length in self._model.bodies[self._model.body_index["lfoot"]].shape.size]
        up, heights = rotation[6:], []
        for side in "lr":
            position, turn = self._end([side + part for part in _LEGS])
            tilted = [absolute(total(up * turn[[axis, axis + 3, axis + 6]])) * size[axis] for axis in range(3)]
            heights.append(total(up * position) - (tilted[0] + tilted[1] + tilted[2]))
        return stack(*heights)

    def _end(self, bodies: Sequence[str]) -> tuple[Number, Number]:
        """Return position and rotation of a chain's last body in the torso's frame, by the perceived joint angles."""
        model, angles = self._model, self._world.perceived("joint_angles") * (np.pi / 180.0)
        offsets = {body.name: np.array(body.offset) for body in model.bodies}
        joints = {joint.body: (k, joint) for k, joint in enumerate(model.joints)}
        position, rotation = constant([0.0] * 3), constant(np.eye(3).ravel().tolist())
        for body in bodies:
            k, joint = joints[body]
            anchor = np.array(joint.anchor, dtype=np.float64)
            # frames are parallel to the torso's at angles 0
            pivot = offsets[body] + anchor - offsets[joint.parent]
            pivoted = position + product(rotation, constant(pivot.tolist()))
            rotation = product(rotation, hinge(joint.axis, angles[k]))
            position = pivoted - product(rotation, constant(anchor.tolist()))
        return position, rotation

    def _see(self, climb: Number) -> list[Store]:
        """Return what corrects the orientation of robots that see the field now."""
        count = len(LANDMARKS)
        polar = self._world.perceived("vision")
        found = known(polar[0::3])
        seeing = total(found) >= MIN_SIGHTS
        distance, theta, phi = (where(known(polar[k::3]), polar[k::3], 0.0) for k in range(3))
        theta, phi = theta * (np.pi / 180.0), phi * (np.pi / 180.0)
        level = distance * cos(phi)
        seen = stack(-1.0 * level * sin(theta), level * cos(theta), distance * sin(phi))
        eye, turn = self._end(_HEAD)
        rotation = rotation_of(self._turned)
        # from the torso to the landmarks, in the world's axes as far as they are known
        sight = product(product(rotation, turn), seen)
        x, y, z = sight[:count], sight[count : 2 * count], sight[2 * count :]
        eye_height = climb[0] + total(rotation[6:] * eye)
        weight = where(found, 1.0 / maximum(distance, 1.0), 0.0)
        weight = weight / maximum(total(weight), 1e-9)
        known_x, known_y, known_z = self._landmarks()
        # yaw: the turn that brings the landmarks' layout onto the known one
        (a, b), (c, d) = ([each - total(weight * each) for each in pair] for pair in ((x, y), (known_x, known_y)))
        yaw = arctan2(total(weight * (a * d - b * c)), total(weight * (a * c + b * d)))
        # tilt: the turns about the horizontal axes that bring the landmarks to their known heights
        missing = known_z - eye_height - z
        yy, xy, xx = (total(weight * each) for each in (y * y, -1.0 * x * y, x * x))
        yy, xx = yy + LEVEL, xx + LEVEL
        up, down = total(weight * y * missing), total(-1.0 * weight * x * missing)
        determinant = yy * xx - xy * xy
        tilt = stack(xx * up - xy * down, yy * down - xy * up) / determinant
        gain = maximum(1.0 / maximum(self._sights, 1.0), MIN_SIGHT_GAIN) * 0.5
        turn = gain * stack(tilt, yaw)
        correction = stack(sqrt(1.0 - minimum(total(square(turn)), 0.99)), turn)
        corrected = normalized(quaternion_product(correction, self._turned))
        return [
            Store(self._sights, begin=constant(0.0), update=self._sights + seeing),
            Store(self._orientation, update=where(seeing, corrected, self._turned)),
        ]

    def _landmarks(self) -> tuple[Number, Number, Number]:
        """Return the landmarks' coordinates in the running direction's frame, x, y and z one after the other."""
        x, y, z = (constant(values) for values in np.array([place for _, place in LANDMARKS]).T.tolist())
        heading = given("heading", constant(0.0))
        cosine, sine = cos(heading), sin(heading)
        return cosine * x + sine * y, cosine * y - sine * x, z


def _after_step(orientation: Number, rate: Number) -> Number:
    """Return an orientation a step later, as ODE steps it, at rad/s in the torso's frame."""
    turning = quaternion_product(orientation, stack(0.0, rate))
    return normalized(orientation + turning * (0.5 * STEP_S))
