"""Uploads of teams at the same time, and deletions beside submissions of matches."""

from __future__ import annotations

import io
import json
import tarfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from naojobs import outcomes, policies
from naojobs.database import Sessions
from naojobs.errors import ConflictError, QuotaError
from naojobs.matches import MatchRequest, submit_match
from naojobs.models import Job, PolicyRecord
from naojobs.quotas import Quota
from naojobs.states import WorkState
from naojobs.store import ArtifactStore, ManifestEntry
from naojobs.submission import JobRequest, submit
from naojobs.teams import delete_team, list_teams, upload_team
from naospec import TrainingSpec
from sqlalchemy import Engine, event, text

from tests.integration.attempts import claim_work
from tests.integration.writes import record_checkpoint


def packed() -> bytes:
    """Return the archive of a team."""
    content = json.dumps({"command": ["{python}", "player.py"]}).encode()
    buffer, info = io.BytesIO(), tarfile.TarInfo("team.json")
    info.size = len(content)
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def test_uploads_at_the_same_time_stay_within_the_quota(
    sessions: Sessions, store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of them have found room before the first is stored."""
    data = packed()
    all_here, put = threading.Barrier(4), store.put_bytes

    def put_bytes(key: str, content: bytes) -> ManifestEntry:
        all_here.wait(30)
        return put(key, content)

    monkeypatch.setattr(store, "put_bytes", put_bytes)

    def upload(number: int) -> str:
        limits = {Quota.BYTES: 2 * len(data) + 100}
        try:
            return upload_team(sessions, store, owner="ann", name=f"t{number}", data=data, limits=limits).name
        except QuotaError as error:
            return str(error)

    with ThreadPoolExecutor(4) as pool:
        ended = list(pool.map(upload, range(4)))
    assert sum("delete jobs, matches or teams" in each for each in ended) == 2, ended
    assert len(list_teams(sessions, "ann", limit=10, after=None)) == 2


@pytest.fixture
def deletions(sessions: Sessions, store: ArtifactStore) -> dict[str, tuple[str, Callable[[], object]]]:
    """By kind of what a match may need: a team that needs one, and what deletes it."""
    walker = JobRequest(TrainingSpec.model_validate({"task": "velocity", "robot": "t1"}))
    job = submit(sessions, walker, owner="bea")[0]
    claim = claim_work(sessions, Job, job.id, "w")
    assert claim is not None
    outcomes.begin(sessions, claim.lease, step=0)
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    record_checkpoint(sessions, claim.lease, step=10, key=f"jobs/{job.id}/checkpoints/10", manifest={"files": []})
    name = job.id.replace("_", "-")
    version, _ = policies.register(sessions, name, policies.Registration(job.id))
    upload_team(sessions, store, owner="bea", name=name, data=packed())
    with sessions() as session:
        policy = session.get_one(PolicyRecord, version.policy_id)
    return {
        "team": (name, lambda: delete_team(sessions, "bea", name)),
        "version": (
            f"example:walk={name}@{version.number}",
            lambda: policies.delete_version(sessions, policy.id, version.number),
        ),
        "policy": (f"example:walk={name}", lambda: policies.delete_policy(sessions, policy.id)),
    }


@pytest.mark.parametrize("kind", ["team", "version", "policy"])
def test_a_deletion_waits_for_a_match_that_is_being_submitted(
    sessions: Sessions, engine: Engine, deletions: dict[str, tuple[str, Callable[[], object]]], kind: str
) -> None:
    """The match has found what it needs, and is not stored yet."""
    name, delete = deletions[kind]
    found, asked = threading.Event(), threading.Event()

    def stop(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        if statement.startswith("INSERT INTO matches"):
            found.set()
            assert asked.wait(30)

    wanted = MatchRequest(teams=(name, "example"), games=1, players=1, half_s=1.0)
    event.listen(engine, "before_cursor_execute", stop)
    try:
        with ThreadPoolExecutor(2) as pool:
            submission = pool.submit(submit_match, sessions, wanted, owner="bea")
            assert found.wait(30), submission.exception(0)
            deletion = pool.submit(delete)
            with sessions() as session:
                while not session.scalar(text("SELECT count(*) FROM pg_locks WHERE NOT granted")):
                    assert not deletion.done(), "it did not wait"
            asked.set()
            match, _ = submission.result(30)
            with pytest.raises(ConflictError, match=match.id):
                deletion.result(30)
    finally:
        asked.set()
        event.remove(engine, "before_cursor_execute", stop)
