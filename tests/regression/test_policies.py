"""Evaluations of the bundled policies give the recorded results."""

from __future__ import annotations

from typing import Any

import pytest

from . import runs
from .comparison import differences, message, outside, read_record

pytestmark = pytest.mark.timeout(600)

RECORD = read_record("policies")


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    return runs.run("evaluations")


def test_the_policies_are_those_on_record(found: dict[str, Any]) -> None:
    assert sorted(found["results"]) == sorted(RECORD["results"])


@pytest.mark.parametrize("name", sorted(RECORD["results"]))
def test_an_evaluation_gives_the_recorded_results(found: dict[str, Any], name: str) -> None:
    recorded, evaluated = RECORD["results"][name], found["results"][name]
    if found["platform"] == RECORD["platform"]:
        lines = differences(recorded, evaluated, name)
    else:
        lines = close(recorded["summary"], evaluated["summary"], name)
    assert not lines, message(lines)


def close(recorded: dict[str, Any], evaluated: dict[str, Any], name: str) -> list[str]:
    """Compare results that hardly depend on rounding: the means over the episodes, and the number of falls."""
    lines = differences({"episodes": recorded["episodes"]}, {"episodes": evaluated["episodes"]}, name)
    if "results" in recorded:
        old, new = ({result["name"]: result["value"] for result in one["results"]} for one in (recorded, evaluated))
        lines += outside(old["rmse_mps"], new["rmse_mps"], f"{name}.rmse_mps", relative=0.1)
        return lines + outside(old["upright_rate"], new["upright_rate"], f"{name}.upright_rate", absolute=0.05)
    for metric in ("distance_m", "speed_mps"):
        lines += outside(recorded[metric]["mean"], evaluated[metric]["mean"], f"{name}.{metric}.mean", relative=0.03)
    lines += outside(recorded["falls"]["rate"], evaluated["falls"]["rate"], f"{name}.falls.rate", absolute=0.05)
    return lines


def test_the_tolerances_of_other_machines_find_a_worse_policy() -> None:
    recorded = RECORD["results"]["sprint"]["summary"]
    worse = {
        **recorded,
        "speed_mps": {"mean": 0.96 * recorded["speed_mps"]["mean"]},
        "falls": {"rate": recorded["falls"]["rate"] + 0.06},
    }
    assert close(recorded, recorded, "sprint") == []
    assert [line.split(":")[0] for line in close(recorded, worse, "sprint")] == [
        "sprint.speed_mps.mean",
        "sprint.falls.rate",
    ]
