from __future__ import annotations

import os
import socket
import urllib.request
from collections.abc import Callable
from typing import Any

import pytest
from naoctl.client import ApiError, Client, StreamEvent
from naoctl.config import Target
from naoctl.errors import CliError, ExitCode, Unreachable
from naospec.proxies import exempt_loopback, is_loopback


def no_sleep(seconds: float) -> None:
    pass


def test_requests_carry_token_and_query(server: Any, client: Client) -> None:
    @server.on("GET", "/jobs")
    def answer(request: Any) -> None:
        request.json({"items": []})

    assert client.get("/jobs", state=["queued", "running"], owner=None) == {"items": []}
    asked = server.received[0]
    assert asked.headers["Authorization"] == "Bearer nao_test"
    assert asked.query == {"state": ["queued", "running"]}


def test_pages_follow_the_cursor_and_stop_at_the_limit(server: Any, client: Client) -> None:
    @server.on("GET", "/jobs")
    def answer(request: Any) -> None:
        query = server.received[-1].query
        start = int(query.get("cursor", ["0"])[0])
        count = min(int(query["limit"][0]), 100)  # a page may be shorter than asked for
        request.json({"items": [{"n": n} for n in range(start, start + count)], "next_cursor": str(start + count)})

    found = list(client.pages("/jobs", limit=250))
    assert [item["n"] for item in found] == list(range(250))
    assert [asked.query["limit"] for asked in server.received] == [["200"], ["150"], ["50"]]


@pytest.mark.parametrize(
    ("status", "code", "words"),
    [
        (401, ExitCode.DENIED, "naoctl login"),
        (403, ExitCode.DENIED, "administrator"),
        (404, ExitCode.NOT_FOUND, "naoctl list"),
        (409, ExitCode.CONFLICT, "naoctl status"),
        (422, ExitCode.USAGE, "No such thing"),
        (429, ExitCode.FAILURE, "Try again in 7 s"),
        (500, ExitCode.FAILURE, "naoctl doctor"),
        (503, ExitCode.FAILURE, "503"),
    ],
)
def test_every_refusal_has_words_a_fix_and_a_code(
    server: Any, client: Client, status: int, code: ExitCode, words: str
) -> None:
    server.on("GET", "/jobs/x")(lambda request: request.problem(status, "no such thing", retry_after="7"))
    with pytest.raises(ApiError) as caught:
        client.get("/jobs/x")
    assert caught.value.code is code
    assert caught.value.status == status
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("path", "detail", "shown", "fix"),
    [
        ("/studies/a/trials/7/tell", "study a has no trial 7", "Study a has no trial 7", "naoctl study list"),
        ("/matches/m", "no match m", "No match m", "naoctl match list"),
        (
            "/policies/t1-sprint",
            "t1-sprint is a bundled policy",
            "t1-sprint is a bundled policy",
            "naoctl policies list",
        ),
        ("/policies/sprint", "sprint is a bundled policy", "sprint is a bundled policy", "naoctl policies list"),
        ("/usage", "no owner x", "No owner x", ""),
    ],
)
def test_what_does_not_exist_is_looked_up_where_it_would_be(
    server: Any, client: Client, path: str, detail: str, shown: str, fix: str
) -> None:
    server.on("GET", path)(lambda request: request.problem(404, detail))
    with pytest.raises(ApiError) as caught:
        client.get(path)
    assert caught.value.message == shown
    assert fix in (caught.value.fix or "") and bool(fix) == bool(caught.value.fix)


def test_wrong_fields_are_named(server: Any, client: Client) -> None:
    errors = [{"field": "tags.0", "message": "too long"}, {"field": "priority", "message": "at most 9"}]
    server.on("POST", "/jobs")(lambda request: request.problem(422, "see errors", errors))
    with pytest.raises(ApiError, match=r"tags\.0: too long; priority: at most 9"):
        client.post("/jobs", {})


def test_words_of_the_service_cannot_steer_the_terminal(server: Any, client: Client) -> None:
    server.on("GET", "/x")(lambda request: request.problem(409, "bad\x1b[2J\nstate"))
    with pytest.raises(ApiError) as caught:
        client.get("/x")
    assert caught.value.message == "Bad [2J state"


def test_a_missing_token_is_told_from_a_wrong_one(server: Any) -> None:
    server.on("GET", "/x")(lambda request: request.problem(401, "the token is unknown"))
    with Client(Target(server.url, None)) as client, pytest.raises(ApiError, match="requires a token"):
        client.get("/x")


def test_a_redirect_does_not_take_the_token_along(server: Any, client: Client) -> None:
    server.on("GET", "/x")(lambda request: request.raw(b"", 302, location="http://elsewhere.example/"))
    with pytest.raises(ApiError, match=r"elsewhere\.example"):
        client.get("/x")


def test_something_that_is_no_naosprint_service(server: Any, client: Client) -> None:
    server.on("GET", "/x")(lambda request: request.raw(b"<html>", content_type="text/html"))
    with pytest.raises(CliError, match="other than JSON"):
        client.get("/x")
    server.on("GET", "/y")(lambda request: request.raw(b"<html>", 500, content_type="text/html"))
    with pytest.raises(ApiError, match="failed with status 500"):
        client.get("/y")


