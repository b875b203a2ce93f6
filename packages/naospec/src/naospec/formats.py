"""Formats of what is stored, by number, and how each is read from the one before.

A change that older data does not fit raises the number here and adds a conversion from the number before, which may
stay until the next release but one: every version reads what the version before has written. Where a value has no place
in the new format, the conversion raises `FormatError` with a sentence; a migration then stops before it changes
anything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any


class Kind(StrEnum):
    """Kind of stored document."""

    TRAINING = "training specification"
    EVALUATION = "evaluation specification"
    CHECKPOINT = "checkpoint"
    """`checkpoint.json` with the specification in it."""
    RESULT = "evaluation"
    """`evaluation.json` with the specifications in it."""


class FormatError(ValueError):
    """Document of a format that this version cannot read."""


CURRENT: dict[Kind, int] = {Kind.TRAINING: 3, Kind.EVALUATION: 1, Kind.CHECKPOINT: 5, Kind.RESULT: 4}
"""The formats that this version writes."""

UNNUMBERED: Mapping[Kind, int] = {Kind.TRAINING: 1, Kind.EVALUATION: 1}
"""Formats of stored documents without a number; all others have one."""

Document = dict[str, Any]


def _engine(spec: Document) -> Document:
    """Convert a training specification: ``simulator.exact`` became ``engine``."""
    simulator = spec.get("simulator")
    if not isinstance(simulator, Mapping) or "exact" not in simulator:
        return spec
    others = {name: value for name, value in simulator.items() if name != "exact"}
    return {**spec, "simulator": {**others, "engine": "mujoco" if simulator["exact"] is True else "fast"}}


CANDIDATES_ARE_STUDIES = (
    "a stage trains one policy; run a study of seeds (naoctl tune --space seed=0..99) and continue from its best job "
    "(naoctl submit --from JOB)"
)
"""What replaces a stage's ``candidates``, of which the best continued."""


def _one_candidate(spec: Document) -> Document:
    """Convert a training specification: every stage trains one policy."""
    stages = spec.get("stages")
    if not isinstance(stages, list | tuple) or not all(isinstance(stage, Mapping) for stage in stages):
        return spec
    for number, stage in enumerate(stages):
        if stage.get("candidates", 1) != 1:
            # which of them continued is not recorded
            raise FormatError(f"stages.{number}.candidates: {CANDIDATES_ARE_STUDIES}")
    one = [{name: value for name, value in stage.items() if name != "candidates"} for stage in stages]
    return {**spec, "stages": one}


def _compiled_update(spec: Document) -> Document:
    """Convert a training specification: ``runtime.compiled_update``, which changes the last digits, is PPO's."""
    runtime, algorithm = spec.get("runtime"), spec.get("algorithm", {})
    if not isinstance(runtime, Mapping) or "compiled_update" not in runtime:
        return spec
    others = {name: value for name, value in runtime.items() if name != "compiled_update"}
    if isinstance(algorithm, Mapping) and algorithm.get("name", "ppo") == "ppo":
        algorithm = {**algorithm, "compiled_update": runtime["compiled_update"]}
    return {**spec, "runtime": others, "algorithm": algorithm}


def _version_3(spec: Document) -> Document:
    """Convert a training specification of format 2."""
    return _compiled_update(_one_candidate(spec))


def _within(section: str, convert: Callable[[Document], Document]) -> Callable[[Document], Document]:
    """Return the conversion of a document that contains a training specification."""

    def whole(document: Document) -> Document:
        spec = document.get(section)
        return {**document, section: convert(dict(spec))} if isinstance(spec, Mapping) else document

    return whole


CONVERSIONS: dict[tuple[Kind, int], Callable[[Document], Document]] = {
    (Kind.TRAINING, 1): _engine,
    (Kind.TRAINING, 2): _version_3,
    (Kind.CHECKPOINT, 2): _within("spec", _engine),
    (Kind.CHECKPOINT, 3): _within("spec", _version_3),
    (Kind.CHECKPOINT, 4): dict,  # has no names of what only a critic observes
    (Kind.RESULT, 2): _within("training", _engine),
    (Kind.RESULT, 3): _within("training", _version_3),
}
"""From each older format that can be read, the function that returns a document of the next one."""


def current(kind: Kind, document: Mapping[str, Any]) -> Document:
    """Return a document in the format that this version writes, with its number if the kind has one.

    Raises:
        FormatError: it is of a newer version, or too old.
    """
    content = dict(document)
    unnumbered = UNNUMBERED.get(kind)
    number = content.pop("format", unnumbered)
    if not isinstance(number, int) or isinstance(number, bool):
        raise FormatError(f"format: expected the number of the {kind}'s format, got {number!r}")
    newest = CURRENT[kind]
    if number > newest:
        raise FormatError(
            f"format {number} of this {kind} is of a newer version of naosprint; this one reads up to {newest}. "
            "Upgrade naosprint."
        )
    while number < newest:
        convert = CONVERSIONS.get((kind, number))
        if convert is None:
            raise FormatError(f"format {number} of this {kind} is too old: this version reads {_read(kind)}")
        content, number = convert(content), number + 1
    return content if unnumbered is not None else {"format": number, **content}


def numbered(kind: Kind, document: Mapping[str, Any]) -> Document:
    """Return a document of the current format as it is stored: with its number, unless that is what none means."""
    if CURRENT[kind] == UNNUMBERED.get(kind):
        return dict(document)
    return {"format": CURRENT[kind], **document}


def _read(kind: Kind) -> str:
    oldest = newest = CURRENT[kind]
    while (kind, oldest - 1) in CONVERSIONS:
        oldest -= 1
    return f"format {newest}" if oldest == newest else f"formats {oldest} to {newest}"
