"""Readable JSON contains the same values, with arrays on one line."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from naospec.json_text import json_text

scalars = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"]))
)
documents = st.recursive(
    scalars,
    lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner),
    max_leaves=60,
)


@given(documents)
def test_the_text_has_the_same_values(value: Any) -> None:
    assert json.loads(json_text(value)) == value


def test_long_arrays_stay_on_one_line_and_long_objects_do_not() -> None:
    text = json_text({"curve": [0.25] * 500, "results": [{"name": "speed", "text": "x" * 1190}] * 2})
    assert [len(line.split(",")) for line in text.splitlines() if "0.25" in line] == [501]
    assert [line.strip() for line in text.splitlines()][2:5] == ['"results": [', "{", '"name": "speed",']


def test_keys_are_sorted_on_request() -> None:
    assert json_text({"b": 1, "a": {"d": 2, "c": 3}}, sort_keys=True) == '{"a": {"c": 3, "d": 2}, "b": 1}\n'


def test_a_number_that_is_not_finite_is_an_error() -> None:
    with pytest.raises(ValueError, match="JSON"):
        json_text({"value": math.nan})
