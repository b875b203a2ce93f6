"""Values of metrics as users see them."""

from __future__ import annotations

import pytest
from naospec.metrics import Metric, format_value


@pytest.mark.parametrize(
    ("unit", "value", "text"),
    [
        ("m/s", -0.004, "0.00 m/s"),
        ("m/s", -0.006, "-0.01 m/s"),
        ("m", -1234.5, "-1,234.50 m"),
        ("°", -0.001, "0.00°"),
        ("%", -0.00001, "0.00 %"),
        ("", -0.0, "0.00"),
        ("", None, "-"),
    ],
)
def test_a_value_that_is_rounded_to_zero_has_no_sign(unit: str, value: float | None, text: str) -> None:
    assert format_value(Metric("lead", "Lead", unit), value) == text
