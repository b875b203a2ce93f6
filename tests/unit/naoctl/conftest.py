"""A real HTTP server on the loopback that plays the service, one answer at a time."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from naoctl.cli import main
from naoctl.client import Client
from naoctl.config import Target

Handler = Callable[["Request"], None]


class Request(BaseHTTPRequestHandler):
    """One request, with what a handler needs to answer it."""

    protocol_version = "HTTP/1.1"
    server: Server

    def log_message(self, format: str, *args: object) -> None:
        pass

    def handle_any(self) -> None:
        parts = urlsplit(self.path)
        length = int(self.headers.get("content-length", 0))
        body = self.rfile.read(length)
        record = Received(
            self.command, parts.path, parse_qs(parts.query), dict(self.headers), json.loads(body) if body else None
        )
        self.server.received.append(record)
        handler = self.server.routes.get((self.command, parts.path))
        if handler is None:
            self.problem(404, "no such address")
        else:
            handler(self)

    do_GET = do_POST = do_PATCH = do_DELETE = handle_any

    def json(self, value: Any, status: int = 200, **headers: str) -> None:
        self.raw(json.dumps(value).encode(), status, **{"content-type": "application/json", **headers})

    def problem(self, status: int, detail: str, errors: list[dict[str, str]] | None = None, **headers: str) -> None:
        value = {"type": "about:blank", "title": "x", "status": status, "detail": detail, "errors": errors or []}
        self.json(value, status, **headers)

    def raw(self, data: bytes, status: int = 200, **headers: str) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def stream(self, *chunks: str) -> None:
        """Send server-sent events and end the connection."""
        self.send_response(200)
        self.send_header("content-type", "text/event-stream")
        self.send_header("connection", "close")
        self.end_headers()
        for chunk in chunks:
            self.wfile.write(chunk.encode())
            self.wfile.flush()
        self.close_connection = True


@dataclass
class Received:
    """What the server was asked."""

    method: str
    path: str
    query: dict[str, list[str]]
    headers: dict[str, str]
    body: Any


class Server(ThreadingHTTPServer):
    """The playing service."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Request)
        self.routes: dict[tuple[str, str], Handler] = {}
        self.received: list[Received] = []

    def handle_error(self, request: Any, client_address: Any) -> None:
        # a client that is interrupted leaves without its answer
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def on(self, method: str, path: str) -> Callable[[Handler], Handler]:
        def keep(handler: Handler) -> Handler:
            self.routes[method, path] = handler
            return handler

        return keep


@dataclass
class Home:
    """A user's surroundings for one test: no configuration but the test's own."""

    config: Path
    data: Path
    environment: dict[str, str] = field(default_factory=dict)


@pytest.fixture
def server() -> Iterator[Server]:
    playing = Server()
    thread = threading.Thread(target=playing.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield playing
    finally:
        playing.shutdown()
        thread.join()
        playing.server_close()


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    with Client(Target(server.url, "nao_test")) as made:
        yield made


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Home:
    made = Home(tmp_path / "config" / "config.toml", tmp_path / "data")
    monkeypatch.setenv("NAOCTL_CONFIG", str(made.config))
    monkeypatch.setenv("NAOCTL_DATA_DIR", str(made.data))
    for name in ("NAOCTL_URL", "NAOCTL_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    return made


def make_job(**fields: Any) -> dict[str, Any]:
    """A job as the service shows it."""
    job: dict[str, Any] = {
        "id": "job_01m7y0yae5d2d9p46g58mkcxxh",
        "name": "first",
        "owner": "ada",
        "tags": ["try"],
        "state": "running",
        "priority": 5,
        "queue": "embedded",
        "spec": {
            "task": {"name": "sprint1"},
            "robot": {"name": "nao-0"},
            "simulator": {"name": "embedded"},
            "algorithm": {"name": "ppo", "preset": "fast", "learning_rate": 5e-4},
            "seed": 0,
        },
        "evaluation": None,
        "attempt": 1,
        "failures": 0,
        "max_attempts": 3,
        "worker": "host:1",
        "heartbeat_at": None,
        "cancel_requested": False,
        "pause_requested": False,
        "parent_job_id": None,
        "parent_checkpoint_id": None,
        "group_id": None,
        "progress_step": 250,
        "total_steps": 1000,
        "latest_metrics": {"reward": 1.5, "distance_m": 2.25},
        "error": None,
        "created_at": "2026-01-02T03:04:05Z",
        "queued_at": "2026-01-02T03:04:05Z",
        "started_at": "2026-01-02T03:04:06Z",
        "finished_at": None,
        "updated_at": "2026-01-02T03:04:07Z",
    }
    return {**job, **fields}


@pytest.fixture
def job() -> Callable[..., dict[str, Any]]:
    return make_job


def sse(event: str, data: Any, identifier: str = "") -> str:
    """One server-sent event as it goes over the wire."""
    head = f"id: {identifier}\n" if identifier else ""
    return f"{head}event: {event}\ndata: {json.dumps(data)}\n\n"


@pytest.fixture
def event() -> Callable[..., str]:
    return sse


class Ran:
    """What one run of the program printed and how it ended."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


@pytest.fixture
def naoctl(server: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    """Run the program against the playing service, as the shell would."""
    monkeypatch.setenv("NAOCTL_URL", server.url)
    monkeypatch.setenv("NAOCTL_TOKEN", "nao_test")

    def run(*words: str) -> Ran:
        code = 0
        try:
            main(list(words))
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1 if ended.code else 0
        out, err = capfd.readouterr()
        return Ran(code, out, err)

    return run
