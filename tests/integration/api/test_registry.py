"""Registered policies over HTTP: versions, aliases, cards, and checkpoints that stay as long as they are in use."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import naopolicies
import pytest
from naojobs import outcomes, policies, records, studies, submission
from naojobs.errors import NotFoundError
from naojobs.leases import Lease
from naojobs.models import Checkpoint, Job, PolicyRecord, PolicyVersion, Study
from naojobs.promotion import MAX_ALIASES
from naojobs.records import MetricsRow
from naojobs.retention import Retention, prune_checkpoints
from naojobs.states import WorkState
from naojobs.store import ArtifactStore
from naospec import EvaluationSpec, TrainingSpec
from naosprint_api import cards
from sqlalchemy import select
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work

Sessions = sessionmaker[Session]

numbers = itertools.count(1)


@pytest.fixture
def name() -> str:
    """A name that no other test uses."""
    return f"mine-{next(numbers)}"


@pytest.fixture
def train(run_job: Callable[..., Lease], save_checkpoint: Callable[..., str], sessions: Sessions) -> Callable[..., Any]:
    """Train a job with a checkpoint at each of some steps; return its lease and the checkpoints' ids."""

    def train(*steps: int, owner: str = "alice", **fields: Any) -> tuple[Lease, list[str]]:
        lease = run_job(owner, **fields)
        rows = [MetricsRow(step, {"time_s": step / 10, "reward": 1.0, "distance_m": 2.0}) for step in steps]
        records.write(sessions, lease, records.Batch(metrics=rows))
        return lease, [save_checkpoint(lease, step, {"policy.npz": b"weights %d" % step}) for step in steps]

    return train


@pytest.fixture
def evaluate(sessions: Sessions, store: ArtifactStore) -> Callable[..., str]:
    """Record a finished evaluation of a checkpoint with one result; return its id."""

    def evaluate(lease: Lease, checkpoint_id: str, speed: float, episodes: int = 10) -> str:
        key = f"jobs/{lease.job_id}/evaluations/{checkpoint_id}-{episodes}"
        files = [store.put_bytes(f"{key}/replay.json", b'{"frames": [%d]}' % episodes).model_dump()]
        result = {"name": "top_speed_mps", "title": "Top speed", "unit": "m/s", "value": speed, "digits": 2}
        summary = {"episodes": episodes, "results": [result], "headline": ["top_speed_mps"], "tables": []}
        spec = EvaluationSpec(episodes=episodes)
        return records.record_evaluation(
            sessions,
            lease,
            checkpoint_id=checkpoint_id,
            spec=spec,
            summary={**summary, "evaluation": spec.model_dump(mode="json")},
            key=key,
            manifest={"files": files},
        )

    return evaluate


def register(client: httpx.Client, name: str, lease: Lease, checkpoint_id: str, *aliases: str) -> dict[str, Any]:
    body = {"job_id": lease.job_id, "checkpoint_id": checkpoint_id, "aliases": aliases}
    answer = client.post(f"/policies/{name}/versions", json=body)
    assert answer.status_code == 201, answer.text
    card: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/policies/{card['reference']}"
    return card


