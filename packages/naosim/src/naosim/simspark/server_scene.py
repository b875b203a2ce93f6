"""The scene graph that a monitor port shows: what the real server prints for its field and its robots."""

from __future__ import annotations

from dataclasses import dataclass

from naosim.robots.nao_model import RobotModel
from naosim.simspark import protocol

Step = tuple[str, str, int]
"""Text of a full frame, text of an incremental one, and a row of the poses, `STILL` or `CLOSE`."""

STILL, CLOSE = -1, -2
_END: Step = ("", "", CLOSE)
_UPRIGHT = "-1 0 0 0 0 0 1 0 0 1 0 0 0 0 0 1"
_IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 {:g} {:g} {:g} 1"
_BAR = 0.04
"""Thickness of a goal's frame, m."""


@dataclass(frozen=True)
class Actor:
    """Robot of the scene; number 0 has no team yet."""

    model: RobotModel
    side: int
    uniform_number: int
    selected: bool = False
    """Whether a trainer has selected it, which a viewer marks."""


def _still(matrix: str, *children: Step) -> list[Step]:
    return [(f"(nd TRF (SLT {matrix})", "(nd", STILL), *children, _END]


def _mesh(model: str, scale: str, materials: str) -> tuple[Step, Step]:
    text = f"(nd StaticMesh (setVisible 1) (load models/{model}.obj) (sSc {scale})(resetMaterials {materials})"
    return ((text, "(nd StaticMesh", STILL), _END)


def _shape(shape: str, scale: str, material: str) -> tuple[Step, Step]:
    return ((f"(nd SMN (setVisible 1) (load {shape}) (sSc {scale}) (sMat {material})", "(nd SMN", STILL), _END)


def _field() -> list[Step]:
    length, width = protocol.FIELD_LENGTH, protocol.FIELD_WIDTH
    steps: list[Step] = []
    for side, ambient in ((-10, "0.8"), (10, "0")):
        light = (
            f"(nd Light (setDiffuse 1 1 1 1) (setAmbient {ambient} {ambient} {ambient} 1) (setSpecular 0.1 0.1 0.1 1)"
        )
        steps += _still(_IDENTITY.format(side, -side, 10), (light, "(nd", STILL), _END)
    sky = " ".join(f"Material_skyrender_{k:04}.tif" for k in range(1, 7))
    steps += _still(_UPRIGHT, *_mesh("naosoccerfield", f"{length / 12:g} 1 {width / 8:g}", "None_rcs-naofield.png"))
    steps += _still(_UPRIGHT, *_mesh("skybox", "10 10 10", sky))
    size = " ".join(f"{c + 2 * _BAR:g}" for c in (protocol.GOAL_WIDTH, protocol.GOAL_HEIGHT, protocol.GOAL_DEPTH))
    depth, height, post = protocol.GOAL_DEPTH / 2, protocol.GOAL_HEIGHT / 2, protocol.GOAL_WIDTH / 2
    frame = [(0.0, -post - _BAR / 2, 0.0), (0.0, post + _BAR / 2, 0.0), (_BAR / 2 - depth, 0.0, 0.0)]
    frame += [(0.0, 0.0, height + _BAR / 2), (depth, post, height), (depth, -post, height)]
    for name, sign in (("leftsoccergoal", -1), ("rightsoccergoal", 1)):
        at = f"{sign * (length / 2 + depth):g} 0 {height:g}"
        turn = f"{-sign} 0 0 0 0 {-sign} 0 0 0 0 1 0 {at} 1"
        text = f"(nd StaticMesh (setVisible 1) (setTransparent) (load models/{name}.obj) (sSc {size})"
        mesh: Step = (text + "(resetMaterials naogoalnet white)", "(nd StaticMesh", STILL)
        inner = _still(f"0 1 0 0 0 0 1 0 1 0 0 0 {depth:g} 0 {-height:g} 1", mesh, _END)
        bars = [step for place in frame for step in _still(_IDENTITY.format(*place))]
        steps += _still(turn, *inner, *bars)
    away, aside = length / 2 + 0.333 * length, width / 2 + 0.75 * width
    across, along = f"1 {1 + 2 * aside:g} 1", f"{1 + 2 * away:g} 1 1"
    for place, size in (
        ((-away, 0, 0), across),
        ((away, 0, 0), across),
        ((0, aside, 0), along),
        ((0, -aside, 0), along),
    ):
        steps += _still(_IDENTITY.format(*place), *_shape("StdUnitBox", size, "matGrey"))
    for name, (x, y, z) in protocol.LANDMARKS:
        if name.startswith("F"):
            steps += _still(_IDENTITY.format(x, y, z))
    for _ in protocol.LINES:
        steps += _still(_IDENTITY.format(0, 0, 0))
    return steps


