"""Short trainings end with the recorded weights, learner and environments."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from . import runs
from .comparison import differences, message, outside, read_record

pytestmark = pytest.mark.timeout(600)

RECORD = read_record("trainings")


@pytest.fixture(scope="module")
def found() -> dict[str, dict[str, Any]]:
    presets = sorted(RECORD["results"])
    with ThreadPoolExecutor() as pool:
        return dict(zip(presets, pool.map(runs.run, [f"training-{preset}" for preset in presets]), strict=True))


@pytest.mark.parametrize("preset", sorted(RECORD["results"]))
def test_a_training_ends_with_the_recorded_arrays(found: dict[str, dict[str, Any]], preset: str) -> None:
    recorded, trained = RECORD["results"][preset], found[preset]["results"]
    if found[preset]["platform"] == RECORD["platform"]:
        lines = differences(
            {name: recorded[name] for name in ("metrics", "policy")},
            {name: trained[name] for name in ("metrics", "policy")},
            preset,
        )
        for file in ("learner", "environment"):
            lines += unmatched(recorded[file], trained[file], f"{preset}.{file}")
    else:
        lines = close(recorded, trained, preset)
    assert not lines, message(lines)


def test_a_bundled_policy_is_what_its_last_steps_give() -> None:
    verification = runs.run("verification")
    if verification["platform"] != RECORD["platform"]:
        pytest.skip("another machine computes other last digits")
    assert verification["results"] and not any(verification["results"].values()), verification["results"]


def unmatched(recorded: list[str], trained: list[str], name: str) -> list[str]:
    """Compare the arrays of a file by their hashes, regardless of their names."""
    missing, extra = Counter(recorded) - Counter(trained), Counter(trained) - Counter(recorded)
    return [
        *(f"{name}: no array has the recorded hash {digest}" for digest in missing.elements()),
        *(f"{name}: an array has the hash {digest}, which is not in the record" for digest in extra.elements()),
    ]


def close(recorded: dict[str, Any], trained: dict[str, Any], name: str) -> list[str]:
    """Compare results that hardly depend on rounding: the steps, the number of episodes, and what the files contain."""
    old, new = recorded["metrics"], trained["metrics"]
    lines = outside(old["step"], new["step"], f"{name}.metrics.step")
    lines += outside(old["episodes"], new["episodes"], f"{name}.metrics.episodes", relative=0.2)
    for part in ("metrics", "policy"):
        lines += differences(sorted(recorded[part]), sorted(trained[part]), f"{name}.{part}: names")
    for part in ("learner", "environment"):
        lines += differences(len(recorded[part]), len(trained[part]), f"{name}.{part}: number of arrays")
    return lines


def test_the_tolerances_of_other_machines_find_a_different_training() -> None:
    recorded = RECORD["results"]["fast"]
    other = {**recorded, "metrics": {**recorded["metrics"], "episodes": 0.7 * recorded["metrics"]["episodes"]}}
    assert close(recorded, recorded, "fast") == []
    assert [line.split(":")[0] for line in close(recorded, other, "fast")] == ["fast.metrics.episodes"]