def test_versions_and_aliases(client: httpx.Client, name: str, train: Callable[..., Any]) -> None:
    lease, (first, second) = train(100, 200)
    assert register(client, name, lease, first, "best", "match")["aliases"] == ["best", "match"]
    assert register(client, name, lease, second)["reference"] == f"{name}@2"
    found = {version: client.get(f"/policies/{name}@{version}").json() for version in ("1", "2", "best", "latest")}
    assert [found[version]["version"] for version in found] == [1, 2, 1, 2]
    assert client.get(f"/policies/{name}").json() == found["latest"]
    promoted = client.put(f"/policies/{name}/aliases/best", json={"version": 2}).json()
    assert (promoted["version"], promoted["aliases"]) == (2, ["best"])
    listed = client.get(f"/policies/{name}/versions").json()["items"]
    assert [(card["version"], card["aliases"]) for card in listed] == [(2, ["best"]), (1, ["match"])]
    refused = client.delete(f"/policies/{name}/versions/1")
    assert (refused.status_code, "match" in refused.json()["detail"]) == (409, True)
    assert client.delete(f"/policies/{name}/aliases/match").status_code == 204
    assert client.delete(f"/policies/{name}/versions/1").status_code == 204
    assert client.get(f"/policies/{name}@1").status_code == 404
    missing = client.get(f"/policies/{name}@match")
    assert (missing.status_code, "latest, best" in missing.json()["detail"]) == (404, True)
    assert client.put(f"/policies/{name}/aliases/best", json={"version": 1}).status_code == 404
    # A number is not used again.
    assert register(client, name, lease, first)["version"] == 3
    # Nor when the last version is gone, or all of them: what names one would name another checkpoint.
    require = {"requirements": [{"result": "fall_rate", "most": 0.1}]}
    client.put(f"/policies/{name}/aliases/best/requirements", json=require).raise_for_status()
    for number, path in ((4, f"/policies/{name}"), (5, f"/policies/{name}/versions/4")):
        assert client.delete(path).status_code == 204
        assert client.get(f"/policies/{name}").status_code == 404
        assert client.delete(path).status_code == 404
        assert name not in [card["name"] for card in client.get("/policies?limit=200").json()["items"]]
        assert register(client, name, lease, first)["version"] == number
    assert client.put(f"/policies/{name}/aliases/best", json={"version": 5}).status_code == 200, "it requires nothing"


def test_a_card_has_metrics_and_lineage(
    client: httpx.Client, name: str, train: Callable[..., Any], evaluate: Callable[..., str]
) -> None:
    parent, (start,) = train(100)
    spec = TrainingSpec(algorithm={"name": "ppo", "learning_rate": 1e-4})
    lease, (point,) = train(50, spec=spec, parent_job_id=parent.job_id, parent_checkpoint_id=start)
    register(client, name, parent, start)
    card = register(client, name, lease, point)
    assert (card["results"], card["headline"], card["episodes"], card["evaluation"]) == ([], [], 0, None)
    evaluate(lease, point, 3.0, episodes=10)
    best = evaluate(lease, point, 3.5, episodes=20)
    card = client.get(f"/policies/{name}").json()
    assert (card["evaluation_id"], card["episodes"], card["results"][0]["value"]) == (best, 20, 3.5)
    assert card["evaluation"]["episodes"] == 20
    assert (card["job_id"], card["checkpoint_id"], card["owner"]) == (lease.job_id, point, "alice")
    assert (card["parent_policy"], card["spec_sha256"]) == (f"{name}@1", spec.digest())
    assert TrainingSpec.model_validate(card["spec"]) == spec
    first, last = card["lineage"]
    assert (first["job_id"], first["checkpoint_id"], first["steps"], first["training_s"]) == (
        parent.job_id,
        start,
        100,
        10,
    )
    assert (last["job_id"], last["checkpoint_id"], last["overrides"]) == (
        lease.job_id,
        point,
        {"algorithm.learning_rate": 1e-4},
    )
    assert (last["spec_sha256"], last["parent_policy"]) == (spec.digest(), f"{name}@1")
    assert (card["steps"], card["training_s"]) == (150, 15)
    replay = client.get(f"/policies/{name}@2/replay")
    assert replay.json() == {"frames": [20]}
    assert replay.headers["cache-control"] == "private, no-cache" and "Authorization" in replay.headers["vary"]
    known = {"If-None-Match": replay.headers["etag"]}
    assert client.get(f"/policies/{name}@2/replay", headers=known).status_code == 304
    evaluate(lease, point, 3.5, episodes=30)
    assert client.get(f"/policies/{name}@2/replay", headers=known).json() == {"frames": [30]}
    assert client.get(f"/policies/{name}@1/replay").status_code == 404, "it has not been evaluated"


def test_downloads_by_name(client: httpx.Client, name: str, train: Callable[..., Any]) -> None:
    lease, (point,) = train(100)
    register(client, name, lease, point, "best")
    (file,) = client.get(f"/policies/{name}@best").json()["files"]
    assert client.get(file["url"]).content == b"weights 100"
    for file in client.get("/policies/sprint").json()["files"]:
        data = client.get(file["url"]).content
        assert data == (naopolicies.folder("sprint") / file["name"]).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (file["sha256"], file["size"])
    assert client.get("/policies/sprint/files/card.json").status_code == 404


