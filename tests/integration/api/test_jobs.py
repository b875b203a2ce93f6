"""Jobs over HTTP: submit, look up, control, and errors."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
from naojobs import leases, outcomes, records, registry
from naojobs.capabilities import Capabilities
from naojobs.leases import Lease
from naojobs.models import Job
from naojobs.states import WorkState
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.writes import append_metrics

UNKNOWN = "job_01m7y0bdkc59pc1szgpqz7ge55"


def submit(client: httpx.Client, **body: Any) -> dict[str, Any]:
    answer = client.post("/jobs", json=body)
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == f"/jobs/{answer.json()['id']}"
    job: dict[str, Any] = answer.json()
    return job


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    """Return the problem document of an answer; check that it is complete."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = answer.json()
    assert set(document) == {"type", "title", "status", "detail", "errors"}
    assert document["status"] == status
    assert document["detail"]
    return document


def test_a_job_from_submit_to_delete(client: httpx.Client) -> None:
    job = submit(client, name="first", tags=["a/b"], spec={"task": "sprint2", "total_steps": 1000})
    assert (job["state"], job["owner"], job["name"]) == ("queued", "alice", "first")
    assert (job["spec"]["task"]["name"], job["evaluation"]["task"]) == ("sprint2", None)
    path = f"/jobs/{job['id']}"
    assert client.get(path).json() == job
    assert client.post(f"{path}/pause").json()["state"] == "paused"
    assert client.post(f"{path}/resume").json()["state"] == "queued"
    problem(client.delete(path), 409)
    assert client.post(f"{path}/cancel").json()["state"] == "cancelled"
    assert client.post(f"{path}/retry").json()["state"] == "queued"
    assert client.post(f"{path}/cancel").json()["state"] == "cancelled"
    assert client.delete(path).status_code == 204
    problem(client.get(path), 404)


@pytest.mark.parametrize("count", [1, 2])
def test_a_job_whose_stages_have_candidates_is_listed_and_shown(
    client: httpx.Client, sessions: sessionmaker[Session], count: int
) -> None:
    """As this version writes it with one each, and as it was stored with several; the next job cannot start from it."""
    job = submit(client, name=f"of {count}", spec={"stages": [{"steps": 8192}, {"steps": 8192}]})
    with sessions.begin() as session:
        row = session.get_one(Job, job["id"])
        stages = [{**stage, "candidates": count} for stage in row.spec["stages"]]
        row.spec = {**row.spec, "format": 2, "stages": stages}
    shown = client.get(f"/jobs/{job['id']}").json()
    assert shown["spec"]["stages"] == (job["spec"]["stages"] if count == 1 else stages)
    assert shown in client.get("/jobs", params={"q": f"of {count}"}).json()["items"]
    answer = client.post("/jobs", json={"parent_job_id": job["id"]})
    if count == 1:
        assert answer.status_code == 201, answer.text
    else:
        assert "specifications this one cannot read; use a newer job" in problem(answer, 422)["detail"]


def test_an_empty_object_is_a_job_of_defaults(make_client: Callable[..., httpx.Client]) -> None:
    job = submit(make_client("dora", "submit"))
    assert (job["name"], job["spec"]["algorithm"]["preset"], job["priority"]) == ("sprint1-fast-0", "fast", 5)


def test_a_name_that_is_taken_is_numbered(make_client: Callable[..., httpx.Client]) -> None:
    alice, bob = make_client("alice", "submit"), make_client("bob", "submit")
    names = [submit(alice, name="first")["name"] for _ in range(3)]
    assert names == ["first", "first-2", "first-3"]
    assert submit(alice, name="first-2")["name"] == "first-2-2"
    assert submit(bob, name="first")["name"] == "first", "names are an owner's own"
    long = "x" * 200
    assert [submit(alice, name=long)["name"] for _ in range(2)] == [long, f"{long[:190]}-2"]
    group = alice.post("/groups", json={"job": {"name": "g"}, "seeds": [1]}).json()
    again = alice.post("/groups", json={"job": {"name": "g"}, "seeds": [1]}).json()
    assert [item["jobs"][0]["name"] for item in (group, again)] == ["g-seed-1", "g-seed-1-2"]


