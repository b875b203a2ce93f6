"""Copies of jobs in the real MLflow and Weights & Biases."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from naoctl.client import Client
from naoctl.mirrors import Copy, DownloadMirror, MlflowMirror, WandbMirror, flat, mirror_jobs

Job = dict[str, Any]
RESULT = {"results": [{"name": "top_speed_mps", "value": 4.03}, {"name": "time_28m_s", "value": None}]}


@pytest.fixture
def mlflow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], MlflowMirror]:
    """Connect to MLflow with its store in a folder, as `mlflow ui` opens it."""
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    return lambda: MlflowMirror(f"file:{tmp_path / 'mlruns'}", "naosprint")


@pytest.fixture
def wandb(tmp_path: Path) -> Iterator[Callable[[], WandbMirror]]:
    """Connect to Weights & Biases in offline mode."""
    package = pytest.importorskip("wandb")
    yield lambda: WandbMirror("naosprint", None, tmp_path, offline=True)
    package.teardown()


@pytest.fixture
def service(server: Any, job: Callable[..., Job], event: Callable[..., str]) -> Callable[..., None]:
    """Return a function that gives the service one job: its rows of metrics and its states, one after the other."""

    def play(rows: list[Job], *states: Job) -> None:
        shown = [job(**state) for state in states]

        @server.on("GET", "/jobs")
        def jobs(request: Any) -> None:
            request.json({"items": shown[:1], "next_cursor": None})

        @server.on("GET", "/jobs/stream")
        def stream(request: Any) -> None:
            request.stream(event("ready", {}, "1"), *(event("job", one, "2") for one in shown[1:]))

        @server.on("GET", f"/jobs/{shown[0]['id']}/metrics")
        def metrics(request: Any) -> None:
            after = int(server.received[-1].query["after_step"][0])
            later = [row for row in rows if row["step"] > after]
            columns = {name: [row.get(name) for row in later] for name in rows[0]} if later else {}
            request.json({"columns": columns, "rows": len(later), "total_rows": len(later), "last_seq": 1})

    return play


ROWS = [{"step": step, "attempt": 1, "time_s": step / 100, "reward": float(step)} for step in (100, 200, 300)]
ROWS[0]["reward"] = None


def test_mlflow_has_a_run_with_settings_metrics_and_results(
    client: Client, service: Callable[..., None], job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    service(ROWS, {}, {"state": "succeeded", "result": RESULT, "finished_at": "2026-01-02T03:05:06Z"})
    mirror_jobs(client, mlflow, [job()["id"]])
    mirror = mlflow()
    assert mirror.finished() == {job()["id"]}
    (run,) = mirror._client.search_runs([mirror._experiment])
    assert run.info.run_name == "first" and run.info.end_time - run.info.start_time == 60_000
    assert run.data.params["algorithm.learning_rate"] == "0.0005"
    assert run.data.metrics["evaluation/top_speed_mps"] == 4.03 and "evaluation/time_28m_s" not in run.data.metrics
    history = mirror._client.get_metric_history(run.info.run_id, "reward")
    assert [(point.step, point.value, point.timestamp) for point in history] == [
        (200, 200.0, 1767323048000),
        (300, 300.0, 1767323049000),
    ]


def test_a_copy_goes_on_where_it_stopped(
    client: Client, service: Callable[..., None], job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    service(ROWS[:2], {"state": "paused"})
    mirror_jobs(client, mlflow, [job()["id"]])
    assert mlflow().finished() == set()
    service([*ROWS[:1], {**ROWS[1], "reward": -1.0}, ROWS[2]], {"state": "succeeded"})
    mirror_jobs(client, mlflow, [job()["id"]])
    mirror = mlflow()
    (run,) = mirror._client.search_runs([mirror._experiment])
    history = mirror._client.get_metric_history(run.info.run_id, "reward")
    assert [(point.step, point.value) for point in history] == [(200, 200.0), (300, 300.0)]
    assert run.info.status == "FINISHED"


def test_a_tracking_system_that_is_away_is_tried_again(
    client: Client, service: Callable[..., None], job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    service(ROWS, {"state": "succeeded"})
    failures = iter([ConnectionError("refused"), TimeoutError("no answer"), None, OSError("away")])
    notes: list[str] = []

    class Unreliable:
        def __init__(self) -> None:
            fail()
            self._mirror: DownloadMirror = mlflow()

        def finished(self) -> set[str]:
            return self._mirror.finished()

        def open(self, job: Job) -> Copy:
            fail()
            return self._mirror.open(job)

    def fail() -> None:
        if error := next(failures, None):
            raise error

    mirror_jobs(client, Unreliable, [job()["id"]], note=notes.append, retry_s=0.0)
    assert [line for line in notes if "next attempt" in line] == [
        f"{text}; next attempt in 0 s"
        for text in ("ConnectionError: refused", "TimeoutError: no answer", "OSError: away")
    ]
    assert mlflow().finished() == {job()["id"]}


def test_a_job_that_is_deleted_meanwhile_ends_its_copy_only(
    server: Any,
    client: Client,
    service: Callable[..., None],
    job: Callable[..., Job],
    mlflow: Callable[[], MlflowMirror],
) -> None:
    service(ROWS, {}, {"state": "succeeded"})
    server.on("GET", f"/jobs/{job()['id']}/metrics")(lambda request: request.problem(404, "no such job"))
    notes: list[str] = []
    mirror_jobs(client, mlflow, [job()["id"]], note=notes.append)
    assert notes[-1] == f"{job()['id']}: deleted"


def test_a_job_that_never_began_is_not_waited_for(
    client: Client, service: Callable[..., None], job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    service(ROWS, {"state": "cancelled", "started_at": None})
    mirror_jobs(client, mlflow, [job()["id"]])
    mirror = mlflow()
    assert not mirror._client.search_runs([mirror._experiment])


def test_weights_and_biases_has_a_run_that_can_be_uploaded(
    client: Client,
    service: Callable[..., None],
    job: Callable[..., Job],
    wandb: Callable[[], WandbMirror],
    tmp_path: Path,
) -> None:
    service(ROWS, {"state": "succeeded", "result": RESULT})
    notes: list[str] = []
    mirror_jobs(client, wandb, [job()["id"]], note=notes.append)
    assert notes == [f"{job()['id']}: copying from step 0", f"{job()['id']}: succeeded"]
    assert wandb().finished() == {job()["id"]}
    pytest.importorskip("wandb").teardown()  # as at the end of `naoctl mirror`: its service writes what it still holds
    (written,) = tmp_path.glob(f"wandb/offline-run-*/run-{job()['id']}.wandb")
    records = read_records(written)
    (run,) = [record.run for record in records if record.HasField("run")]
    assert (run.project, run.run_id, run.display_name, list(run.tags)) == ("naosprint", job()["id"], "first", ["try"])
    assert (
        json.loads(next(entry for entry in run.config.update if entry.key == "algorithm").value_json)["preset"]
        == "fast"
    )
    rows = [
        {(entry.key or entry.nested_key[0]): json.loads(entry.value_json) for entry in record.history.item}
        for record in records
        if record.HasField("history")
    ]
    assert [(row["_step"], row.get("reward"), row["_timestamp"]) for row in rows] == [
        (100, None, 1767323047.0),
        (200, 200.0, 1767323048.0),
        (300, 300.0, 1767323049.0),
    ]
    (ended,) = [record.exit for record in records if record.HasField("exit")]
    assert ended.exit_code == 0
    summary = {
        (entry.key or entry.nested_key[0]): json.loads(entry.value_json)
        for record in records
        if record.HasField("summary")
        for entry in record.summary.update
    }
    assert summary["evaluation/top_speed_mps"] == 4.03


def read_records(path: Path) -> list[Any]:
    """Return the records of a run's file: a header, then LevelDB's log format, in blocks of 32 KiB."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, at, whole, records = path.read_bytes(), 7, b"", []
    assert data.startswith(b":W&B")
    while at + 7 <= len(data):
        if (room := -at % 32768) < 7:
            at += room
            continue
        length, kind = struct.unpack("<4xHB", data[at : at + 7])
        whole += data[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # complete, or the last part
            records.append(Record.FromString(whole))
            whole = b""
    return records


def test_settings_are_flattened_by_section() -> None:
    spec = {"seed": 1, "algorithm": {"name": "ppo", "kp": {}}, "stages": [{"steps": 5}]}
    assert list(flat(spec)) == [
        ("seed", 1),
        ("algorithm.name", "ppo"),
        ("algorithm.kp", {}),
        ("stages", [{"steps": 5}]),
    ]
