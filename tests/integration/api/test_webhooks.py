"""Webhooks: messages are written with the changes that they report, and reach a real receiver."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_network
from typing import Any

import httpx
import pytest
from naojobs import leases, outcomes, records, requests, studies, webhooks
from naojobs.errors import ConflictError
from naojobs.leases import Lease
from naojobs.models import Delivery, Evaluation, Job, Token, Webhook
from naojobs.states import WorkState
from naojobs.studies import StudyRequest
from naojobs.submission import JobRequest
from naojobs.tokens import Scope, create_token, revoke
from naojobs.webhooks import MessageType
from naospec import EvaluationSpec
from naospec.search import SearchSpec
from naosprint_api.deliveries import Deliverer
from sqlalchemy import delete, func, or_, text, update
from sqlalchemy.orm import Session, sessionmaker
from standardwebhooks import Webhook as Verifier

from tests.integration.writes import request_evaluation

Sessions = sessionmaker[Session]
LOOPBACK = (ip_network("127.0.0.1/32"),)


class Receiver:
    """HTTP server on the loopback that can be down and keeps its port."""

    def __init__(self) -> None:
        self.received: list[tuple[dict[str, str], str]] = []
        self.arrived = threading.Event()
        self.status: dict[str, int] = {}
        """Status of answers by path."""
        self.paths: list[str] = []
        """Paths of all requests, and those that are answered once `release` is set."""
        self.held: set[str] = set()
        self.release = threading.Event()
        self._port = 0
        self._server: ThreadingHTTPServer | None = None
        self.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._port}/"

    def types(self) -> list[str]:
        return [json.loads(body)["type"] for _, body in self.received]

    def start(self) -> None:
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"])).decode()
                receiver.received.append((dict(self.headers), body))
                receiver.paths.append(self.path)
                if self.path in receiver.held:
                    receiver.release.wait(30)
                self.send_response(receiver.status.get(self.path, 204))
                self.end_headers()
                receiver.arrived.set()

            def log_message(self, format: str, *args: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", self._port), Handler)
        self._port = self._server.server_port
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def stop(self) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.stop()


@pytest.fixture(autouse=True)
def no_webhooks(sessions: Sessions) -> None:
    with sessions.begin() as session:
        session.execute(delete(Webhook))


@pytest.fixture
def subscribe(sessions: Sessions, receiver: Receiver) -> Callable[..., Webhook]:
    def subscribe(path: str = "", owner: str = "alice", events: Any = MessageType) -> Webhook:
        return webhooks.create_webhook(sessions, owner=owner, url=receiver.url + path, events=events)

    return subscribe


def deliver(sessions: Sessions, networks: Any = LOOPBACK) -> int:
    """Send what is due, as an API process does in one pass."""

    async def send() -> int:
        deliverer = Deliverer(sessions, networks=networks, poll_s=1.0)
        number = await deliverer.send_due()
        while not deliverer.idle:
            await deliverer.wait()
        return number

    return asyncio.run(send())


def outbox(sessions: Sessions) -> list[Delivery]:
    with sessions() as session:
        return list(session.query(Delivery).order_by(Delivery.id))


def advance(sessions: Sessions, seconds: float) -> None:
    """Make the messages in the outbox and their webhooks' pauses older."""
    with sessions.begin() as session:
        earlier = text("UPDATE webhooks SET not_before = not_before - :seconds * interval '1 s'")
        session.execute(earlier, {"seconds": seconds})
        for column in ("next_at", "created_at"):
            earlier = text(f"UPDATE deliveries SET {column} = {column} - :seconds * interval '1 s'")
            session.execute(earlier, {"seconds": seconds})


def until_next(sessions: Sessions) -> float:
    """Return the seconds until the next attempt of any message."""
    with sessions() as session:
        return float(
            session.execute(
                text(
                    "SELECT extract(epoch FROM min(greatest(next_at, not_before)) - now()) "
                    "FROM deliveries JOIN webhooks ON webhooks.id = webhook_id"
                )
            ).scalar_one()
        )


def end_job(sessions: Sessions, lease: Lease, state: WorkState = WorkState.SUCCEEDED, **details: Any) -> None:
    outcomes.transition(sessions, lease, state, **details)


