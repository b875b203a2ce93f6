"""Alerts: webhooks whose messages are text for people, through a real SMTP server and a real HTTP receiver."""

from __future__ import annotations

import email
import email.policy
import json
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from email.message import EmailMessage
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx
import pytest
from aiosmtpd.controller import Controller
from aiosmtpd.smtp import AuthResult, LoginPassword
from naojobs import outcomes
from naojobs.leases import Lease
from naojobs.states import WorkState
from naosprint_api import alerts

from tests.ports import reserved_port

USER, PASSWORD, TOPIC = "lab", "hunter22secret", "a-topic-as-a-secret"
GUIDE = "https://appriseit.com/services/"


class Mails:
    """What an SMTP server receives; with `refusal` it answers every message with this error."""

    def __init__(self) -> None:
        self.received: list[EmailMessage] = []
        self.arrived = threading.Semaphore(0)
        self.refusal = ""

    async def handle_DATA(self, server: Any, session: Any, envelope: Any) -> str:
        message = email.message_from_bytes(envelope.content, policy=email.policy.default)
        assert isinstance(message, EmailMessage)
        if not self.refusal:
            self.received.append(message)
        self.arrived.release()
        return self.refusal or "250 OK"


def log_in(server: Any, session: Any, envelope: Any, mechanism: str, data: Any) -> AuthResult:
    return AuthResult(success=data == LoginPassword(USER.encode(), PASSWORD.encode()))


@pytest.fixture
def mails() -> Mails:
    return Mails()


@pytest.fixture
def mail_port(mails: Mails) -> Iterator[int]:
    """An SMTP server whose users have to log in."""
    options = {"authenticator": log_in, "auth_required": True, "auth_require_tls": False}
    controller = Controller(mails, hostname="127.0.0.1", port=reserved_port(), **options)
    controller.start()
    yield controller.port
    controller.stop()


@pytest.fixture
def topics() -> Iterator[tuple[str, list[tuple[str, Any]]]]:
    """An HTTP server in the place of ntfy: its address, and the paths and bodies of requests."""
    received: list[tuple[str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["content-length"])))
            received.append((self.path, body))
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"{}")

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"127.0.0.1:{server.server_port}", received
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def api(start_api: Callable[..., Any]) -> Any:
    return start_api(api_webhook_networks="127.0.0.1/32", api_webhook_poll_s=0.05)


def until_sent(client: httpx.Client, webhook: str) -> dict[str, Any]:
    """Wait for the result of the first attempt of a webhook's newest message."""
    for _ in range(10_000):
        (item, *_) = client.get(f"/webhooks/{webhook}/deliveries").json()["items"]
        if item["delivered_at"] or item["error"]:
            return dict(item)
    raise AssertionError("no attempt ends")


@pytest.mark.filterwarnings("ignore:Requiring AUTH while not requiring TLS", "ignore:Session.login_data is deprecated")
def test_an_alert_by_mail(
    client: httpx.Client, mails: Mails, mail_port: int, run_job: Callable[..., Lease], sessions: Any, caplog: Any
) -> None:
    caplog.set_level(logging.DEBUG)
    url = f"mailto://{USER}:{PASSWORD}@127.0.0.1:{mail_port}?from=lab@example.org&to=ada@example.org"
    answer = client.post("/webhooks", json={"url": url, "events": ["job.ended"]})
    assert answer.status_code == 201, answer.text
    made = answer.json()
    assert (made["url"], made["secret"]) == ("mailto://…@127.0.0.1", "")
    outcomes.transition(sessions, run_job(name="night"), WorkState.FAILED, error="no memory was left")
    assert mails.arrived.acquire(timeout=60)
    assert until_sent(client, made["id"])["error"] is None
    (mail,) = mails.received
    assert mail["subject"] == "naosprint: job night failed"
    assert (mail["to"], mail["from"].addresses[0].addr_spec) == ("ada@example.org", "lab@example.org")
    body = mail.get_body(("plain", "html"))
    assert body is not None and "no memory was left" in body.get_content()

    mails.refusal = "554 5.7.1 ada@example.org wants nothing today"
    outcomes.transition(sessions, run_job(name="day"), WorkState.CANCELLED)
    assert mails.arrived.acquire(timeout=60)
    item = until_sent(client, made["id"])
    assert item["next_at"] and item["attempts"] == 1  # as after any failure of a webhook
    texts = [client.get(path).text for path in ("/webhooks", f"/webhooks/{made['id']}/deliveries")]
    logged = "\n".join(record.getMessage() for record in caplog.records if record.name != "mail.log")  # the server's
    for secret in (PASSWORD, "ada@example.org"):
        assert not [text for text in (answer.text, logged, *texts) if secret in text]
    client.delete(f"/webhooks/{made['id']}").raise_for_status()


