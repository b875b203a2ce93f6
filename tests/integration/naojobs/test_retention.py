"""Only unneeded checkpoints and files that no row refers to are deleted."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime, timedelta, tzinfo

import pytest
from naojobs import backups, outcomes, requests, submission
from naojobs.__main__ import main
from naojobs.errors import LeaseLostError
from naojobs.leases import Lease
from naojobs.models import Checkpoint, Evaluation, Job, ServiceKey
from naojobs.retention import ForeignStoreError, Retention, adopt, find_orphans, prune_checkpoints, sweep
from naojobs.states import WorkState
from naojobs.store import OWNER, ArtifactStore, StoreError, checkpoint_key, evaluation_key, team_key
from naojobs.submission import JobRequest
from naospec import EvaluationSpec, TrainingSpec
from naospec.flat import nest
from sqlalchemy import Engine, event, select, update
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import append_metrics, record_checkpoint, request_evaluation

Sessions = sessionmaker[Session]

ROLLOUT, INTERVAL = 100, 250
"""Steps between two updates, and planned between two checkpoints."""


@pytest.fixture
def lease(sessions: Sessions) -> Lease:
    """The lease of a running job that saves a checkpoint every 250 steps, that is at 300, 500, 800, 1000 ..."""
    spec = {"n_envs": 10, "n_steps": 10, "batch_size": 50, "checkpoint_interval_steps": INTERVAL}
    job, _ = submission.submit(sessions, JobRequest(TrainingSpec.model_validate(nest(spec))), owner="alice")
    claim = claim_work(sessions, Job, job.id, "worker-1")
    assert claim is not None
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    return claim.lease


@pytest.fixture
def save(sessions: Sessions, store: ArtifactStore, lease: Lease) -> Callable[[int], str]:
    """Store and record a checkpoint of a step; return its id."""

    def save(step: int) -> str:
        key = checkpoint_key(lease.job_id, step, lease.attempt)
        entry = store.put_bytes(f"{key}/policy.npz", b"policy")
        manifest = {"files": [entry.model_dump()]}
        store.put_bytes(f"{key}/manifest.json", json.dumps(manifest).encode())
        return record_checkpoint(sessions, lease, step=step, key=key, manifest=manifest)

    return save


def steps(sessions: Sessions, job_id: str) -> list[int]:
    with sessions() as session:
        return list(
            session.scalars(select(Checkpoint.step).where(Checkpoint.job_id == job_id).order_by(Checkpoint.step))
        )


PLANNED = [0, 300, 500, 800, 1000, 1300, 1500, 1800, 2000]


@pytest.mark.parametrize(
    ("wanted", "kept"),
    [
        (Retention(2), [1800, 2000]),
        (Retention(20), PLANNED),
        (Retention(2, every=3), [0, 800, 1500, 1800, 2000]),
        (Retention(2, every=1), PLANNED),
    ],
)
def test_the_newest_and_every_nth_are_kept(
    sessions: Sessions, lease: Lease, save: Callable[[int], str], wanted: Retention, kept: list[int]
) -> None:
    for step in PLANNED:
        save(step)
    keys = prune_checkpoints(sessions, lease, wanted)
    assert steps(sessions, lease.job_id) == kept
    assert sorted(keys) == [checkpoint_key(lease.job_id, step, 1) for step in PLANNED if step not in kept]
    assert prune_checkpoints(sessions, lease, wanted) == []


def test_a_checkpoint_between_the_planned_ones_is_not_one_of_the_nth(
    sessions: Sessions, lease: Lease, save: Callable[[int], str]
) -> None:
    """Such as that of a pause."""
    for step in (500, 700, 1500, 1800):
        save(step)
    prune_checkpoints(sessions, lease, Retention(2, every=2))
    assert steps(sessions, lease.job_id) == [500, 1500, 1800]


def test_what_something_refers_to_and_the_best_are_kept(
    sessions: Sessions, lease: Lease, save: Callable[[int], str]
) -> None:
    ids = {step: save(step) for step in PLANNED}
    rewards: Iterable[tuple[int, float]] = ((300, 1.0), (500, 10.0), (700, 99.0), (1000, 9.5), (1800, -1.0))
    append_metrics(sessions, lease, [{"step": step, "reward": reward} for step, reward in rewards])
    append_metrics(sessions, lease, [{"step": 2000, "loss": 1.0}])
    request_evaluation(sessions, lease.job_id, checkpoint_id=ids[800])
    parent = JobRequest(parent_job_id=lease.job_id, parent_checkpoint_id=ids[1300], spec=TrainingSpec())
    submission.submit(sessions, parent, owner="alice")
    prune_checkpoints(sessions, lease, Retention(2))
    # No checkpoint was saved at step 700, although its reward was the highest.
    assert steps(sessions, lease.job_id) == [500, 800, 1300, 1800, 2000]


def test_who_lost_the_lease_removes_nothing(sessions: Sessions, lease: Lease, save: Callable[[int], str]) -> None:
    for step in PLANNED:
        save(step)
    outcomes.lose(sessions, lease, "the trainer died")
    with pytest.raises(LeaseLostError):
        prune_checkpoints(sessions, lease, Retention(2))
    assert steps(sessions, lease.job_id) == PLANNED


def grow_old(store: ArtifactStore, prefix: str, age: timedelta = timedelta(hours=25)) -> None:
    """Set old modification times on files."""
    assert store.local_root is not None
    at = time.time() - age.total_seconds()
    for key in store.list(prefix):
        os.utime(store.local_root / key, (at, at))


@pytest.fixture
def used(sessions: Sessions, store: ArtifactStore) -> None:
    """Make this database have used the store for longer than files without a row are kept."""
    adopt(sessions, store)
    owner = json.loads(store.get_bytes(OWNER))
    owner["since"] = (datetime.now(UTC) - timedelta(hours=25)).isoformat()
    store.put_bytes(OWNER, json.dumps(owner).encode())


LOST = "jobs/job_01m7y0bdkc59pc1szgpqz7ge55/checkpoints/000000000001-1"


def test_nothing_is_swept_from_a_store_of_another_service(
    sessions: Sessions, store: ArtifactStore, lease: Lease, save: Callable[[int], str], used: None
) -> None:
    """A worker with another database, or with one that was lost and made again, begins with a sweep."""
    save(300)
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    store.put_bytes(f"{LOST}/a", b"a")
    grow_old(store, "jobs")
    with sessions.begin() as session:
        session.execute(update(ServiceKey).values(key=secrets.token_hex(4)))
    files = store.list("jobs")
    for sweeps in (find_orphans, sweep):
        with pytest.raises(ForeignStoreError, match=r"another service's.*artifacts adopt"):
            sweeps(sessions, store)
    assert store.list("jobs") == files
    adopt(sessions, store, force=True)
    assert sweep(sessions, store) == []  # not before a day has passed
    assert sweep(sessions, store, age_s=0) == [LOST]


def test_a_store_without_owner_becomes_that_of_a_database_that_refers_to_its_files(
    sessions: Sessions, store: ArtifactStore, lease: Lease, save: Callable[[int], str]
) -> None:
    for prefix in ("jobs", "service"):
        store.delete_prefix(prefix)
    store.put_bytes(f"{LOST}/a", b"a")
    with pytest.raises(ForeignStoreError, match="refers to none of the files"):
        sweep(sessions, store, age_s=0)
    save(300)
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    assert sweep(sessions, store, age_s=0) == [LOST]
    store.put_bytes(OWNER, b"{")
    with pytest.raises(ForeignStoreError, match="damaged"):
        sweep(sessions, store, age_s=0)
    store.delete_file(OWNER)


def test_a_restored_database_deletes_nothing_for_a_day(
    sessions: Sessions, store: ArtifactStore, lease: Lease, save: Callable[[int], str], used: None
) -> None:
    """Recovery to a moment that was too early can be repeated with a later one."""
    save(300)
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    store.put_bytes(f"{LOST}/a", b"a")
    grow_old(store, "jobs")
    assert find_orphans(sessions, store) == [LOST]
    backups.renew_generation(sessions)
    assert sweep(sessions, store) == []
    assert sweep(sessions, store, age_s=0) == [LOST]


def test_files_that_no_row_refers_to_are_swept(
    sessions: Sessions, store: ArtifactStore, lease: Lease, save: Callable[[int], str], used: None
) -> None:
    save(300)
    lost = checkpoint_key("job_01m7y0bdkc59pc1szgpqz7ge55", 1, 1)
    cut = evaluation_key(lease.job_id, "eval_01m7y0bdkc59pc1szgpqz7ge55", 1)
    young = checkpoint_key("job_01m7y0bdkc59pc1szgpqz7ge56", 1, 1)
    for key in (lost, cut, young):
        store.put_bytes(f"{key}/a", b"a")
    store.put_bytes("probes/left", b"probe")
    for prefix in (f"jobs/{lease.job_id}", lost, "probes"):
        grow_old(store, prefix)

    # A worker has leased the job, so the age of its files does not matter.
    assert find_orphans(sessions, store) == [lost, "probes/left"]
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    assert sorted(sweep(sessions, store)) == sorted([lost, cut, "probes/left"])
    assert sweep(sessions, store) == []
    kept = store.list("jobs")
    assert f"{young}/a" in kept
    assert {key for key in kept if lease.job_id in key} == {
        f"{checkpoint_key(lease.job_id, 300, 1)}/{name}" for name in ("manifest.json", "policy.npz")
    }


def test_a_file_that_cannot_be_deleted_keeps_no_other(
    sessions: Sessions, store: ArtifactStore, lease: Lease, save: Callable[[int], str], used: None
) -> None:
    save(300)
    assert store.local_root is not None
    foreign = [store.local_root / "jobs/job_0/checkpoints" / name for name in (".nfs0001", "notes (1).txt")]
    foreign[0].parent.mkdir(parents=True)
    for path in foreign:
        path.write_text("of no artifact")
    store.put_bytes(f"{LOST}/a", b"a")
    for prefix in ("jobs/job_0", LOST):
        grow_old(store, prefix)
    with pytest.raises(StoreError, match=r"job_0/checkpoints/\.nfs0001 cannot be deleted: key .*; nor can 1 others"):
        sweep(sessions, store)
    assert all(path.exists() for path in foreign)
    assert not store.list(LOST)
    foreign[1].unlink()
    foreign[0].unlink()


def test_a_running_evaluation_keeps_its_files(
    sessions: Sessions, store: ArtifactStore, lease: Lease, save: Callable[[int], str], used: None
) -> None:
    save(300)
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    asked = request_evaluation(sessions, lease.job_id, spec=EvaluationSpec(episodes=1))
    claim = claim_work(sessions, Evaluation, asked.id, "w")
    assert claim is not None
    key = evaluation_key(lease.job_id, asked.id, claim.lease.attempt)
    store.put_bytes(f"{key}/a", b"a")
    grow_old(store, key)
    assert key not in find_orphans(sessions, store)
    outcomes.transition(sessions, claim.lease, WorkState.FAILED, error="no space")
    assert key in find_orphans(sessions, store)


def test_a_worker_whose_clock_is_ahead_sweeps_no_new_file(
    sessions: Sessions, store: ArtifactStore, monkeypatch: pytest.MonkeyPatch, used: None
) -> None:
    """It may be a team's, which no lease protects while it is uploaded."""

    class Ahead(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return datetime.now(tz) + timedelta(days=2)

    monkeypatch.setattr("naojobs.retention.datetime", Ahead)
    store.put_bytes(f"{team_key('team_01m7y0bdkc59pc1szgpqz7ge55')}/team.tar", b"a")
    assert not any("team_" in prefix for prefix in find_orphans(sessions, store))


def test_files_that_are_recorded_while_orphans_are_looked_for_are_none(
    sessions: Sessions, engine: Engine, store: ArtifactStore, lease: Lease, save: Callable[[int], str], used: None
) -> None:
    """By a clock that is ahead of the store's all files are old: the lease protects them until their rows do."""

    looks = iter([lambda: (save(300), outcomes.transition(sessions, lease, WorkState.CANCELLED))])

    def end(_connection: object, _cursor: object, statement: str, *_rest: object) -> None:
        if statement.startswith(("SELECT checkpoints.key", "SELECT jobs.id")):
            next(looks, lambda: None)()

    key = checkpoint_key(lease.job_id, 300, lease.attempt)
    store.put_bytes(f"{key}/policy.npz", b"policy")
    event.listen(engine, "after_cursor_execute", end)
    try:
        assert key not in find_orphans(sessions, store, age_s=-60.0)
    finally:
        event.remove(engine, "after_cursor_execute", end)
    assert steps(sessions, lease.job_id) == [300]


def test_the_files_of_a_deleted_job_are_swept_from_a_shell(
    sessions: Sessions,
    store: ArtifactStore,
    lease: Lease,
    save: Callable[[int], str],
    service_environment: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    used: None,
) -> None:
    """The store was unavailable when the job was deleted."""
    save(300)
    outcomes.transition(sessions, lease, WorkState.CANCELLED)
    requests.delete(sessions, lease.job_id)
    with sessions() as session:
        assert session.get(Job, lease.job_id) is None
    key = checkpoint_key(lease.job_id, 300, 1)
    for name, value in service_environment.items():
        monkeypatch.setenv(name, value)
    assert main(["artifacts", "sweep"]) == 0
    assert key not in capsys.readouterr().out, "it is not a day old"
    grow_old(store, key)
    assert main(["artifacts", "sweep", "--dry-run"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert not shown["deleted"] and key in shown["prefixes"]
    assert store.list(key)
    assert main(["artifacts", "sweep"]) == 0
    assert key in json.loads(capsys.readouterr().out)["prefixes"]
    assert store.list(key) == []
    assert main(["artifacts", "adopt"]) == 0
    assert "since" in json.loads(capsys.readouterr().out)