def test_every_kind_of_change_is_reported(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease], save_checkpoint: Any
) -> None:
    subscribe()
    lease = run_job(name="runner", tags=["lab"])
    outcomes.report_stall(sessions, lease, 300.0)
    outcomes.report_stall(sessions, lease, None)
    checkpoint = save_checkpoint(lease, 8192, {"policy.npz": b"x"})
    outcomes.transition(sessions, lease, WorkState.EVALUATING)
    summary = {"episodes": 2, "results": [{"name": "speed", "value": 3.5}, {"name": "height", "value": None}]}
    records.record_evaluation(
        sessions,
        lease,
        checkpoint_id=checkpoint,
        spec=EvaluationSpec(),
        summary=summary,
        key="k",
        manifest={"files": []},
    )
    end_job(sessions, lease)
    requested = request_evaluation(sessions, lease.job_id)
    requests.request_cancel(sessions, Evaluation, requested.id)
    search = SearchSpec.model_validate({"space": {"gamma": {"type": "float", "low": 0.9, "high": 0.99}}})
    study, _ = studies.submit_study(sessions, StudyRequest(JobRequest(), search, "best"), owner="alice")
    studies.cancel_study(sessions, study.id)

    stalled, evaluated, ended, cancelled, finished = outbox(sessions)
    of_job = {"job_id": lease.job_id, "name": "runner", "tags": ["lab"], "group_id": None, "error": None}
    steps = {"step": 0, "total_steps": stalled.data["total_steps"], "attempt": 1}
    assert (stalled.type, stalled.data) == ("job.stalled", {**of_job, **steps, "state": "running"})
    assert (evaluated.type, evaluated.data["results"]) == ("evaluation.finished", {"speed": 3.5, "height": None})
    assert (evaluated.data["state"], evaluated.data["checkpoint_id"]) == ("succeeded", checkpoint)
    assert (ended.type, ended.data) == ("job.ended", {**of_job, **steps, "state": "succeeded"})
    assert (cancelled.type, cancelled.data["state"]) == ("evaluation.finished", "cancelled")
    assert cancelled.data["evaluation_id"] == requested.id
    of_study = {"study_id": study.id, "name": "best", "state": "cancelled", "error": None}
    assert (finished.type, finished.data) == ("study.finished", of_study)


def test_only_the_owner_and_only_chosen_types_are_sent(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease]
) -> None:
    subscribe(owner="bob")
    subscribe(events=[MessageType.STUDY_FINISHED])
    chosen = subscribe(events=[MessageType.JOB_ENDED])
    lease = run_job()
    outcomes.report_stall(sessions, lease, 300.0)
    end_job(sessions, lease, WorkState.FAILED, error="out of memory")
    (delivery,) = outbox(sessions)
    assert (delivery.webhook_id, delivery.data["error"]) == (chosen.id, "out of memory")


def test_a_change_that_is_rolled_back_is_not_reported(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease]
) -> None:
    subscribe()
    lease = run_job()
    with pytest.raises(ConflictError), sessions.begin() as session:
        outcomes._settle(session, leases.hold(session, lease), WorkState.SUCCEEDED)
        assert session.query(Delivery).count() == 1
        raise ConflictError("the transaction fails")
    assert outbox(sessions) == []


def test_a_job_ends_also_while_its_webhook_is_being_deleted(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease]
) -> None:
    webhook = subscribe()
    lease = run_job()
    with ThreadPoolExecutor(1) as pool, sessions() as session:
        session.execute(delete(Webhook).where(Webhook.id == webhook.id))
        ending = pool.submit(end_job, sessions, lease)
        waits = text(
            "SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND datname = current_database()"
        )
        while not session.execute(waits).scalar_one():
            assert not ending.done()
            session.execute(text("SELECT pg_stat_clear_snapshot()"))
        session.commit()
        ending.result(10)
    with sessions() as session:
        assert session.get_one(Job, lease.job_id).state is WorkState.SUCCEEDED
    assert outbox(sessions) == []


