"""How the members of a population go on."""

from __future__ import annotations

from random import Random
from typing import Any

import pytest
from naojobs.models import Trial, TrialState
from naospec.search import Parameter, SearchSpec
from naosprint_worker.population import _perturbed, is_due, start_of
from pydantic import TypeAdapter

SPACE = {
    "learning_rate": {"type": "float", "low": 1e-4, "high": 1e-3, "log": True},
    "gae_lambda": {"type": "float", "low": 0.9, "high": 1.0},
    "n_epochs": {"type": "int", "low": 1, "high": 3},
    "batch_size": {"type": "choice", "choices": [64, 128, 256]},
}
PARAMS = {"learning_rate": 5e-4, "gae_lambda": 0.95, "n_epochs": 2, "batch_size": 128}


def search(direction: str = "maximize", **fields: Any) -> SearchSpec:
    objectives = [{"metric": "reward", "direction": direction}]
    content = {"space": SPACE, "objectives": objectives, "sampler": "population", "population": 8, "trials": 24}
    return SearchSpec.model_validate({**content, **fields})


def generation(values: list[float | None]) -> dict[int, Trial]:
    """Return the trials of the first generation; those without a value have failed."""
    return {
        number: Trial(
            study_id="study_1",
            number=number,
            job_id=f"job_{number}",
            params={**PARAMS, "gae_lambda": 0.9 + number / 100},
            state=TrialState.COMPLETE if value is not None else TrialState.FAILED,
            values=[value] if value is not None else None,
        )
        for number, value in enumerate(values)
    }


def parents(spec: SearchSpec, trials: dict[int, Trial]) -> list[int | None]:
    starts = [start_of(spec, trials, number) for number in range(8, 16)]
    return [start.parent.number if start.parent else None for start in starts]


def test_the_first_generation_starts_from_nothing() -> None:
    assert all(is_due(search(), {}, number) for number in range(8))
    assert start_of(search(), {}, 3).parent is None


def test_a_generation_waits_for_the_one_before() -> None:
    trials = generation([1.0] * 8)
    assert is_due(search(), trials, 8)
    trials[7].state = TrialState.RUNNING
    assert not is_due(search(), trials, 8)
    assert not is_due(search(), trials, 15)
    del trials[7]
    assert not is_due(search(), trials, 8)


@pytest.mark.parametrize("direction", ["maximize", "minimize"])
def test_the_worst_quarter_continues_from_the_best(direction: str) -> None:
    sign = 1.0 if direction == "maximize" else -1.0
    trials = generation([sign * value for value in (5.0, 1.0, 7.0, 2.0, 8.0, 3.0, 4.0, 6.0)])
    chosen = parents(search(direction), trials)
    assert [chosen[member] for member in (0, 2, 4, 5, 6, 7)] == [0, 2, 4, 5, 6, 7]
    assert {chosen[1], chosen[3]} <= {2, 4}
    assert start_of(search(direction), trials, 8).params == trials[0].params


def test_a_member_that_failed_continues_from_the_best() -> None:
    trials = generation([5.0, None, 7.0, 2.0, 8.0, 3.0, 4.0, 6.0])
    trials[0].job_id = None  # deleted
    chosen = parents(search(), trials)
    assert {chosen[0], chosen[1]} <= {2, 4}
    assert [chosen[member] for member in (2, 3, 4, 5, 6, 7)] == [2, 3, 4, 5, 6, 7]


def test_a_generation_without_a_policy_starts_again() -> None:
    assert parents(search(), generation([None] * 8)) == [None] * 8


def test_perturbed_settings_stay_in_their_ranges_and_every_worker_chooses_the_same() -> None:
    trials = generation([float(number) for number in range(8)])
    changed = set()
    for seed in range(200):
        spec = search(seed=seed)
        start = start_of(spec, trials, 8)
        assert start == start_of(spec, trials, 8)
        assert start.parent is not None
        before, after = start.parent.params, start.params
        changed |= {name for name in SPACE if before[name] != after[name]}
        assert after["learning_rate"] in (pytest.approx(4e-4), pytest.approx(6e-4))
        assert after["n_epochs"] in (1, 3)
        assert 0.9 <= after["gae_lambda"] <= 1.0
        assert after["batch_size"] in (64, 128, 256)
    assert changed == set(SPACE)


@pytest.mark.parametrize(
    ("kind", "grid"),
    [
        ("float", [0.0, 0.25, 0.5, 0.75, 1.0]),
        ("float", [0.9, 0.93, 0.96, 0.99]),
        ("float", [0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9]),
        ("float", [-3.0, -2.5, -2.0, -1.5, -1.0]),
        ("float", [round(0.01 * k, 2) for k in range(100)]),
        ("int", [1, 3, 5, 7]),
        ("int", list(range(0, 99, 3))),
    ],
)
def test_settings_on_a_grid_change_and_stay_on_it(kind: str, grid: list[Any]) -> None:
    """Also where a step is more than the usual change, and where the range ends between two values."""
    step, random = round(grid[1] - grid[0], 2), Random(0)
    for high in (grid[-1], grid[-1] + (step / 3 if kind == "float" else step - 1)):
        item = TypeAdapter(Parameter).validate_python({"type": kind, "low": grid[0], "high": high, "step": step})
        for i, value in enumerate(grid):
            found = {_perturbed(item, value, random) for _ in range(50)}
            assert found <= set(grid), value
            if 0 < i < len(grid) - 1:
                assert value not in found
                assert min(found) < value < max(found)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"trials": 15}, "two generations"),
        ({"pruning": {"name": "median"}}, "pruning none"),
        ({"objectives": [{"metric": "a"}, {"metric": "b"}]}, "a single one"),
    ],
)
def test_a_population_that_cannot_work_is_refused(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        search(**fields)
