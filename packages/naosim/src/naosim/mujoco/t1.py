"""Numbers of a T1's ``MjModel`` for the kernel in C++ that steps several T1s at once.

Topology is compiled into the kernel; every number comes from the model, so that gains, masses and another version of
the robot need no new build. ``cpp/t1_model.hpp`` has the same order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from naosim.mujoco.world import library

if TYPE_CHECKING:
    from naosim.mujoco.world import World

Floats = NDArray[np.float64]

_PARENTS = (0, 1, 2, 1, 4, 5, 6, 1, 8, 9, 10, 1, 12, 13, 14, 15, 16, 17, 12, 19, 20, 21, 22, 23)
_AXES = (2, 1, 1, 0, 1, 2, 1, 0, 1, 2, 2, 1, 0, 2, 1, 1, 0, 1, 0, 2, 1, 1, 0)
_GEOM_BODIES = (1, 3, 6, 7, 10, 11, 14, 16, 18, 20, 22, 24)
_SPHERE, _CAPSULE, _BOX = 2, 3, 6
_SHAPES = (_BOX, _SPHERE, _CAPSULE, _CAPSULE, _CAPSULE, _CAPSULE, _CAPSULE, _CAPSULE, _BOX, _CAPSULE, _CAPSULE, _BOX)
_LIMITS = (1e-4, 0.9999)  # mjMINIMP, mjMAXIMP


def topology_difference(world: World) -> str:
    """Return in what a world differs from what the kernel is compiled for; empty if it can step it."""
    model = world.model
    if world.ball:
        return "it has a ball"
    if model.nv != 29 or not np.array_equal(model.body_parentid[1:], _PARENTS):
        return "its bodies form another tree"
    if not np.array_equal(model.jnt_axis[1:], np.eye(3)[list(_AXES)]) or model.jnt_pos[1:].any():
        return "its joints have other axes"
    if not np.array_equal(model.geom_bodyid[1:], _GEOM_BODIES) or not np.array_equal(model.geom_type[1:], _SHAPES):
        return "its geoms have other shapes"
    if not np.array_equal(model.actuator_gear[:, 0], np.ones(69)) or model.jnt_stiffness.any():
        return "its motors have gears or its joints springs"
    if (model.geom_solimp[:, 3:] != (0.5, 2.0)).any() or (model.jnt_solimp[:, 3:] != (0.5, 2.0)).any():
        return "its impedances have another shape"
    if model.geom_margin.any() or model.jnt_margin.any() or model.opt.integrator or model.opt.cone:
        return "it has margins, or another integrator or friction cone"
    return ""


def shared_numbers(world: World) -> Floats:
    """Return what all robots of a batch have in common: ``Shared`` of ``cpp/t1_model.hpp``."""
    model = world.model
    step = float(model.opt.timestep)
    inertia, mass = model.body_inertia[1:], model.body_mass[1:, None]
    box = np.sqrt(np.maximum(1e-15, inertia.sum(axis=1, keepdims=True) - 2.0 * inertia) / mass * 6.0)
    solref, solimp = model.geom_solref[1:], model.geom_solimp[1:]
    friction = _impedance(model.dof_solref[6], model.dof_solimp[6], step)
    pairs = [
        _impedance(0.5 * solref[i] + 0.5 * solref[j], 0.5 * solimp[i] + 0.5 * solimp[j], step)
        for i in range(12)
        for j in range(12)
    ]
    parts = [
        [step],
        _impedance(model.jnt_solref[1], model.jnt_solimp[1], step),
        [model.dof_frictionloss[6], friction[0], friction[4]],
        [model.opt.density, model.opt.viscosity],
        model.body_pos[1:],
        _rotations(model.body_quat[1:]),
        model.body_ipos[1:],
        _rotations(model.body_iquat[1:]),
        box,
        model.dof_armature,
        model.dof_damping,
        model.actuator_gainprm[1::3, 0],
        model.actuator_gainprm[2::3, 0],
        model.jnt_actfrcrange[1:, 1],
        model.jnt_range[1:, 0],
        model.jnt_range[1:, 1],
        model.geom_size[1:],
        model.geom_pos[1:],
        _rotations(model.geom_quat[1:]),
        [_impedance(ref, imp, step) for ref, imp in zip(solref, solimp, strict=True)],
        pairs,
        _collides(model),
    ]
    return np.concatenate([np.ravel(part) for part in parts])


def varied_numbers(world: World) -> Floats:
    """Return what randomisation can give each robot: ``Varied`` of ``cpp/t1_model.hpp``."""
    model = world.model
    axes = _rotations(model.body_iquat[1:]).reshape(-1, 3, 3)
    inertia = np.einsum("bij,bj,bkj->bik", axes, model.body_inertia[1:], axes)
    parts = [
        [model.opt.gravity[2], 1.0 / (model.stat.meaninertia * model.nv)],
        model.body_mass[1:],
        inertia[:, (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)],
        model.body_invweight0[1:, 0],
        model.geom_friction[1:, 0],
        model.dof_invweight0[6:],
    ]
    return np.concatenate([np.ravel(part) for part in parts])


def _impedance(solref: Floats, solimp: Floats, step: float) -> list[float]:
    """Return d0, d1, width, stiffness and damping of MuJoCo's constraint parameters."""
    d0, d1 = np.clip(solimp[:2], *_LIMITS)
    time, ratio = max(float(solref[0]), 2.0 * step), float(solref[1])
    return [d0, d1, float(solimp[2]), 1.0 / (d1 * d1 * time * time * ratio * ratio), 2.0 / (d1 * time)]


def _rotations(quaternions: Floats) -> Floats:
    mujoco, out = library(), np.empty((len(quaternions), 9))
    for row, quaternion in zip(out, quaternions, strict=True):
        mujoco.mju_quat2Mat(row, quaternion)
    return out


def _collides(model: Any) -> Floats:
    """Return which geoms MuJoCo's filters let collide: neither of parent and child nor of excluded bodies."""
    excluded = {(int(pair) >> 16, int(pair) & 0xFFFF) for pair in model.exclude_signature}
    out = np.zeros((12, 12))
    for i, a in enumerate(_GEOM_BODIES):
        for j, b in enumerate(_GEOM_BODIES):
            related = model.body_parentid[a] == b or model.body_parentid[b] == a
            out[i, j] = not (a == b or related or (a, b) in excluded or (b, a) in excluded)
    return out
