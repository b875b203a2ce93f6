"""Numbers of a humanoid's ``MjModel`` for the kernel in C++ that steps several robots of a kind at once.

The robot's tree is compiled into its kernel; every number comes from the model, so that gains, masses and another
version of the robot need no new build. ``cpp/humanoid_model.hpp`` has the same order.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from naosim.mujoco.world import FEET, FOREARMS, PREFIX, SHANKS, library, motor_gains
from naosim.simulator import TOUCHING

if TYPE_CHECKING:
    from naosim.mujoco.world import MujocoWorld

Floats = NDArray[np.float64]

_LIMITS = (1e-4, 0.9999)  # mjMINIMP, mjMAXIMP
SHARED = (*("body_pos", "dof_damping", "dof_armature", "dof_frictionloss", "jnt_range", "geom_size", "geom_solimp"),)
"""Arrays of a model that are numbers of the whole batch, and that randomisation might change."""

_CELLS = 8  # kCells of the kernel

_CONTACT_COUNT, _CONTACTS = 161576, 162432
"""Where ``ncon`` and ``contact`` are in MuJoCo's ``mjData``; humanoid_contacts.hpp has the same numbers."""


class Parts:
    """Where a robot is among the bodies, geoms and speeds of its model."""

    def __init__(self, world: MujocoWorld) -> None:
        model = world.model
        names = [model.body(body).name for body in range(model.nbody)]
        first = next(body for body, name in enumerate(names) if name.startswith(PREFIX))
        self.bodies = slice(first, int(model.nbody))
        self.names = [name.removeprefix(PREFIX) for name in names[first:]]
        self.geoms = slice(int(world.geoms[0]), int(model.ngeom))
        self.joints = slice(int(model.njnt) - world.joints, int(model.njnt))
        self.speeds = slice(world.first_speed - 6, int(model.nv))
        self.hinges = slice(world.first_speed, int(model.nv))
        self.ball = next((geom for geom in range(self.geoms.start) if names[model.geom_bodyid[geom]] == "ball"), -1)
        self._ball_body = int(model.geom_bodyid[self.ball]) if self.ball >= 0 else -1
        self.still = [geom for geom in range(1, self.geoms.start) if geom != self.ball]

    def number(self, body: int) -> int:
        """Return the kernel's number of a body of the robot, or of the ball."""
        return self.bodies.stop - self.bodies.start if body == self._ball_body else body - self.bodies.start


def topology_difference(world: MujocoWorld) -> str:
    """Return in what a world differs from what the robot's kernel is compiled for; empty if it can step it."""
    from naosim.mujoco._mujoco import topology

    model, parts, tree = world.model, Parts(world), topology(world.robot.lower())
    first, axes = parts.bodies.start, np.eye(3)[tree["axes"][1:]]
    if [int(parent) - first for parent in model.body_parentid[parts.bodies]][1:] != tree["parents"][1:]:
        return "its bodies form another tree"
    if model.jnt_axis[parts.joints].tolist() != axes.tolist() or model.jnt_pos.any():
        return "its joints have other axes"
    bodies = (model.geom_bodyid[parts.geoms] - first).tolist()
    if bodies != tree["geom_bodies"] or model.geom_type[parts.geoms].tolist() != tree["geom_shapes"]:
        return "its geoms have other shapes"
    if not np.array_equal(model.actuator_gear[:, 0], np.ones(3 * world.joints)) or model.jnt_stiffness.any():
        return "its motors have gears or its joints springs"
    if (model.geom_solimp[:, 3:] != (0.5, 2.0)).any() or (model.jnt_solimp[:, 3:] != (0.5, 2.0)).any():
        return "its impedances have another shape"
    if model.geom_margin.any() or model.jnt_margin.any() or model.opt.integrator or model.opt.cone:
        return "it has margins, or another integrator or friction cone"
    if (model.geom_condim[parts.geoms] != 3).any() or model.body_dofnum[model.geom_bodyid[parts.still]].any():
        return "its contacts have other dimensions or its surroundings move"
    if parts.ball >= 0 and (np.ptp(model.body_inertia[model.geom_bodyid[parts.ball]]) or model.dof_damping[:6].any()):
        return "its ball is no uniform sphere"
    _require_layout()
    return ""