def test_bundled_policies_are_entries_that_no_one_changes(
    client: httpx.Client, name: str, train: Callable[..., Any]
) -> None:
    lease, (point,) = train(100)
    register(client, name, lease, point)
    cards = client.get("/policies").json()["items"]
    assert [card["name"] for card in cards if card["owner"] is None] == list(naopolicies.names())
    assert next(card for card in cards if card["name"] == name)["owner"] == "alice"
    body = {"job_id": lease.job_id, "checkpoint_id": point}
    refused = client.post("/policies/sprint/versions", json=body)
    assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "name")
    assert client.put("/policies/sprint/aliases/best", json={"version": 1}).status_code == 409
    assert client.delete("/policies/sprint").status_code == 409


def test_a_key_registers_one_version(client: httpx.Client, name: str, train: Callable[..., Any]) -> None:
    lease, (first, second) = train(100, 200)
    path, headers = f"/policies/{name}/versions", {"Idempotency-Key": "once"}
    body = {"job_id": lease.job_id, "checkpoint_id": first}
    answers = [client.post(path, json=body, headers=headers) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 200]
    assert answers[0].json() == answers[1].json()
    other = client.post(path, json={**body, "checkpoint_id": second}, headers=headers)
    assert (other.status_code, other.json()["errors"][0]["field"]) == (409, "Idempotency-Key")
    again = client.post(path, json=body)
    assert (again.status_code, f"{name}@1 is this checkpoint" in again.json()["detail"]) == (409, True)


def test_policies_belong_to_the_owner_of_the_job(
    client: httpx.Client,
    admin: httpx.Client,
    make_client: Callable[..., httpx.Client],
    name: str,
    train: Callable[..., Any],
) -> None:
    lease, (point,) = train(100)
    register(client, name, lease, point)
    mallory, reader = make_client("mallory", "submit"), make_client("alice", "read")
    assert reader.get(f"/policies/{name}").status_code == 200
    assert mallory.get(f"/policies/{name}").status_code == 404
    assert mallory.get(f"/policies/{name}", params={"owner": "alice"}).status_code == 404
    assert name not in [card["name"] for card in mallory.get("/policies").json()["items"]]
    assert mallory.post(f"/policies/{name}/versions", json={"job_id": lease.job_id}).status_code == 404
    changes = (("PUT", "/aliases/best"), ("DELETE", "/aliases/best"), ("DELETE", "/versions/1"), ("DELETE", ""))
    for method, path in changes:
        body = {"json": {"version": 1}} if method == "PUT" else {}
        assert mallory.request(method, f"/policies/{name}{path}", **body).status_code == 404
        assert reader.request(method, f"/policies/{name}{path}", **body).status_code == 403
    theirs, (point,) = train(100, owner="mallory")
    register(mallory, name, theirs, point)
    assert (mallory.get(f"/policies/{name}").json()["owner"], client.get(f"/policies/{name}").json()["owner"]) == (
        "mallory",
        "alice",
    )
    several = admin.get(f"/policies/{name}")
    assert (several.status_code, several.json()["errors"][0]["field"]) == (409, "owner")
    assert admin.get(f"/policies/{name}", params={"owner": "mallory"}).json()["job_id"] == theirs.job_id
    token = client.post(f"/jobs/{lease.job_id}/share").json()["token"]
    guest = httpx.get(client.base_url.join(f"/policies/{name}"), headers={"Authorization": f"Bearer {token}"})
    assert guest.status_code == 404


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"aliases": ["latest"]}, "aliases.0"),
        ({"aliases": ["3"]}, "aliases.0"),
        ({"notes": "\x00"}, "notes"),
        ({"job_id": "nothing"}, "job_id"),
    ],
)
def test_bad_requests_name_the_field(
    client: httpx.Client, run_job: Callable[..., Lease], body: dict[str, Any], field: str
) -> None:
    answer = client.post("/policies/bad/versions", json={"job_id": run_job().job_id, **body})
    assert (answer.status_code, [error["field"] for error in answer.json()["errors"]]) == (422, [field])


