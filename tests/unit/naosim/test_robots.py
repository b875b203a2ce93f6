"""The robot tables agree with the published data of the robot."""

from __future__ import annotations

import numpy as np
import pytest
from naosim.robots import nao_model


@pytest.mark.parametrize("robot_type", nao_model.ROBOT_TYPES)
def test_every_type_is_a_tree_with_one_hinge_a_body(robot_type: int) -> None:
    model = nao_model.model(robot_type)
    assert len(model.joints) == len(model.bodies) - 1 == (24 if robot_type == 4 else 22)
    assert {joint.body for joint in model.joints} == set(model.body_names[1:])
    for joint in model.joints:
        assert model.body_index[joint.parent] < model.body_index[joint.body]
        assert joint.low_deg < 0 < joint.high_deg
        assert np.linalg.norm(joint.axis) == pytest.approx(1.0)


def test_standard_robot_matches_the_published_figures() -> None:
    model = nao_model.model(0)
    assert model.mass == pytest.approx(4.6071)
    assert model.standing_height == pytest.approx(0.385)
    assert model.joint_names == (
        "hj1", "hj2", "laj1", "laj2", "laj3", "laj4", "raj1", "raj2", "raj3", "raj4",
        "llj1", "llj2", "llj3", "llj4", "llj5", "llj6", "rlj1", "rlj2", "rlj3", "rlj4", "rlj5", "rlj6",
    )  # fmt: skip
    assert np.rad2deg(nao_model.MAX_JOINT_SPEED) == pytest.approx(351.77, abs=1e-5)
    foot = model.bodies[model.body_index["rfoot"]]
    assert foot.offset == pytest.approx((0.055, 0.025, -0.375))


def test_sides_mirror_each_other() -> None:
    for robot_type in nao_model.ROBOT_TYPES:
        model = nao_model.model(robot_type)
        for joint in model.joints:
            if joint.name[0] != "l":
                continue
            other = model.joints[model.joint_index["r" + joint.name[1:]]]
            if joint.axis[0] != 0.0 and joint.axis[2] == 0.0:  # pitch: same limits
                assert (joint.low_deg, joint.high_deg) == (other.low_deg, other.high_deg)
            elif joint.axis[0] == 0.0:  # roll and yaw: mirrored limits
                assert (joint.low_deg, joint.high_deg) == (-other.high_deg, -other.low_deg)
            ours, theirs = (model.bodies[model.body_index[j.body]].offset for j in (joint, other))
            assert ours == pytest.approx((-theirs[0], theirs[1], theirs[2]))


def test_heterogeneous_types_differ_where_they_should() -> None:
    assert nao_model.model(1).standing_height > nao_model.model(0).standing_height
    assert nao_model.model(3).standing_height > nao_model.model(1).standing_height
    ankle = nao_model.model(2).joints[nao_model.model(2).joint_index["llj5"]]
    assert ankle.max_speed == 8.80667
    toes = nao_model.model(4)
    assert toes.joint_names[16] == "llj7" and toes.joint_names[-1] == "rlj7"
    assert toes.mass == pytest.approx(nao_model.model(0).mass)
    assert [name for name, _ in toes.touch_sensors] == ["rf", "lf", "rf1", "lf1"]


def test_watched_pairs_leave_out_neighbours_on_a_leg() -> None:
    pairs = {frozenset(pair) for pair in nao_model.model(0).collision_pairs}
    assert len(pairs) == 11 * 10 // 2 - 6
    assert frozenset(("rthigh", "torso")) not in pairs
    assert frozenset(("rthigh", "lthigh")) in pairs
    assert frozenset(("rfoot", "rthigh")) in pairs


@pytest.mark.parametrize("wrong", [5, -1, "0", None, True, 1.5])
def test_unknown_type_is_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match="robot_type"):
        nao_model.model(wrong)  # type: ignore[arg-type]