def test_a_receiver_that_is_down_for_ten_minutes_gets_every_message(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease], receiver: Receiver
) -> None:
    webhook = subscribe()
    receiver.stop()
    leases = [run_job() for _ in range(10)]
    for lease in leases[:5]:
        end_job(sessions, lease)
    passed_s = 0.0
    attempts = 0
    while passed_s < 600:
        attempts += deliver(sessions)
        wait_s = max(until_next(sessions), 0) + 0.001
        advance(sessions, wait_s)
        passed_s += wait_s
        if leases[5:] and passed_s > 300:
            for lease in leases.pop(), leases.pop(), leases.pop(), leases.pop(), leases.pop():
                end_job(sessions, lease)
    assert 10 <= attempts <= 15, "five at once, then one each time that the webhook's pause is over"
    assert {delivery.delivered_at for delivery in outbox(sessions)} == {None}
    assert all("ConnectError" in str(delivery.error) for delivery in outbox(sessions) if delivery.attempts > 1)
    receiver.start()
    while len(receiver.received) < 10:
        if not deliver(sessions):
            wait_s = max(until_next(sessions), 0) + 0.001
            advance(sessions, wait_s)
            passed_s += wait_s
    assert passed_s < 1300
    assert deliver(sessions) == 0
    assert {delivery.next_at for delivery in outbox(sessions)} == {None}
    assert {delivery.error for delivery in outbox(sessions)} == {None}
    bodies = [Verifier(webhook.secret).verify(body, headers) for headers, body in receiver.received]
    assert len({body["data"]["job_id"] for body in bodies}) == 10
    assert {headers["webhook-id"] for headers, _ in receiver.received} == {d.id for d in outbox(sessions)}


def test_the_time_of_an_attempt_is_that_of_the_databases_clock(
    sessions: Sessions,
    subscribe: Callable[..., Webhook],
    run_job: Callable[..., Lease],
    receiver: Receiver,
    clock_ahead: timedelta,
) -> None:
    """Receivers refuse messages whose time is off by some minutes, and hosts may have wrong clocks."""
    subscribe()
    end_job(sessions, run_job())
    assert deliver(sessions) == 1
    ((headers, _),) = receiver.received
    apart_s = time.time() + clock_ahead.total_seconds() - int(headers["webhook-timestamp"])
    assert -60 < apart_s < 60


def test_a_message_whose_sender_died_is_sent_again(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease], receiver: Receiver
) -> None:
    subscribe()
    end_job(sessions, run_job())
    (message,) = webhooks.take_due(sessions)
    assert deliver(sessions) == 0, "another sender has it"
    advance(sessions, webhooks.TAKEN_S)
    assert deliver(sessions) == 1
    ((headers, _),) = receiver.received
    assert headers["webhook-id"] == message.id
    webhooks.settle(sessions, message, "the first sender was only slow")
    (delivery,) = outbox(sessions)
    assert (delivery.attempts, delivery.error) == (2, None) and delivery.delivered_at is not None


def test_senders_at_once_get_different_messages(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease]
) -> None:
    for number in range(6):
        subscribe(owner=f"owner-{number}")
    with sessions.begin() as session:
        for number in range(6):
            webhooks.publish(session, f"owner-{number}", MessageType.JOB_ENDED, {})
    with ThreadPoolExecutor(3) as pool:
        taken = [message.id for batch in pool.map(webhooks.take_due, [sessions] * 3) for message in batch]
    taken += [message.id for message in webhooks.take_due(sessions)]
    assert sorted(taken) == sorted(delivery.id for delivery in outbox(sessions))


def test_a_webhook_with_many_messages_does_not_hold_up_others(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease]
) -> None:
    busy = subscribe(owner="busy")
    with sessions.begin() as session:
        for _ in range(100):
            webhooks.publish(session, "busy", MessageType.JOB_ENDED, {})
    other = subscribe()
    end_job(sessions, run_job())
    taken = [message.webhook_id for message in webhooks.take_due(sessions)]
    assert sorted(taken) == sorted([busy.id] * webhooks.MOST_TO_WEBHOOK + [other.id])


def test_slow_webhooks_of_one_owner_do_not_hold_up_another(
    sessions: Sessions, subscribe: Callable[..., Webhook], receiver: Receiver
) -> None:
    """The slow ones answer only once the other owner's message has arrived."""
    receiver.held = {"/slow"}
    for _ in range(20):
        subscribe("slow", owner="slow")
    with sessions.begin() as session:
        for _ in range(10):
            webhooks.publish(session, "slow", MessageType.JOB_ENDED, {})
    subscribe("quick", owner="quick")

    async def run() -> tuple[int, int]:
        deliverer = Deliverer(sessions, networks=LOOPBACK, poll_s=0.01)
        first, again = await deliverer.send_due(), await deliverer.send_due()
        with sessions.begin() as session:
            webhooks.publish(session, "quick", MessageType.JOB_ENDED, {})
        deliverer.start()
        while "/quick" not in receiver.paths:
            await asyncio.sleep(0.01)
        receiver.release.set()
        await deliverer.stop()
        return first, again

    assert asyncio.run(run()) == (webhooks.MOST_OF_OWNER, 0)