def test_an_owner_has_so_many_versions_at_most(
    start_api: Callable[..., Any], client: httpx.Client, name: str, train: Callable[..., Any]
) -> None:
    lease, (first, second) = train(100, 200, owner="alice")
    register(client, name, lease, first)
    strict = start_api(api_max_policy_versions=1)
    answer = httpx.post(
        f"{strict.url}/policies/{name}/versions",
        json={"job_id": lease.job_id, "checkpoint_id": second},
        headers={"Authorization": client.headers["Authorization"]},
    )
    assert (answer.status_code, "versions of policies, of 1" in answer.json()["detail"]) == (429, True)


def test_neither_retention_nor_deletion_takes_a_registered_checkpoint(
    client: httpx.Client, name: str, train: Callable[..., Any], sessions: Sessions
) -> None:
    lease, (_, registered, _, _) = train(100, 200, 300, 400)
    register(client, name, lease, registered)
    with sessions.begin() as session:  # so that none is the best by its reward
        session.execute(Checkpoint.__table__.update().values(step=Checkpoint.step + 1))
    prune_checkpoints(sessions, lease, Retention(1))
    with sessions.begin() as session:
        left = session.scalars(select(Checkpoint.step).where(Checkpoint.job_id == lease.job_id)).all()
    assert sorted(left) == [201, 401]
    outcomes.transition(sessions, lease, WorkState.SUCCEEDED)
    refused = client.delete(f"/jobs/{lease.job_id}")
    assert (refused.status_code, f"delete {name}@1 first" in refused.json()["detail"]) == (409, True)
    assert client.delete(f"/policies/{name}").status_code == 204
    assert client.delete(f"/jobs/{lease.job_id}").status_code == 204


def test_a_refused_deletion_names_no_work_of_another_user(
    client: httpx.Client, admin: httpx.Client, name: str, train: Callable[..., Any], sessions: Sessions
) -> None:
    lease, (checkpoint,) = train(1024)
    register(client, name, lease, checkpoint)
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    start = {"parent_job_id": lease.job_id, "parent_checkpoint_id": checkpoint}
    search = {"space": {"n_epochs": {"type": "int", "low": 1, "high": 3}}}
    admin.post("/studies", json={"job": start, "search": search}).raise_for_status()
    child = admin.post("/jobs", json=start).raise_for_status().json()["id"]

    def refusal(path: str) -> str:
        answer = client.delete(path)
        assert answer.status_code == 409, answer.text
        return str(answer.json()["detail"])

    assert refusal(f"/jobs/{lease.job_id}").startswith("a job of another user starts from the policy")
    assert refusal(f"/policies/{name}").startswith(f"a study of another user uses {name}@1")
    admin.post(f"/jobs/{child}/cancel").raise_for_status()
    with sessions.begin() as session:  # as before the version was registered
        session.delete(session.scalars(select(PolicyVersion).where(PolicyVersion.checkpoint_id == checkpoint)).one())
    assert refusal(f"/jobs/{lease.job_id}").startswith("a study of another user uses a checkpoint")


def test_a_training_starts_from_a_policy_by_name(
    client: httpx.Client, name: str, train: Callable[..., Any], sessions: Sessions
) -> None:
    lease, (first, second) = train(100, 200)
    register(client, name, lease, first, "best")
    register(client, name, lease, second)

    def submit(reference: str, **body: Any) -> httpx.Response:
        return client.post("/jobs", json={"parent_policy": reference, "evaluation": None, **body})

    job = submit(f"{name}@best").json()
    assert (job["parent_policy"], job["parent_job_id"], job["parent_checkpoint_id"]) == (
        f"{name}@1",
        lease.job_id,
        first,
    )
    claim = claim_work(sessions, Job, job["id"], "w")
    assert claim is not None
    assert claim.initial_policy is not None
    assert (claim.initial_policy.id, claim.bundled_policy) == (first, None)
    bundled = submit("sprint", spec=naopolicies.spec("sprint")).json()
    assert (bundled["parent_policy"], bundled["parent_job_id"]) == ("sprint", None)
    claim = claim_work(sessions, Job, bundled["id"], "w")
    assert claim is not None
    assert (claim.initial_policy, claim.bundled_policy) == (None, "sprint")
    for reference, part in (("nothing", "no policy 'nothing'"), (f"{name}@9", "no version '9'")):
        answer = submit(reference)
        assert (answer.status_code, answer.json()["errors"][0]["field"]) == (422, "parent_policy")
        assert part in answer.json()["detail"]
    assert submit("sprint", spec={"robot": "t1"}).json()["errors"][0]["field"] == "spec.robot"
    assert submit(name, parent_job_id=lease.job_id).status_code == 422


