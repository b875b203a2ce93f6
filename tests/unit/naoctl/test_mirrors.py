"""Copies of jobs in the real MLflow and Weights & Biases."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from naoctl.client import Client
from naoctl.mirrors import Copy, DownloadMirror, flat, mirror_jobs
from naoctl.mlflow_mirror import MlflowMirror
from naoctl.transfer import ATTEMPTS
from naoctl.wandb_mirror import WandbMirror

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

        for path in ("/policies", f"/jobs/{shown[0]['id']}/checkpoints", f"/jobs/{shown[0]['id']}/evaluations"):
            server.on("GET", path)(lambda request: request.json({"items": [], "next_cursor": None}))

    return play


@pytest.fixture
def files(server: Any) -> Callable[..., list[Job]]:
    """Return a function that gives the service files and returns their description."""

    def keep(path: str, contents: dict[str, bytes]) -> list[Job]:
        for name, content in contents.items():
            server.on("GET", f"{path}/{name}")(lambda request, content=content: request.raw(content))
        return [
            {
                "name": name,
                "url": f"{path}/{name}",
                "size": len(content),
                "sha256": hashlib.sha256(content).hexdigest(),
            }
            for name, content in contents.items()
        ]

    return keep


@pytest.fixture
def trained(server: Any, service: Callable[..., None], job: Callable[..., Job], files: Callable[..., list[Job]]) -> Job:
    """A job of the service that has ended with two checkpoints, an evaluation and a report; return what can change.

    It is registered as version 1 of the policy `walker`.
    """
    service(ROWS, {"state": "succeeded", "result": RESULT})
    identifier = job()["id"]
    points = [
        {
            "id": f"ckp_{step}",
            "job_id": identifier,
            "attempt": 1,
            "step": step,
            "files": files(f"/checkpoints/ckp_{step}/files", {"policy.npz": f"weights {step}".encode()}),
        }
        for step in (200, 300)
    ]
    results = {"evaluation.json": b"{}", "report.html": b"<p>curves</p>", "run.mp4": b"a film"}
    evaluation = {
        "id": "evl_1",
        "state": "succeeded",
        "summary": {"episodes": 10},
        "finished_at": "2026-01-02T03:05:06Z",
        "files": files("/evaluations/evl_1/files", results),
    }
    card = {
        "name": "walker",
        "reference": "walker@1",
        "owner": "ada",
        "version": 1,
        "aliases": ["best", "latest"],
        "job_id": identifier,
        "checkpoint_id": "ckp_200",
        "spec_sha256": "ab" * 32,
        "notes": "It walks.",
        "robot": "nao-0",
        "task": "sprint1",
        "steps": 200,
    }
    bundled = {**card, "name": "nao-sprint", "reference": "nao-sprint", "owner": None, "job_id": None}
    registry = {"cards": [card]}

    def page(path: str, items: Callable[[], list[Job]]) -> None:
        server.on("GET", path)(lambda request: request.json({"items": items(), "next_cursor": None}))

    page(f"/jobs/{identifier}/checkpoints", lambda: points)
    page(f"/jobs/{identifier}/evaluations", lambda: [evaluation])
    page("/policies", lambda: [bundled, registry["cards"][-1]])
    page("/policies/walker/versions", lambda: registry["cards"][::-1])
    for point in points:
        server.on("GET", f"/checkpoints/{point['id']}")(lambda request, point=point: request.json(point))
    return registry


NO_MORE: Job = {"next_cursor": None}
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


def test_mlflow_has_the_policy_the_report_and_the_film(
    client: Client, trained: Job, job: Callable[..., Job], mlflow: Callable[[], MlflowMirror], tmp_path: Path
) -> None:
    notes: list[str] = []
    mirror_jobs(client, mlflow, [job()["id"]], note=notes.append)
    assert notes[1:] == [f"{job()['id']}: succeeded", "walker@1: registered as walker"]
    mirror = mlflow()
    (run,) = mirror._client.search_runs([mirror._experiment])
    files = {
        item.path
        for folder in ("", "checkpoint-000000000300", "evaluation")
        for item in mirror._client.list_artifacts(run.info.run_id, folder)
    }
    assert {"checkpoint-000000000300/policy.npz", "evaluation/report.html", "evaluation/run.mp4"} <= files
    version = mirror._client.get_model_version_by_alias("walker", "best")
    assert (version.run_id, version.tags["naosprint.reference"]) == (run.info.run_id, "walker@1")
    assert version.description == "It walks."
    folder = mirror._client.download_artifacts(run.info.run_id, "checkpoint-000000000200", str(tmp_path))
    assert (Path(folder) / "policy.npz").read_bytes() == b"weights 200"
    assert mirror._client.get_model_version_download_uri("walker", version.version).endswith("/checkpoint-000000000200")


def test_later_versions_and_moved_aliases_are_copied_once(
    client: Client, trained: Job, job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    mirror_jobs(client, mlflow, [job()["id"]])
    (first,) = trained["cards"]
    second = {**first, "reference": "walker@2", "version": 2, "checkpoint_id": "ckp_300", "notes": ""}
    trained["cards"] = [{**first, "aliases": ["old"]}, second]
    for number in (2, 0):
        notes: list[str] = []
        mirror_jobs(client, mlflow, [job()["id"]], note=notes.append)
        assert len([line for line in notes if "registered as" in line]) == number
    mirror = mlflow()
    assert mirror.registered("walker") == {"walker@1": ["old"], "walker@2": ["best"]}


def test_a_file_that_cannot_be_had_costs_only_its_artifact(
    server: Any, client: Client, trained: Job, job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    gone = "/evaluations/evl_1/files/run.mp4"
    server.on("GET", gone)(lambda request: request.problem(403, "no right to see it"))
    notes: list[str] = []
    mirror_jobs(client, mlflow, [job()["id"]], note=notes.append)
    (line,) = [line for line in notes if "is not copied" in line]
    assert line.startswith(f"{job()['id']}: evaluation is not copied: ")
    mirror = mlflow()
    (run,) = mirror._client.search_runs([mirror._experiment])
    assert run.info.status == "FINISHED" and run.data.metrics["evaluation/top_speed_mps"] == 4.03
    assert [item.path for item in mirror._client.list_artifacts(run.info.run_id)] == [
        "checkpoint-000000000200",
        "checkpoint-000000000300",
    ]


@pytest.mark.parametrize("trouble", [503, None])
def test_a_file_that_cannot_be_had_for_a_while_is_copied_later(
    trouble: int | None,
    server: Any,
    client: Client,
    trained: Job,
    job: Callable[..., Job],
    mlflow: Callable[[], MlflowMirror],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The store does not answer, or ends each answer early, for longer than a download waits."""
    monkeypatch.setattr("naoctl.transfer.PAUSE_S", 0.0)
    path = "/evaluations/evl_1/files/run.mp4"
    answer, left = server.routes["GET", path], [True] * (2 * ATTEMPTS + 1)

    @server.on("GET", path)
    def fail(request: Any) -> None:
        if not left:
            answer(request)
            return
        left.pop()
        if trouble:
            request.problem(trouble, "the store does not answer")
        else:
            request.send_response(200)
            request.send_header("content-length", "6")
            request.end_headers()
            request.wfile.write(b"a f")
            request.close_connection = True

    notes: list[str] = []
    mirror_jobs(client, mlflow, [job()["id"]], note=notes.append, retry_s=0.0)
    assert [line for line in notes if line.endswith("later") and line.startswith(job()["id"])]
    mirror = mlflow()
    (run,) = mirror._client.search_runs([mirror._experiment])
    assert run.info.status == "FINISHED"
    assert {item.path for item in mirror._client.list_artifacts(run.info.run_id, "evaluation")} == {
        f"evaluation/{name}" for name in ("evaluation.json", "report.html", "run.mp4")
    }