def test_owners_take_turns(sessions: Sessions, subscribe: Callable[..., Webhook]) -> None:
    """An owner with many messages that have been due for long gets no place before others' first ones."""
    owners = [f"many-{number}" for number in range(5)]
    with sessions.begin() as session:
        for owner in owners:
            for _ in range(4):
                subscribe(owner=owner)
            for _ in range(4):
                webhooks.publish(session, owner, MessageType.JOB_ENDED, {})
    advance(sessions, 60)
    subscribe(owner="late")
    with sessions.begin() as session:
        webhooks.publish(session, "late", MessageType.JOB_ENDED, {})
    taken = [message.owner for message in webhooks.take_due(sessions)]
    assert len(taken) == webhooks.MOST_SENDING and "late" in taken
    assert {taken.count(owner) for owner in owners} <= {12, 13}


def test_alerts_have_places_of_their_own_and_one_owner_does_not_fill_them(
    sessions: Sessions, subscribe: Callable[..., Webhook]
) -> None:
    """Each takes a process, so few are sent at a time. One that is being sent is not taken a second time."""

    def publish(owner: str) -> None:
        with sessions.begin() as session:
            webhooks.publish(session, owner, MessageType.JOB_ENDED, {})

    def taken(sending: Sequence[webhooks.Message] = ()) -> list[webhooks.Message]:
        return webhooks.take_due(sessions, sending)

    for owner in ("slow", *(f"other-{number}" for number in range(4))):
        for number in range(4):
            url = f"ntfys://{owner}-{number}.example.org/topic"
            webhooks.create_webhook(sessions, owner=owner, url=url, signed=False, events=list(MessageType))
    subscribe(owner="slow")
    publish("slow")
    first = taken()
    alerts = [message for message in first if webhooks.is_alert(message.url)]
    assert (len(first), len(alerts)) == (3, webhooks.MOST_ALERTS_OF_OWNER)
    advance(sessions, 2 * webhooks.TAKEN_S)
    assert taken(first) == []

    for number in range(4):
        publish(f"other-{number}")
    owners = Counter(message.owner for message in taken(first))
    assert owners.total() == webhooks.MOST_ALERTS - len(alerts)
    assert "slow" not in owners and max(owners.values()) == webhooks.MOST_ALERTS_OF_OWNER


def test_a_webhook_that_fails_waits_as_a_whole(
    sessions: Sessions, subscribe: Callable[..., Webhook], receiver: Receiver
) -> None:
    subscribe("broken")
    subscribe("sound")
    receiver.status["/broken"] = 500
    with sessions.begin() as session:
        for _ in range(3):
            webhooks.publish(session, "alice", MessageType.JOB_ENDED, {})
    assert deliver(sessions) == 6
    with sessions.begin() as session:
        webhooks.publish(session, "alice", MessageType.JOB_ENDED, {})
    assert deliver(sessions) == 1, "a new message waits as well, that of the sound webhook does not"
    for pause_s in (5, 10, 20, 40):
        wait_s = until_next(sessions)
        assert pause_s - 2 < wait_s <= pause_s
        advance(sessions, wait_s + 0.001)
        assert deliver(sessions) == 1, "one message tries whether it answers again"
    receiver.status.clear()
    advance(sessions, until_next(sessions) + 0.001)
    assert deliver(sessions) == 1
    advance(sessions, webhooks.LONGEST_DELAY_S)
    assert deliver(sessions) == 3
    assert {delivery.error for delivery in outbox(sessions)} == {None}


def test_the_oldest_messages_to_a_webhook_are_dropped(
    sessions: Sessions, subscribe: Callable[..., Webhook], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhooks, "MOST_KEPT", 3)
    full, other = subscribe(), subscribe(events=[MessageType.STUDY_FINISHED])
    with sessions.begin() as session:
        webhooks.publish(session, "alice", MessageType.STUDY_FINISHED, {"number": 0})
        for number in range(1, 6):
            webhooks.publish(session, "alice", MessageType.JOB_ENDED, {"number": number})
    assert webhooks.forget(sessions) == 3
    kept = [(delivery.webhook_id, delivery.data["number"]) for delivery in outbox(sessions)]
    assert sorted(kept) == sorted([(full.id, 3), (full.id, 4), (full.id, 5), (other.id, 0)])


