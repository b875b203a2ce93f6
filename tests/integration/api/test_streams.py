"""Live streams: nothing is lost or repeated, and streams end when they should."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import datetime, timedelta
from functools import partial
from itertools import islice, takewhile
from typing import Any

import httpx
import psycopg
import pytest
from naojobs import outcomes, records, registry
from naojobs.capabilities import Capabilities
from naojobs.database import make_engine, make_sessions, notify
from naojobs.leases import Lease
from naojobs.models import Evaluation, Job
from naojobs.states import WorkState
from naojobs.tokens import Scope, create_token, revoke
from naosprint_api import broadcast, queries
from naosprint_api.feed import Feed
from sqlalchemy import Engine, event, func, select, text
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import append_metrics

Sessions = sessionmaker[Session]


def test_a_follower_sees_a_job_live_until_it_ends(
    client: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease], follow: Any
) -> None:
    lease = run_job()
    with follow(client, f"/jobs/{lease.job_id}/stream") as messages:
        backlog = list(islice(messages, 5))
        assert [message.event for message in backlog] == ["event"] * 4 + ["state"]
        assert backlog[-1].data["state"] == "running"
        append_metrics(sessions, lease, [{"step": 10, "reward": 1.0}])
        news = list(islice(messages, 2))
        assert (news[0].event, news[0].data) == ("metrics", {"step": 10, "reward": 1.0, "attempt": 1})
        assert (news[1].event, news[1].data["progress_step"]) == ("state", 10)
        records.append_logs(sessions, lease, [records.LogLine("info", "two\nlines \N{SNOWMAN}")])
        line = next(messages)
        assert (line.event, line.data["message"]) == ("log", "two\nlines \N{SNOWMAN}")
        outcomes.transition(sessions, lease, WorkState.EVALUATING)
        outcomes.transition(sessions, lease, WorkState.SUCCEEDED)
        rest = list(messages)
    kinds = [message.event for message in rest]
    assert kinds.count("event") == 2
    assert kinds[-2:] == ["state", "end"]
    assert rest[-1].data == {"state": "succeeded", "error": None}


@pytest.mark.parametrize("path", ["/jobs/stream", "/jobs/{}/stream"])
def test_a_follower_without_news_is_told_that_the_stream_lives(
    path: str, client: httpx.Client, run_job: Callable[..., Lease], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Proxies close silent connections, and only a write detects that a follower has disconnected."""
    for name in ("_IDLE_S", "_BLIND_S"):
        monkeypatch.setattr(broadcast, name, 0.05)
    with client.stream("GET", path.format(run_job().job_id)) as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        assert next(line for line in response.iter_lines() if line.startswith(":")) == ": ping"


def test_a_follower_that_comes_back_misses_nothing_and_hears_nothing_twice(
    client: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease], follow: Any
) -> None:
    lease = run_job()
    path = f"/jobs/{lease.job_id}/stream"
    total = 1200  # more than two batches
    append_metrics(sessions, lease, [{"step": step} for step in range(1, total + 1)])
    records.append_logs(sessions, lease, [records.LogLine("info", f"{n}") for n in range(700)])
    outcomes.transition(sessions, lease, WorkState.FAILED, error="gone")

    seen = []
    last_id = None
    for cut in (1, 700, 3, 650, 10_000):
        with follow(client, path, last_id=last_id) as messages:
            part = list(islice(messages, cut))
        seen += part
        last_id = part[-1].id
    assert [m.data["step"] for m in seen if m.event == "metrics"] == list(range(1, total + 1))
    assert [m.data["message"] for m in seen if m.event == "log"] == [str(n) for n in range(700)]
    ids = [m.data["id"] for m in seen if m.event == "event"]
    assert ids == sorted(set(ids))
    assert seen[-1].event == "end"
    assert seen[-1].data["error"] == "gone"


