"""Jobs, groups, studies, evaluations and matches are submitted alike: key, address, tags, priority, earliest start."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from naojobs.database import Sessions
from naojobs.leases import Lease
from naojobs.models import Study
from naojobs.studies import job_of

from tests.integration.writes import record_checkpoint

from .test_jobs import problem

SEARCH = {"space": {"n_epochs": {"type": "int", "low": 1, "high": 3}}}


@pytest.fixture
def paths(run_job: Callable[..., Lease], sessions: Sessions) -> dict[str, str]:
    """Where each kind of work is submitted; alice's job has a checkpoint."""
    lease = run_job("alice")
    record_checkpoint(sessions, lease, step=1, key=f"{lease.job_id}/1", manifest={"files": []})
    names = ("jobs", "groups", "studies", "matches")
    return {**{name: f"/{name}" for name in names}, "evaluations": f"/jobs/{lease.job_id}/evaluations"}


def body_of(kind: str, **common: Any) -> dict[str, Any]:
    """Return a request of a kind of work with fields that all have in common."""
    if kind == "matches":
        return {"teams": ["example", "example"], "players": 1, **common}
    return {
        "groups": {"job": common, "seeds": [1, 2]},
        "studies": {"job": common, "search": SEARCH},
    }.get(kind, common)


def place_of(kind: str, field: str) -> str:
    return f"job.{field}" if kind in ("groups", "studies") else field


@pytest.mark.parametrize("kind", ["jobs", "groups", "studies", "evaluations", "matches"])
def test_all_work_is_submitted_alike(
    client: httpx.Client, paths: dict[str, str], kind: str, sessions: Sessions
) -> None:
    path, key = paths[kind], {"Idempotency-Key": "once"}
    later = (datetime.now(UTC) + timedelta(hours=3)).replace(microsecond=0)
    body = body_of(kind, tags=["night", "x:1"], priority=7, max_attempts=2, not_before=later.isoformat())
    first = client.post(path, json=body, headers=key)
    assert first.status_code == (202 if kind == "evaluations" else 201), first.text
    again = client.post(path, json=body, headers=key)
    assert (again.status_code, again.json()["id"]) == (200, first.json()["id"])
    assert first.headers["location"] == again.headers["location"]
    refused = problem(client.post(path, json=body_of(kind, priority=1), headers=key), 409)
    assert refused["errors"][0]["field"] == "Idempotency-Key"
    found = client.get(first.headers["location"]).json()
    if kind == "studies":
        with sessions() as session:
            job = job_of(session.get_one(Study, found["id"]))
        made = [{**{name: getattr(job, name) for name in ("priority", "max_attempts")}, "tags": list(job.tags)}]
        moments = [job.not_before]
    else:
        made = found["items"] if kind == "groups" else [found]
        moments = [datetime.fromisoformat(each["not_before"]) for each in made]
        assert all("to start at" in each["waiting_reason"] for each in made)
    assert all((each["tags"], each["priority"], each["max_attempts"]) == (["night", "x:1"], 7, 2) for each in made)
    assert set(moments) == {later}


@pytest.mark.parametrize("kind", ["jobs", "groups", "studies", "evaluations", "matches"])
def test_all_work_names_the_field_that_is_wrong(client: httpx.Client, paths: dict[str, str], kind: str) -> None:
    for field, value in (("priority", 10), ("max_attempts", 0), ("not_before", "2026-12-01T06:00"), ("tags", ["a b"])):
        refused = problem(client.post(paths[kind], json=body_of(kind, **{field: value})), 422)
        assert refused["errors"][0]["field"].startswith(place_of(kind, field))


@pytest.mark.parametrize(
    "moment",
    [
        "9999-12-31T23:59:59-12:00",
        "9999-12-31T23:59:59Z",
        "9000-01-01T00:00:00Z",
        "1999-12-31T23:59:59Z",
        "0001-01-01T00:00:00+14:00",
    ],
)
@pytest.mark.parametrize("kind", ["jobs", "groups", "studies", "evaluations", "matches"])
def test_a_start_is_a_time_that_exists_in_every_zone(
    client: httpx.Client, paths: dict[str, str], kind: str, moment: str
) -> None:
    refused = problem(client.post(paths[kind], json=body_of(kind, not_before=moment)), 422)
    assert [each["field"] for each in refused["errors"]] == [place_of(kind, "not_before")]
    assert "from the year 2000 to the year 8999" in refused["detail"]


def test_a_start_is_stored_in_utc(client: httpx.Client) -> None:
    """So that a repeated request is equal whatever zone it names."""
    answers = [
        client.post("/jobs", json={"not_before": moment}, headers={"Idempotency-Key": "zones"})
        for moment in ("8999-12-31T23:59:59Z", "9000-01-01T13:59:59+14:00")
    ]
    assert [answer.status_code for answer in answers] == [201, 200]
    assert {answer.json()["not_before"] for answer in answers} == {"8999-12-31T23:59:59Z"}


@pytest.mark.parametrize("kind", ["jobs", "groups", "studies"])
def test_a_wrong_job_is_named_where_it_stands(client: httpx.Client, paths: dict[str, str], kind: str) -> None:
    unknown = {"parent_job_id": "job_00000000000000000000000000"}
    refused = problem(client.post(paths[kind], json=body_of(kind, **unknown)), 422)
    assert refused["errors"][0]["field"] == place_of(kind, "parent_job_id")


def test_matches_are_found_by_tag(client: httpx.Client) -> None:
    ids = [client.post("/matches", json=body_of("matches", tags=tags)).json()["id"] for tags in (["a", "b"], ["a"])]
    for tags, found in ((["a"], ids[::-1]), (["a", "b"], ids[:1]), (["c"], []), (["\x00"], [])):
        assert [match["id"] for match in client.get("/matches", params={"tag": tags}).json()["items"]] == found


def test_a_study_elsewhere_has_no_start(client: httpx.Client) -> None:
    search = {**SEARCH, "elsewhere": True, "objectives": [{"metric": "score", "direction": "maximize"}]}
    body = {"job": {"not_before": "2030-01-01T00:00:00Z"}, "search": search}
    assert "leave it out" in problem(client.post("/studies", json=body), 422)["detail"]


def test_an_evaluation_can_ask_for_a_film(client: httpx.Client, paths: dict[str, str]) -> None:
    asked = client.post(paths["evaluations"], json={"report": "film"}).json()
    assert asked["report"] == client.get(f"/evaluations/{asked['id']}").json()["report"] == "film"
    assert client.post(paths["evaluations"]).json()["report"] is None
    problem(client.post(paths["evaluations"], json={"report": "poster"}), 422)
