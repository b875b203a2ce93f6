"""The relay in the documentation forwards messages by e-mail and chat."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import socketserver
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from standardwebhooks import Webhook

ROOT = Path(__file__).parents[3]
SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"


@contextmanager
def serving(server: socketserver.TCPServer) -> Iterator[int]:
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_the_relay_forwards_each_message_once(monkeypatch: pytest.MonkeyPatch) -> None:
    chat: list[Any] = []
    mails: list[str] = []

    class Chat(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            chat.append(json.loads(self.rfile.read(int(self.headers["content-length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            pass

    class Mail(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            self.wfile.write(b"220 ready\r\n")
            while line := self.rfile.readline():
                command = line[:4].upper()
                if command == b"DATA":
                    self.wfile.write(b"354 go\r\n")
                    mails.append(b"".join(iter(self.rfile.readline, b".\r\n")).decode())
                self.wfile.write(b"221 bye\r\n" if command == b"QUIT" else b"250 ok\r\n")

    spec = importlib.util.spec_from_file_location("documents", Path(__file__).with_name("documents.py"))
    assert spec is not None and spec.loader is not None
    documents = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "documents", documents)
    spec.loader.exec_module(documents)
    (source,) = documents.blocks(ROOT / "docs/how-to/webhooks.md", "python")
    with (
        serving(HTTPServer(("127.0.0.1", 0), Chat)) as chat_port,
        serving(socketserver.TCPServer(("127.0.0.1", 0), Mail)) as mail_port,
    ):
        monkeypatch.setenv("RELAY_SECRET", SECRET)
        monkeypatch.setenv("RELAY_CHAT_URL", f"http://127.0.0.1:{chat_port}/")
        monkeypatch.setenv("RELAY_MAIL_TO", "ada@example.org")
        monkeypatch.setenv("RELAY_MAIL_HOST", f"127.0.0.1:{mail_port}")
        relay: dict[str, Any] = {}
        exec(compile(source, "relay.py", "exec", dont_inherit=True), relay)

        async def post(headers: dict[str, str], body: str) -> int:
            transport = httpx.ASGITransport(relay["app"])
            async with httpx.AsyncClient(transport=transport, base_url="http://relay") as client:
                return (await client.post("/naosprint", content=body, headers=headers)).status_code

        def send(identifier: str, kind: str, data: dict[str, Any], secret: str = SECRET) -> int:
            body, now = json.dumps({"type": kind, "timestamp": "", "data": data}), datetime.now(UTC)
            headers = {
                "webhook-id": identifier,
                "webhook-timestamp": str(int(now.timestamp())),
                "webhook-signature": Webhook(secret).sign(identifier, now, body),
            }
            return asyncio.run(post(headers, body))

        failed = {"name": "night", "state": "failed", "error": "out of memory"}
        assert [send("msg_1", "job.ended", failed) for _ in range(2)] == [204, 204]
        results = {"speed": 3.5, "height": None}
        evaluated = {"name": "day", "state": "succeeded", "error": None, "results": results}
        assert send("msg_2", "evaluation.finished", evaluated) == 204
        assert send("msg_3", "job.ended", failed, "whsec_b3RoZXI=") == 401
        played = {"match_id": "match_1", "teams": ["a", "b"], "games": 20, "state": "succeeded", "error": None}
        assert send("msg_4", "match.ended", played) == 204
    texts = [
        "job.ended: night failed\nout of memory",
        "evaluation.finished: day succeeded, speed 3.5",
        "match.ended: a against b succeeded",
    ]
    assert [message["text"] for message in chat] == texts
    (mail,) = mails
    assert "Subject: naosprint: night failed" in mail and "out of memory" in mail
