"""A task or an algorithm of another package appears everywhere once it is installed, without changes of naosprint."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from naojobs.roles import Role

from tests.forking import leads_session
from tests.integration.conftest import as_role
from tests.ports import reserved_port

PACKAGES = [Path(__file__).parents[2] / "packages" / f"naosprint-{name}" for name in ("backwards", "push", "sac")]
TASK = "run-backwards"
STEPS = 600_000
FLAGS = ("--n-steps", "32", "--batch-size", "1024", "--gamma", "0.99", "--checkpoint-interval-steps", "500_000")
LEAST_M = 2.0
"""Metres backwards, of which a robot that falls does not reach one."""
MOST_LINES = {"naosprint_backwards": 105, "naosprint_push": 105, "naosprint_sac": 150}

pytestmark = pytest.mark.timeout(1500)


@dataclass(frozen=True)
class Installation:
    """A running service and a command line that have the package."""

    url: str
    client: httpx.Client
    environment: dict[str, str]
    worker: psutil.Process

    def naoctl(self, *words: str) -> str:
        """Run naoctl and return what it printed."""
        command = [sys.executable, "-m", "naoctl", *words]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def installed(
    service_environment: dict[str, str],
    database_url: str,
    make_token: Callable[..., str],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Installation]:
    """API, worker and naoctl as processes that find the packages, which are installed into a folder of their own."""
    folder = tmp_path_factory.mktemp("backwards")
    sources = [folder / package.name for package in PACKAGES]
    for package, source in zip(PACKAGES, sources, strict=True):
        # a copy: building writes beside the sources
        source.mkdir()
        for file in package.iterdir():
            if file.is_file():
                (source / file.name).write_bytes(file.read_bytes())
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", folder / "site", *sources], check=True)
    with httpx.Client(timeout=30) as client:
        port = reserved_port()
        url = f"http://127.0.0.1:{port}"
        token = make_token("alice", "submit")
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("NAOSPRINT_", "NAOCTL_"))},
            **service_environment,
            "PYTHONPATH": str(folder / "site"),
            "NAOSPRINT_API_PORT": str(port),
            "NAOSPRINT_WORKER_DIR": str(folder / "worker"),
            "NAOSPRINT_WORKER_REPORT": "pictures",
            "NAOSPRINT_WORKER_CHECKPOINT_S": "0",
            "NAOCTL_URL": url,
            "NAOCTL_TOKEN": token,
            "NAOCTL_CONFIG": str(folder / "config.toml"),
            "COLUMNS": "200",
            "TERM": "dumb",
        }
        processes = []
        try:
            for module, role in (("naosprint_api", Role.API), ("naosprint_worker", Role.WORKER)):
                with (folder / f"{module}.log").open("wb") as log:
                    command = [sys.executable, "-m", module]
                    own = {**environment, "NAOSPRINT_DATABASE_URL": as_role(database_url, role)}
                    processes.append(subprocess.Popen(command, env=own, stdout=log, stderr=subprocess.STDOUT))
            _until(lambda: _ready(client, f"{url}/readyz"), 120)
            client.base_url, client.headers = httpx.URL(url), httpx.Headers({"Authorization": f"Bearer {token}"})
            yield Installation(url, client, environment, psutil.Process(processes[1].pid))
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                process.wait(60)


@pytest.fixture(scope="module")
def trained(installed: Installation) -> tuple[dict[str, Any], dict[str, Any]]:
    """A job that naoctl has submitted, trained and evaluated by the service, and its evaluation."""
    words = ("--task", TASK, "--gait-period-s", "0.5", "--steps", str(STEPS), *FLAGS, "--eval-episodes", "100")
    submitted = json.loads(installed.naoctl("submit", *words, "--name", "backwards", "--json"))
    path = f"/jobs/{submitted['id']}"
    installed.naoctl("watch", submitted["id"], "--json")  # returns when the job has succeeded
    job = installed.client.get(path).json()
    (evaluation,) = installed.client.get(f"{path}/evaluations").json()["items"]
    return job, evaluation


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_the_package_is_small(package: Path) -> None:
    (module,) = package.glob("*.py")
    assert len(module.read_text(encoding="utf-8").splitlines()) <= MOST_LINES[module.stem]


def test_the_command_line_has_its_flags(installed: Installation) -> None:
    text = "".join(installed.naoctl("submit", "--help-all").split())  # lines are broken anywhere
    assert TASK in "".join(installed.naoctl("submit", "--help").split())
    assert "--gait-period-s" in text
    assert f"(task{TASK})" in text


def test_the_schema_and_the_catalog_have_what_the_dashboard_is_made_from(installed: Installation) -> None:
    schema = installed.client.get("/spec/schema").json()
    options = schema["$defs"]["TrainingSpec"]["properties"]["task"]["oneOf"]
    (own,) = (option for option in options if option["properties"]["name"]["const"] == TASK)
    assert own["properties"]["gait_period_s"] | {"description": ""} == {
        "type": "number",
        "default": 0.4,
        "exclusiveMinimum": 0.0,
        "maximum": 2.0,
        "title": "Gait period",
        "description": "",
        "unit": "s",
        "own": True,  # presets say nothing of it
    }
    (task,) = (task for task in installed.client.get("/tasks").json() if task["name"] == TASK)
    metrics = {metric["name"]: metric for metric in task["metrics"]}
    assert (metrics["backward_m"]["title"], metrics["backward_m"]["unit"]) == ("Distance backwards", "m")
    assert ["backward_m"] in [chart["metrics"] for chart in task["charts"]]
    assert task["listed"][0] == task["headline"][0] == "backward_m"
    wrong = installed.client.post("/jobs", json={"spec": {"task": {"name": TASK, "gait_period_s": 3}}})
    assert wrong.json()["errors"][0]["field"] == "spec.task.gait_period_s"


def test_it_learns_to_run_backwards(trained: tuple[dict[str, Any], dict[str, Any]], installed: Installation) -> None:
    job, evaluation = trained
    assert job["spec"]["task"]["gait_period_s"] == 0.5
    assert job["progress_step"] >= STEPS
    columns = installed.client.get(f"/jobs/{job['id']}/metrics").json()["columns"]
    assert {"backward_m", "backward_fall_rate"} <= set(columns)
    results = {result["name"]: result for result in evaluation["summary"]["results"]}
    assert results["backward_m"]["value"] >= LEAST_M
    low, high = results["backward_m"]["interval"]
    assert low < results["backward_m"]["value"] < high
    assert evaluation["summary"]["headline"] == ["backward_m", "backward_mps", "backward_fall_rate"]


def test_tables_of_the_command_line_show_its_metrics(
    trained: tuple[dict[str, Any], dict[str, Any]], installed: Installation, tmp_path: Path
) -> None:
    job, evaluation = trained
    (distance,) = (result for result in evaluation["summary"]["results"] if result["name"] == "backward_m")
    for words in (("list",), ("status", "backwards")):
        text = installed.naoctl(*words)
        assert "distance backwards" in text.lower()
        assert f"{distance['value']:.2f} m" in text
    again = installed.naoctl("compare", "backwards", _twin(installed, job))
    assert f"{distance['value']:.2f} m [" in again
    installed.naoctl("download", "backwards", "--output", str(tmp_path))
    assert json.loads((tmp_path / "evaluation" / "evaluation.json").read_text()) == evaluation["summary"]


def test_the_report_shows_its_results(trained: tuple[dict[str, Any], dict[str, Any]], installed: Installation) -> None:
    _, evaluation = trained
    files = {file["name"]: file["url"] for file in evaluation["files"]}
    assert "report.html" in files, sorted(files)
    page = installed.client.get(files["report.html"]).text
    (distance,) = (result for result in evaluation["summary"]["results"] if result["name"] == "backward_m")
    assert "Distance backwards" in page
    assert f"{distance['value']:.2f}" in page


def test_a_task_with_a_ball_is_trained_evaluated_filmed_and_exported(installed: Installation, tmp_path: Path) -> None:
    """A few updates only: how the ball is pushed is no matter of the service."""
    few = ("--n-envs", "16", "--n-steps", "32", "--batch-size", "256", "--steps", "2048", "--eval-episodes", "10")
    words = ("--task", "push-ball", "--episode-steps", "50", "--robot", "t1", "--head-pitch-rad", "0.6", *few)
    job = json.loads(installed.naoctl("submit", *words, "--name", "push", "--json"))
    installed.naoctl("watch", job["id"], "--json")
    columns = installed.client.get(f"/jobs/{job['id']}/metrics").json()["columns"]
    assert {"ball_m", "touch_rate", "push_fall_rate"} <= set(columns)
    (evaluation,) = installed.client.get(f"/jobs/{job['id']}/evaluations").json()["items"]
    results = {result["name"]: result for result in evaluation["summary"]["results"]}
    assert results["ball_m"]["title"] == "Ball's way" and results["ball_m"]["episodes"] == 10
    assert evaluation["summary"]["headline"] == ["ball_m", "touch_rate", "push_fall_rate"]
    assert "Ball's way" in installed.naoctl("status", "push")
    files = {file["name"]: file["url"] for file in evaluation["files"]}
    replay = installed.client.get(files["replay.json"]).json()
    assert [body["name"] for body in replay["bodies"]].index("ball") == len(replay["bodies"]) - 1
    installed.naoctl("report", "push", "--film", "--output", str(tmp_path / "report"))
    assert list((tmp_path / "report").rglob("*.mp4"))
    installed.naoctl("export", "push", "--format", "onnx", "--output", str(tmp_path / "export"))
    assert list((tmp_path / "export").rglob("*.onnx"))
    wrong = installed.client.post("/jobs", json={"spec": {"task": "push-ball", "robot": "nao-0"}})
    assert wrong.status_code == 422 and "nao-0 have no ball" in wrong.text


def test_an_algorithm_is_trained_killed_resumed_evaluated_and_exported(installed: Installation, tmp_path: Path) -> None:
    """Soft actor-critic of stable-baselines3 learns sprint1 on a NAO; a killed training continues."""
    few = ("--n-envs", "8", "--n-steps", "32", "--steps", "5_120", "--checkpoint-interval-steps", "512")
    own = ("--algorithm", "sac", "--units", "16", "--random-steps", "512", "--gradient-steps", "2")
    job = json.loads(installed.naoctl("submit", *own, *few, "--eval-episodes", "10", "--name", "sac", "--json"))
    path = f"/jobs/{job['id']}"
    _until(lambda: installed.client.get(path).json()["progress_step"] >= 1024, 300)
    (training,) = [child for child in installed.worker.children() if leads_session(child.pid)]
    training.kill()
    installed.naoctl("watch", job["id"], "--json")
    job = installed.client.get(path).json()
    assert (job["state"], job["progress_step"], job["attempt"]) == ("succeeded", 5_120, 2)
    metrics = installed.client.get(f"{path}/metrics").json()["columns"]
    assert {"distance_m", "sac_actor_loss", "sac_critic_loss"} <= set(metrics)
    (algorithm,) = (each for each in installed.client.get("/algorithms").json() if each["name"] == "sac")
    assert algorithm["charts"][0]["metrics"] == ["sac_actor_loss", "sac_critic_loss"]
    assert "sac" in installed.client.get("/workers").json()["items"][0]["algorithms"]
    (evaluation,) = installed.client.get(f"{path}/evaluations").json()["items"]
    assert {result["name"] for result in evaluation["summary"]["results"]} >= {"distance_m", "fall_rate"}
    installed.naoctl("export", "sac", "--format", "onnx", "--output", str(tmp_path / "export"))
    assert list((tmp_path / "export").rglob("*.onnx"))


def _twin(installed: Installation, job: dict[str, Any]) -> str:
    """Submit the same training again and cancel it; return its id."""
    made = installed.client.post("/jobs", json={"spec": job["spec"], "name": "twin"}).json()
    installed.client.post(f"/jobs/{made['id']}/cancel")
    return str(made["id"])


def _ready(client: httpx.Client, url: str) -> bool:
    try:
        return client.get(url).status_code == 200
    except httpx.TransportError:
        return False


def _until(condition: Callable[[], bool], timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"not so after {timeout_s:g} s"
        time.sleep(0.2)