def _part(name: str, actor: Actor) -> list[Step]:
    kind = actor.model.robot_type
    team = ("matTeam", "matLeft", "matRight")[actor.side]
    number = f"matNum{actor.uniform_number}" if actor.uniform_number else "matNum"
    # materials name the robot type, except those of the robot with toes
    dressed = team if kind == 4 else f"{team} matType{kind}"
    size = actor.model.bodies[actor.model.body_index[name]].shape.size
    scale = f"{size[0]:g} {size[0]:g} {size[0]:g}"
    if name == "torso":
        marker = f"(nd SMN (setVisible {int(actor.selected)}) (setTransparent) (load StdUnitCylinder 1 1)"
        ring: Step = (f"{marker} (sSc 0.2 0.2 0.02) (sMat matSelect)", "(nd SMN", STILL)
        body_mesh = _mesh(f"naobody{kind}", scale, f"{number} {dressed} naowhite")
        return [*_still(_UPRIGHT, *body_mesh), *_still(_IDENTITY.format(0, 0, 0), ring, _END)]
    if name == "head":
        return _still(_UPRIGHT, *_mesh("naohead", "0.1 0.1 0.1", f"{team} naoblack naogrey naowhite"))
    if name == "neck":
        return list(_shape(f"StdCapsule {size[0]:g} {size[1]:g}", "1 1 1", "matDarkGrey"))
    part = name[1:]
    if part in ("shoulder", "elbow", "hip1", "hip2", "ankle"):
        return list(_shape("StdUnitSphere", scale, "matRed" if part == "ankle" else "matYellow"))
    if part == "foot":
        scale = f"{size[0]:g} {size[0] * size[1] / 0.16:g} {size[0]:g}"
    if part == "toe":
        foot = actor.model.bodies[actor.model.body_index[f"{name[0]}foot"]].shape.size
        scale = f"{size[0]:g} {size[0] * size[1] / foot[1]:g} {size[0] * size[2] / foot[2]:g}"
    mesh = {"upperarm": f"{name}{kind}", "shank": f"{name}{kind}", "toe": f"{name[0]}foot"}.get(part, name)
    materials = {"rthigh": f"{number} {team}", "upperarm": dressed, "shank": dressed}
    paint = materials.get(name, materials.get(part, team))
    return list(_mesh(mesh, scale, f"{paint} naowhite"))


def describe(actors: list[Actor]) -> tuple[list[Step], int]:
    """Return the scene of a field with a ball and robots.

    Returns:
        The graph in the order of printing, and how many poses it takes: the ball's, then each robot's bodies.
    """
    steps = _field()
    steps.append(("(nd TRF", "(nd", 0))
    radius = f"{protocol.BALL_RADIUS:g}"
    steps += [*_mesh("soccerball", f"{radius} {radius} {radius}", "soccerball_rcs-soccerball.png"), _END]
    row = 1
    for actor in actors:
        steps.append((f"(nd TRF (SLT {_IDENTITY.format(0, 0, 0)})", "(nd", STILL))
        for body in actor.model.bodies:
            steps += [("(nd TRF", "(nd", row), *_part(body.name, actor), _END]
            row += 1
        steps.append(_END)
    return steps, row
