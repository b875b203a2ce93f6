"""Yaw and height of a NAO's torso, estimated from what a player perceives.

Orientation: the gyroscope has no noise, so that the torso's turns since the start are known almost exactly; what is
unknown is the orientation at the start. The accelerometer gives a first guess of it, and every sight of the field
corrects it, each by less than the one before.

Height: the accelerometer's vertical part is integrated twice. While a foot touches the ground, the height of the torso
above its sole corrects the result.

What is perceived is one or two steps old, so both are extrapolated to the present.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.simspark.kinematics import rotations
from naosim.simspark.protocol import LANDMARKS
from naosim.simulator import STEP_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosim.robots.nao_model import RobotModel

    from naosprint.arrays import AnyArray, FloatArray, IntArray
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

_LANDMARKS = np.array([position for _, position in LANDMARKS])
_LEGS = ("hip1", "hip2", "thigh", "shank", "ankle", "foot")


class OnboardPose:
    """Estimates for n robots.

    Attributes:
        values: (n, 2) yaw in radians from the running direction, counter-clockwise, and height in metres, at present.
        arrays: everything that is stored, by name, one row per robot.
    """

    def __init__(self, world: World) -> None:
        from naosim.robots.nao import model_of

        n = world.n
        model = model_of(world.robot)
        self._perceptors = world.perceptors
        self._feet = _Chains(model, [[side + part for part in _LEGS] for side in "lr"])
        self._head = _Chains(model, [["neck", "head"]])
        self._sole = np.array(model.bodies[model.body_index["lfoot"]].shape.size) / 2.0
        self.values: FloatArray = np.zeros((n, 2))
        self._orientation: FloatArray = np.zeros((n, 4))  # quaternion w x y z when the joint angles were taken
        self._up: FloatArray = np.zeros((n, 3))  # the world's z axis in the torso's frame, a step earlier
        self._soles: FloatArray = np.zeros((n, 2))  # height of left and right sole relative to the torso, then
        self._climb: FloatArray = np.zeros((n, 2))  # height and vertical speed of the torso, then
        self._sights: FloatArray = np.zeros(n)
        self.arrays: dict[str, AnyArray] = {
            "onboard_pose": self.values,
            "onboard_orientation": self._orientation,
            "onboard_up": self._up,
            "onboard_soles": self._soles,
            "onboard_climb": self._climb,
            "onboard_sights": self._sights,
        }

    def begin(self, rows: IntArray) -> None:
        """Begin with robots that stand still and face the running direction as far as they know."""
        up = self._perceptors["accel"][rows]
        up = up / np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
        orientation = _normalized(np.stack([1.0 + up[:, 2], up[:, 1], -up[:, 0], np.zeros(len(up))], axis=1))
        turned = rotations(orientation)
        half = -0.5 * np.arctan2(turned[:, 1, 1], turned[:, 0, 1])
        facing = np.stack([np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)], axis=1)
        self._orientation[rows] = _product(facing, orientation)
        self._sights[rows] = 0.0
        rotation = rotations(self._orientation[rows])
        self._soles[rows] = self._sole_heights(rows, rotation)
        self._climb[rows, 0] = -self._soles[rows].min(axis=1)
        self._climb[rows, 1] = 0.0
        self._up[rows] = rotation[:, 2]
        self.values[rows, 0] = 0.0
        self.values[rows, 1] = self._climb[rows, 0]

    def update(self, rows: slice) -> None:
        """Use what the robots perceive after a step."""
        perceptors = self._perceptors
        rate = np.deg2rad(perceptors["gyro"][rows])
        orientation = _turned(self._orientation[rows], rate)
        self._see(rows, orientation)
        self._orientation[rows] = orientation
        rotation = rotations(orientation)
        # The accelerometer is a step older than the gyroscope, and so is the contact that a force sensor reports.
        climb = self._climb[rows]
        climb[:, 1] += STEP_S * (np.einsum("ij,ij->i", self._up[rows], perceptors["accel"][rows]) - GRAVITY)
        climb[:, 0] += STEP_S * climb[:, 1]
        touching = np.stack([perceptors[name][rows, 0] for name in ("foot_left", "foot_right")], axis=1)
        lowest = np.where(np.isnan(touching), np.inf, self._soles[rows]).min(axis=1)
        error = np.where(np.isfinite(lowest), SOLE_HEIGHT_M - lowest - climb[:, 0], 0.0)
        climb[:, 0] += HEIGHT_GAIN * error
        climb[:, 1] += CLIMB_GAIN / STEP_S * error
        self._up[rows] = rotation[:, 2]
        self._soles[rows] = self._sole_heights(rows, rotation)
        ahead = rotations(_turned(orientation, rate))
        self.values[rows, 0] = np.arctan2(ahead[:, 1, 1], ahead[:, 0, 1])
        self.values[rows, 1] = climb[:, 0] + STEP_S * climb[:, 1]

    def _sole_heights(self, rows: slice | IntArray, rotation: FloatArray) -> FloatArray:
        """Return the (k, 2) heights of the lowest point of left and right sole relative to the torso, metres."""
        position, turned = self._feet.ends(self._perceptors["joint_angles"][rows])
        up = rotation[:, None, 2]
        centre = np.einsum("kci,kci->kc", np.broadcast_to(up, position.shape), position)
        tilted = np.abs(np.einsum("kci,kcij->kcj", np.broadcast_to(up, position.shape), turned))
        return np.asarray(centre - tilted @ self._sole)

    def _see(self, rows: slice, orientation: FloatArray) -> None:
        """Correct (k, 4) orientations of robots that see the field now."""
        polar = self._perceptors["vision"][rows].reshape(len(orientation), -1, 3)
        found = ~np.isnan(polar[..., 0])
        seeing = np.flatnonzero(found.sum(axis=1) >= MIN_SIGHTS)
        if not len(seeing):
            return
        numbers = seeing + rows.start
        distance, theta, phi = np.moveaxis(np.nan_to_num(polar[seeing]), -1, 0)
        theta, phi = np.deg2rad(theta), np.deg2rad(phi)
        ahead = distance * np.cos(phi)
        seen = np.stack([-ahead * np.sin(theta), ahead * np.cos(theta), distance * np.sin(phi)], axis=-1)
        eye, turned = self._head.ends(self._perceptors["joint_angles"][numbers])
        rotation = rotations(orientation[seeing])
        # from the torso to the landmarks, in the world's axes as far as they are known
        sight = np.einsum("kij,klj->kli", rotation @ turned[:, 0], seen)
        eye_height = self._climb[numbers, 0] + np.einsum("ki,ki->k", rotation[:, 2], eye[:, 0])
        weight = np.where(found[seeing], 1.0 / np.maximum(distance, 1.0), 0.0)
        weight /= weight.sum(axis=1, keepdims=True)
        # yaw: the turn that brings the landmarks' layout onto the known one
        seen_about = sight[..., :2] - np.einsum("kl,kli->ki", weight, sight[..., :2])[:, None]
        known_about = _LANDMARKS[:, :2] - (weight @ _LANDMARKS[:, :2])[:, None]
        across = seen_about[..., 0] * known_about[..., 1] - seen_about[..., 1] * known_about[..., 0]
        along = (seen_about * known_about).sum(axis=-1)
        yaw = np.arctan2((weight * across).sum(axis=1), (weight * along).sum(axis=1))
        # tilt: the turns about the horizontal axes that bring the landmarks to their known heights
        lever = np.stack([sight[..., 1], -sight[..., 0]], axis=-1)
        missing = _LANDMARKS[:, 2] - eye_height[:, None] - sight[..., 2]
        normal = np.einsum("kl,kli,klj->kij", weight, lever, lever) + LEVEL * np.eye(2)
        tilt = np.linalg.solve(normal, np.einsum("kl,kli,kl->ki", weight, lever, missing)[..., None])[..., 0]
        self._sights[numbers] += 1.0
        gain = np.maximum(MIN_SIGHT_GAIN, 1.0 / self._sights[numbers])[:, None]
        turn = 0.5 * gain * np.concatenate([tilt, yaw[:, None]], axis=1)
        correction = np.concatenate([np.sqrt(1.0 - np.minimum(0.99, (turn * turn).sum(axis=1)))[:, None], turn], axis=1)
        orientation[seeing] = _normalized(_product(correction, orientation[seeing]))


class _Chains:
    """Forward kinematics of several chains of hinges that begin at the torso and have the same number of links."""

    def __init__(self, model: RobotModel, chains: Sequence[Sequence[str]]) -> None:
        joints = {joint.body: (k, joint) for k, joint in enumerate(model.joints)}
        offsets = {body.name: np.array(body.offset) for body in model.bodies}
        self._links = []
        for bodies in zip(*chains, strict=True):
            found = [joints[body] for body in bodies]
            anchors = np.array([joint.anchor for _, joint in found])
            parents = np.array([offsets[joint.parent] for _, joint in found])
            axes = np.array([joint.axis for _, joint in found])
            cross = np.cross(np.eye(3), axes[:, None])
            # frames are parallel to the torso's at angles 0
            pivots = np.array([offsets[body] for body in bodies]) + anchors - parents
            self._links.append(([k for k, _ in found], pivots, anchors, cross, cross @ cross))
        self._width = len(chains)

    def ends(self, angles_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the chains' last bodies in the torso's frame for (k, J) joint angles in degrees.

        Returns:
            (k, c, 3) positions in metres and (k, c, 3, 3) rotations into the torso's frame.
        """
        k = len(angles_deg)
        position: FloatArray = np.zeros((k, self._width, 3))
        rotation: FloatArray = np.broadcast_to(np.eye(3), (k, self._width, 3, 3))
        for joints, pivots, anchors, cross, squared in self._links:
            angles = np.deg2rad(angles_deg[:, joints])[..., None, None]
            pivot = position + (rotation @ pivots[..., None])[..., 0]
            rotation = rotation @ (np.eye(3) + np.sin(angles) * cross + (1.0 - np.cos(angles)) * squared)
            position = pivot - (rotation @ anchors[..., None])[..., 0]
        return position, rotation


def _turned(orientations: FloatArray, rates: FloatArray) -> FloatArray:
    """Return (k, 4) orientations a step later, as ODE steps them, at (k, 3) rad/s in the torso's frame."""
    rates = np.concatenate([np.zeros((len(rates), 1)), rates], axis=1)
    return _normalized(orientations + 0.5 * STEP_S * _product(orientations, rates))


def _normalized(quaternions: FloatArray) -> FloatArray:
    return np.asarray(quaternions / np.sqrt((quaternions * quaternions).sum(axis=1, keepdims=True)))


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the (k, 4) products of quaternions w, x, y, z."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    )
