"""The league over HTTP: one ranking is computed at a time, and no other request waits for it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
from naoctl.client import NO_CERTIFICATES
from naojobs import league
from naojobs.league import Results, Standing

from tests.integration.conftest import RunningApi

CALLERS = 60
"""More than the API has threads."""


def test_a_ranking_that_takes_long_holds_no_other_request_up(
    api: RunningApi, make_token: Callable[..., str], client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, free = threading.Event(), threading.Event()
    rankings: list[int] = []
    standings = league.standings

    def slow(results: Iterable[Results]) -> list[Standing]:
        rankings.append(threading.get_ident())
        begun.set()
        assert free.wait(60)
        return standings(results)

    monkeypatch.setattr(league, "standings", slow)
    headers = {"Authorization": f"Bearer {make_token('bob', 'read')}"}

    def ask(_: int) -> int:
        return httpx.get(f"{api.url}/league", headers=headers, timeout=60, verify=NO_CERTIFICATES).status_code

    with ThreadPoolExecutor(CALLERS) as pool:
        asked = [pool.submit(ask, number) for number in range(CALLERS)]
        try:
            assert begun.wait(60)
            deadline = time.monotonic() + 30
            while len(api.server.server_state.connections) < CALLERS:
                assert time.monotonic() < deadline
                time.sleep(0.05)
            assert client.get("/jobs", timeout=20).status_code == 200
            assert not any(each.done() for each in asked)
        finally:
            free.set()
        assert {each.result() for each in asked} == {200}
    assert len(rankings) == 1, "those that waited get the ranking that the first has computed"
