"""The command line against the real service: `naoctl up` with Postgres, broker, API, worker and trainings.

The tests run in order and share one data folder, as a user's days do.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from naoctl.demo import count_numbers, differences
from naoctl.errors import ExitCode
from naoctl.stack.layout import Layout
from naoctl.stack.state import StackState, marked_processes

TINY = ["--steps", "256", "--n-envs", "4", "--n-steps", "32", "--batch-size", "128", "--simulator-threads", "1"]
EVAL = ["--eval-episodes", "6", "--eval-n-envs", "4"]
ENDLESS = ["--steps", "1000000000", "--n-envs", "4", "--n-steps", "64", "--batch-size", "256"]


class Shell:
    """Run naoctl with a home folder of its own."""

    def __init__(self, home: Path) -> None:
        # Characters that have a meaning to programs which are given the path.
        self.layout = Layout.at(home / "-a b'\"[c]*?$HOME%s%%#;&,(é)\\")
        self.home = home
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("NAOCTL_", "NAOSPRINT_"))},
            "NAOCTL_CONFIG": str(home / "config.toml"),
            "NAOCTL_DATA_DIR": str(self.layout.root),
        }

    def __call__(self, *words: str, code: int = 0, **environment: str) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [sys.executable, "-m", "naoctl", *words],
            check=False,
            capture_output=True,
            text=True,
            timeout=120,
            env={**self.environment, **environment},
            cwd=self.home,
            stdin=subprocess.DEVNULL,
        )
        assert done.returncode == code, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    def json(self, *words: str, code: int = 0, **environment: str) -> Any:
        return json.loads(self(*words, "--json", code=code, **environment).stdout)

    def api(self, path: str) -> Any:
        """Query the service directly, without the command line."""
        headers = {"Authorization": f"Bearer {self.layout.admin_token.read_text().strip()}"}
        response = httpx.get(f"{self.state().url}{path}", headers=headers, trust_env=False, timeout=30)
        response.raise_for_status()
        return response.json()

    def job(self, name: str) -> dict[str, Any]:
        (found,) = self.api(f"/jobs?q={name}")["items"]
        return dict(found)

    def study(self, name: str, reached: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait until a study, which has no stream, fulfills a condition; return it with its trials."""
        (row,) = self.api(f"/studies?q={name}")["items"]
        deadline = time.monotonic() + 300
        while not reached(study := self.api(f"/studies/{row['id']}")):
            assert study["state"] in ("running", "finished") and time.monotonic() < deadline, study
            time.sleep(0.2)
        return dict(study)

    def processes(self) -> list[psutil.Process]:
        """All processes of the stack except the supervisor."""
        state = self.state()
        assert state.supervisor is not None
        family = psutil.Process(state.supervisor.pid).children(recursive=True)
        marked = [process for process in marked_processes(state.stack_id) if process.pid != state.supervisor.pid]
        return list({process.pid: process for process in family + marked}.values())

    def state(self) -> StackState:
        state = StackState.load(self.layout)
        assert state is not None
        return state

    def until(self, job: str, reached: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Follow a job's stream until a condition holds."""
        with subprocess.Popen(
            [sys.executable, "-m", "naoctl", "watch", job, "--json"],
            stdout=subprocess.PIPE,
            env=self.environment,
            text=True,
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                update = json.loads(line)
                if reached(update):
                    process.kill()
                    found: dict[str, Any] = update
                    return found
        raise AssertionError(f"{job} ended first")


@pytest.fixture(scope="module")
def naoctl() -> Iterator[Shell]:
    home = Path(tempfile.mkdtemp(prefix="naoctl-"))
    shell = Shell(home)
    try:
        yield shell
    finally:
        if shell.layout.state.exists():
            stack_id = shell.state().stack_id
            subprocess.run(
                [sys.executable, "-m", "naoctl", "down", "--now"], check=False, env=shell.environment, timeout=120
            )
            for process in marked_processes(stack_id):
                process.kill()
        shutil.rmtree(home, ignore_errors=True)


@pytest.fixture(scope="module")
def stack(naoctl: Shell) -> dict[str, Any]:
    """The stack, started in the background."""
    started: dict[str, Any] = naoctl.json("up", "--detach")
    return started


@pytest.fixture(scope="module")
def job(naoctl: Shell, stack: dict[str, Any]) -> dict[str, Any]:
    """A tiny training from submission to results."""
    words = ["submit", *TINY, *EVAL, "--name", "tiny", "--tag", "try", "--tag", "x:1", "--watch"]
    ran = naoctl(*words)
    assert "256 of 256 steps 100%" in ran.stdout
    assert "succeeded at 256 steps" in ran.stdout
    return naoctl.job("tiny")


def test_up_answers_and_keeps_its_secrets(naoctl: Shell, stack: dict[str, Any]) -> None:
    assert httpx.get(f"{stack['url']}/readyz", trust_env=False).json()["ready"] is True
    assert httpx.get(f"{stack['url']}/jobs", trust_env=False).status_code == 401
    layout = naoctl.layout
    for path in (layout.admin_token, layout.secrets, layout.state, naoctl.home / "config.toml"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600, path
    token = layout.admin_token.read_text().strip()
    assert stack["sign_in"] == f"{stack['url']}/#/?token={token}"
    secrets = json.loads(layout.secrets.read_text())
    processes = naoctl.processes()
    assert len(processes) >= 4
    for process in processes:
        words = " ".join(process.cmdline())
        assert not any(secret in words for secret in (token, *secrets.values()))


def test_every_door_is_on_the_loopback(naoctl: Shell, stack: dict[str, Any]) -> None:
    ours = {process.pid for process in naoctl.processes()}
    doors = {
        connection.laddr[:2]
        for connection in psutil.net_connections("inet")
        if connection.pid in ours and connection.status == psutil.CONN_LISTEN
    }
    state = naoctl.state()
    assert doors == {("127.0.0.1", state.api_port), ("127.0.0.1", state.broker_port)}


def test_a_second_start_says_where_the_first_is(naoctl: Shell, stack: dict[str, Any]) -> None:
    ran = naoctl("up", "--detach", code=ExitCode.STACK)
    assert f"running on {naoctl.layout.root} at {stack['url']} (process {stack['pid']})" in ran.stderr
    assert "naoctl down" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1


def test_the_doctor_finds_the_stack_well(naoctl: Shell, stack: dict[str, Any]) -> None:
    findings = {finding["subject"]: finding for finding in naoctl.json("doctor")}
    assert {finding["verdict"] for finding in findings.values()} <= {"ok", "warning"}
    assert stack["url"] in findings["Stack"]["text"]
    assert findings["Worker"]["verdict"] == findings["Readiness"]["verdict"] == "ok"
    (worker,) = naoctl.json("workers")
    assert worker["alive"]
    assert worker["pid"] == naoctl.state().processes["worker"].pid


def test_a_job_from_submit_to_figures(naoctl: Shell, job: dict[str, Any]) -> None:
    assert (job["state"], job["progress_step"], job["tags"]) == ("succeeded", 256, ["try", "x:1"])
    assert [item["id"] for item in naoctl.json("list", "--tag", "try", "--state", "succeeded")] == [job["id"]]
    log = naoctl("logs", "-f", job["id"]).stdout
    assert "checkpoint at step 256" in log
    assert "evaluating 6 episodes" in log
    steps = [json.loads(line) for line in naoctl("watch", "tiny", "--json").stdout.splitlines()]
    assert [line["data"]["step"] for line in steps if line["kind"] == "metrics"] == [128, 256]


def test_a_job_is_copied_to_mlflow(naoctl: Shell, job: dict[str, Any]) -> None:
    uri = f"file:{naoctl.home / 'mlruns'}"
    for _ in range(2):  # the second time there is nothing to add
        done = naoctl("mirror", "mlflow", "tiny", MLFLOW_TRACKING_URI=uri, MLFLOW_ALLOW_FILE_STORE="true")
        assert f"{job['id']}: succeeded" in done.stderr
    (written,) = naoctl.home.glob("mlruns/*/*/metrics/time_s")
    assert [line.split()[2] for line in written.read_text().splitlines()] == ["128", "256"]
    results = {path.name for path in naoctl.home.glob("mlruns/*/*/metrics/evaluation/*")}
    assert {"distance_m", "fall_rate"} <= results


def test_a_downloaded_policy_gives_the_same_figures(naoctl: Shell, job: dict[str, Any]) -> None:
    fetched = {
        item["kind"]: Path(item["path"]) for item in naoctl.json("download", "tiny", "-o", str(naoctl.home / "out"))
    }
    manifest = json.loads((fetched["checkpoint"] / "checkpoint.json").read_text())
    assert manifest["steps"] == 256
    reported = json.loads((fetched["evaluation"] / "evaluation.json").read_text())
    again = subprocess.run(
        [
            *(sys.executable, "-m", "naosprint", "evaluate", "--json", str(fetched["checkpoint"])),
            *("--episodes", "6", "--n-envs", "4"),
        ],
        check=True,
        capture_output=True,
        text=True,
    )
    figures = json.loads(again.stdout)
    assert differences(reported, figures) == []
    assert count_numbers(figures) > 50
    before = {
        path: path.stat().st_mtime_ns for kind in ("checkpoint", "evaluation") for path in fetched[kind].iterdir()
    }
    naoctl("download", "tiny", "-o", str(naoctl.home / "out"))
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_page_and_an_export_of_the_policy(naoctl: Shell, job: dict[str, Any]) -> None:
    page = Path(naoctl.json("report", "tiny", "-o", str(naoctl.home / "out"), "--no-film")["page"])
    assert "tiny" in page.read_text(encoding="utf-8")
    assert (page.parent / "learning-curve.csv").stat().st_size > 0
    files = naoctl.json("export", "tiny", "-o", str(naoctl.home / "out"))["files"]
    assert "policy.onnx" in {Path(name).name for name in files}


def test_a_judgement_on_request(naoctl: Shell, job: dict[str, Any]) -> None:
    evaluated = naoctl.json("eval", "tiny", "--episodes", "4", "--n-envs", "4", "--seed", "9")
    assert evaluated["state"] == "succeeded"
    assert evaluated["summary"]["episodes"] == 4
    assert len(naoctl.api(f"/jobs/{job['id']}/evaluations")["items"]) == 2


def test_the_service_names_the_field_that_is_wrong(naoctl: Shell, stack: dict[str, Any]) -> None:
    ran = naoctl("submit", *TINY, "--tag", "no spaces", code=ExitCode.USAGE)
    assert "tags.0" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1


def test_somebody_elses_token_opens_nothing(naoctl: Shell, job: dict[str, Any]) -> None:
    made = naoctl.json("token", "create", "--owner", "bob", "--scope", "read")
    bob = {"NAOCTL_TOKEN": made["token"]}
    assert naoctl.json("list", **bob) == []
    assert "no job" in naoctl("status", job["id"], code=ExitCode.NOT_FOUND, **bob).stderr.lower()
    naoctl("submit", *TINY, code=ExitCode.DENIED, **bob)
    naoctl("token", "list", code=ExitCode.DENIED, **bob)
    listed = naoctl("token", "list").stdout
    assert "bob" in listed and made["token"] not in listed
    naoctl("token", "revoke", made["id"])
    naoctl("list", code=ExitCode.DENIED, **bob)
    assert "revoked" in naoctl("token", "list").stdout
    assert "naoctl token list" in naoctl("token", "revoke", "bob", code=ExitCode.NOT_FOUND).stderr


def test_cancel_ends_a_running_job(naoctl: Shell, stack: dict[str, Any]) -> None:
    submitted = naoctl.json("submit", *ENDLESS, "--name", "endless", "--no-evaluate")
    naoctl.until(submitted["id"], lambda update: update["kind"] == "metrics")
    assert [item["state"] for item in naoctl.json("cancel", "endless", "--wait")] == ["cancelled"]
    naoctl("logs", "-f", "endless", code=ExitCode.JOB_CANCELLED)
    naoctl("pause", "endless", code=ExitCode.CONFLICT)


SPACE = ["--space", "learning_rate=1e-4..1e-2:log"]


def test_a_study_from_a_policy_is_extended(naoctl: Shell, job: dict[str, Any]) -> None:
    naoctl("policies", "register", "runner", "tiny")
    tuned = ["--objective", "distance_m", "--trials", "1", "--from-policy", "runner", "--name", "searched"]
    started = naoctl.json("tune", *TINY, *EVAL, *SPACE, *tuned)
    (first,) = naoctl.study("searched", lambda study: study["state"] == "finished")["trials"]
    assert naoctl.json("study", "extend", "searched", "--trials", "2")["spec"]["trials"] == 2
    study = naoctl.study("searched", lambda study: study["state"] == "finished")
    assert [trial["state"] for trial in study["trials"]] == ["complete"] * 2
    assert study["trials"][0] == first
    jobs = [naoctl.api(f"/jobs/{trial['job_id']}") for trial in study["trials"]]
    assert {(each["parent_policy"], each["group_id"]) for each in jobs} == {("runner@1", started["id"])}
    shown = naoctl("study", "show", "searched").stdout
    assert "2 of 2 ended" in shown and all(trial["job_id"] in shown for trial in study["trials"])
    assert "searched" in naoctl("study", "list").stdout


def test_cancel_ends_a_study_and_its_jobs(naoctl: Shell, stack: dict[str, Any]) -> None:
    naoctl("tune", *ENDLESS, *SPACE, "--objective", "distance_m", "--trials", "5", "--name", "endless-study")
    study = naoctl.study("endless-study", lambda study: bool(study["trials"]))
    assert naoctl.json("study", "cancel", "endless-study")["state"] == "cancelled"
    for trial in study["trials"]:
        naoctl("watch", trial["job_id"], "--json", code=ExitCode.JOB_CANCELLED)
    naoctl("study", "delete", "endless-study")
    assert "endless-study" not in naoctl("study", "list").stdout


def test_trials_are_asked_for_and_told(naoctl: Shell, stack: dict[str, Any]) -> None:
    space = ["--space", "n_epochs=1..3", "--trials", "2", "--parallel", "1"]
    naoctl("tune", *TINY, *space, "--objective", "score:max", "--elsewhere", "--name", "away")
    for number, words in enumerate((["1.5"], ["--failed", "no power"])):
        naoctl.study("away", lambda study, count=number + 1: len(study["trials"]) == count)
        trial = naoctl.json("study", "ask", "away", "-o", "trial.json")
        spec = json.loads((naoctl.home / "trial.json").read_text())["spec"]
        assert trial["number"] == number and spec["algorithm"]["n_epochs"] == trial["params"]["n_epochs"]
        naoctl("study", "ask", "away", code=ExitCode.CONFLICT)
        naoctl("study", "tell", "away", str(number), *words)
    study = naoctl.study("away", lambda study: study["state"] == "finished")
    assert [(trial["state"], trial["values"]) for trial in study["trials"]] == [("complete", [1.5]), ("failed", None)]
    assert study["best"] == [0]


def test_a_killed_worker_is_replaced(naoctl: Shell, stack: dict[str, Any]) -> None:
    (before,) = naoctl.api("/workers")["items"]
    os.kill(before["pid"], signal.SIGKILL)
    # The next job is a new worker's, and a killed worker's registration changes nothing about that.
    submitted = naoctl.json("submit", *ENDLESS, "--name", "kept", "--no-evaluate")
    naoctl.until(submitted["id"], lambda update: update["kind"] == "metrics" and update["data"]["step"] >= 512)
    now = naoctl.state().processes["worker"]
    assert now.pid != before["pid"]
    assert now.process() is not None


def test_a_killed_supervisor_takes_everything_with_it(naoctl: Shell, stack: dict[str, Any]) -> None:
    state = naoctl.state()
    processes = naoctl.processes()
    assert len(processes) >= 8  # four programs, a training, and Postgres' own
    assert state.supervisor is not None
    os.kill(state.supervisor.pid, signal.SIGKILL)
    _, alive = psutil.wait_procs(processes, timeout=30)
    assert alive == []
    naoctl("list", code=ExitCode.UNREACHABLE)


def test_the_next_start_finds_everything_again(naoctl: Shell, stack: dict[str, Any], job: dict[str, Any]) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "naoctl", "up"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=naoctl.environment,
        text=True,
        start_new_session=True,
    ) as up:
        assert up.stdout is not None
        shown = []
        for line in up.stdout:
            shown.append(line)
            if line.startswith("Stop"):
                break
        assert any(line.split() == ["Dashboard", stack["url"]] for line in shown), shown
        found = naoctl.json("status", "tiny")  # evaluations since then have changed its time
        assert {**found, "updated_at": job["updated_at"]} == job
        assert naoctl.job("kept")["state"] not in ("failed", "succeeded", "cancelled")
        processes = naoctl.processes()
        up.send_signal(signal.SIGINT)
        rest = up.stdout.read()
        assert up.wait(60) == 0
    assert "nothing is left running" in rest
    assert not any(process.is_running() for process in processes)


def test_down_is_sure_and_can_be_repeated(naoctl: Shell, stack: dict[str, Any]) -> None:
    naoctl("up", "--detach")
    state, processes = naoctl.state(), naoctl.processes()
    # Typed as `naoctl up` printed it, in a shell without the data folder's variable.
    command = shlex.split(naoctl.layout.stop_command)
    del naoctl.environment["NAOCTL_DATA_DIR"]
    assert command[0] == "naoctl"
    assert naoctl.json(*command[1:]) == {"data_dir": str(naoctl.layout.root), "stopped": True}
    naoctl.environment["NAOCTL_DATA_DIR"] = str(naoctl.layout.root)
    assert not any(process.is_running() for process in processes)
    assert state.supervisor is not None
    assert state.supervisor.process() is None
    assert naoctl.json("down")["stopped"] is False
    naoctl("status", "tiny", code=ExitCode.UNREACHABLE)
