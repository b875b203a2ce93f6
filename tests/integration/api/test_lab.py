"""What a lab's administrator does over HTTP: drain workers, count core hours; studies that are extended or asked."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
from naojobs import registry
from naojobs.capabilities import Capabilities
from naojobs.database import Sessions
from naojobs.leases import Lease, claim_next
from naojobs.models import Evaluation, Match, Study, Trial, TrialState
from naojobs.usage import add_usage

from tests.integration.attempts import claim_work
from tests.integration.writes import record_checkpoint

from .test_jobs import problem, submit

EVERYTHING = Capabilities({"sprint1": 1, "sprint2": 1}, ["nao-0"], ["embedded"], ["ppo"])


def test_only_an_administrator_drains_a_worker_which_then_claims_nothing(
    client: httpx.Client, admin: httpx.Client, sessions: Sessions
) -> None:
    registry.beat(sessions, "host:1:abc", host="host", pid=1, capabilities=EVERYTHING, version="1")
    job = submit(client)
    problem(client.post("/workers/host:1:abc/drain", json={}), 403)
    problem(admin.post("/workers/host:2:abc/drain", json={}), 404)
    problem(admin.post("/workers/host:1:abc/drain", json={"now": True}), 422)
    drained = admin.post("/workers/host:1:abc/drain", json={}).json()
    assert drained["drained_at"]
    assert admin.post("/workers/host:1:abc/drain", json={"requeue": True}).json()["drained_at"] == drained["drained_at"]
    registry.beat(sessions, "host:1:abc", host="host", pid=1, capabilities=EVERYTHING, version="1")
    assert claim_next(sessions, "host:1:abc", capabilities=EVERYTHING) is None
    assert admin.post("/workers/host:1:abc/undrain").json()["drained_at"] is None
    claim = claim_next(sessions, "host:1:abc", capabilities=EVERYTHING)
    assert claim is not None
    assert claim.lease.id == job["id"]


def test_a_drained_worker_shows_the_evaluation_and_the_match_that_it_still_runs(
    client: httpx.Client,
    admin: httpx.Client,
    make_client: Callable[..., httpx.Client],
    sessions: Sessions,
    run_job: Callable[..., Lease],
) -> None:
    lease = run_job("alice")
    record_checkpoint(sessions, lease, step=1, key=f"{lease.job_id}/1", manifest={"files": []})
    evaluation = client.post(f"/jobs/{lease.job_id}/evaluations").json()["id"]
    match = client.post("/matches", json={"teams": ["example", "example"], "players": 1}).json()["id"]
    registry.beat(sessions, "host:3:abc", host="host", pid=1, capabilities=EVERYTHING, version="1")
    assert claim_work(sessions, Evaluation, evaluation, "host:3:abc") is not None
    assert claim_work(sessions, Match, match, "host:3:abc") is not None
    drained = admin.post("/workers/host:3:abc/drain", json={}).json()
    assert (drained["jobs"], drained["evaluations"], drained["matches"]) == ([], [evaluation], [match])
    for who, shown in ((client, [[evaluation], [match]]), (make_client("mallory", "read"), [[], []])):
        worker = next(each for each in who.get("/workers").json()["items"] if each["id"] == "host:3:abc")
        assert [worker["evaluations"], worker["matches"]] == shown


def test_use_is_summed_by_owner_and_shown_to_its_owner(
    client: httpx.Client, admin: httpx.Client, sessions: Sessions, run_job: Callable[..., Lease]
) -> None:
    mine, theirs = run_job("alice"), run_job("carol")
    add_usage(sessions, mine, cpu_s=7200.0, run_s=3600.0)
    add_usage(sessions, mine, cpu_s=1.0, run_s=1.0)
    add_usage(sessions, theirs, cpu_s=9000.0, run_s=10.0)
    alice = {"owner": "alice", "cpu_s": 7201.0, "run_s": 3601.0}
    carol = {"owner": "carol", "cpu_s": 9000.0, "run_s": 10.0}
    assert client.get("/usage").json() == [alice]
    problem(client.get("/usage", params={"owner": "carol"}), 404)
    assert admin.get("/usage").json() == [carol, alice]
    tomorrow = (datetime.now(UTC) + timedelta(days=1)).date().isoformat()
    assert admin.get("/usage", params={"since": tomorrow}).json() == []
    assert admin.get("/usage", params={"until": tomorrow, "owner": "alice"}).json() == [alice]


def test_jobs_are_found_by_task_and_robot(client: httpx.Client) -> None:
    erect = submit(client, spec={"task": "sprint1-erect", "robot": "nao-2"})
    for wanted in ({"task": "sprint1-erect"}, {"robot": "nao-2"}, {"task": "sprint1-erect", "robot": "nao-2"}):
        assert [job["id"] for job in client.get("/jobs", params=wanted).json()["items"]] == [erect["id"]]
    assert client.get("/jobs", params={"task": "sprint1-erect", "robot": "nao-0"}).json()["items"] == []


def test_a_study_that_runs_elsewhere_over_http(
    client: httpx.Client, make_client: Callable[..., httpx.Client], sessions: Sessions
) -> None:
    search: dict[str, Any] = {"space": {"n_epochs": {"type": "int", "low": 1, "high": 3}}, "elsewhere": True}
    refused = problem(client.post("/studies", json={"job": {}, "search": search}), 422)
    assert "objectives with directions" in refused["detail"]
    search["objectives"] = [{"metric": "score", "direction": "minimize"}]
    study = client.post("/studies", json={"job": {}, "search": search}).json()
    path = f"/studies/{study['id']}"
    problem(client.post(f"{path}/ask"), 409)
    with sessions.begin() as session:  # as a worker starts it
        session.add(Trial(study_id=study["id"], number=0, state=TrialState.RUNNING, params={"n_epochs": 2}))
    problem(make_client("mallory", "submit").post(f"{path}/ask"), 404)
    with sessions() as session:  # another version has stored it
        row = session.get_one(Study, study["id"])
        spec, row.job = row.job["spec"], {**row.job, "spec": {"task": {"name": "gone"}}}
        session.commit()
        assert "does not fit this version" in problem(client.post(f"{path}/ask"), 409)["detail"]
        row.job = {**row.job, "spec": spec}
        session.commit()
    asked = client.post(f"{path}/ask").json()
    assert (asked["number"], asked["job_id"], asked["spec"]["algorithm"]["n_epochs"]) == (0, None, 2)
    tell = f"{path}/trials/0/tell"
    problem(client.post(tell, json={}), 422)
    problem(client.post(f"{path}/trials/7/tell", json={"values": [1.0]}), 404)
    assert client.post(tell, json={"values": [1.0]}).json()["values"] == [1.0]
    problem(client.post(tell, json={"error": "no"}), 409)
    problem(client.post(f"{path}/extend", json={"trials": 1}), 422)
    assert client.post(f"{path}/extend", json={"trials": 30}).json()["spec"]["trials"] == 30
    ordinary = client.post("/studies", json={"job": {}, "search": {"space": search["space"]}}).json()
    problem(client.post(f"/studies/{ordinary['id']}/ask"), 409)


def test_a_study_of_another_robot_has_no_results_of_a_nao(client: httpx.Client) -> None:
    search = {
        "space": {"n_epochs": {"type": "int", "low": 1, "high": 3}},
        "objectives": [{"metric": "run_challenge_score"}],
    }
    refused = problem(client.post("/studies", json={"job": {"spec": {"robot": "t1"}}, "search": search}), 422)
    assert "no metric 'run_challenge_score'" in refused["detail"] and "top_speed_mps" in refused["detail"]
    assert client.post("/studies", json={"job": {}, "search": search}).status_code == 201