def shared_numbers(world: MujocoWorld) -> Floats:
    """Return what all robots of a batch have in common: ``Shared`` of ``cpp/humanoid_model.hpp``."""
    model, at = world.model, Parts(world)
    step = float(model.opt.timestep)
    inertia, mass = model.body_inertia[at.bodies], model.body_mass[at.bodies, None]
    friction = _impedance(model.dof_solref[-1], model.dof_solimp[-1], step)
    geoms = range(at.geoms.start, at.geoms.stop)
    offsets, frames = model.geom_pos[at.geoms], _rotations(model.geom_quat[at.geoms])
    hulls = model.geom_aabb[at.geoms]
    middles = offsets + np.einsum("gij,gj->gi", frames.reshape(-1, 3, 3), hulls[:, :3])
    rules = [[contact_rule(model, geom, other, step) for other in geoms] for geom in geoms]
    parts = [
        [step, float(model.dof_damping.any())],
        _impedance(model.jnt_solref[-1], model.jnt_solimp[-1], step),
        [model.dof_frictionloss[-1], friction[0], friction[4]],
        [model.opt.density, model.opt.viscosity],
        model.body_pos[at.bodies],
        _rotations(model.body_quat[at.bodies]),
        _rotations(model.body_iquat[at.bodies]),
        _sides(inertia, mass),
        model.dof_armature[at.speeds],
        model.dof_damping[at.speeds],
        model.jnt_actfrcrange[at.joints, 1],
        model.jnt_range[at.joints, 0],
        model.jnt_range[at.joints, 1],
        model.geom_size[at.geoms],
        offsets,
        frames,
        hulls[:, 3:],
        middles,
        [contact_rule(model, 0, geom, step) for geom in geoms],
        rules,
        _collides(model, at),
        _ball_numbers(world, at, step),
        _goal_numbers(world, at),
        _extents(model, at),
    ]
    return np.concatenate([np.ravel(np.asarray(part, dtype=np.float64)) for part in parts])


def varied_numbers(world: MujocoWorld) -> Floats:
    """Return what randomisation can give each robot: ``Varied`` of ``cpp/humanoid_model.hpp``."""
    model, at = world.model, Parts(world)
    axes = _rotations(model.body_iquat[at.bodies]).reshape(-1, 3, 3)
    inertia = np.einsum("bij,bj,bkj->bik", axes, model.body_inertia[at.bodies], axes)
    parts = [
        [model.opt.gravity[2], 1.0 / (model.stat.meaninertia * model.nv)],
        model.body_mass[at.bodies],
        inertia[:, (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)],
        model.body_ipos[at.bodies],
        model.body_invweight0[at.bodies, 0],
        model.geom_friction[at.geoms, 0],
        model.dof_invweight0[at.hinges],
        *motor_gains(model),
        [world.stiffness, np.sqrt(world.stiffness)],
    ]
    return np.concatenate([np.ravel(part) for part in parts])


def contact_rule(model: Any, a: int, b: int, step: float) -> list[float]:
    """Return the :func:`_impedance` of contacts of two geoms, as MuJoCo mixes it from theirs."""
    priorities = model.geom_priority[[a, b]]
    if priorities[0] != priorities[1]:
        rule = (a, b)[int(np.argmax(priorities))]
        return _impedance(model.geom_solref[rule], model.geom_solimp[rule], step)
    weights = model.geom_solmix[[a, b]] / model.geom_solmix[[a, b]].sum()
    mixed = [weights[0] * values[a] + weights[1] * values[b] for values in (model.geom_solref, model.geom_solimp)]
    return _impedance(mixed[0], mixed[1], step)


def _ball_numbers(world: MujocoWorld, at: Parts, step: float) -> Floats:
    model, parts = world.model, np.zeros(at.bodies.stop - at.bodies.start)
    head: list[float] = [0.0] * 5
    rule, friction, place, turn = [0.0] * 5, np.zeros(5), np.zeros(3), np.zeros(9)
    camera, count = 0, 0
    if at.ball >= 0:
        body = model.geom_bodyid[at.ball]
        mass, inertia = model.body_mass[body], model.body_inertia[body]
        sides = _sides(inertia[None], np.array([[mass]]))
        head = [1.0, model.geom_size[at.ball, 0], mass, inertia[0], sides[0, 0]]
        rule = contact_rule(model, 0, at.ball, step)
        friction = model.geom_friction[at.ball][[0, 0, 1, 2, 2]]
        if world.scene.ball:
            camera, count = int(model.site_bodyid[world.camera]) - at.bodies.start, len(TOUCHING)
            place, turn = model.site_pos[world.camera], _rotations(model.site_quat[[world.camera]])
            single, subtrees = [*FEET, *SHANKS[world.robot]], [*FOREARMS[world.robot], "torso"]
            for bit, name in enumerate(single):
                parts[at.names.index(name)] += 2**bit
            for bit, name in enumerate(subtrees, start=len(single)):
                for body in range(len(parts)):
                    parts[body] += 2**bit * _is_above(
                        model, at.names.index(name) + at.bodies.start, body + at.bodies.start
                    )
    return np.concatenate([head, rule, friction, parts, [count, camera], place, np.ravel(turn)])


