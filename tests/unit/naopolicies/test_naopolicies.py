"""The bundled policies are complete, and their cards describe them."""

from __future__ import annotations

import json
from pathlib import Path

import naopolicies
import numpy as np
import pytest
from naospec import EvaluationSpec, plugins
from naospec.json_text import json_text
from naosprint.analysis.replay import load_replay
from naosprint.analysis.results import by_name, headline, value_text
from naosprint.rl.policy import load_policy


@pytest.mark.parametrize("name", naopolicies.names())
def test_policy_is_complete_and_its_card_is_about_it(name: str) -> None:
    """Checksums match, the policy acts, and card, checkpoint and replay are of the same robot and task."""
    folder, card = naopolicies.folder(name), naopolicies.card(name)
    policy, manifest = load_policy(folder)
    actions = policy.act(np.zeros((3, len(manifest.observations))))
    assert actions.shape == (3, len(manifest.actions))
    assert np.isfinite(actions).all()
    assert card["name"] == name
    assert (card["robot"], card["task"]) == (manifest.spec.robot.name, manifest.spec.task.name)
    # settings that are newer than the policy have their defaults
    assert naopolicies.spec(name)["task"].items() <= manifest.spec.model_dump(mode="json")["task"].items()
    assert load_replay(folder / naopolicies.REPLAY).robot.name == card["robot"]


@pytest.mark.parametrize("name", naopolicies.names())
def test_card_has_results_and_lineage(name: str) -> None:
    """Results of a thousand episodes in the task's order, and every job with its settings."""
    card = naopolicies.card(name)
    _, manifest = load_policy(naopolicies.folder(name))
    assert card["episodes"] == card["evaluation"]["episodes"] >= 1000
    assert EvaluationSpec.model_validate(card["evaluation"]).seed > 0
    task = plugins.load(plugins.TASKS, card["task"])
    assert tuple(card["headline"]) == task.presentation.headline
    assert set(card["headline"]) <= set(by_name(card))
    for result in headline(card):
        assert value_text(result) in card["summary"]
    last = card["lineage"][-1]
    assert (last["task"], last["robot"]) == (card["task"], card["robot"])
    steps = [part["steps"] for part in card["lineage"]]
    assert sum(steps[-len(manifest.spec.stage_specs) :]) == manifest.steps
    assert last["overrides"] == _plain(manifest.stage_spec.overrides())
    assert card["steps"] == sum(steps)
    for part in card["lineage"]:
        listed = plugins.load(plugins.TASKS, part["task"]).presentation.listed
        assert set(part["curve"]) == {"step", *listed}
        assert len({len(values) for values in part["curve"].values()}) == 1


def _plain(overrides: dict[str, object]) -> dict[str, object]:
    return {path: list(value) if isinstance(value, tuple) else value for path, value in overrides.items()}


def test_unknown_name_lists_those_that_exist(tmp_path: Path) -> None:
    """The error for an unknown name lists the valid ones."""
    with pytest.raises(ValueError, match="unknown policy 'sprnt': choose one of"):
        naopolicies.folder("sprnt")
    with pytest.raises(ValueError, match=r"nor a bundled policy; these are: k1-getup, k1-kick, k1-run, "):
        naopolicies.resolve("sprnt")
    assert naopolicies.resolve(str(tmp_path)) == tmp_path


def test_a_folder_called_like_a_policy_does_not_hide_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless it is a checkpoint itself."""
    monkeypatch.chdir(tmp_path)
    Path("sprint").mkdir()
    assert naopolicies.resolve("sprint") == naopolicies.folder("sprint")
    Path("sprint", naopolicies.CHECKPOINT).touch()
    assert naopolicies.resolve("sprint") == Path("sprint")


@pytest.mark.parametrize("name", naopolicies.names())
def test_a_card_describes_a_metric_once(name: str) -> None:
    """Results that tables and conditions repeat are stored without its words, and read with them."""
    text = (naopolicies.folder(name) / naopolicies.CARD).read_text(encoding="utf-8")
    card = naopolicies.card(name)
    assert text == json_text(naopolicies.stored(card))
    metrics = by_name(card)
    for part in (*card.get("robustness", ()), *(column for table in card["tables"] for column in table["columns"])):
        for result in part["results"]:
            assert {"title", "unit", "description"} <= result.keys()
            if described := metrics.get(result["name"]):
                assert result["title"] == described["title"]
                assert text.count(json.dumps(described["description"], ensure_ascii=False)) == 1
