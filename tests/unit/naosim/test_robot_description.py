"""A description of a robot is refused by robot, field and what to write, unless its parts belong together."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
from naosim import robots
from naosim.robots import JointDescription, PerceptorDescription, Robot
from naosim.robots.description import FilledIn

T1 = robots.get("t1")
ANGLES = PerceptorDescription("joint_angles", 3, "deg")
JOINTS = (
    JointDescription("neck", "n", "centre", "neck", -1.0, 1.0, mirror_sign=-1.0),
    JointDescription("left_roll", "l", "left", "right_roll", -0.2, 0.8),
    JointDescription("right_roll", "r", "right", "left_roll", -0.8, 0.2, sign=-1.0),
)


def walker(**changes: Any) -> Robot:
    fields = {
        "name": "walker",
        "family": "walker",
        "title": "Walker",
        "joints": JOINTS,
        "nominal_rad": {"left_roll": 0.1, "right_roll": -0.1},
        "standing_height_m": 0.6,
        "front_axis": 0,
        "perceptors": (ANGLES,),
    }
    return Robot(**{**fields, **changes})


def changed(number: int, **fields: Any) -> dict[str, tuple[JointDescription, ...]]:
    """Return the joints, one of them with other fields."""
    return {
        "joints": tuple(dataclasses.replace(each, **fields) if i == number else each for i, each in enumerate(JOINTS))
    }


def test_a_robot_whose_parts_belong_together_is_described() -> None:
    ranges = dict.fromkeys(("neck", "left_roll", "right_roll"), 0.5)
    assert walker(action_range_rad=ranges).nominal.tolist() == [0.0, 0.1, -0.1]
    # without ranges actions are counted from the middle of a joint's range: any pose can be the start
    assert walker(nominal_rad={"left_roll": 0.3}).nominal.tolist() == [0.0, 0.3, 0.0]
    turns = changed(0, low_rad=-float("inf"), high_rad=float("inf"))
    assert walker(**turns, nominal_rad={}, action_range_rad=ranges).joints[0].high_rad == float("inf")
    held = changed(0, actuated=False)
    assert walker(**held, nominal_rad={"neck": 0.4}, action_range_rad={"left_roll": 0.5, "right_roll": 0.5})
    assert all(dataclasses.replace(robots.get(name)) == robots.get(name) for name in robots.names())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"nominal_rad": {"left_rol": 0.1}},
            "nominal_rad: there is no joint 'left_rol'; its joints are neck, left_roll",
        ),
        ({"nominal_rad": {"neck": 30.0}}, "nominal_rad: neck: 30 is not from -1 to 1, the joint's range in radians"),
        ({"nominal_rad": {"neck": float("nan")}}, "nominal_rad: neck: nan is not from -1 to 1"),
        ({"nominal_rad": 0.5}, "nominal_rad: 0.5 names no joint; write an angle for each by name"),
        ({"action_range_rad": 0.5}, "action_range_rad: 0.5 names no joint"),
        ({"action_range_rad": {"head": 0.5}}, "action_range_rad: there is no joint 'head'; its joints are neck"),
        ({"action_range_rad": {"neck": 0.5}}, "action_range_rad: left_roll is missing; state every joint"),
        (
            {"action_range_rad": {"neck": 0.0, "left_roll": 0.5, "right_roll": 0.5}},
            "action_range_rad: neck: 0 is no angle that an action can reach; write one above 0",
        ),
        (
            {"action_range_rad": {"neck": 0.5, "left_roll": 0.5, "right_roll": 0.4}},
            "action_range_rad: left_roll and right_roll: mirrored actions are no mirrored posture; write the same",
        ),
        (
            {"action_range_rad": dict.fromkeys(("neck", "left_roll", "right_roll"), 0.5), "nominal_rad": {"neck": 0.2}},
            "nominal_rad: neck: mirrored actions are no mirrored posture: with their signs, 0.2 is -0.2 in a mirror",
        ),
        (changed(1, mirror="rigth_roll"), "joints: left_roll: mirror: there is no joint 'rigth_roll'; its joints are"),
        (changed(1, mirror="left_roll"), "joints: left_roll: its side is left, that of its mirror left_roll left"),
        (changed(0, mirror="left_roll"), "joints: neck: its mirror is left_roll, whose mirror is right_roll"),
        (changed(2, side="left"), "joints: left_roll: its side is left, that of its mirror right_roll left"),
        (changed(1, mirror_sign=-1.0), "joints: left_roll and right_roll: mirror_sign differs; write the same"),
        (changed(1, actuated=False), "joints: left_roll and right_roll: actuated differs; write the same for both"),
        (changed(0, sign=0.0), "joints: neck: sign must be 1 or -1, not 0"),
        (changed(0, mirror_sign=2.0), "joints: neck: mirror_sign must be 1 or -1, not 2"),
        (changed(2, name="left_roll"), "joints: 'left_roll' is there twice; every joint needs a name of its own"),
        (
            changed(2, sign=1.0),
            "joints: left_roll and right_roll: mirrored actions are no mirrored posture: with their signs, -0.2 to 0.8 "
            "is -0.8 to 0.2 in a mirror; change sign, mirror_sign, low_rad or high_rad",
        ),
        (changed(0, low_rad=-0.5), "joints: neck: mirrored actions are no mirrored posture: with their signs, -0.5 to"),
        (
            {"perceptors": (PerceptorDescription("joint_speeds", 2, "deg/s"),)},
            "joint_speeds has 2 numbers for 3 joints",
        ),
        (
            {"joints": tuple(dataclasses.replace(each, actuated=False) for each in JOINTS)},
            "joints: none is actuated; a policy needs one at least that it moves",
        ),
        (changed(0, low_rad=float("nan")), "joints: neck: its range is nan to 1; write numbers"),
        (changed(0, low_rad=-float("inf"), high_rad=float("inf")), "neck: its range is -inf to inf; write numbers, or"),
        ({"standing_height_m": 0.0}, "standing_height_m: 0 is no height"),
        ({"load_shapes": ()}, "load_shapes: () is no function; write one that returns a tuple of Shape"),
        ({"front_axis": 3}, "front_axis: 3 is no column of a rotation; write 0, 1 or 2"),
        ({"camera": T1.camera}, "camera: it turns with the joint 'head_yaw', which is missing; add it, or set camera"),
    ],
)
def test_what_does_not_belong_together_is_refused_by_name(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=r"^robot walker: ") as refused:
        walker(**changes)
    assert words in str(refused.value)


@pytest.mark.parametrize("shapes", [None, [], ("torso",)])
def test_shapes_of_another_type_are_named(shapes: Any) -> None:
    with pytest.raises(ValueError, match=r"^robot walker: load_shapes: expected a tuple of Shape, got "):
        _ = walker(load_shapes=lambda: shapes).shapes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda: {"joints": T1.joints[:-1]}, "left_ankle_roll: mirror: there is no joint 'right_ankle_roll'"),
        (lambda: {"joints": T1.joints[2:]}, "joint_angles has 23 numbers for 21 joints; keep all joints"),
        (lambda: {"nominal_rad": T1.nominal_rad | {"left_knee": 0.5}}, "nominal_rad: there is no joint 'left_knee'"),  # type: ignore[operator]
        (lambda: {"action_range_rad": {"left_knee_pitch": 0.2}}, "action_range_rad: left_shoulder_pitch is missing"),
    ],
)
def test_a_variant_of_a_robot_is_checked_as_well(change: Callable[[], dict[str, Any]], words: str) -> None:
    with pytest.raises(ValueError, match=r"^robot t1-x: ") as refused:
        dataclasses.replace(T1, name="t1-x", **change())
    assert words in str(refused.value)


def test_angles_that_settings_filled_in_are_not_taken_for_the_descriptions_own() -> None:
    own = {"neck": 0.1, "left_roll": 0.2}
    filled = FilledIn(own, {"neck": 0.3})
    assert filled == {"neck": 0.3, "left_roll": 0.2} and len(filled) == 2 and filled.described is own
    assert repr(filled) == repr(dict(filled))
    assert filled | {"neck": 0.4} == {"neck": 0.4, "left_roll": 0.2}