def test_nobody_at_home() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{probe.getsockname()[1]}"
    with Client(Target(url, None)) as client, pytest.raises(Unreachable) as caught:
        client.get("/jobs")
    assert caught.value.code is ExitCode.UNREACHABLE
    assert "connection refused" in str(caught.value)
    assert "naoctl up" in str(caught.value)


def test_a_stream_goes_on_behind_the_last_event(server: Any, client: Client, event: Callable[..., str]) -> None:
    parts = [
        (event("metrics", {"step": 1}, "1-0-0"), event("metrics", {"step": 2}, "2-0-0")),
        (": still here\n\n", event("metrics", {"step": 3}, "3-0-0"), "id: 4-0-0\nevent: metrics\ndata: {cut"),
        (event("end", {"state": "succeeded"}, "4-0-0"),),
    ]

    @server.on("GET", "/stream")
    def answer(request: Any) -> None:
        request.stream(*parts[len(server.received) - 1])

    lost: list[str] = []
    seen: list[StreamEvent] = []
    for message in client.events("/stream", on_lost=lambda reason, wait: lost.append(reason), sleep=no_sleep):
        seen.append(message)
        if message.kind == "end":
            break
    assert [message.data.get("step") for message in seen] == [1, 2, 3, None]
    assert [asked.headers.get("Last-Event-ID") for asked in server.received] == [None, "2-0-0", "3-0-0"]
    assert len(lost) == 2


def test_a_stream_waits_for_a_service_that_starts(server: Any, client: Client, event: Callable[..., str]) -> None:
    @server.on("GET", "/stream")
    def answer(request: Any) -> None:
        if len(server.received) < 3:
            request.problem(503, "starting")
        else:
            request.stream(event("state", {"state": "queued"}, "1"))

    waits: list[float] = []
    first = next(client.events("/stream", on_lost=lambda reason, wait: waits.append(wait), sleep=no_sleep))
    assert first.data == {"state": "queued"}
    assert waits == [0.5, 1.0]


def test_a_stream_that_is_refused_is_not_asked_again(server: Any, client: Client) -> None:
    server.on("GET", "/stream")(lambda request: request.problem(404, "no job"))
    with pytest.raises(ApiError) as caught:
        next(client.events("/stream", sleep=no_sleep))
    assert caught.value.code is ExitCode.NOT_FOUND
    assert len(server.received) == 1


def test_a_stream_gives_up_when_nobody_comes_back() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{probe.getsockname()[1]}"
    with Client(Target(url, None)) as client, pytest.raises(Unreachable):
        next(client.events("/stream", patience_s=0.0, sleep=no_sleep))


@pytest.mark.parametrize("name", ["HTTP_PROXY", "ALL_PROXY", "http_proxy"])
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.2"])
def test_this_machine_is_never_reached_through_a_proxy(
    server: Any, monkeypatch: pytest.MonkeyPatch, name: str, host: str
) -> None:
    """The proxy would get the token, and cannot reach the service."""
    server.on("GET", "/jobs")(lambda request: request.json({"items": []}))
    with socket.create_server(("127.0.0.1", 0)) as proxy:
        proxy.setblocking(False)
        monkeypatch.setenv(name, f"http://127.0.0.1:{proxy.getsockname()[1]}")
        url = server.url if host == "127.0.0.1" else f"http://{host}:{server.server_port}"
        try:
            with Client(Target(url, "nao_secret")) as client:
                assert client.get("/jobs") == {"items": []}
        except Unreachable:
            assert host == "127.0.0.2"  # the server has one address
        with pytest.raises(BlockingIOError):
            proxy.accept()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ALL_PROXY", "socks5://127.0.0.1:1"),
        ("HTTPS_PROXY", "ftp://127.0.0.1:1"),
        ("HTTP_PROXY", "127.0.0.1:1:1"),
        ("SSL_CERT_FILE", "/no/such/file"),
    ],
)
def test_settings_of_the_environment_that_cannot_be_used_are_one_line(
    monkeypatch: pytest.MonkeyPatch, server: Any, name: str, value: str
) -> None:
    """For other machines they are named; for this one they do not matter."""
    monkeypatch.setenv(name, value)
    try:
        Client(Target("https://naosprint.invalid", "nao_secret"))
    except CliError as error:
        assert error.code is ExitCode.USAGE
        assert "\n" not in str(error)
        assert "HTTP_PROXY" in str(error)
    server.on("GET", "/jobs")(lambda request: request.json({"items": []}))
    with Client(Target(server.url, "nao_secret")) as client:
        assert client.get("/jobs") == {"items": []}


def test_child_processes_and_other_libraries_spare_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the user has exempted stays exempted."""
    monkeypatch.setenv("no_proxy", "example.org, 127.0.0.1")
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    exempt_loopback()
    assert os.environ["NO_PROXY"] == os.environ["no_proxy"] == "example.org,127.0.0.1,localhost,::1"
    assert urllib.request.proxy_bypass("localhost")
    assert is_loopback("[::1]")
    assert not is_loopback("127.0.0.1.example.org")