def test_jobs_submitted_at_once_have_different_names(make_client: Callable[..., httpx.Client]) -> None:
    client = make_client("carol", "submit")
    with ThreadPoolExecutor(8) as pool:
        names = list(pool.map(lambda _: submit(client, name="same")["name"], range(8)))
    assert sorted(names) == sorted(["same", *(f"same-{number}" for number in range(2, 9))])


def test_a_job_without_evaluation(client: httpx.Client) -> None:
    assert submit(client, evaluation=None)["evaluation"] is None


def test_a_key_makes_one_job(client: httpx.Client) -> None:
    headers = {"Idempotency-Key": "once"}
    first = client.post("/jobs", json={"name": "k"}, headers=headers)
    second = client.post("/jobs", json={"name": "k"}, headers=headers)
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json()["id"] == second.json()["id"]
    refused = problem(client.post("/jobs", json={"name": "other"}, headers=headers), 409)
    assert refused["errors"][0]["field"] == "Idempotency-Key"
    refused = problem(client.post("/jobs", json={}, headers={"Idempotency-Key": "a b"}), 422)
    assert refused["errors"][0]["field"] == "Idempotency-Key"


@pytest.mark.parametrize(
    ("body", "field", "hint"),
    [
        ({"spec": {"algorithm": {"learning_rate": 0}}}, "spec.algorithm.learning_rate", "greater than 0"),
        ({"spec": {"algorithm": {"learning_rat": 1}}}, "spec.algorithm.learning_rat", "no such setting"),
        ({"spec": {"learning_rate": 1}}, "spec.learning_rate", "write algorithm.learning_rate"),
        ({"spec": {"algorithm": {"batch_size": 1000}}}, "spec.algorithm.batch_size", "use a divisor"),
        ({"spec": {"algorithm": {"hidden_sizes": [64, 0]}}}, "spec.algorithm.hidden_sizes.1", "greater than or equal"),
        ({"spec": {"task": "marathon"}}, "spec.task", "choose one of"),
        ({"spec": {"task": {"name": "sprint1", "min_height_m": 0.5}}}, "spec.task.min_height_m", "smaller min_height"),
        ({"spec": {"task": {"name": "sprint1", "version": 9}}}, "spec.task.version", "installed is version"),
        ({"spec": {"task": {"drift_penalty": -1}}}, "spec.task.drift_penalty", "greater than or equal to 0"),
        ({"spec": {"robot": "r2"}}, "spec.robot", "choose one of"),
        ({"spec": {"robot": "nao-0", "simulator": "moon"}}, "spec.simulator", "choose one of"),
        ({"spec": {"task": {"name": "sprint1", "push_mps": 0.5}}}, "spec.task.push_mps", "use robot k1 or t1"),
        (
            {"spec": {"robot": "k1", "task": "velocity", "algorithm": {"imitation_steps": 9}}},
            "spec.algorithm.imitation_steps",
            "needs demonstrations",
        ),
        (
            {"spec": {"robot": "t1", "task": "getup"}, "evaluation": {"simulator": "server"}},
            "evaluation.simulator",
            "getup needs lying starts",
        ),
        (
            {"evaluation": {"task": {"name": "sprint1", "gravity_min": 0.5}}},
            "evaluation.task.gravity_min",
            "0.5 needs other gravity",
        ),
        ({"spec": {"robot": "nao-0"}, "evaluation": {"engine": "fast"}}, "evaluation.engine", "embedded with robot"),
        ({"spec": {"runtime": {"simulator_threads": 0}}}, "spec.runtime.simulator_threads", "greater than or equal"),
        ({"spec": {"stages": [{"steps": 0}]}}, "spec.stages.0.steps", "greater than or equal to 1"),
        ({"spec": {"stages": [{"steps": 9, "algorithm": {"gamma": 2}}]}}, "spec.stages.0.algorithm.gamma", "less than"),
        ({"evaluation": {"episodes": 0}}, "evaluation.episodes", "greater than or equal to 1"),
        ({"tags": ["ok", "not ok"]}, "tags.1", "letters, digits and ._:/=-"),
        ({"tags": ["a"] * 21}, "tags", "at most 20"),
        ({"name": "a\u0000b"}, "name", "without control, format and separator characters"),
        ({"name": " "}, "name", "at least 1 character"),
        ({"name": "last"}, "name", "refers to the newest job"),
        ({"priority": 10}, "priority", "less than or equal to 9"),
        ({"parent_checkpoint_id": "ckpt_01m7y0bdkc59pc1szgpqz7ge55"}, "parent_job_id", "give the job"),
        ({"parent_job_id": UNKNOWN}, "parent_job_id", "one of your jobs"),
        ({"parent_job_id": "../../etc/passwd"}, "parent_job_id", "expected a full id"),
        ([], "body", "JSON object"),
        ("text", "body", "JSON object"),
    ],
)
def test_bad_bodies_are_refused_by_field(client: httpx.Client, body: Any, field: str, hint: str) -> None:
    errors = problem(client.post("/jobs", json=body), 422)["errors"]
    assert [item["field"] for item in errors] == [field]
    assert hint in errors[0]["message"]


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"{'a': 1}", b"\xff\xfe", b'{"spec": {"learning_rate": NaN}}', b'{"spec":' * 5000, b"a: &a [*a, *a]"],
)
def test_broken_bodies_are_refused(client: httpx.Client, content: bytes) -> None:
    answer = client.post("/jobs", content=content, headers={"Content-Type": "application/json"})
    assert problem(answer, 422)["errors"]


