"""Patterns of text in requests have descriptions, so that no error shows a regular expression."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.exceptions import RequestValidationError
from naojobs.submission import INVISIBLE
from naosprint_api.app import openapi_document
from naosprint_api.patterns import PLAIN, WORDS
from naosprint_api.problems import field_errors
from naosprint_api.schemas.jobs import JobCreate
from pydantic import ValidationError


def patterns(document: Any) -> Iterator[str]:
    if isinstance(document, dict):
        if isinstance(document.get("pattern"), str):
            yield document["pattern"]
        for value in document.values():
            yield from patterns(value)
    elif isinstance(document, list):
        for value in document:
            yield from patterns(value)


def test_every_pattern_of_the_api_has_words() -> None:
    found = set(patterns(openapi_document()))
    assert len(found) > 3
    assert found <= WORDS.keys()


@pytest.mark.parametrize(
    ("body", "field"),
    [({"tags": ["not ok"]}, "tags.0"), ({"name": "a\tb"}, "name"), ({"parent_job_id": "x"}, "parent_job_id")],
)
def test_errors_have_no_regular_expression(body: dict[str, Any], field: str) -> None:
    with pytest.raises(ValidationError) as caught:
        JobCreate.model_validate(body)
    errors = [{**item, "loc": ("body", *item["loc"])} for item in caught.value.errors()]
    (error,) = field_errors(RequestValidationError(errors))
    assert error.field == field
    assert error.message.startswith("expected ")
    assert not set("^$[]\\") & set(error.message)


def test_names_exclude_every_invisible_character_of_the_basic_plane() -> None:
    allowed = re.compile(PLAIN)
    for number in range(0x10000):
        if not 0xD800 <= number < 0xE000:
            expected = unicodedata.category(chr(number)) not in INVISIBLE
            assert (allowed.fullmatch(chr(number)) is not None) is expected, hex(number)