@pytest.mark.parametrize("status", [302, 404, 500])
def test_an_answer_other_than_success_is_an_error(
    sessions: Sessions,
    subscribe: Callable[..., Webhook],
    run_job: Callable[..., Lease],
    receiver: Receiver,
    status: int,
) -> None:
    subscribe("refuse")
    receiver.status["/refuse"] = status
    end_job(sessions, run_job())
    deliver(sessions)
    (delivery,) = outbox(sessions)
    assert str(delivery.error).startswith(f"the receiver answered {status}") and delivery.delivered_at is None
    assert 3 < until_next(sessions) <= webhooks.FIRST_DELAY_S
    assert len(receiver.received) == 1


def test_a_receiver_that_is_gone_gets_nothing_more(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease], receiver: Receiver
) -> None:
    webhook = subscribe("gone")
    receiver.status["/gone"] = 410
    for _ in range(2):
        end_job(sessions, run_job())
    deliver(sessions)
    end_job(sessions, run_job())
    assert [(d.next_at, d.error) for d in outbox(sessions)] == [(None, "the receiver answered 410")] * 2
    assert webhooks.get_webhook(sessions, webhook.id).disabled_at is not None


@pytest.mark.parametrize("end", ["revoked", "expired"])
def test_a_webhook_ends_with_the_token_that_made_it(
    sessions: Sessions, run_job: Callable[..., Lease], receiver: Receiver, end: str
) -> None:
    """It could else tell a thief of the token about all later jobs of the owner."""

    def make(**options: Any) -> tuple[str, Webhook]:
        token_id, _ = create_token(sessions, name="", owner="alice", scopes=[Scope.SUBMIT], **options)
        events = [MessageType.JOB_ENDED]
        return token_id, webhooks.create_webhook(
            sessions, owner="alice", url=receiver.url, events=events, token_id=token_id
        )

    first, _ = make()
    make(parent_id=first)
    _, other = make()
    end_job(sessions, run_job())
    if end == "revoked":
        revoke(sessions, first)
    else:
        with sessions.begin() as session:
            session.execute(
                update(Token).where(or_(Token.id == first, Token.parent_id == first)).values(expires_at=func.now())
            )
    assert deliver(sessions) == 1
    end_job(sessions, run_job())
    assert deliver(sessions) == 1
    with sessions() as session:
        assert [hook.id for hook in session.query(Webhook) if hook.disabled_at is None] == [other.id]
    given_up = [delivery for delivery in outbox(sessions) if delivery.delivered_at is None]
    assert [(d.next_at, d.attempts) for d in given_up] == [(None, 0)] * 2
    assert "token" in str(given_up[0].error)
    with pytest.raises(ConflictError, match="use another one"):
        webhooks.create_webhook(sessions, owner="alice", url=receiver.url, events=MessageType, token_id=first)


def test_messages_are_given_up_and_forgotten_after_days(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease], receiver: Receiver
) -> None:
    subscribe()
    receiver.stop()
    end_job(sessions, run_job())
    # The service was off for all of the time in which the message could have been sent.
    advance(sessions, webhooks.GIVE_UP_AFTER.total_seconds() + 60)
    for _ in range(webhooks.LEAST_ATTEMPTS - 1):
        deliver(sessions)
        (delivery,) = outbox(sessions)
        assert delivery.next_at is not None
        advance(sessions, until_next(sessions) + 120)
    deliver(sessions)
    (delivery,) = outbox(sessions)
    assert delivery.next_at is None and delivery.delivered_at is None
    assert webhooks.forget(sessions) == 0
    advance(sessions, webhooks.KEEP.total_seconds())
    assert webhooks.forget(sessions) == 1


def test_private_addresses_are_refused_when_a_message_is_sent(
    sessions: Sessions, subscribe: Callable[..., Webhook], run_job: Callable[..., Lease], receiver: Receiver
) -> None:
    """A name may have got another address since the webhook was made, and an operator another setting."""
    subscribe()
    end_job(sessions, run_job())
    deliver(sessions, networks=())
    (delivery,) = outbox(sessions)
    assert "no public address" in str(delivery.error)
    assert receiver.received == []


# --- over HTTP --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def api(start_api: Callable[..., Any]) -> Any:
    return start_api(api_webhook_networks="127.0.0.1/32", api_webhook_poll_s=0.05, api_max_webhooks=3)