def test_text_that_no_database_takes_is_refused(client: httpx.Client) -> None:
    headers = {"Content-Type": "application/json"}
    for text in (rb'{"name": "\ud800"}', rb'{"name": "a\u0000"}', rb'{"tags": ["\u0000"]}'):
        problem(client.post("/jobs", content=text, headers=headers), 422)


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("state=lost", "state.0"),
        ("limit=0", "limit"),
        ("limit=201", "limit"),
        ("cursor=x", "cursor"),
        ("q=%00", "q"),
        ("group='--", "group"),
    ],
)
def test_bad_queries_are_refused_by_field(client: httpx.Client, query: str, field: str) -> None:
    assert [item["field"] for item in problem(client.get(f"/jobs?{query}"), 422)["errors"]] == [field]


def test_paging_gives_every_job_once_newest_first(make_client: Callable[..., httpx.Client]) -> None:
    client = make_client("paging", "submit")
    ids = [submit(client, name=f"n{number}")["id"] for number in range(7)]
    found: list[str] = []
    cursor = None
    while True:
        page = client.get("/jobs", params={"limit": 3, **({"cursor": cursor} if cursor else {})}).json()
        found += [job["id"] for job in page["items"]]
        cursor = page["next_cursor"]
        submit(client, name="is submitted later and is on no page")
        if cursor is None:
            break
    assert found == list(reversed(ids))


def test_filters_narrow_the_list(make_client: Callable[..., httpx.Client]) -> None:
    client = make_client("filters", "submit")
    red = submit(client, name="Red_fast", tags=["x", "y"])["id"]
    blue = submit(client, name="blue%slow", tags=["x"])["id"]
    client.post(f"/jobs/{blue}/cancel")

    def ids(**params: Any) -> set[str]:
        return {job["id"] for job in client.get("/jobs", params=params).json()["items"]}

    assert ids() == {red, blue}
    assert ids(state="queued") == {red}
    assert ids(state=["queued", "cancelled"]) == {red, blue}
    assert ids(tag="x") == {red, blue}
    assert ids(tag=["x", "y"]) == {red}
    assert ids(tag="none") == ids(tag="\x00") == ids(tag=["x", "\x00"]) == set()
    assert ids(q="red_") == {red}
    assert ids(q="%") == {blue}, "wildcards are plain characters"
    assert ids(q=red[:20]) >= {red}
    assert ids(q=red[-6:]) == {red}, "lists show the end of ids"
    assert red in ids(q="sprint1") and red in ids(q="nao-0"), "task and robot"
    assert ids(owner="filters") == {red, blue}


