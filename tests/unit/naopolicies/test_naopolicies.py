"""Test the shipped policies: what is in the box is whole, and its card says what it is."""

from __future__ import annotations

from pathlib import Path

import naopolicies
import numpy as np
import pytest
from naospec import task
from naosprint.policy import load_policy
from naosprint.replay import load_replay


@pytest.mark.parametrize("name", naopolicies.names())
def test_policy_is_whole_and_its_card_is_about_it(name: str) -> None:
    """Checksums fit, the policy acts, and card, checkpoint and replay speak of the same robot and task."""
    folder, card = naopolicies.folder(name), naopolicies.card(name)
    policy, manifest = load_policy(folder)
    actions = policy.act(np.zeros((3, len(manifest.observations))))
    assert actions.shape == (3, len(manifest.actions))
    assert np.isfinite(actions).all()
    assert card["name"] == name
    assert (card["robot_type"], card["task"]) == (manifest.spec.robot_type, manifest.spec.task)
    assert task(card["task"]).min_height_m <= manifest.spec.fall_height_m
    assert card["lineage"][-1]["steps"] == manifest.steps
    assert card["figures"]["episodes"] >= 1000
    assert load_replay(folder / naopolicies.REPLAY).robot_type == card["robot_type"]


def test_unknown_name_lists_those_that_exist(tmp_path: Path) -> None:
    """A wrong name is answered with the right ones."""
    with pytest.raises(ValueError, match="unknown policy 'sprnt': choose one of"):
        naopolicies.folder("sprnt")
    with pytest.raises(ValueError, match="neither a checkpoint's folder nor a shipped policy"):
        naopolicies.resolve("sprnt")
    assert naopolicies.resolve(str(tmp_path)) == tmp_path