def _goal_numbers(world: MujocoWorld, at: Parts) -> Floats:
    """Return the number of goals and the corners of the boxes around them."""
    mujoco, model = library(), world.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    boxes: dict[int, list[Floats]] = {}
    for geom in at.still:
        half = np.abs(data.geom_xmat[geom].reshape(3, 3)) @ model.geom_aabb[geom, 3:]
        boxes.setdefault(int(model.geom_bodyid[geom]), []).append(
            np.stack([data.geom_xpos[geom] - half, data.geom_xpos[geom] + half])
        )
    corners = np.zeros((2, 2, 3))
    for k, each in enumerate(boxes.values()):
        corners[k] = np.min([box[0] for box in each], axis=0), np.max([box[1] for box in each], axis=0)
    return np.concatenate([[len(boxes)], corners.ravel()])


def _extents(model: Any, at: Parts) -> Floats:
    """Return how far each mesh extends from the middle of its box, in directions on a cube's surface.

    Raises:
        ValueError: if MuJoCo has computed no hull of a mesh.
    """
    edge = np.linspace(-1.0, 1.0, _CELLS + 1)
    grid = np.stack([np.ones((_CELLS + 1,) * 2), *np.meshgrid(edge, edge, indexing="ij")], axis=-1)
    sides = np.stack([np.roll(grid * (sign, 1.0, 1.0), k, axis=-1) for k in range(3) for sign in (1.0, -1.0)])
    meshes = np.flatnonzero(model.geom_type[at.geoms] == library().mjtGeom.mjGEOM_MESH) + at.geoms.start
    out = np.zeros((max(len(meshes), 1), *sides.shape[:-1]))
    for row, geom in zip(out, meshes, strict=False):
        mesh = model.geom_dataid[geom]
        if model.mesh_graphadr[mesh] < 0:
            raise ValueError(f"mesh {model.mesh(mesh).name}: MuJoCo has computed no hull of it; let the geom collide")
        # vertices of the hull: number, number of faces, their edges, and which of the mesh's they are
        graph = model.mesh_graph[model.mesh_graphadr[mesh] :]
        hull = model.mesh_vertadr[mesh] + graph[2 + graph[0] : 2 + 2 * graph[0]]
        row[:] = (sides @ (model.mesh_vert[hull] - model.geom_aabb[geom, :3]).T).max(axis=-1)
    return out


def _impedance(solref: Floats, solimp: Floats, step: float) -> list[float]:
    """Return d0, d1, width, stiffness and damping of MuJoCo's constraint parameters."""
    d0, d1 = np.clip(solimp[:2], *_LIMITS)
    time, ratio = float(solref[0]), float(solref[1])
    if time <= 0.0:  # stiffness and damping themselves
        return [d0, d1, float(solimp[2]), -time / (d1 * d1), -ratio / d1]
    time = max(time, 2.0 * step)
    return [d0, d1, float(solimp[2]), 1.0 / (d1 * d1 * time * time * ratio * ratio), 2.0 / (d1 * time)]


def _sides(inertia: Floats, mass: Floats) -> Floats:
    """Return the (k, 3) sides of the boxes with (k, 3) inertias and (k, 1) masses."""
    sides: Floats = np.sqrt(np.maximum(1e-15, inertia.sum(axis=1, keepdims=True) - 2.0 * inertia) / mass * 6.0)
    return sides


def _rotations(quaternions: Floats) -> Floats:
    mujoco, out = library(), np.empty((len(quaternions), 9))
    for row, quaternion in zip(out, quaternions, strict=True):
        mujoco.mju_quat2Mat(row, quaternion)
    return out


def _is_above(model: Any, above: int, body: int) -> bool:
    while body > above:
        body = int(model.body_parentid[body])
    return body == above


def _collides(model: Any, at: Parts) -> Floats:
    """Return which geoms MuJoCo's filters let collide: neither of parent and child nor of excluded bodies."""
    excluded = {(int(pair) >> 16, int(pair) & 0xFFFF) for pair in model.exclude_signature}
    bodies = model.geom_bodyid[at.geoms].tolist()
    out = np.zeros((len(bodies), len(bodies)))
    for i, a in enumerate(bodies):
        for j, b in enumerate(bodies):
            related = model.body_parentid[a] == b or model.body_parentid[b] == a
            out[i, j] = not (a == b or related or (a, b) in excluded or (b, a) in excluded)
    return out


@cache
def _require_layout() -> None:
    """Raise RuntimeError unless contacts are where the kernels read them in MuJoCo's memory."""
    mujoco = library()
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='plane' size='1 1 1'/><body pos='0 0 .05'><freejoint/>"
        "<geom type='box' size='.1 .1 .1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    count = ctypes.c_int.from_address(data._address + _CONTACT_COUNT).value
    contacts = ctypes.c_void_p.from_address(data._address + _CONTACTS).value
    if count != data.ncon or not count or contacts != data.contact.dist.ctypes.data:
        raise RuntimeError("mujoco: its data has another layout than that of version 3.5.0")
