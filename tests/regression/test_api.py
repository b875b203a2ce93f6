"""The API gives the recorded responses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from . import runs
from .comparison import differences, message, read_record

RECORD = read_record("api")


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    return runs.run_script(Path(__file__).with_name("api_scenario.py"))


def test_the_requests_are_those_on_record(found: dict[str, Any]) -> None:
    assert sorted(found) == sorted(RECORD)


@pytest.mark.parametrize("request_line", sorted(RECORD))
def test_a_response_is_the_recorded_one(found: dict[str, Any], request_line: str) -> None:
    lines = differences(RECORD[request_line], found[request_line], request_line)
    assert not lines, message(lines)
