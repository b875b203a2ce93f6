"""Specifications of searches."""

from __future__ import annotations

from typing import Any

import pytest
from naospec.search import SearchSpec
from pydantic import ValidationError

WIDE = {"type": "int", "low": 1, "high": 2**63 - 1}


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({"type": "float", "low": 1e-4, "high": 1e-3, "step": 1e-300}, "more than 1,000,000 values; use a larger step"),
        ({"type": "float", "low": -1e308, "high": 1e308, "step": 1.0}, "more than 1,000,000 values; use a larger step"),
        ({"type": "int", "low": 0, "high": 10_000_000, "step": 2}, "more than 1,000,000 values; use a larger step"),
        (WIDE, "less than or equal to 9007199254740992"),
        ({**WIDE, "low": -(2**63), "high": 1}, "greater than or equal to -9007199254740992"),
        ({"type": "float", "low": 2.0, "high": 1.0}, r"expected a number above low \(2\), got 1"),
    ],
)
def test_ranges_that_no_sampler_can_sample_are_refused(space: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        SearchSpec.model_validate({"space": {"learning_rate": space}})


def test_ranges_may_be_wide_without_steps_and_have_as_many_values_as_they_say() -> None:
    for space in ({"type": "int", "low": 0, "high": 2**53}, {"type": "float", "low": 0, "high": 1, "step": 1e-6}):
        assert SearchSpec.model_validate({"space": {"learning_rate": space}})