def test_a_group_is_found_by_its_id(client: httpx.Client) -> None:
    answer = client.post("/groups", json={"job": {"tags": ["g"]}, "seeds": [1, 2, 3]})
    assert answer.status_code == 201
    group = answer.json()
    found = client.get("/jobs", params={"group": group["id"]}).json()["items"]
    assert {job["id"] for job in found} == {job["id"] for job in group["jobs"]}
    assert sorted(job["spec"]["seed"] for job in found) == [1, 2, 3]
    for body, field in (
        ({"job": {}}, "seeds"),
        ({"job": {}, "seeds": [-1]}, "grid.seed"),
        ({"job": {}, "grid": {"nonsense": [1]}}, "grid.nonsense"),
        ({"job": {}, "grid": {"n_epochs": [1] * 17, "n_envs": [1] * 17}}, "grid"),
    ):
        assert problem(client.post("/groups", json=body), 422)["errors"][0]["field"] == field


def test_nobody_without_a_token_gets_in(api: Any) -> None:
    with httpx.Client(base_url=api.url) as stranger:
        for method, path in (
            ("GET", "/jobs"),
            ("POST", "/jobs"),
            ("GET", f"/jobs/{UNKNOWN}"),
            ("DELETE", f"/jobs/{UNKNOWN}"),
            ("GET", f"/jobs/{UNKNOWN}/stream"),
            ("GET", "/jobs/stream"),
            ("GET", "/workers"),
            ("GET", "/metrics"),
            ("GET", "/whoami"),
        ):
            answer = stranger.request(method, path)
            assert problem(answer, 401)["errors"][0]["field"] == "Authorization"
            assert answer.headers["www-authenticate"].startswith("Bearer")
            for header in ("Bearer nao_wrong", "Basic YWRtaW46YWRtaW4=", "Bearer", "Bearer \u00ff"):
                answer = stranger.request(method, path, headers={"Authorization": header.encode("latin-1")})
                problem(answer, 401)


def test_a_token_that_may_only_read_changes_nothing(make_client: Callable[..., httpx.Client]) -> None:
    job = submit(make_client("reader", "submit"))["id"]
    reader = make_client("reader", "read")
    assert reader.get(f"/jobs/{job}").status_code == 200
    assert reader.get("/whoami").json() == {
        "owner": "reader",
        "scopes": ["read"],
        "job_id": None,
        "docs_url": "",
    }
    for method, path in (
        ("POST", "/jobs"),
        ("POST", "/groups"),
        ("POST", f"/jobs/{job}/cancel"),
        ("POST", f"/jobs/{job}/pause"),
        ("POST", f"/jobs/{job}/resume"),
        ("POST", f"/jobs/{job}/retry"),
        ("POST", f"/jobs/{job}/evaluations"),
        ("DELETE", f"/jobs/{job}"),
    ):
        assert "submit" in problem(reader.request(method, path, json={}), 403)["errors"][0]["message"]
    assert reader.get(f"/jobs/{job}").json()["state"] == "queued"


def test_jobs_of_others_do_not_exist(
    client: httpx.Client,
    admin: httpx.Client,
    make_client: Callable[..., httpx.Client],
    caplog: pytest.LogCaptureFixture,
) -> None:
    job = submit(client)["id"]
    mallory = make_client("mallory", "submit")
    for method, path in (
        ("GET", ""),
        ("GET", "/metrics"),
        ("GET", "/logs"),
        ("GET", "/events"),
        ("GET", "/stream"),
        ("GET", "/checkpoints"),
        ("GET", "/evaluations"),
        ("POST", "/evaluations"),
        ("POST", "/cancel"),
        ("POST", "/pause"),
        ("POST", "/resume"),
        ("POST", "/retry"),
        ("DELETE", ""),
    ):
        theirs = problem(mallory.request(method, f"/jobs/{job}{path}"), 404)
        nobodys = problem(mallory.request(method, f"/jobs/{UNKNOWN}{path}"), 404)
        assert theirs["detail"].replace(job, UNKNOWN) == nobodys["detail"], "the answers must not distinguish them"
        assert "refused mallory" in caplog.text and f"{job} belongs to alice" in caplog.text
        caplog.clear()
    assert mallory.get("/jobs").json()["items"] == []
    problem(mallory.get("/jobs", params={"owner": "alice"}), 404)
    problem(mallory.post("/jobs", json={"parent_job_id": job}), 422)
    assert admin.get(f"/jobs/{job}").json()["state"] == "queued"
    assert admin.get("/jobs", params={"owner": "alice", "q": job}).json()["items"][0]["id"] == job
    assert admin.post(f"/jobs/{job}/cancel").json()["state"] == "cancelled"


