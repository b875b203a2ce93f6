"""Byte ranges."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from naosprint_api.downloads import parse_range
from naosprint_api.problems import ProblemError


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("bytes=0-9", (0, 10)),
        ("bytes=90-", (90, 100)),
        ("bytes=90-1000", (90, 100)),
        ("bytes=-5", (95, 100)),
        ("bytes=-1000", (0, 100)),
        (" bytes=0-0 ", (0, 1)),
        ("bytes=9-0", None),
        ("bytes=-", None),
        ("bytes=0-1,2-3", None),
        ("bytes=0x1-2", None),
        ("bytes=\u0661-2", None),
        ("items=0-1", None),
        ("bytes=" + "9" * 30 + "-", None),
    ],
)
def test_ranges(header: str, expected: tuple[int, int] | None) -> None:
    assert parse_range(header, 100) == expected


@pytest.mark.parametrize(("header", "size"), [("bytes=100-", 100), ("bytes=-0", 100), ("bytes=0-", 0), ("bytes=-1", 0)])
def test_outside(header: str, size: int) -> None:
    with pytest.raises(ProblemError) as caught:
        parse_range(header, size)
    assert caught.value.status_code == 416
    assert caught.value.headers == {"Content-Range": f"bytes */{size}"}


@given(st.text(alphabet="bytes=0123456789-, ", max_size=30), st.integers(0, 200))
def test_no_header_gets_bytes_that_are_not_there(header: str, size: int) -> None:
    try:
        part = parse_range(header, size)
    except ProblemError:
        return
    if part is not None:
        start, stop = part
        assert 0 <= start < stop <= size