def test_an_alert_through_a_service_with_http(
    client: httpx.Client, topics: tuple[str, list[tuple[str, Any]]], run_job: Callable[..., Lease], sessions: Any
) -> None:
    host, received = topics
    made = client.post("/webhooks", json={"url": f"ntfy://{host}/{TOPIC}"}).json()
    outcomes.transition(sessions, run_job(name="walk"), WorkState.CANCELLED)
    assert until_sent(client, made["id"])["error"] is None
    ((path, body),) = received
    assert (path, body["topic"], body["title"]) == ("/", TOPIC, "naosprint: job walk cancelled")
    assert TOPIC not in client.get("/webhooks").text
    client.delete(f"/webhooks/{made['id']}").raise_for_status()


@pytest.mark.parametrize(
    ("url", "detail"),
    [
        ("json://127.0.0.1/", "expected an address of http, https, discord"),
        ("tgram://hidden/12315544", f"expected an address that apprise can read ({GUIDE})"),
        ("slack://T1/hidden/x?template=/proc/self/environ", "has no parameter of that name here"),
        ("mailto://ada:hidden@10.0.0.1", "expected a public address"),
        ("mailto://ada:hidden@[::1", "Invalid IPv6 URL"),
        ("mailto://ada:hidden@example.org?smtp=192.168.0.1", "expected a public address"),
        ("mailto://ada:hidden@example.org?smtp=\u0000", "without spaces and control characters"),
    ],
)
def test_a_wrong_alert_is_refused_without_its_secrets(client: httpx.Client, url: str, detail: str) -> None:
    answer = client.post("/webhooks", json={"url": url})
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["field"] == "url" and detail in error["message"], error
    assert "hidden" not in answer.text


def test_an_address_is_tried_only_where_there_is_room_for_it_and_few_at_a_time(
    start_api: Callable[..., Any], make_client: Callable[..., httpx.Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each takes a process of 30 MB, so that a user could fill the memory."""
    url = {"url": "slack://T1JJ3T3L2/A1BRTD4JD/TIiajkdnlazkcOXrIdevi7FQ"}
    full = start_api(api_max_webhooks=0)
    client = make_client("alice", "submit")
    with monkeypatch.context() as patched:
        patched.setattr(alerts, "_run", pytest.fail)  # it starts the process
        answer = httpx.post(f"{full.url}/webhooks", json=url, headers=client.headers)
    assert (answer.status_code, answer.json()["errors"][0]["field"]) == (429, "owner")

    with ExitStack() as busy:
        for _ in range(alerts.TRIED_AT_A_TIME):
            busy.enter_context(alerts._trying)
        answer = client.post("/webhooks", json=url)
        assert (answer.status_code, answer.headers["Retry-After"]) == (429, "3")
        assert "tried" in answer.json()["detail"]
    answer = client.post("/webhooks", json=url)
    assert answer.status_code == 201
    client.delete(f"/webhooks/{answer.json()['id']}").raise_for_status()