def test_a_webhook_from_its_making_to_its_end(client: httpx.Client, sessions: Sessions, receiver: Receiver) -> None:
    answer = client.post("/webhooks", json={"url": receiver.url, "events": ["job.ended"]})
    assert answer.status_code == 201
    made = answer.json()
    assert made["secret"].startswith("whsec_")
    with sessions() as session:
        assert session.get_one(Token, webhooks.get_webhook(sessions, made["id"]).token_id).owner == "alice"
    shown = {name: value for name, value in made.items() if name != "secret"}
    listed = client.get("/webhooks")
    assert listed.json()["items"] == [shown] and made["secret"] not in listed.text

    job = client.post("/jobs", json={"name": "told"}).json()["id"]
    client.post(f"/jobs/{job}/cancel").raise_for_status()
    assert receiver.arrived.wait(10)
    headers, body = receiver.received[0]
    message = Verifier(made["secret"]).verify(body, headers)
    assert message["type"] == "job.ended"
    assert (message["data"]["job_id"], message["data"]["state"]) == (job, "cancelled")

    path = f"/webhooks/{made['id']}"
    page = client.get(f"{path}/deliveries").json()
    assert [item["id"] for item in page["items"]] == [headers["webhook-id"]] and page["next_cursor"] is None
    assert client.delete(path).status_code == 204
    assert client.get(f"{path}/deliveries").status_code == client.delete(path).status_code == 404
    assert len(receiver.received) == 1


def test_deliveries_are_paged_and_show_the_last_error(
    client: httpx.Client, sessions: Sessions, receiver: Receiver, run_job: Callable[..., Lease]
) -> None:
    receiver.status["/broken"] = 500
    path = "/webhooks/" + client.post("/webhooks", json={"url": receiver.url + "broken"}).json()["id"] + "/deliveries"
    for _ in range(3):
        end_job(sessions, run_job())
    first = client.get(path, params={"limit": 2}).json()
    second = client.get(path, params={"limit": 2, "cursor": first["next_cursor"]}).json()
    ids = [item["id"] for item in (*first["items"], *second["items"])]
    assert ids == sorted(ids, reverse=True) and len(ids) == 3
    assert receiver.arrived.wait(10)
    while not (item := client.get(path).json()["items"][-1])["error"]:
        pass
    assert (item["error"], item["delivered_at"], item["attempts"]) == ("the receiver answered 500", None, 1)


def test_an_owner_has_a_quota_and_cannot_see_others(make_client: Callable[..., httpx.Client]) -> None:
    carol, dave, reader = make_client("carol", "submit"), make_client("dave", "submit"), make_client("carol", "read")
    body = {"url": "https://hooks.example.org/x"}
    ids = [carol.post("/webhooks", json=body).json()["id"] for _ in range(3)]
    refused = carol.post("/webhooks", json=body)
    assert refused.status_code == 429 and "3 webhooks, of 3" in refused.json()["detail"]
    assert dave.get("/webhooks").json()["items"] == []
    for answer in (dave.delete(f"/webhooks/{ids[0]}"), dave.get(f"/webhooks/{ids[0]}/deliveries")):
        assert answer.status_code == 404
    assert reader.get("/webhooks").status_code == reader.post("/webhooks", json=body).status_code == 403
    assert len(make_client("root", "admin").get("/webhooks").json()["items"]) == 3


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "url"),
        ({"url": "ftp://example.org/"}, "url"),
        ({"url": "https://user:secret@example.org/"}, "url"),
        ({"url": "https://10.0.0.1/"}, "url"),
        ({"url": "http://0x7f.2/"}, "url"),
        ({"url": "http://[::1]/"}, "url"),
        ({"url": "https://example.org/" + "x" * 3000}, "url"),
        ({"url": "https://example.org/", "events": []}, "events"),
        ({"url": "https://example.org/", "events": ["job.began"]}, "events.0"),
        ({"url": "https://example.org/", "secret": "mine"}, "secret"),
    ],
)
def test_wrong_webhooks_are_refused_by_field(make_client: Callable[..., httpx.Client], body: Any, field: str) -> None:
    answer = make_client("erin", "submit").post("/webhooks", json=body)
    assert answer.status_code == 422
    assert [item["field"] for item in answer.json()["errors"]] == [field]
    assert "secret@" not in answer.text
