"""``naoctl open``: the page in the browser, with the token in a file of the user's own instead of on a command line."""

from __future__ import annotations

import json
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

from .conftest import Home, Ran


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The addresses that the browser is given."""
    addresses: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: addresses.append(url) is None)
    return addresses


def test_a_jobs_page_opens_signed_in(
    server: Any, naoctl: Callable[..., Ran], job: Callable[..., dict[str, Any]], opened: list[str], home: Home
) -> None:
    server.on("GET", "/jobs")(lambda request: request.json({"items": [job()], "next_cursor": None}))
    ran = naoctl("open", "first")
    url = f"{server.url}/#/jobs/{job()['id']}"
    assert (ran.code, ran.out) == (0, f"{url}\n")
    (address,) = opened
    page = Path(unquote(urlsplit(address).path))
    assert page.parent == home.config.parent and page.stat().st_mode & 0o777 == 0o600
    assert f"url={url}?token=nao_test" in page.read_text(encoding="utf-8")
    assert "nao_test" not in address


@pytest.mark.parametrize(("page", "path"), [("jobs", "/"), ("policies", "/policies"), ("submit", "/submit")])
def test_pages_have_names(server: Any, naoctl: Callable[..., Ran], opened: list[str], page: str, path: str) -> None:
    assert naoctl("open", page, "--print").out == f"{server.url}/#{path}\n"
    assert json.loads(naoctl("open", page, "--json").out) == {"url": f"{server.url}/#{path}"}
    assert not opened


def test_without_a_browser_the_address_is_enough(
    server: Any, naoctl: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda url: False)
    ran = naoctl("open")
    assert ran.out == f"{server.url}/#/\n"
    assert "no browser" in ran.err
