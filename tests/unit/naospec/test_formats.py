"""Formats of stored documents, and what is read of other versions."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from naospec import EvaluationSpec, TrainingSpec, formats, read_stored, stored
from naospec.formats import Kind
from pydantic import ValidationError

ROOT = Path(__file__).parents[3]


def raise_number(monkeypatch: pytest.MonkeyPatch, kind: Kind, convert: Any = None) -> None:
    """Raise the number of a format, with a conversion from the one before."""
    number = formats.CURRENT[kind]
    monkeypatch.setitem(formats.CURRENT, kind, number + 1)
    if convert is not None:
        monkeypatch.setitem(formats.CONVERSIONS, (kind, number), convert)


@pytest.mark.parametrize(("kind", "model"), [(Kind.TRAINING, TrainingSpec), (Kind.EVALUATION, EvaluationSpec)])
def test_a_specification_of_the_format_before_is_converted(kind: Kind, model: Any, monkeypatch: Any) -> None:
    before = {"format": formats.CURRENT[kind], "chance": 7}
    raise_number(monkeypatch, kind, lambda document: {"seed": document["chance"]})
    assert read_stored(model, before).seed == 7
    written = stored(model(seed=7))
    assert (written["format"], written["seed"]) == (formats.CURRENT[kind], 7)
    assert stored(read_stored(model, written)) == stored(model.model_validate(written)) == written
    assert stored(model.model_validate(before)) == written  # a file of the version before


def test_a_specification_has_no_number_while_none_means_its_format() -> None:
    assert "format" not in stored(EvaluationSpec())
    assert stored(EvaluationSpec.model_validate({"format": 1, "seed": 7})) == stored(EvaluationSpec(seed=7))


@pytest.mark.parametrize(("exact", "engine"), [(True, "mujoco"), (False, "fast"), (None, "fast")])
@pytest.mark.parametrize("robot", ["t1", "k1"])
def test_what_was_exact_is_an_engine(robot: str, exact: bool | None, engine: str, tmp_path: Path) -> None:
    """In stored specifications, files of the version before, checkpoints and evaluations."""
    from naosprint.rl.checkpoint import read_manifest

    simulator = {"name": "embedded", "settle_steps": 50, **({} if exact is None else {"exact": exact})}
    before = {"robot": robot, "simulator": simulator}
    for spec in (read_stored(TrainingSpec, before), TrainingSpec.model_validate({"format": 1, **before})):
        assert (spec.simulator.engine, spec.simulator.settle_steps) == (engine, 50)
        assert (
            stored(spec)["format"] == formats.CURRENT[Kind.TRAINING] and stored(spec)["simulator"]["engine"] == engine
        )
    summary = formats.current(Kind.RESULT, {"format": 2, "training": before})
    assert TrainingSpec.model_validate(summary["training"]).simulator.engine == engine
    document = json.loads(
        next((ROOT / "packages/naopolicies/src").rglob(f"{robot}-sprint/checkpoint.json")).read_text()
    )
    document["format"], document["spec"]["simulator"] = 2, simulator
    write_manifest(tmp_path, document)
    assert read_manifest(tmp_path).spec.simulator.engine == engine


def write_manifest(folder: Path, document: dict[str, Any]) -> None:
    """Write the manifest of a checkpoint with the checksum of its specification."""
    written = {name: value for name, value in document["spec"].items() if name != "runtime"}
    text = json.dumps(written, sort_keys=True, separators=(",", ":"))
    document["spec_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    (folder / "checkpoint.json").write_text(json.dumps(document), encoding="utf-8")


@pytest.mark.parametrize("count", [1, 2])
def test_stages_with_one_candidate_are_stages(count: int, tmp_path: Path) -> None:
    """Which of several continued is not recorded: the error names the field, and what to do instead."""
    from naosprint.rl.checkpoint import CheckpointError, read_manifest

    stages = [{"steps": 1024}, {"steps": 512, "seed": 3, "candidates": count}]
    before = {"format": 2, "stages": stages}
    manifest = json.loads(next((ROOT / "packages/naopolicies/src").rglob("t1-sprint/checkpoint.json")).read_text())
    manifest["format"] = 3
    for stage in manifest["spec"]["stages"]:
        stage["candidates"] = count
    write_manifest(tmp_path, manifest)
    if count == 1:
        assert [(stage.steps, stage.seed) for stage in read_stored(TrainingSpec, before).stages] == [
            (1024, None),
            (512, 3),
        ]
        assert formats.current(Kind.RESULT, {"format": 3, "training": before})["training"]["stages"][1] == {
            "steps": 512,
            "seed": 3,
        }
        assert len(read_manifest(tmp_path).spec.stages) == 2
        return
    words = r"stages\.{}\.candidates: a stage trains one policy; run a study of seeds"
    with pytest.raises(ValidationError, match=words.format(1)):
        read_stored(TrainingSpec, before)
    with pytest.raises(formats.FormatError, match=words.format(1)):
        formats.current(Kind.RESULT, {"format": 3, "training": before})
    with pytest.raises(CheckpointError, match=words.format(0)):
        read_manifest(tmp_path)


@pytest.mark.parametrize("compiled", [True, False])
def test_the_compiled_update_is_a_setting_of_ppo(compiled: bool) -> None:
    """It changes the last digits of a result, so two specifications that differ in it have two digests."""
    before = {"format": 2, "algorithm": {"name": "ppo", "n_envs": 32}, "runtime": {"compiled_update": compiled}}
    spec = read_stored(TrainingSpec, before)
    assert spec == TrainingSpec(algorithm={"n_envs": 32, "compiled_update": compiled})
    assert (spec.digest() == TrainingSpec(algorithm={"n_envs": 32}).digest()) == compiled
    with pytest.raises(ValidationError, match=r"write algorithm\.compiled_update") as refused:
        TrainingSpec(runtime={"compiled_update": compiled})
    assert refused.value.errors()[0]["loc"] == ("runtime", "compiled_update")


def test_the_error_about_candidates_names_what_replaces_them() -> None:
    """In a file that a user writes."""
    with pytest.raises(ValidationError) as refused:
        TrainingSpec.model_validate({"stages": [{"steps": 512}, {"steps": 512, "candidates": 2}]})
    (error,) = refused.value.errors()
    assert error["loc"] == ("stages", 1, "candidates")
    assert "naoctl tune --space seed=0..99" in error["msg"]


@pytest.mark.parametrize(("exact", "engine"), [(True, "mujoco"), (False, "fast"), ("true", "mujoco")])
def test_the_error_about_exact_names_the_new_field(exact: object, engine: str) -> None:
    with pytest.raises(ValidationError, match=f"exact was replaced; write engine: {engine}"):
        TrainingSpec.model_validate({"robot": "t1", "simulator": {"exact": exact}})


def test_a_nao_has_no_engine_to_choose() -> None:
    assert "engine" not in read_stored(TrainingSpec, {"simulator": {"name": "embedded"}}).simulator.model_dump()


@pytest.mark.parametrize("broken", [None, [], "embedded", {"exact": []}])
def test_a_simulator_that_is_none_is_left_to_its_validation(broken: object) -> None:
    assert formats.current(Kind.TRAINING, {"format": 1, "simulator": broken})
    assert formats.current(Kind.CHECKPOINT, {"format": 2, "spec": broken})


@pytest.mark.parametrize("kind", list(Kind))
def test_a_newer_format_is_one_sentence(kind: Kind) -> None:
    number = formats.CURRENT[kind] + 1
    with pytest.raises(formats.FormatError, match=rf"^format {number} of this {kind} is of a newer version.*Upgrade"):
        formats.current(kind, {"format": number})


def test_a_format_without_conversion_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        formats.FormatError, match=r"^format 1 of this checkpoint is too old: this version reads formats 2 to 5$"
    ):
        formats.current(Kind.CHECKPOINT, {"format": 1})
    raise_number(monkeypatch, Kind.CHECKPOINT, dict)
    with pytest.raises(formats.FormatError, match=r"reads formats 2 to 6$"):
        formats.current(Kind.CHECKPOINT, {"format": 1})


@pytest.mark.parametrize("number", ["2", None, 2.5, True, [1]])
def test_a_number_that_is_none_names_the_field(number: Any) -> None:
    with pytest.raises(ValidationError, match="format: expected the number"):
        TrainingSpec.model_validate({"format": number})


def test_a_checkpoint_of_the_format_before_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from naosprint.rl.checkpoint import CheckpointError, read_manifest

    policy = next((ROOT / "packages/naopolicies/src").rglob("sprint-hour/checkpoint.json"))
    number = formats.CURRENT[Kind.CHECKPOINT]
    document = formats.current(Kind.CHECKPOINT, json.loads(policy.read_text(encoding="utf-8")))
    assert document["format"] == number
    expected = read_manifest(policy.parent)
    document["rounds"] = document.pop("updates")
    (tmp_path / "checkpoint.json").write_text(json.dumps(document), encoding="utf-8")

    def convert(old: dict[str, Any]) -> dict[str, Any]:
        return {**{name: value for name, value in old.items() if name != "rounds"}, "updates": old["rounds"]}

    raise_number(monkeypatch, Kind.CHECKPOINT, convert)
    assert read_manifest(tmp_path).model_dump() == {**expected.model_dump(), "format": number + 1}
    monkeypatch.undo()
    document["format"] = number + 1
    (tmp_path / "checkpoint.json").write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(CheckpointError, match="newer version of naosprint"):
        read_manifest(tmp_path)
