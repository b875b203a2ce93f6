"""The limit of request bodies."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from naosprint_api.middleware import BodyLimit
from naosprint_api.problems import ProblemError
from starlette.types import Message, Receive, Scope, Send


async def read_all(scope: Scope, receive: Receive, send: Send) -> None:
    """Read the body and answer with its length."""
    size, more = 0, True
    while more:
        message = await receive()
        size += len(message.get("body", b""))
        more = message.get("more_body", False)
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": str(size).encode()})


def exchange(pieces: list[bytes], headers: dict[str, str], max_bytes: int = 100) -> tuple[int, int]:
    """Send `pieces`; return the status and how many of them were read."""
    sent: list[Message] = []
    read = 0

    async def receive() -> Message:
        nonlocal read
        read += 1
        return {"type": "http.request", "body": pieces[read - 1], "more_body": read < len(pieces)}

    async def send(message: Message) -> None:
        sent.append(message)

    scope: dict[str, Any] = {
        "type": "http",
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
    }
    try:
        asyncio.run(BodyLimit(read_all, max_bytes)(scope, receive, send))
    except ProblemError as error:
        return error.status_code, read
    return sent[0]["status"], read


@pytest.mark.parametrize("announce", [True, False])
@pytest.mark.parametrize(("size", "status"), [(0, 200), (99, 200), (100, 200), (101, 413), (1_000, 413)])
def test_the_limit_is_exact(size: int, status: int, announce: bool) -> None:
    pieces = [b"x"] * size or [b""]
    headers = {"content-length": str(size)} if announce else {}
    found, read = exchange(pieces, headers)
    assert found == status
    assert read == len(pieces), "a body that is not much too large is read to its end"


def test_of_a_huge_body_little_is_read() -> None:
    pieces = [b"x" * 100] * 1_000
    assert exchange(pieces, {"content-length": "100000"}) == (413, 0)
    status, read = exchange(pieces, {})
    assert status == 413
    assert read < 20


@pytest.mark.parametrize("length", ["-1", "x", "1e3", "\u0661"])
def test_a_strange_length_is_refused(length: str) -> None:
    assert exchange([b""], {"content-length": length})[0] == 413
