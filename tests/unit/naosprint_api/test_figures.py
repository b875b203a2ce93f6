"""Joints and shapes by which the dashboard draws the robots of a game: those of the league's model files.

After a change of the models, `python tests/unit/naosprint_api/test_figures.py` writes the files again.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import naosprint_api
import numpy as np
import pytest
from naosim import robots
from naosim.mujoco.shapes import body_poses, shapes_of
from naosim.mujoco.world import MujocoWorld, library, world_of
from naosprint.matches.log import joint_angles

FOLDER = Path(naosprint_api.__file__).parent / "static" / "robots"
ROBOTS = ("t1", "k1")
TURNS = {"x": 0, "y": 1, "z": 2}
Matrix = np.ndarray[Any, np.dtype[np.float64]]


def figure(robot: str) -> dict[str, list[dict[str, Any]]]:
    """Return the joints of a robot, each in the frame of its parent (-1 for the torso), and the shapes at them."""
    world = world_of(robots.get(robot))
    model, first = world.model, world.model.njnt - len(robots.get(robot).joints)
    joints = list(range(first, model.njnt))
    of_body = {int(model.jnt_bodyid[joint]): index for index, joint in enumerate(joints)}
    found: dict[str, list[dict[str, Any]]] = {"joints": [], "shapes": []}
    for joint in joints:
        body = model.jnt_bodyid[joint]
        assert not model.jnt_pos[joint].any()
        axis = next(name for name, turn in TURNS.items() if model.jnt_axis[joint][turn] == 1.0)
        at = _rounded(model.body_pos[body])
        found["joints"].append({"parent": of_body.get(int(model.body_parentid[body]), -1), "at": at, "axis": axis})
    for geom, shape in zip(world.geoms, shapes_of(robot.upper()), strict=True):
        body = model.geom_bodyid[geom]
        matrix = np.empty(9)
        library().mju_quat2Mat(matrix, model.geom_quat[geom])
        middle = model.geom_pos[geom] + matrix.reshape(3, 3) @ model.geom_aabb[geom, :3]
        found["shapes"].append(
            {
                "joint": of_body.get(int(body), -1),
                "part": _part(model.body(body).name, shape.side, shape.kind),
                "kind": shape.kind,
                "size_m": list(shape.size_m),
                "at": _rounded(middle),
                "turn": _rounded(model.geom_quat[geom]),
            }
        )
    return found


def _part(body: str, side: str, kind: str) -> str:
    """Return what a shape is coloured as."""
    if body.endswith("foot_link"):
        return "feet"
    if body.endswith(("H2", "Head_2")):
        return "head"
    if body.endswith("torso") and kind == "box":
        return "torso"
    return "joint" if side == "centre" else "limb"


def _rounded(values: Matrix) -> list[float]:
    return [round(value, 4) + 0.0 for value in values.tolist()]


def text(robot: str) -> str:
    """Return the file of a robot: one joint or shape a line."""
    parts = (
        f'  "{name}": [\n' + ",\n".join(f"    {json.dumps(row)}" for row in rows) + "\n  ]"
        for name, rows in figure(robot).items()
    )
    return "{\n" + ",\n".join(parts) + "\n}\n"


def drawn(described: dict[str, list[dict[str, Any]]], torso: Matrix, angles: Matrix) -> Matrix:
    """Return the (B, 3) centres of the shapes as the dashboard computes them, from the (4, 4) pose of the torso."""
    frames: list[Matrix] = []
    for joint, angle in zip(described["joints"], angles, strict=True):
        axis = TURNS[joint["axis"]]
        i, k = (axis + 1) % 3, (axis + 2) % 3
        turned = np.eye(4)
        turned[i, i] = turned[k, k] = np.cos(angle)
        turned[k, i] = np.sin(angle)
        turned[i, k] = -turned[k, i]
        turned[:3, 3] = joint["at"]
        frames.append((torso if joint["parent"] < 0 else frames[joint["parent"]]) @ turned)
    at = [(torso if s["joint"] < 0 else frames[s["joint"]]) @ [*s["at"], 1.0] for s in described["shapes"]]
    return np.array(at)[:, :3]


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_dashboards_figure_is_that_of_the_models(robot: str) -> None:
    assert (FOLDER / f"{robot}.json").read_text(encoding="utf-8") == text(robot)


@pytest.mark.parametrize("robot", ROBOTS)
def test_shapes_are_where_mujoco_puts_them(robot: str) -> None:
    world: MujocoWorld = world_of(robots.get(robot))
    described = json.loads((FOLDER / f"{robot}.json").read_text(encoding="utf-8"))
    angles = np.random.default_rng(3).uniform(-0.6, 0.6, len(described["joints"]))
    row = np.concatenate([[1.0, -2.0, 0.7], [np.cos(0.4), 0.0, 0.0, np.sin(0.4)], angles])
    torso = np.eye(4)
    torso[:2, :2] = [[np.cos(0.8), -np.sin(0.8)], [np.sin(0.8), np.cos(0.8)]]
    torso[:3, 3] = row[:3]
    expected = body_poses(world, row[None])[0, :, :3]
    np.testing.assert_allclose(drawn(described, torso, angles), expected, atol=1e-3)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_log_has_an_angle_for_every_joint_of_the_figure(robot: str) -> None:
    joints = len(json.loads((FOLDER / f"{robot}.json").read_text(encoding="utf-8"))["joints"])
    bodies = np.tile(np.vstack([np.eye(3), np.zeros(3)]).astype(np.float32), (joints + 1, 1, 1))
    assert len(joint_angles(bodies)) == joints


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for each in ROBOTS:
        (FOLDER / f"{each}.json").write_text(text(each), encoding="utf-8")