def test_a_version_stays_while_a_study_starts_from_it(
    client: httpx.Client, name: str, train: Callable[..., Any], sessions: Sessions
) -> None:
    """All trials start from the version that the name meant when the study began; the same key finds it ever after."""
    lease, (point,) = train(100)
    register(client, name, lease, point)
    outcomes.transition(sessions, lease, WorkState.FAILED, error="enough")
    search = {"space": {"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-3}}}
    body = {"search": search, "job": {"parent_policy": name, "evaluation": None}}

    def begin() -> httpx.Response:
        return client.post("/studies", json=body, headers={"Idempotency-Key": name})

    study = begin().json()["id"]
    for path in (f"/policies/{name}/versions/1", f"/policies/{name}"):
        refused = client.delete(path)
        assert refused.status_code == 409
        assert refused.json()["detail"] == f"study {study} uses {name}@1; wait for its end, or cancel it"
    with sessions.begin() as session:
        trial = studies.trial_job(studies.job_of(session.get_one(Study, study)), {"learning_rate": 5e-4})
        job, _ = submission.add_job(session, trial, "alice", see_all=True)
        assert (job.parent_policy, job.parent_checkpoint_id) == (f"{name}@1", point)
    assert client.post(f"/studies/{study}/cancel").status_code == 200
    assert client.delete(f"/policies/{name}").status_code == 204
    answer = begin()
    assert (answer.status_code, answer.json()["id"]) == (200, study)


def test_a_version_that_a_study_is_about_to_start_from_is_not_deleted_meanwhile(
    client: httpx.Client, name: str, train: Callable[..., Any], sessions: Sessions
) -> None:
    lease, (point,) = train(100)
    register(client, name, lease, point)
    with sessions() as session:
        policy_id = session.scalars(select(PolicyRecord.id).where(PolicyRecord.name == name)).one()
    with ThreadPoolExecutor(1) as pool:
        with sessions.begin() as session:
            policies.find(session, PolicyRecord.id == policy_id, f"{name}@1", keep=True)
            deletion = pool.submit(policies.delete_version, sessions, policy_id, 1)
            with pytest.raises(TimeoutError):
                deletion.result(0.5)
        deletion.result(30)


def test_the_lineage_begins_with_that_of_a_bundled_policy(
    client: httpx.Client, name: str, train: Callable[..., Any]
) -> None:
    spec = TrainingSpec.model_validate(naopolicies.spec("sprint"))
    lease, (point,) = train(100, spec=spec, parent_policy="sprint")
    card = register(client, name, lease, point)
    bundled = naopolicies.card("sprint")
    assert (card["parent_policy"], card["steps"]) == ("sprint", bundled["steps"] + 100)
    assert card["lineage"][:-1] == bundled["lineage"]


# --- requirements of aliases ----------------------------------------------------------------------------------------


@pytest.fixture
def measure(sessions: Sessions, store: ArtifactStore) -> Callable[..., None]:
    """Record an evaluation with one result and its interval, under some conditions."""
    count = itertools.count(1)

    def measure(
        lease: Lease,
        checkpoint_id: str,
        value: float,
        *,
        episodes: int = 200,
        settings: dict[str, Any] | None = None,
        **conditions: float,
    ) -> None:
        key = f"jobs/{lease.job_id}/evaluations/{checkpoint_id}-measured-{next(count)}"
        files = [store.put_bytes(f"{key}/replay.json", b'{"frames": []}').model_dump()]
        interval = [value - 0.01, value + 0.01]
        result = {"name": "fall_rate", "title": "Falls", "value": value, "interval": interval, "better": "lower"}
        summary = {"episodes": episodes, "results": [result], "headline": ["fall_rate"], "tables": []}
        task = {"name": "sprint1", **conditions} if conditions else None
        spec = EvaluationSpec(episodes=episodes, task=task, **settings or {})
        records.record_evaluation(
            sessions, lease, checkpoint_id=checkpoint_id, spec=spec, summary=summary, key=key, manifest={"files": files}
        )

    return measure


def refused(client: httpx.Client, name: str, version: int) -> str:
    """Return why `best` cannot name a version."""
    answer = client.put(f"/policies/{name}/aliases/best", json={"version": version})
    assert answer.status_code == 409, answer.text
    return str(answer.json()["detail"])


def test_an_alias_requires_results(
    client: httpx.Client, name: str, train: Callable[..., Any], measure: Callable[..., None]
) -> None:
    lease, (first, second, third) = train(1024, 2048, 3072)
    for checkpoint in (first, second):
        register(client, name, lease, checkpoint)
    shaken = {"start_noise_deg": 8.0, "fall_penalty_m": 1.0}
    wanted = [{"result": "fall_rate", "most": 0.03, "episodes": 200, "conditions": shaken}]
    path = f"/policies/{name}/aliases/best"
    answer = client.put(f"{path}/requirements", json={"requirements": wanted})
    assert answer.status_code == 200, answer.text
    (kept,) = answer.json()["requirements"]["best"]
    assert {key: kept[key] for key in wanted[0]} == wanted[0]

    measure(lease, first, 0.01)  # not from such starts
    measure(lease, first, 0.01, episodes=50, **shaken)  # too short
    measure(lease, first, 0.01, start_noise_deg=8.0)  # other conditions
    measure(lease, first, 0.01, settings={"start_noise_deg": 0.0}, **shaken)  # which replaces that of the task
    measure(lease, first, 0.01, settings={"confidence": 0.9999}, **shaken)  # whose intervals overlap with any
    bound = "fall_rate <= 0.03 with fall_penalty_m=1.0 start_noise_deg=8.0"
    assert refused(client, name, 1) == (
        f"{name}@1 cannot be best: {bound}: no evaluation of 200 episodes or more says so; run one"
    )
    measure(lease, first, 0.05, **shaken)
    assert refused(client, name, 1) == f"{name}@1 cannot be best: {bound}: it is 0.05"
    measure(lease, first, 0.02, settings={"simulator": "embedded"}, **shaken)  # the newest counts
    assert client.put(path, json={"version": 1}).status_code == 200

    body = {"job_id": lease.job_id, "checkpoint_id": third, "aliases": ["best"]}
    answer = client.post(f"/policies/{name}/versions", json=body)
    assert (answer.status_code, "cannot be best" in answer.json()["detail"]) == (409, True)
    assert len(client.get(f"/policies/{name}/versions").json()["items"]) == 2, "nothing of it is left"

    assert client.put(f"{path}/requirements", json={"requirements": []}).json()["requirements"] == {}
    assert client.put(path, json={"version": 2}).status_code == 200


def test_an_alias_with_requirements_refuses_a_version_that_cannot_be_read(
    client: httpx.Client, name: str, train: Callable[..., Any], sessions: Sessions
) -> None:
    lease, (first,) = train(1024)
    register(client, name, lease, first)
    path = f"/policies/{name}/aliases/best/requirements"
    wanted = {"requirements": [{"result": "fall_rate", "most": 0.1, "conditions": {"start_noise_deg": 8.0}}]}
    client.put(path, json=wanted).raise_for_status()
    with sessions.begin() as session:  # an older version had a setting of this name
        policy = session.scalars(select(PolicyRecord).where(PolicyRecord.name == name)).one()
        (stored,) = policy.requirements["best"]
        policy.requirements = {"best": [{**stored, "conditions": {"gone": 8.0}}]}
    assert "replace this requirement" in refused(client, name, 1)
    with sessions.begin() as session:  # and a task
        version = session.scalars(select(PolicyVersion).where(PolicyVersion.checkpoint_id == first)).one()
        version.spec = {"task": {"name": "gone"}}
    assert "version 1 cannot be read" in refused(client, name, 1)
    answer = client.put(path, json=wanted)
    assert (answer.status_code, "version 1 cannot be read" in answer.json()["detail"]) == (409, True)
    client.put(path, json={"requirements": []}).raise_for_status()
    assert client.put(f"/policies/{name}/aliases/best", json={"version": 1}).status_code == 200


def test_a_policy_has_so_many_aliases_at_most(client: httpx.Client, name: str, train: Callable[..., Any]) -> None:
    lease, (checkpoint,) = train(1024)
    register(client, name, lease, checkpoint)
    wanted = {"requirements": [{"result": "fall_rate", "most": 0.1}]}
    for number in range(MAX_ALIASES):
        path = f"/policies/{name}/aliases/a{number}"
        client.put(path, json={"version": 1}).raise_for_status()
        client.put(f"{path}/requirements", json=wanted).raise_for_status()
    more = f"/policies/{name}/aliases/more"
    for path, body in ((more, {"version": 1}), (f"{more}/requirements", wanted)):
        answer = client.put(path, json=body)
        assert answer.status_code in (409, 422), answer.text
        assert f"{MAX_ALIASES}" in answer.json()["detail"]


def test_a_successor_is_no_worse(
    client: httpx.Client, name: str, train: Callable[..., Any], measure: Callable[..., None]
) -> None:
    lease, checkpoints = train(1024, 2048, 3072)
    for checkpoint in checkpoints:
        register(client, name, lease, checkpoint)
    path = f"/policies/{name}/aliases/best"
    wanted = {"requirements": [{"result": "fall_rate", "no_worse": True}]}
    assert client.put(f"{path}/requirements", json=wanted).status_code == 200
    measure(lease, checkpoints[0], 0.10)
    assert client.put(path, json={"version": 1}).status_code == 200, "the first has no predecessor"
    measure(lease, checkpoints[1], 0.115)
    assert client.put(path, json={"version": 2}).status_code == 200, "the intervals overlap"
    measure(lease, checkpoints[2], 0.14)
    assert refused(client, name, 3).endswith("fall_rate not worse than now: it is 0.14, that of version 2 is 0.115")
    measure(lease, checkpoints[2], 0.05)
    assert client.put(path, json={"version": 3}).status_code == 200


@pytest.mark.parametrize(
    ("requirement", "message"),
    [
        ({"result": "fall_rate"}, "give most, least or no_worse"),
        ({"result": "fall_rate", "most": 0.1, "conditions": {"friction": 0.6}}, "friction"),
        ({"result": "fall_rate", "most": 0.1, "conditions": {"start_noise_deg": "low"}}, "start_noise_deg"),
        ({"result": "fall_rate", "most": 0.1, "conditions": {"friction_min": 0.6}}, "needs other friction"),
        ({"result": "fall_rate", "most": 0.1, "simulator": "nowhere"}, "nowhere"),
        ({"result": "Fall rate", "most": 0.1}, "result"),
        ({"result": "fal_rate", "most": 0.1}, "has no result 'fal_rate'; choose one of "),
        (
            {"result": "flight_share", "no_worse": True},
            "flight_share has no better direction; give most or least instead",
        ),
    ],
)
def test_a_requirement_that_nothing_could_meet_is_refused(
    client: httpx.Client, name: str, train: Callable[..., Any], requirement: dict[str, Any], message: str
) -> None:
    lease, (checkpoint,) = train(1024)
    register(client, name, lease, checkpoint)
    body = {"requirements": [requirement]}
    answer = client.put(f"/policies/{name}/aliases/best/requirements", json=body)
    assert answer.status_code == 422, answer.text
    assert message in answer.text


def test_a_policy_that_is_deleted_meanwhile_is_not_found(
    client: httpx.Client, name: str, train: Callable[..., Any], sessions: Sessions
) -> None:
    """The request has found it, and comes to its versions after its deletion and that of its job."""
    lease, (checkpoint,) = train(1024)
    register(client, name, lease, checkpoint)
    with sessions() as session:
        found = policies.find(session, PolicyRecord.owner == "alice", name)
    client.delete(f"/policies/{name}").raise_for_status()
    with pytest.raises(NotFoundError, match=name):
        policies.require(sessions, found[0].id, "best", [])
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    client.delete(f"/jobs/{lease.job_id}").raise_for_status()
    with pytest.raises(NotFoundError, match=name):
        cards.version_details(sessions, *found)


def test_only_its_owner_sets_what_an_alias_requires(
    client: httpx.Client, name: str, train: Callable[..., Any], make_client: Callable[..., httpx.Client]
) -> None:
    lease, (checkpoint,) = train(1024)
    register(client, name, lease, checkpoint)
    path, body = f"/policies/{name}/aliases/best/requirements", {"requirements": []}
    assert make_client("mallory", "submit").put(path, json=body).status_code == 404
    assert client.put("/policies/sprint/aliases/best/requirements", json=body).status_code == 409
