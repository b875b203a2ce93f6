"""Bundled policies over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx
import naopolicies
import numpy as np
import pytest
from naospec import TrainingSpec
from naosprint.analysis.replay import load_replay
from naosprint.rl.policy import load_policy


def test_cards_of_all_bundled_policies(client: httpx.Client) -> None:
    cards = client.get("/policies").json()["items"]
    assert [card["name"] for card in cards] == list(naopolicies.names())
    for card in cards:
        expected = {"motion": {}, "robustness": [], "ranges": None, **naopolicies.card(card["name"])}
        assert {name: card[name] for name in expected} == expected
        _, manifest = load_policy(naopolicies.folder(card["name"]))
        assert (card["reference"], card["version"], card["spec_sha256"]) == (card["name"], 1, manifest.spec_sha256)
        policy = client.get(f"/policies/{card['name']}").json()
        assert TrainingSpec.model_validate(policy.pop("spec")) == manifest.spec
        assert {file["name"] for file in policy.pop("files")} == {"checkpoint.json", "policy.npz"}
        assert policy.pop("requirements") == {}
        assert policy == card
        assert client.get(f"/policies/{card['name']}/versions").json()["items"] == [card]


@pytest.mark.parametrize("name", naopolicies.names())
def test_replay_can_be_played(client: httpx.Client, tmp_path: Path, name: str) -> None:
    answer = client.get(f"/policies/{name}/replay")
    assert answer.headers["content-type"] == "application/json"
    path = tmp_path / "replay.json"
    path.write_bytes(answer.content)
    replay = load_replay(path)
    way = replay.positions[:, 0, :2] - replay.positions[0, 0, :2]
    farthest_m = np.hypot(way[:, 0], way[:, 1]).max()
    assert farthest_m > 0.3, "a robot that gets up rolls over, one that kicks takes steps, and may take them back"


@pytest.mark.parametrize("path", ["/policies/sprnt", "/policies/sprnt/replay"])
def test_unknown_policy_is_answered_with_those_that_exist(client: httpx.Client, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 404
    assert "no policy 'sprnt'" in answer.json()["detail"]
    for name in naopolicies.names():
        assert name in answer.json()["detail"]


@pytest.mark.parametrize("name", ["..", "%2e%2e%2fcard", "A", "x" * 61])
def test_names_cannot_leave_the_folder(client: httpx.Client, name: str) -> None:
    assert client.get(f"/policies/{name}/replay").status_code in (404, 422)


def test_policies_need_a_token(api: Any) -> None:
    assert httpx.get(f"{api.url}/policies").status_code == 401