def test_a_running_job_is_asked_to_stop(
    client: httpx.Client, sessions: sessionmaker[Session], run_job: Callable[..., Lease]
) -> None:
    lease = run_job()
    paused = client.post(f"/jobs/{lease.job_id}/pause").json()
    assert (paused["state"], paused["pause_requested"], paused["worker"]) == ("pausing", True, "worker-1")
    problem(client.post(f"/jobs/{lease.job_id}/resume"), 409)
    cancelled = client.post(f"/jobs/{lease.job_id}/cancel").json()
    assert (cancelled["state"], cancelled["cancel_requested"]) == ("pausing", True)
    requests = leases.heartbeat(sessions, lease)
    assert (requests.state, requests.cancel) == (WorkState.PAUSING, True)
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    assert client.get(f"/jobs/{lease.job_id}").json()["state"] == "cancelled"


def test_metrics_by_column_thinned_on_request(
    client: httpx.Client, sessions: sessionmaker[Session], run_job: Callable[..., Lease]
) -> None:
    lease = run_job()
    path = f"/jobs/{lease.job_id}/metrics"
    assert client.get(path).json() == {"columns": {"step": []}, "rows": 0, "total_rows": 0, "last_seq": 0}
    append_metrics(
        sessions,
        lease,
        [{"step": 10 * n, "reward": float(n), **({"late": 1.0} if n > 900 else {})} for n in range(1, 1001)],
    )
    whole = client.get(path).json()
    assert (whole["rows"], whole["total_rows"]) == (1000, 1000)
    assert whole["columns"]["step"] == list(range(10, 10_001, 10))
    assert whole["columns"]["late"][899:902] == [None, 1.0, 1.0]
    for points in (2, 7, 100, 999, 1000):
        thin = client.get(path, params={"max_points": points}).json()
        steps = thin["columns"]["step"]
        assert points // 2 < len(steps) <= points
        assert steps[-1] == 10_000
        assert steps == sorted(set(steps))
        assert thin["columns"]["reward"] == [step / 10 for step in steps]
        assert thin["total_rows"] == 1000
    rest = client.get(path, params={"after_step": 9_980}).json()
    assert rest["columns"]["step"] == [9_990, 10_000]
    assert client.get(f"/jobs/{lease.job_id}").json()["latest_metrics"]["reward"] == 1000.0


def test_logs_and_events_continue_behind_the_last(
    client: httpx.Client, sessions: sessionmaker[Session], run_job: Callable[..., Lease]
) -> None:
    lease = run_job()
    path = f"/jobs/{lease.job_id}/logs"
    assert client.get(path).json() == {"items": [], "next_after": None}
    records.append_logs(sessions, lease, [records.LogLine("info", f"line {n}") for n in range(25)])
    found: list[str] = []
    after = 0
    while (page := client.get(path, params={"after": after, "limit": 10}).json())["items"]:
        found += [line["message"] for line in page["items"]]
        after = page["next_after"]
    assert found == [f"line {n}" for n in range(25)]
    tail = client.get(path, params={"tail": True, "limit": 2}).json()
    assert [line["message"] for line in tail["items"]] == ["line 23", "line 24"]
    events = client.get(f"/jobs/{lease.job_id}/events").json()["items"]
    assert [event["kind"] for event in events] == ["queued", "claimed", "started", "running"]


def test_workers_show_only_ones_own_jobs(
    client: httpx.Client,
    admin: httpx.Client,
    make_client: Callable[..., httpx.Client],
    sessions: sessionmaker[Session],
    run_job: Callable[..., Lease],
) -> None:
    lease = run_job()
    capabilities = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
    registry.beat(sessions, "worker-1", host="h", pid=1, capabilities=capabilities, version="1")
    for who, sees in ((client, True), (admin, True), (make_client("mallory", "read"), False)):
        (worker,) = who.get("/workers").json()["items"]
        assert (worker["id"], worker["alive"]) == ("worker-1", True)
        assert (worker["tasks"], worker["robots"], worker["simulators"]) == ({"sprint1": 1}, ["nao-0"], ["embedded"])
        assert (lease.job_id in worker["jobs"]) is sees
    registry.leave(sessions, "worker-1")