def test_a_follower_is_told_when_a_job_waits_for_another_reason(
    client: httpx.Client, sessions: Sessions, follow: Any, soon: Callable[..., bool]
) -> None:
    """Workers come and go without a change of the job."""
    path = f"/jobs/{client.post('/jobs', json={}).json()['id']}"
    with follow(client, f"{path}/stream", only="state") as messages:
        assert next(messages).data["waiting_reason"] == "no worker is running"
        none = Capabilities({}, [], [], [])
        registry.beat(sessions, "idle", host="h", pid=1, capabilities=none, version="1")
        assert soon(lambda: client.get(path).json()["waiting_reason"] == "no worker has simulator 'embedded'")
        with sessions.begin() as session:
            notify(session, path.rpartition("/")[2])  # else it looks by itself after some seconds
        assert next(messages).data["waiting_reason"] == "no worker has simulator 'embedded'"
    registry.leave(sessions, "idle")


def test_a_follower_may_start_behind_what_it_has_fetched(
    client: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease], follow: Any
) -> None:
    lease = run_job()
    append_metrics(sessions, lease, [{"step": step} for step in (1, 2, 3)])
    seq = client.get(f"/jobs/{lease.job_id}/metrics").json()["last_seq"]
    append_metrics(sessions, lease, [{"step": 4}])
    with follow(client, f"/jobs/{lease.job_id}/stream", only="metrics", metrics_after=seq) as messages:
        assert next(messages).data["step"] == 4


def test_a_resumed_job_sends_its_steps_again(
    client: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease], follow: Any
) -> None:
    lease = run_job()
    with follow(client, f"/jobs/{lease.job_id}/stream", only=["metrics", "event"], events_after=10**9) as messages:
        append_metrics(sessions, lease, [{"step": step} for step in (10, 20)])
        assert [m.data["step"] for m in islice(messages, 2)] == [10, 20]
        outcomes.lose(sessions, lease, "the trainer died")
        claim = claim_work(sessions, Job, lease.job_id, "worker-2")
        assert claim is not None
        outcomes.begin(sessions, claim.lease, step=10, resumed_from="x")
        append_metrics(sessions, claim.lease, [{"step": 20}])
        again = next(messages)
        assert (again.data["step"], again.data["attempt"]) == (20, 2)


def test_a_stream_of_a_deleted_job_ends(
    client: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease], follow: Any
) -> None:
    job = client.post("/jobs", json={}).json()["id"]
    with follow(client, f"/jobs/{job}/stream", only="state") as messages:
        assert next(messages).data["state"] == "queued"
        with sessions.begin() as session:
            session.delete(session.get_one(Job, job))
            notify(session, job)
        assert [(m.event, m.data) for m in messages] == [("gone", {"id": job})]


def test_followers_of_all_jobs_hear_of_their_own_only(
    client: httpx.Client, make_client: Callable[..., httpx.Client], follow: Any
) -> None:
    other = make_client("other", "submit")
    with follow(client, "/jobs/stream") as messages:
        ready = next(messages)
        assert ready.event == "ready"
        other.post("/jobs", json={})
        mine = client.post("/jobs", json={}).json()["id"]
        while (news := next(messages)).data["id"] != mine:
            assert news.data["owner"] == "alice"
        assert (news.event, news.data["state"]) == ("job", "queued")
        client.post(f"/jobs/{mine}/cancel")
        while (news := next(messages)).data["state"] != "cancelled":
            assert news.data["owner"] == "alice"
        client.delete(f"/jobs/{mine}")
        while (news := next(messages)).event != "gone":
            assert news.data["owner"] == "alice"
        assert news.data == {"id": mine}
    missed = client.post("/jobs", json={}).json()["id"]
    with follow(client, "/jobs/stream", last_id=ready.id) as messages:
        while next(messages).data.get("id") != missed:
            pass


