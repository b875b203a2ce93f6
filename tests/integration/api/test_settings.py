"""Settings of the API that differ from their defaults."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest


@pytest.mark.parametrize(("public", "status"), [(True, 200), (False, 404)])
def test_the_description_is_public_unless_it_is_disabled(
    start_api: Callable[..., Any], public: bool, status: int
) -> None:
    api = start_api(api_docs_public=public)
    assert httpx.get(f"{api.url}/openapi.json").status_code == status
    assert httpx.get(f"{api.url}/ui/").status_code == 200


def test_a_body_may_have_the_bytes_that_are_set(start_api: Callable[..., Any], make_token: Callable[..., str]) -> None:
    api = start_api(api_max_body_bytes=2048)
    headers = {"Authorization": f"Bearer {make_token('alice', 'submit')}", "Content-Type": "application/json"}
    body = json.dumps({}).encode().ljust(2048)
    assert httpx.post(f"{api.url}/jobs", content=body, headers=headers).status_code == 201
    answer = httpx.post(f"{api.url}/jobs", content=body + b" ", headers=headers)
    assert (answer.status_code, answer.json()["detail"]) == (413, "the body is larger than 2048 bytes; send less")
