"""Helpers for the tests of the API: running jobs, stored checkpoints, and a reader of streams."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from naojobs import outcomes, submission
from naojobs.leases import Lease
from naojobs.models import Job
from naojobs.states import WorkState
from naojobs.store import ArtifactStore, checkpoint_key
from naojobs.submission import JobRequest
from naosprint_api.recent import KEEP_S
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.writes import record_checkpoint


@dataclass(frozen=True)
class Message:
    """One server-sent event."""

    event: str
    id: str
    data: Any


@pytest.fixture(scope="session")
def follow() -> Callable[..., Any]:
    """Open a stream; yield an iterator of its messages."""

    @contextmanager
    def follow(
        client: httpx.Client, path: str, last_id: str | None = None, **params: Any
    ) -> Iterator[Iterator[Message]]:
        headers = {"Last-Event-ID": last_id} if last_id is not None else {}
        with client.stream("GET", path, params=params, headers=headers) as response:
            if response.status_code != 200:
                response.read()
                raise httpx.HTTPStatusError(response.text, request=response.request, response=response)
            assert response.headers["content-type"].startswith("text/event-stream")
            yield read(response)

    def read(response: httpx.Response) -> Iterator[Message]:
        fields: dict[str, str] = {}
        for line in response.iter_lines():
            if line == "" and "data" in fields:
                yield Message(fields.get("event", "message"), fields.get("id", ""), json.loads(fields["data"]))
                fields = {}
            elif line and not line.startswith(":"):
                name, _, value = line.partition(": ")
                fields[name] = value

    return follow


@pytest.fixture(scope="session")
def soon() -> Callable[[Callable[[], bool]], bool]:
    """Return whether a condition becomes true while a process of the API may still use what it has looked up."""

    def soon(condition: Callable[[], bool]) -> bool:
        until = time.monotonic() + 2.0 * KEEP_S
        while not (reached := condition()) and time.monotonic() < until:
            time.sleep(0.02)
        return reached

    return soon


@pytest.fixture
def run_job(sessions: sessionmaker[Session]) -> Callable[..., Lease]:
    """Submit a job of `owner` and claim it for a worker; return the worker's lease."""

    def run(owner: str = "alice", **fields: Any) -> Lease:
        job, _ = submission.submit(sessions, JobRequest(**fields), owner=owner)
        claim = claim_work(sessions, Job, job.id, "worker-1")
        assert claim is not None
        outcomes.begin(sessions, claim.lease, step=0)
        outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
        return claim.lease

    return run


@pytest.fixture
def save_checkpoint(sessions: sessionmaker[Session], store: ArtifactStore, tmp_path: Path) -> Callable[..., str]:
    """Store a checkpoint of a leased job with the given files; return its id."""

    def save(lease: Lease, step: int, files: dict[str, bytes]) -> str:
        folder = tmp_path / f"{lease.job_id}-{step}"
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        key = checkpoint_key(lease.job_id, step, lease.attempt)
        manifest = store.put_directory(key, folder)
        return record_checkpoint(sessions, lease, step=step, key=key, manifest=manifest.model_dump())

    return save
