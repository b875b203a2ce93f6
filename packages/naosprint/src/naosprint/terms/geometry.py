"""Directions, rotations and quaternions as expressions. Matrices are 3 x 3, row by row; quaternions are w, x, y, z."""

from __future__ import annotations

from collections.abc import Sequence

from naosprint.terms.expressions import Number, cos, sin, sqrt, square, stack, total


def along(heading: Number, moved: Number) -> Number:
    """Return the parts of a displacement (x, y) along a heading in radians, and to the left of it."""
    cosine, sine = cos(heading), sin(heading)
    return stack(cosine * moved[0] + sine * moved[1], cosine * moved[1] - sine * moved[0])


def cross(a: Number, b: Number) -> Number:
    """Return the cross product of two vectors."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return a[ahead] * b[behind] - a[behind] * b[ahead]


def turned(quaternion: Number, vector: Number) -> Number:
    """Return a vector of a body's frame in the world's, by the body's orientation."""
    axis = quaternion[1:]
    across = cross(axis, vector) * 2.0
    return vector + quaternion[0] * across + cross(axis, across)


def normalized(numbers: Number) -> Number:
    """Return numbers divided by the root of the sum of their squares."""
    return numbers / sqrt(total(square(numbers)))


def quaternion_product(a: Number, b: Number) -> Number:
    """Return the orientation a after b."""
    (aw, ax, ay, az), (bw, bx, by, bz) = _four(a), _four(b)
    return stack(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def rotation_of(quaternion: Number) -> Number:
    """Return the matrix of a normalized quaternion."""
    w, x, y, z = _four(quaternion)
    return stack(
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def hinge(axis: Sequence[float], angle: Number) -> Number:
    """Return the matrix of a turn about an axis of length 1 by an angle in radians."""
    x, y, z = axis
    across = (0.0, -z, y, z, 0.0, -x, -y, x, 0.0)
    twice = [sum(across[3 * i + k] * across[3 * k + j] for k in range(3)) for i in range(3) for j in range(3)]
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return sin(angle) * across + (1.0 - cos(angle)) * twice + identity


def _four(quaternion: Number) -> tuple[Number, Number, Number, Number]:
    return quaternion[0], quaternion[1], quaternion[2], quaternion[3]
