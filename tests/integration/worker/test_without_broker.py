"""Without a broker all requests of users work, only some seconds later."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from naojobs.states import ENDED
from naojobs.tokens import Scope, create_token
from naospec.flat import nest
from naosprint_api.__main__ import make_server
from naosprint_api.settings import ApiSettings
from naosprint_worker.settings import WorkerSettings

from tests.ports import reserved_port

from .conftest import ROLLOUT, TINY, Postgres, Service, WorkerProcess

START_S = 30.0
"""How long a submitted job may take to start."""


@pytest.fixture
def service(postgres: Postgres, template: str, tmp_path: Path) -> Iterator[Service]:
    """A service whose broker's address is one where nothing listens."""
    port = reserved_port()
    url = f"redis://127.0.0.1:{port}/0"
    service = Service(postgres, url, postgres.new_database(template), tmp_path)
    yield service
    service.close()


@pytest.fixture
def worker(service: Service) -> WorkerProcess:
    """A worker that polls at its default interval."""
    return service.start_worker(NAOSPRINT_WORKER_CLAIM_S=str(WorkerSettings.model_fields["worker_claim_s"].default))


@pytest.fixture
def client(service: Service) -> Iterator[httpx.Client]:
    """A client of an API of this service."""
    shared = {
        name: getattr(service.settings, name) for name in ApiSettings.model_fields if hasattr(service.settings, name)
    }
    listener = socket.create_server(("127.0.0.1", 0))
    server = make_server(ApiSettings(**shared))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    _, secret = create_token(service.sessions, name="test", owner="alice", scopes=[Scope.SUBMIT])
    headers = {"Authorization": f"Bearer {secret}"}
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{listener.getsockname()[1]}", headers=headers) as client:
            assert client.get("/readyz", timeout=60).json()["broker"] == "failed"
            yield client
    finally:
        server.should_exit = True
        thread.join(30)


def test_everything_works_without_the_broker(service: Service, worker: WorkerProcess, client: httpx.Client) -> None:
    def until(path: str, reached: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        def look() -> dict[str, Any] | None:
            found: dict[str, Any] = client.get(path).json()
            if reached(found):
                return found
            assert found["state"] not in ENDED, f"{found['state']}: {found['error']}\n{service.report()}"
            return None

        found = service.until(look, timeout_s=START_S, what=what)
        assert found is not None
        return found

    service.until(lambda: "is ready" in worker.output(), what="for the worker")
    spec = nest({**TINY, "total_steps": 10**9, "checkpoint_interval_steps": ROLLOUT * 20})
    began = time.monotonic()
    answer = client.post("/jobs", json={"spec": spec, "evaluation": None})
    assert answer.status_code == 201
    assert time.monotonic() - began < 2
    job = f"/jobs/{answer.json()['id']}"
    until(job, lambda found: found["state"] == "running", "for the job to start")

    # An evaluation of a running job's checkpoint, to its end.
    service.until_checkpoints(answer.json()["id"], 1)
    body = {"spec": {"task": "sprint2", "episodes": 2, "n_envs": 2, "bootstrap_resamples": 100}}
    short = client.post(f"{job}/evaluations", json=body).json()["id"]
    until(f"/evaluations/{short}", lambda found: found["state"] == "succeeded", "for the evaluation")

    # One that would take for ever is cancelled, another one reaches its time limit.
    body["spec"]["episodes"] = 100_000
    endless = client.post(f"{job}/evaluations", json=body).json()["id"]
    until(f"/evaluations/{endless}", lambda found: found["state"] == "running", "for the evaluation to start")
    assert client.post(f"/evaluations/{endless}/cancel").json()["state"] == "running"
    until(f"/evaluations/{endless}", lambda found: found["state"] == "cancelled", "for the evaluation to be cancelled")
    limited = client.post(f"{job}/evaluations", json={**body, "time_limit_s": 4}).json()["id"]
    ended = until(f"/evaluations/{limited}", lambda found: found["state"] == "failed", "for the time limit")
    assert ended["error"] == "the evaluator ran longer than its time limit of 4 s"

    # The job is paused, resumed and cancelled.
    client.post(f"{job}/pause")
    until(job, lambda found: found["state"] == "paused", "for the pause")
    client.post(f"{job}/resume")
    resumed = until(job, lambda found: found["state"] == "running", "for the job to resume")
    assert resumed["attempt"] == 2
    client.post(f"{job}/cancel")
    until(job, lambda found: found["state"] == "cancelled", "for the job to be cancelled")

    began = time.monotonic()
    worker.terminate(timeout_s=30)
    assert time.monotonic() - began < 15, "a worker that waits for its broker ends at once"
    assert "Traceback" not in worker.output()