def test_without_artifacts_only_numbers_are_copied(
    client: Client, trained: Job, job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    mirror_jobs(client, mlflow, [job()["id"]], artifacts=False)
    mirror = mlflow()
    (run,) = mirror._client.search_runs([mirror._experiment])
    assert not mirror._client.list_artifacts(run.info.run_id) and not mirror._client.search_registered_models()


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


class Refusing:
    """A tracking system that refuses one job, or one policy, as W&B does a run that was deleted there."""

    def __init__(self, mirror: MlflowMirror, refused: str, times: float) -> None:
        self._mirror, self._refused, self._left = mirror, refused, times
        self.finished, self.registered = mirror.finished, mirror.registered

    def _refuse(self, what: str) -> None:
        if what == self._refused and self._left > 0:
            self._left -= 1
            raise ValueError(f"{what} was deleted; use another id")

    def open(self, job: Job) -> Copy:
        self._refuse(job["id"])
        return self._mirror.open(job)

    def register(self, card: Job, name: str, folder: Path) -> bool:
        self._refuse(name)
        return self._mirror.register(card, name, folder)


def test_a_job_that_is_refused_keeps_no_other_from_being_copied(
    server: Any,
    client: Client,
    service: Callable[..., None],
    job: Callable[..., Job],
    event: Callable[..., str],
    mlflow: Callable[[], MlflowMirror],
) -> None:
    service(ROWS, {"state": "succeeded"})
    others = [job(id=f"job_{number}", state="succeeded") for number in (1, 2)]
    for other in others:
        for path in ("metrics", "checkpoints", "evaluations"):
            empty = {"columns": {}} if path == "metrics" else {"items": [], "next_cursor": None}
            server.on("GET", f"/jobs/{other['id']}/{path}")(lambda request, empty=empty: request.json(empty))
    server.on("GET", "/jobs")(lambda request: request.json({"items": [others[0], job(state="succeeded")], **NO_MORE}))
    server.on("GET", "/jobs/stream")(lambda request: request.stream(event("ready", {}, "1"), event("job", others[1])))
    notes: list[str] = []
    chosen = [job()["id"], *(other["id"] for other in others)]
    mirror_jobs(client, lambda: Refusing(mlflow(), job()["id"], 3), chosen, note=notes.append, retry_s=0.0)
    assert mlflow().finished() == set(chosen)
    ends = [line for line in notes if line.endswith(("succeeded", "later"))]
    refused = f"{job()['id']}: ValueError: {job()['id']} was deleted; use another id; it is tried again later"
    assert ends == [refused, "job_1: succeeded", "job_2: succeeded", refused, f"{job()['id']}: succeeded"]


def test_a_policy_that_is_refused_or_damaged_keeps_no_other_from_being_copied(
    server: Any, client: Client, trained: Job, job: Callable[..., Job], mlflow: Callable[[], MlflowMirror]
) -> None:
    (card,) = trained["cards"]
    for name in ("runner", "sprinter"):
        cards = [
            {**card, "name": name, "reference": f"{name}@{number}", "version": number, "checkpoint_id": f"ckp_{step}"}
            for number, step in ((2, 200), (1, 300))
        ]
        server.on("GET", f"/policies/{name}/versions")(
            lambda request, all=cards: request.json({"items": all, **NO_MORE})
        )
    listed = [{**card, "name": name} for name in ("runner", "walker", "sprinter")]
    server.on("GET", "/policies")(lambda request: request.json({"items": listed, **NO_MORE}))
    server.on("GET", "/checkpoints/ckp_300/files/policy.npz")(lambda request: request.problem(410, "no file"))
    notes: list[str] = []
    mirror_jobs(client, lambda: Refusing(mlflow(), "runner", 9), [job()["id"]], note=notes.append, retry_s=0.0)
    assert [line for line in notes if "walker" in line] == ["walker@1: registered as walker"]
    assert any(line.startswith("runner: ValueError: ") for line in notes)
    assert any(line.startswith("sprinter@1 is not copied: ") for line in notes)
    assert "sprinter@2: registered as sprinter" in notes


@pytest.mark.parametrize("status", [429, 503])
def test_a_service_that_is_unavailable_for_a_while_ends_no_mirror(
    status: int,
    server: Any,
    client: Client,
    service: Callable[..., None],
    job: Callable[..., Job],
    mlflow: Callable[[], MlflowMirror],
) -> None:
    service(ROWS, {"state": "succeeded"})
    for path in ("/jobs", f"/jobs/{job()['id']}/metrics", "/policies"):
        answer = server.routes["GET", path]

        def once(request: Any, path: str = path, answer: Any = answer) -> None:
            server.on("GET", path)(answer)
            request.problem(status, "not now")

        server.on("GET", path)(once)
    mirror_jobs(client, mlflow, [job()["id"]], retry_s=0.0)
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


def test_weights_and_biases_has_the_policy_the_report_and_the_film(
    client: Client, trained: Job, job: Callable[..., Job], wandb: Callable[[], WandbMirror], tmp_path: Path
) -> None:
    notes: list[str] = []
    mirror_jobs(client, wandb, [job()["id"]], note=notes.append)
    assert notes[1:] == [f"{job()['id']}: succeeded", "walker@1: registered as walker"]
    assert wandb().registered("walker") == {"walker@1": ["best"]}
    mirror_jobs(client, wandb, [job()["id"]], note=notes.append)
    assert len([line for line in notes if "registered as" in line]) == 1
    pytest.importorskip("wandb").teardown()
    records = [record for path in tmp_path.glob("wandb/offline-run-*/*.wandb") for record in read_records(path)]
    artifacts = {
        (made.name, made.type): (sorted(made.aliases), sorted(entry.path for entry in made.manifest.contents))
        for record in records
        if record.WhichOneof("record_type") in ("artifact", "request")
        for made in [record.artifact if record.HasField("artifact") else record.request.log_artifact.artifact]
        if made.name
    }
    identifier = job()["id"]
    assert artifacts == {
        (f"{identifier}-policy", "model"): (["checkpoint-000000000300", "latest"], ["policy.npz"]),
        (f"{identifier}-evaluation", "evaluation"): (
            ["evaluation", "latest"],
            ["evaluation.json", "report.html", "run.mp4"],
        ),
        ("walker", "model"): (["best", "latest", "version-1"], ["policy.npz"]),
    }
    shown = {
        entry.key or entry.nested_key[0]
        for record in records
        if record.HasField("history")
        for entry in record.history.item
    }
    assert {"report", "film"} <= shown


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