def test_followers_of_all_jobs_hear_of_a_result_behind_the_end_of_a_job(
    client: httpx.Client,
    sessions: Sessions,
    run_job: Callable[..., Lease],
    save_checkpoint: Callable[..., str],
    follow: Any,
) -> None:
    lease = run_job()
    save_checkpoint(lease, 10, {"policy.npz": b"weights"})
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    asked = client.post(f"/jobs/{lease.job_id}/evaluations").raise_for_status().json()["id"]
    with follow(client, "/jobs/stream") as messages:
        assert next(messages).event == "ready"
        claim = claim_work(sessions, Evaluation, asked, "worker-1")
        assert claim is not None
        outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
        summary: dict[str, Any] = {"episodes": 3, "results": [], "headline": []}
        records.record_result(sessions, claim.lease, summary=summary, key="jobs/x", manifest={"files": []})
        assert outcomes.succeed(sessions, claim.lease) is None
        later = run_job().job_id
        news = takewhile(lambda message: message.data["id"] != later, messages)
        results = [message.data["result"] for message in news if message.data["id"] == lease.job_id]
    assert (results[-1]["evaluation_id"], results[-1]["episodes"]) == (asked, 3)


def test_followers_hear_of_more_jobs_than_fit_into_one_read(
    client: httpx.Client, sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1,280 jobs change at the same time, as when a group is submitted."""
    monkeypatch.setattr(broadcast, "_IDLE_S", 1.0)
    model = client.post("/jobs", json={"tags": ["many"]}).json()["id"]
    own = {"id", "updated_at", "changed_in"}
    names = [column.name for column in Job.__table__.columns if column.name not in own]
    copied = ", ".join(f'"{name}"' for name in names)
    missing = {f"job_{number:026d}" for number in range(1, 1281)}
    pings = 0
    with client.stream("GET", "/jobs/stream", params={"tag": "many"}) as response:
        lines = response.iter_lines()
        assert next(lines) == "event: ready"
        with sessions.begin() as session:
            session.execute(
                text(
                    f"INSERT INTO jobs (id, updated_at, {copied}) "
                    f"SELECT 'job_' || lpad(n::text, 26, '0'), now(), {copied} "
                    "FROM jobs, generate_series(1, 1280) AS n WHERE id = :model"
                ),
                {"model": model},
            )
        for line in lines:
            pings += line.startswith(":")
            assert pings < 5, f"{len(missing)} jobs are missing"
            if line.startswith('data: {"id":"job_'):
                missing.discard(json.loads(line.removeprefix("data: "))["id"])
            if not missing:
                break
    with sessions.begin() as session:
        session.execute(text("DELETE FROM jobs WHERE 'many' = ANY(tags)"))


def change(session: Session, job_id: str, at: Any) -> None:
    """Set when a job has changed; its followers are notified once the transaction is committed."""
    session.get_one(Job, job_id).updated_at = at
    session.flush()
    notify(session, job_id)


def test_followers_hear_of_changes_after_the_databases_clock_was_set_back(
    client: httpx.Client, sessions: Sessions, follow: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(broadcast, "_IDLE_S", 60.0)  # longer than the client waits
    before, after = (client.post("/jobs", json={}).json()["id"] for _ in range(2))
    with follow(client, "/jobs/stream") as messages:
        for job_id, ahead in ((before, timedelta(hours=1)), (after, timedelta())):
            with sessions.begin() as session:
                at = session.scalars(select(func.now() + ahead)).one()
                change(session, job_id, at)
            while (news := next(messages)).event != "job" or news.data["id"] != job_id:
                pass
            assert datetime.fromisoformat(news.data["updated_at"]) == at


@pytest.mark.parametrize("returns", [False, True])
def test_followers_hear_of_a_transaction_that_began_early_and_is_committed_late(
    client: httpx.Client, sessions: Sessions, follow: Any, monkeypatch: pytest.MonkeyPatch, returns: bool
) -> None:
    """Also one that returns with the id of a later change, which was committed earlier."""
    monkeypatch.setattr(broadcast, "_IDLE_S", 60.0)  # longer than the client waits
    late, other = (client.post("/jobs", json={}).json()["id"] for _ in range(2))
    with sessions() as session:
        change(session, late, func.now() - timedelta(hours=1))
        with follow(client, "/jobs/stream") as messages:
            for _ in range(2):
                client.patch(f"/jobs/{other}", json={"notes": "x"}).raise_for_status()
                while (news := next(messages)).data.get("id") != other:
                    assert news.data.get("id") != late
            if not returns:
                session.commit()
                while next(messages).data.get("id") != late:
                    pass
        if returns:
            session.commit()
            with follow(client, "/jobs/stream", last_id=news.id) as messages:
                while (news := next(messages)).data.get("id") != late:
                    assert news.event != "reset"


@pytest.mark.parametrize("last_id", ["x", "@", "2026-01-01T00:00:00+00:00", "0@{}", "-1@{}", f"{10**18}@{{}}", "{}@x"])
def test_a_follower_whose_id_is_not_known_reads_the_list_again(
    client: httpx.Client, follow: Any, monkeypatch: pytest.MonkeyPatch, last_id: str
) -> None:
    monkeypatch.setattr(broadcast, "_IDLE_S", 60.0)  # longer than the client waits
    with follow(client, "/jobs/stream") as messages:
        number, _, database = next(messages).id.partition("@")
    last_id = last_id.format(number if last_id == "{}@x" else database)
    with follow(client, "/jobs/stream", last_id=last_id) as messages:
        assert [message.event for message in islice(messages, 2)] == ["reset", "ready"]


@pytest.mark.parametrize(("most", "first"), [(3, ["ready", "job", "job", "job"]), (2, ["reset", "ready"])])
def test_a_follower_that_has_missed_too_much_reads_the_list_again(
    client: httpx.Client, follow: Any, monkeypatch: pytest.MonkeyPatch, most: int, first: list[str]
) -> None:
    monkeypatch.setattr(queries, "REPLAYED", most)
    with follow(client, "/jobs/stream") as messages:
        last_id = next(messages).id
    for _ in range(3):
        client.post("/jobs", json={}).raise_for_status()
    with follow(client, "/jobs/stream", last_id=last_id) as messages:
        assert [message.event for message in islice(messages, len(first))] == first


def test_many_old_ids_delay_no_other_owner(
    client: httpx.Client,
    make_client: Callable[..., httpx.Client],
    run_job: Callable[..., Lease],
    follow: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(queries, "REPLAYED", 1)
    greedy, job_id = make_client("greedy", "submit"), run_job().job_id
    for _ in range(2):
        greedy.post("/jobs", json={}).raise_for_status()
    with follow(greedy, "/jobs/stream") as messages:
        last_id = "1@" + next(messages).id.partition("@")[2]
    with ExitStack() as stack:
        streams = [stack.enter_context(follow(greedy, "/jobs/stream", last_id=last_id)) for _ in range(20)]
        with follow(client, f"/jobs/{job_id}/stream") as messages:
            assert next(messages).event == "event"
        for stream in streams:
            assert [message.event for message in islice(stream, 2)] == ["reset", "ready"]


def test_reads_of_one_owner_delay_no_other_owner_and_no_short_query() -> None:
    async def reads() -> None:
        feed, gate, done = Feed(make_sessions(make_engine("postgresql+psycopg://")), list), threading.Event(), []
        owner = [asyncio.create_task(feed.read("greedy", partial(gate.wait, 30))) for _ in range(20)]
        try:
            async with asyncio.timeout(20):
                await asyncio.sleep(0)  # they begin
                done += [await feed.read("other", lambda: "page"), await feed.in_thread(lambda: "token")]
                assert not any(task.done() for task in owner)
        finally:
            gate.set()
        assert await asyncio.gather(*owner) == [True] * 20
        assert done == ["page", "token"]

    asyncio.run(reads())


def test_followers_read_the_list_again_after_deletions_may_have_been_missed(
    client: httpx.Client, follow: Any, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(broadcast, "_BLIND_S", 0.05)
    monkeypatch.setattr(broadcast, "_IDLE_S", 60.0)  # longer than the client waits
    with follow(client, "/jobs/stream") as messages:
        assert next(messages).event == "ready"
        with psycopg.connect(database_url, autocommit=True) as connection:
            connection.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'naosprint-api-listen'"
            )
        while next(messages).event != "reset":
            pass


def test_deletions_that_a_busy_follower_does_not_take_are_limited() -> None:
    subscription = broadcast.Subscription()
    for number in range(broadcast.MOST_DELETED):
        subscription.add_deleted(f"{number}", "alice")
    deleted, missing = subscription.take_deleted()
    assert (len(deleted), missing) == (broadcast.MOST_DELETED, False)
    for number in range(broadcast.MOST_DELETED + 2):
        subscription.add_deleted(f"{number}", "alice")
    deleted, missing = subscription.take_deleted()
    assert (len(deleted), missing) == (1, True)
    assert subscription.take_deleted() == ({}, False)


def test_a_lock_that_is_not_granted_is_no_failure_of_the_database(
    start_api: Callable[..., Any], make_token: Callable[..., str], sessions: Sessions
) -> None:
    def wait_shortly(connection: psycopg.Connection[Any], _record: object) -> None:
        connection.execute("SET lock_timeout = 100")
        connection.commit()

    headers = {"Authorization": f"Bearer {make_token('alice', 'submit')}"}
    event.listen(Engine, "connect", wait_shortly)
    try:
        with httpx.Client(base_url=start_api().url, headers=headers, timeout=20) as client:
            job_id = client.post("/jobs", json={}).json()["id"]
            with sessions.begin() as session:
                session.get_one(Job, job_id, with_for_update=True)
                answer = client.post(f"/jobs/{job_id}/cancel")
            assert answer.status_code == 429
            assert answer.json()["detail"] == "another change of the same is still being stored; try again"
            assert int(answer.headers["retry-after"]) > 0
            assert client.post(f"/jobs/{job_id}/cancel").status_code == 200
    finally:
        event.remove(Engine, "connect", wait_shortly)


@pytest.mark.parametrize("last_id", ["x", "1-2", "-1-2-3", "9" * 40, "2026-01-01T00:00", "\u00b2-1-1"])
def test_a_strange_last_id_of_a_job_is_refused(client: httpx.Client, last_id: str) -> None:
    job = client.get("/jobs", params={"limit": 1}).json()["items"][0]["id"]
    answer = client.get(f"/jobs/{job}/stream", headers={"Last-Event-ID": last_id.encode()})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "Last-Event-ID"


def test_followers_hear_again_after_the_database_cut_the_line(
    client: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease], follow: Any, database_url: str
) -> None:
    lease = run_job()
    with follow(client, f"/jobs/{lease.job_id}/stream", only="metrics") as messages:
        append_metrics(sessions, lease, [{"step": 1}])
        assert next(messages).data["step"] == 1
        with psycopg.connect(database_url, autocommit=True) as connection:
            cut = connection.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name LIKE 'naosprint-api%'"
            ).fetchall()
        assert cut
        append_metrics(sessions, lease, [{"step": 2}])
        assert next(messages).data["step"] == 2
        append_metrics(sessions, lease, [{"step": 3}])
        assert next(messages).data["step"] == 3


def test_too_many_followers_are_sent_away(
    start_api: Callable[..., Any], make_token: Callable[..., str], run_job: Callable[..., Lease], follow: Any
) -> None:
    api = start_api(api_max_followers=2)
    path = f"/jobs/{run_job('crowd').job_id}/stream"
    headers = {"Authorization": f"Bearer {make_token('crowd', 'read')}"}
    with (
        httpx.Client(base_url=api.url, headers=headers) as client,
        follow(client, path) as first,
        follow(client, path) as second,
    ):
        next(first), next(second)
        refused = client.get(path)
        assert refused.status_code == 503
        assert int(refused.headers["retry-after"]) > 0


@pytest.mark.parametrize("path", ["/jobs/stream", "/jobs/{}/stream"])
@pytest.mark.parametrize("end", ["revoked", "expired"])
def test_a_stream_ends_with_its_token(
    start_api: Callable[..., Any],
    sessions: Sessions,
    run_job: Callable[..., Lease],
    follow: Any,
    soon: Callable[..., bool],
    monkeypatch: pytest.MonkeyPatch,
    path: str,
    end: str,
) -> None:
    monkeypatch.setattr(broadcast, "_IDLE_S", 0.1)
    path = path.format(run_job("leaver").job_id)
    valid_for = timedelta(seconds=3) if end == "expired" else None
    token, secret = create_token(sessions, name="", owner="leaver", scopes=[Scope.READ], valid_for=valid_for)
    headers = {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=start_api(api_recheck_s=0.2).url, headers=headers, timeout=20) as client:
        with follow(client, path) as messages:
            next(messages)
            if end == "revoked":
                revoke(sessions, token)
            for _ in messages:
                pass
        assert soon(lambda: client.get(path).status_code == 401)


def test_places_are_taken_before_they_are_used_and_an_owner_has_some_of_them(
    start_api: Callable[..., Any], make_token: Callable[..., str], run_job: Callable[..., Lease]
) -> None:
    """Many who come at the same moment get no more places than there are."""
    path = f"/jobs/{run_job('rush').job_id}/stream"
    url = start_api(api_max_followers=5, api_max_followers_per_owner=3).url

    def come(secret: str) -> int:
        with httpx.stream("GET", url + path, headers={"Authorization": f"Bearer {secret}"}, timeout=30) as response:
            chunks = response.iter_raw()  # an iterator that is dropped closes the connection
            if response.status_code == 200:
                next(chunks)
            done.wait(30)
            return response.status_code

    done = threading.Barrier(16)
    for _ in range(2):  # the second time shows that they are given back
        owners = (("rush", "read"), ("root", "admin"), ("rush", "submit"), ("root", "admin")) * 4
        secrets = [make_token(*owner) for owner in owners]
        with ThreadPoolExecutor(16) as pool:
            came = list(pool.map(come, secrets))
        assert (came.count(200), came.count(503)) == (5, 11)
        of_owner = [sum(status == 200 for status in came[first::2]) for first in (0, 1)]
        assert max(of_owner) == 3


def test_links_to_jobs_leave_streams_to_their_owner(
    start_api: Callable[..., Any], make_token: Callable[..., str], run_job: Callable[..., Lease], follow: Any
) -> None:
    """Who has a link may open many streams with it, or with several; the owner can follow the job all the same."""
    job = f"/jobs/{run_job('host').job_id}"
    url = start_api(api_max_followers_per_owner=5).url
    open_streams = []  # an iterator that is dropped closes the connection
    with ExitStack() as stack:

        def come(client: httpx.Client) -> None:
            open_streams.append(stack.enter_context(follow(client, f"{job}/stream")))
            next(open_streams[-1])

        def refused(client: httpx.Client) -> bool:
            with client.stream("GET", f"{job}/stream") as response:
                return response.status_code == 503

        def guest(secret: str) -> httpx.Client:
            headers = {"Authorization": f"Bearer {secret}"}
            return stack.enter_context(httpx.Client(base_url=url, headers=headers, timeout=20))

        host = guest(make_token("host", "submit"))
        guests = [guest(host.post(f"{job}/share").raise_for_status().json()["token"]) for _ in range(3)]
        for client in guests:
            come(client)
        assert all(map(refused, guests))
        for _ in range(2):
            come(host)
        assert refused(host)