def test_a_stalled_job_is_shown_and_counted(
    client: httpx.Client, admin: httpx.Client, sessions: sessionmaker[Session], run_job: Callable[..., Lease]
) -> None:
    lease = run_job()
    outcomes.report_stall(sessions, lease, 400.0)
    shown = client.get(f"/jobs/{lease.job_id}").json()
    assert shown["stalled_since"] is not None
    assert "naosprint_stalled 1.0" in admin.get("/metrics").text
    assert "stalled" in [event["kind"] for event in client.get(f"/jobs/{lease.job_id}/events").json()["items"]]
    outcomes.report_stall(sessions, lease, None)
    assert client.get(f"/jobs/{lease.job_id}").json()["stalled_since"] is None
    outcomes.report_stall(sessions, lease, 400.0)
    outcomes.transition(sessions, lease, WorkState.FAILED, error="x")
    text = admin.get("/metrics").text
    assert "naosprint_stalled 0.0" in text
    assert "naosprint_jobs_failed_recently 1.0" in text


def test_a_queued_job_tells_why_no_worker_can_take_it(
    client: httpx.Client, sessions: sessionmaker[Session], soon: Callable[..., bool]
) -> None:
    job_id = client.post("/jobs", json={"spec": {"task": "sprint2"}}).json()["id"]

    def reason() -> str | None:
        reason: str | None = client.get(f"/jobs/{job_id}").json()["waiting_reason"]
        return reason

    assert soon(lambda: reason() == "no worker is running")
    capabilities = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
    registry.beat(sessions, "w", host="h", pid=1, capabilities=capabilities, version="1")
    assert soon(lambda: reason() == "no worker has task 'sprint2' version 1")
    (listed,) = [job for job in client.get("/jobs").json()["items"] if job["id"] == job_id]
    assert listed["waiting_reason"] == "no worker has task 'sprint2' version 1"
    other = client.post("/jobs", json={"spec": {"task": "sprint1"}}).json()
    assert other["waiting_reason"] is None
    assert client.post(f"/jobs/{job_id}/cancel").json()["waiting_reason"] is None
    registry.leave(sessions, "w")


@pytest.mark.parametrize(
    ("path", "body", "field"),
    [
        ("/jobs", '{"spec": {"seed": %s}}', "spec.seed"),
        ("/jobs", '{"spec": {"algorithm": {"gamma": %s}}}', "spec.algorithm.gamma"),
        ("/jobs", '{"priority": %s}', "priority"),
        ("/groups", '{"job": {}, "seeds": [%s]}', "seeds.0"),
        ("/groups", '{"job": {}, "grid": {"learning_rate": [0.001, %s]}}', "grid.learning_rate.1"),
    ],
)
@pytest.mark.parametrize("value", ["1" + "0" * 400, "1" + "0" * 5000, '"\\ud800"', "NaN", "1e999"], ids=range(5))
def test_values_that_nothing_can_hold_are_refused(
    client: httpx.Client, path: str, body: str, field: str, value: str
) -> None:
    answer = client.post(path, content=body % value, headers={"Content-Type": "application/json"})
    document = problem(answer, 422)
    # a number of more than 4300 digits is not valid JSON for Python
    assert document["errors"][0]["field"] == ("body" if len(value) > 4300 else field)


@pytest.mark.parametrize("body", ['{"name": "\\udfff"}', '{"tags": ["\\ud83d"]}', '{"\\ud800": 1}'])
def test_half_a_surrogate_pair_is_refused(client: httpx.Client, body: str) -> None:
    problem(client.post("/jobs", content=body, headers={"Content-Type": "application/json"}), 422)


def test_nonsense_is_refused_before_it_trains(client: httpx.Client) -> None:
    for name, section, value in (("learning_rate", "algorithm", 1.0), ("reward_scale", "task", 1e30)):
        document = problem(
            client.post(
                "/jobs", json={"spec": {section: {"name": "ppo" if section == "algorithm" else "sprint1", name: value}}}
            ),
            422,
        )
        assert document["errors"][0]["field"] == f"spec.{section}.{name}"
