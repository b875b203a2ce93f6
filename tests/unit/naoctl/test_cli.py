from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from naoctl import __version__
from naoctl.cli import build_app
from naoctl.commands.artifacts import export_flags
from naoctl.config import Config
from naoctl.errors import ExitCode, InvalidInput
from naoctl.render import Curve, _PlainConsole, live_view
from naospec import TrainingSpec
from rich.console import Console

from .conftest import Ran

Jobs = Callable[..., dict[str, Any]]

RESULT = {"name": "height_m", "title": "Jump height", "unit": "m", "digits": 2, "value": 3.5, "interval": [3.0, 4.0]}
"""One result of an evaluation as it describes itself."""


EVALUATED = {
    "evaluation_id": "eval_01m7y0yae5d2d9p46g58mkcxxh",
    "checkpoint_id": "ckpt_1",
    "step": 1000,
    "episodes": 1000,
    "finished_at": "2026-01-02T03:05:05Z",
    "results": [
        {"name": "distance_m", "title": "Distance", "unit": "m", "digits": 2, "value": 27.9, "interval": [27.8, 28.0]}
    ],
}
"""A job's evaluation as the service shows it with the job; the live metric beside it includes exploration."""


def test_submit_sends_what_was_chosen_once(server: Any, naoctl: Callable[..., Ran], job: Jobs, tmp_path: Path) -> None:
    server.on("POST", "/jobs")(lambda request: request.json(job(state="queued"), 201))
    path = tmp_path / "job.toml"
    path.write_text('name = "night"\n[spec]\nalgorithm = {preset = "paper"}\nseed = 3\n')
    ran = naoctl("submit", str(path), "--seed", "4", "-t", "a", "-t", "b", "--priority", "9", "--no-evaluate")
    assert ran.code == 0, ran.err
    assert "Submitted job_01m7y0yae5d2d9p46g58mkcxxh" in ran.out
    asked = server.received[0]
    assert asked.body == {
        "name": "night",
        "spec": {"algorithm": {"preset": "paper"}, "seed": 4},
        "evaluation": None,
        "tags": ["a", "b"],
        "priority": 9,
    }
    assert len(asked.headers["Idempotency-Key"]) == 32


def test_submit_prints_the_job_as_json(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    server.on("POST", "/jobs")(lambda request: request.json(job(), 201))
    ran = naoctl("submit", "--json", "--idempotency-key", "mine")
    assert json.loads(ran.out) == job()
    assert ran.err == ""
    assert server.received[0].headers["Idempotency-Key"] == "mine"


def test_submit_from_another_jobs_policy(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    server.on("GET", "/jobs")(lambda request: request.json({"items": [job()], "next_cursor": None}))
    server.on("POST", "/jobs")(lambda request: request.json(job(), 201))
    assert naoctl("submit", "--task", "sprint2", "--from", "first").code == 0
    assert server.received[-1].body["parent_job_id"] == job()["id"]
    assert naoctl("submit", "--from-checkpoint", "x").code == ExitCode.USAGE
    points = [{"id": f"ckpt_{step}", "step": step, "attempt": 1} for step in (100, 200)]
    server.on("GET", f"/jobs/{job()['id']}/checkpoints")(
        lambda request: request.json({"items": points, "next_cursor": None})
    )
    for wanted in ("100", "ckpt_100"):
        assert naoctl("submit", "--from", "first", "--from-checkpoint", wanted).code == 0
        assert server.received[-1].body["parent_checkpoint_id"] == "ckpt_100"
    refused = naoctl("submit", "--from", "first", "--from-checkpoint", "300")
    assert (refused.code, "Its newest are at steps 100, 200." in refused.err) == (ExitCode.NOT_FOUND, True)


def test_a_sweep_is_one_request(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    server.on("POST", "/groups")(lambda request: request.json({"id": "group_1", "jobs": [job(), job()]}, 201))
    ran = naoctl("submit", "--seeds", "0-1", "--name", "sweep")
    assert "2 jobs as group group_1" in ran.out
    assert server.received[0].body == {"job": {"spec": {}, "name": "sweep"}, "seeds": [0, 1], "grid": {}}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["submit", "--n-envs", "0"], "--n-envs"),
        (["submit", "--task", "sprint9"], "sprint1, sprint1-erect, sprint2"),
        (["submit", "missing.yaml"], "missing.yaml"),
        (["submit", "--name", "last"], "newest job"),
        (["submit", "--seed", "3", "--seeds", "0-1"], "--seeds and --seed contradict"),
        (["submit", "--seeds", "0-1", "--watch"], "--watch"),
        (["list", "--state", "dead"], "queued, starting"),
        (["compare", "a"], "two jobs"),
        (["delete", "job_01m7y0yae5d2d9p46g58mkcxxh"], "--yes"),
        (["login", "not a url"], "http address"),
        (["token", "create", "--owner", "x", "--scope", "root"], "read, submit, admin"),
    ],
)
def test_wrong_input_is_told_before_anything_is_sent(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("naoctl.commands.jobs.stdin_is_terminal", lambda: False)
    server.on("GET", f"/jobs/{job()['id']}")(lambda request: request.json(job()))
    ran = naoctl(*words)
    assert ran.code == ExitCode.USAGE
    assert said in ran.err
    assert ran.out == ""
    assert all(asked.method == "GET" for asked in server.received)


def test_errors_are_one_line_for_people_and_json_for_programs(server: Any, naoctl: Callable[..., Ran]) -> None:
    server.on("GET", "/jobs")(lambda request: request.problem(401, "the token is unknown"))
    ran = naoctl("list")
    assert ran.code == ExitCode.DENIED
    assert ran.err == "naoctl: The token is unknown. Sign in with `naoctl login`, or set NAOCTL_TOKEN.\n"
    ran = naoctl("list", "--json")
    assert ran.code == ExitCode.DENIED
    assert json.loads(ran.err)["code"] == 4


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["list", "--limit", "many"], "--limit"),
        (["list", "--nope"], "--nope"),
        (["lst"], "lst"),
        (["compare"], "JOB"),
        (["submit", "--n-envs", "0"], "--n-envs"),
        (["submit", "--from-policy", ""], "--from-policy is empty"),
        (["download", "last", "--output="], "--output is empty"),
        (["match", "a", ""], "B is empty"),
        (["--url", "", "list"], "--url is empty"),
    ],
)
def test_usage_errors_are_one_line_and_obey_json(naoctl: Callable[..., Ran], words: list[str], said: str) -> None:
    ran = naoctl(*words)
    assert (ran.code, ran.out, ran.err.count("\n")) == (ExitCode.USAGE, "", 1)
    assert ran.err.startswith("naoctl: ") and said in ran.err
    ran = naoctl(*words, "--json")
    assert (ran.code, ran.out) == (ExitCode.USAGE, "")
    error = json.loads(ran.err)
    assert said in error["error"] and error["code"] == ExitCode.USAGE


def test_list_filters_and_prints(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    server.on("GET", "/jobs")(lambda request: request.json({"items": [job()], "next_cursor": None}))
    ran = naoctl("list", "-s", "running", "-s", "queued", "--tag", "try", "-q", "fir", "--group", "group_1")
    assert "first" in ran.out
    query = server.received[0].query
    assert query["state"] == ["running", "queued"]
    assert query["tag"] == ["try"]
    assert query["q"] == ["fir"]
    assert query["group"] == ["group_1"]
    assert json.loads(naoctl("list", "--json").out) == [job()]


@pytest.mark.parametrize("reference", ["first", "job_01m7y0", "mkcxxh", "last", "job_01m7y0yae5d2d9p46g58mkcxxh"])
def test_a_job_can_be_named_in_several_ways(server: Any, naoctl: Callable[..., Ran], job: Jobs, reference: str) -> None:
    server.on("GET", "/jobs")(lambda request: request.json({"items": [job()], "next_cursor": None}))
    server.on("GET", f"/jobs/{job()['id']}")(lambda request: request.json(job()))
    assert json.loads(naoctl("status", reference, "--json").out)["id"] == job()["id"]


def test_broken_plugins_of_others_stop_no_command(
    broken: Path, server: Any, naoctl: Callable[..., Ran], job: Jobs
) -> None:
    """A job of a task that is broken here is described by the service."""
    jobs = [job(), job(spec={**job()["spec"], "task": {"name": "dives"}})]
    server.on("GET", "/jobs")(lambda request: request.json({"items": jobs, "next_cursor": None}))
    server.on("GET", "/tasks")(lambda request: request.json([]))
    assert naoctl("list").code == 0
    assert naoctl("spec").code == 0
    assert naoctl("submit", "--help").code == 0
    refused = naoctl("submit", "--task", "sinks")
    assert refused.code == ExitCode.FAILURE
    assert refused.err.splitlines()[-1].startswith("naoctl: sinks: package sinking offers it as ")


def test_shells_show_no_warnings_while_they_complete(broken: Path) -> None:
    question = {"_NAOCTL_COMPLETE": "complete_bash", "COMP_WORDS": "naoctl sub", "COMP_CWORD": "1"}
    program = Path(sys.executable).parent / "naoctl"
    for words, shown in ((question, False), ({}, True)):
        environment = {**os.environ, "PYTHONPATH": str(broken), **words}
        ran = subprocess.run([program, "--version"], env=environment, capture_output=True, text=True, check=True)
        assert ("left out: sinks" in ran.stderr) is shown


def test_a_list_is_sorted_by_any_column(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    jobs = [
        job(name=name, latest_metrics=metrics) for name, metrics in (("a", {"x": 1.0}), ("b", {}), ("c", {"x": 3.0}))
    ]
    server.on("GET", "/jobs")(lambda request: request.json({"items": jobs, "next_cursor": None}))
    ran = naoctl("list", "--sort", "-x", "--columns", "name,x")
    assert [line.split() for line in ran.out.splitlines()] == [["Name", "x"], ["c", "3"], ["a", "1"], ["b", "-"]]
    assert [one["name"] for one in json.loads(naoctl("list", "--sort", "x", "--json").out)] == ["a", "c", "b"]
    assert [one["name"] for one in json.loads(naoctl("list", "--sort", "-x", "-l", "1", "--json").out)] == ["c"]
    assert json.loads(naoctl("list", "--columns", "name,top_speed_mps,algorithm.target_kl_final", "--json").out)[0] == {
        "name": "a", "top_speed_mps": None, "algorithm.target_kl_final": None
    }  # fmt: skip
    for option in ("--sort", "--columns"):
        ran = naoctl("list", option, "y")
        assert ran.code == ExitCode.USAGE and "'y'" in ran.err and "top_speed_mps" in ran.err


def test_values_of_a_trial_can_be_negative_and_have_to_be_finite(server: Any, naoctl: Callable[..., Ran]) -> None:
    study = {"id": "study_" + "1" * 26, "name": "outside"}
    server.on("GET", "/studies")(lambda request: request.json({"items": [study], "next_cursor": None}))
    server.on("GET", f"/studies/{study['id']}")(lambda request: request.json(study))
    server.on("POST", f"/studies/{study['id']}/trials/0/tell")(lambda request: request.json({"number": 0}))
    assert naoctl("study", "tell", "outside", "0", "-1.5", "2").code == 0
    assert server.received[-1].body == {"values": [-1.5, 2.0]}
    for value in ("nan", "-inf"):
        ran = naoctl("study", "tell", "outside", "0", value)
        assert ran.code == ExitCode.USAGE and "--failed REASON" in ran.err


def test_a_version_that_does_not_exist_is_not_called_a_job(server: Any, naoctl: Callable[..., Ran]) -> None:
    problem = {"title": "Not Found", "detail": "policy fast has no alias 'gone'", "status": 404}
    server.on("GET", "/policies/fast@gone")(lambda request: request.json(problem, status=404))
    server.on("GET", "/jobs")(lambda request: request.json({"items": [], "next_cursor": None}))
    ran = naoctl("eval", "fast@gone", "--no-wait")
    assert ran.code == ExitCode.NOT_FOUND
    assert "has no alias 'gone'" in ran.err and "no job" not in ran.err


def test_the_beginning_of_a_worker_s_id_is_enough(server: Any, naoctl: Callable[..., Ran]) -> None:
    workers = [{"id": f"vm:{pid}:8976ab", "jobs": []} for pid in (7802, 7903)]
    server.on("GET", "/workers")(lambda request: request.json({"items": workers, "next_cursor": None}))
    server.on("POST", "/workers/vm%3A7802%3A8976ab/drain")(lambda request: request.json(workers[0]))
    problem = {"title": "Not Found", "detail": "no worker", "status": 404}
    server.on("POST", "/workers/vm%3A7/drain")(lambda request: request.json(problem, status=404))
    assert naoctl("workers", "drain", "vm:7802").out.startswith("vm:7802:8976ab: drained")
    assert "There is no worker vm:7" in naoctl("workers", "drain", "vm:7").err


def test_a_narrow_terminal_folds_no_id_of_workers_and_drops_no_column(
    server: Any, naoctl: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    held = [f"job_01m7y0yae5d2d9p46g58mkcx{end}" for end in ("ab", "cd")]
    worker = {
        **{"id": "ip-10-0-12-113.eu-central-1.compute.internal:7802:8976ab12:3f4e5d6", "jobs": held, "alive": True},
        **{"simulators": ["embedded", "rcssserver3d"], "robots": ["k1", "nao-0"], "disk_free_bytes": 12_100_000_000},
        **{"heartbeat_at": datetime.now(UTC).isoformat(), "drained_at": None, "version": "0.2.0"},
    }
    server.on("GET", "/workers")(lambda request: request.json({"items": [worker], "next_cursor": None}))
    monkeypatch.setattr(_PlainConsole, "is_terminal", True)
    monkeypatch.setenv("COLUMNS", "80")
    out = naoctl("workers").out
    assert worker["id"] in out and "mkcxab" in out and "mkcxcd" in out
    assert all(heading in out for heading in ("Queues", "Robots", "Works", "Free", "seen", "Version"))


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="the system has no zones of processes")
def test_times_are_those_of_this_machine_and_one_that_has_passed_is_noted(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "CET-1")
    time.tzset()
    reason = "it is to start at 2027-12-01 05:00 UTC or later"
    waiting = job(state="queued", started_at=None, waiting_reason=reason)
    server.on("POST", "/jobs")(lambda request: request.json(waiting, 201))
    server.on("GET", f"/jobs/{waiting['id']}")(lambda request: request.json(waiting))
    try:
        ran = naoctl("submit", "--not-before", "2020-12-01T06:00")
        assert "The start time 2020-12-01T06:00:00+01:00 has passed: the work starts at once." in ran.err
        assert "it is to start at 2027-12-01 06:00 CET or later" in ran.err
        assert server.received[0].body["not_before"] == "2020-12-01T06:00:00+01:00"
        assert "2027-12-01 06:00 CET" in naoctl("status", waiting["id"]).out
        assert "has passed" not in naoctl("submit", "--not-before", "8h").err
    finally:
        monkeypatch.undo()
        time.tzset()


def test_a_name_that_means_several_jobs_is_refused(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    twins = [job(), job(id="job_" + "2" * 26)]
    server.on("GET", "/jobs")(lambda request: request.json({"items": twins, "next_cursor": None}))
    ran = naoctl("cancel", "first")
    assert ran.code == ExitCode.USAGE
    assert "job_22222" in ran.err
    assert naoctl("status", "nothing-like-it").code == ExitCode.NOT_FOUND


@pytest.mark.parametrize("verb", ["cancel", "pause", "resume", "retry"])
def test_steering(server: Any, naoctl: Callable[..., Ran], job: Jobs, verb: str) -> None:
    path = f"/jobs/{job()['id']}"
    server.on("GET", path)(lambda request: request.json(job()))
    server.on("POST", f"{path}/{verb}")(lambda request: request.json(job(state="running")))
    ran = naoctl(verb, job()["id"])
    assert ran.code == 0
    assert job()["id"] in ran.out
    server.on("POST", f"{path}/{verb}")(lambda request: request.problem(409, "the job has ended"))
    ran = naoctl(verb, job()["id"])
    assert ran.code == ExitCode.CONFLICT
    assert "The job has ended" in ran.err


def test_an_evaluation_is_cancelled_by_its_id(server: Any, naoctl: Callable[..., Ran]) -> None:
    evaluation = "eval_01m7y0yae5d2d9p46g58mkcxxh"
    states = iter(["starting", "cancelled"])
    answer = {"id": evaluation, "state": "starting", "waiting_reason": None}
    server.on("POST", f"/evaluations/{evaluation}/cancel")(lambda request: request.json(answer))
    server.on("GET", f"/evaluations/{evaluation}")(lambda request: request.json({**answer, "state": next(states)}))
    assert naoctl("cancel", evaluation).out == f"{evaluation}: cancel requested\n"
    assert naoctl("cancel", evaluation, "--wait").out == f"{evaluation}: cancelled\n"


def test_status_shows_why_a_job_waits(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    waiting = job(state="queued", waiting_reason="no worker has task 'sprint9' version 2")
    server.on("GET", f"/jobs/{job()['id']}")(lambda request: request.json(waiting))
    assert "no worker has task 'sprint9' version 2" in naoctl("status", job()["id"]).out
    server.on("POST", "/jobs")(lambda request: request.json(waiting, 201))
    assert "Waiting: no worker has task 'sprint9' version 2" in naoctl("submit").err


def test_a_stalled_job_is_shown_as_such(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    stalled = job(state="running", stalled_since="2026-01-01T00:00:00Z")
    server.on("GET", f"/jobs/{stalled['id']}")(lambda request: request.json(stalled))
    server.on("GET", "/jobs")(lambda request: request.json({"items": [stalled], "next_cursor": None}))
    assert "Stalled" in naoctl("status", stalled["id"]).out
    assert "stalled" in naoctl("list").out


def test_a_finished_job_shows_its_evaluation(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, event: Callable[..., str]
) -> None:
    done = job(state="succeeded", progress_step=1000, result=EVALUATED)
    running = job(id="job_" + "2" * 26, name="second", result=EVALUATED)
    server.on("GET", "/jobs")(lambda request: request.json({"items": [done, running], "next_cursor": None}))
    listed = naoctl("list")
    rows = {line.split()[1]: line for line in listed.out.splitlines()}
    assert "27.90 m" in rows["first"] and "*" not in rows["first"]
    assert "2.25 m*" in rows["second"], "a running job shows training, marked"
    assert listed.err == "* during training, with exploration\n"

    path = f"/jobs/{done['id']}"
    server.on("GET", path)(lambda request: request.json(done))
    shown = naoctl("status", done["id"]).out
    assert "1,000 episodes at step 1,000 (eval_01m7y0yae5d2d9p46g58mkcxxh)" in shown
    assert "27.90 m [27.80, 28.00]" in shown
    assert re.search(r"In training .*distance 2\.25 m \(latest episodes, with exploration\)", shown)

    server.on("GET", f"{path}/stream")(lambda request: request.stream(event("state", done)))
    last = naoctl("watch", done["id"]).out.splitlines()[-1]
    assert "Evaluation, 1,000 episodes at step 1,000" in last and "distance 27.90 m" in last
    unevaluated = {**done, "result": None}
    server.on("GET", f"{path}/stream")(lambda request: request.stream(event("state", unevaluated)))
    assert "In training: distance 2.25 m" in naoctl("watch", done["id"]).out.splitlines()[-1]


def test_compare_and_download_use_the_newest_evaluation_with_the_most_episodes(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, tmp_path: Path
) -> None:
    def evaluation(number: int, episodes: int, minute: int, state: str = "succeeded") -> dict[str, Any]:
        summary = {"episodes": episodes, "results": [{**RESULT, "value": float(number)}], "headline": ["height_m"]}
        return {
            "id": f"eval_{number}",
            "state": state,
            "summary": summary if state == "succeeded" else None,
            "finished_at": f"2026-01-02T03:{minute:02}:05Z",
            "files": [],
        }

    made = [evaluation(5, 2000, 5, "failed"), evaluation(4, 10, 4), evaluation(3, 1000, 3), evaluation(2, 1000, 2)]
    other = job(id="job_" + "2" * 26, name="other")
    for one, evaluations in ((job(), made), (other, [])):
        server.on("GET", f"/jobs/{one['id']}")(lambda request, one=one: request.json(one))
        server.on("GET", f"/jobs/{one['id']}/evaluations")(
            lambda request, found=evaluations: request.json({"items": found, "next_cursor": None})
        )
    out = naoctl("compare", job()["id"], other["id"]).out
    lines = [line.split() for line in out.splitlines()]
    assert ["Evaluation", "eval_3", "-"] in lines
    assert ["Episodes", "1,000", "-"] in lines
    assert "3.00 m" in out and "4.00 m" not in out
    assert out.index("In training") > out.index("Jump height")
    ran = naoctl("download", job()["id"], "--what", "evaluation", "-o", str(tmp_path), "--json")
    assert json.loads(ran.out)[0]["id"] == "eval_3"


def test_watch_shows_why_a_job_waits(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, event: Callable[..., str]
) -> None:
    reason = "no worker has simulator 'server'"
    path = f"/jobs/{job()['id']}"
    server.on("GET", path)(lambda request: request.json(job()))
    server.on("GET", f"{path}/stream")(
        lambda request: request.stream(
            event("state", job(state="queued", waiting_reason=reason)),
            event("state", job(state="queued", waiting_reason=reason)),
            event("state", job(state="cancelled")),
        )
    )
    out = naoctl("watch", job()["id"]).out
    assert out.count(f"Waiting: {reason}") == 1
    console = Console(width=80, file=io.StringIO(), force_terminal=True)
    waiting = job(state="queued", waiting_reason=reason)
    console.print(live_view(waiting, Curve(), [], width=80, ascii_only=False))
    assert reason in console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize(("state", "code"), [("succeeded", 0), ("failed", 10), ("cancelled", 11), ("paused", 12)])
def test_the_exit_code_of_watch_is_the_jobs_result(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, event: Callable[..., str], state: str, code: int
) -> None:
    server.on("GET", f"/jobs/{job()['id']}")(lambda request: request.json(job()))
    server.on("GET", f"/jobs/{job()['id']}/stream")(
        lambda request: request.stream(
            event("metrics", {"step": 500, "reward": 2.0}, "1-0-0"),
            event("state", job(state=state, progress_step=500, error="lost its worker" if state == "failed" else None)),
            event("end", {"state": state}),
        )
    )
    ran = naoctl("watch", job()["id"])
    assert ran.code == code
    assert "500 of 1,000 steps" in ran.out
    assert f"{state} at 500 steps" in ran.out
    assert ("lost its worker" in ran.out) == (state == "failed")
    lines = [json.loads(line) for line in naoctl("watch", job()["id"], "--json").out.splitlines()]
    assert [line["kind"] for line in lines] == ["metrics", "job"]


def test_logs_follow_without_gap_or_repetition(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, event: Callable[..., str]
) -> None:
    path = f"/jobs/{job()['id']}"
    lines = [
        {"id": n, "at": f"2026-01-02T03:04:0{n}Z", "attempt": 1, "level": "info", "message": f"line {n}"}
        for n in range(1, 6)
    ]

    def stored(request: Any) -> None:
        after = int(server.received[-1].query["after"][0])
        # The first look comes before the last three lines are written.
        known = lines if any(asked.path.endswith("/stream") for asked in server.received) else lines[:2]
        items = [line for line in known if line["id"] > after]
        request.json({"items": items, "next_after": items[-1]["id"] if items else None})

    server.on("GET", path)(lambda request: request.json(job()))
    server.on("GET", f"{path}/logs")(stored)
    server.on("GET", f"{path}/events")(lambda request: request.json({"items": [], "next_after": None}))
    server.on("GET", f"{path}/stream")(
        lambda request: request.stream(
            event("log", lines[1], "0-2-0"),
            event("log", lines[2], "0-3-0"),
            event("log", lines[3], "0-4-0"),
            event("state", job(state="failed")),
        )
    )
    ran = naoctl("logs", "-f", job()["id"])
    assert ran.code == ExitCode.JOB_FAILED
    assert [line.split()[-1] for line in ran.out.splitlines()] == ["1", "2", "3", "4", "5"]
    assert naoctl("logs", "-n", "1", job()["id"]).out.split()[-2:] == ["line", "5"]


def test_download_checks_every_file(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import hashlib

    monkeypatch.setattr("naoctl.transfer.PAUSE_S", 0.001)
    content = b"weights"
    path = f"/jobs/{job()['id']}"
    file = {
        "name": "policy.npz",
        "size": 7,
        "sha256": hashlib.sha256(content).hexdigest(),
        "url": "/checkpoints/c/files/policy.npz",
    }
    points = [
        {"id": "ckpt_1", "attempt": 1, "step": 10, "files": [file], "size": 7},
        {"id": "ckpt_2", "attempt": 1, "step": 20, "files": [file], "size": 7},
    ]
    server.on("GET", path)(lambda request: request.json(job()))
    server.on("GET", f"{path}/checkpoints")(lambda request: request.json({"items": points, "next_cursor": None}))
    server.on("GET", f"{path}/evaluations")(lambda request: request.json({"items": [], "next_cursor": None}))
    columns = {"step": [10, 20], "reward": [None, 1.5]}
    server.on("GET", f"{path}/metrics")(lambda request: request.json({"columns": columns, "rows": 2, "total_rows": 2}))
    server.on("GET", file["url"])(lambda request: request.raw(content))
    ran = naoctl("download", job()["id"], "-o", str(tmp_path / "out"), "--json")
    assert [(item["kind"], item["id"]) for item in json.loads(ran.out)] == [
        ("checkpoint", "ckpt_2"),
        ("metrics", job()["id"]),
    ]
    rows = [json.loads(line) for line in (tmp_path / "out" / "metrics.jsonl").read_text().splitlines()]
    assert rows == [{"step": 10}, {"step": 20, "reward": 1.5}]
    assert (tmp_path / "out" / "checkpoint-000000000020" / "policy.npz").read_bytes() == content
    assert naoctl("download", job()["id"], "-c", "10", "-o", str(tmp_path / "out")).code == 0
    assert naoctl("download", job()["id"], "-c", "11").code == ExitCode.NOT_FOUND
    assert naoctl("download", job()["id"], "--what", "evaluation").code == ExitCode.NOT_FOUND
    server.on("GET", file["url"])(lambda request: request.raw(b"WEIGHTS"))
    assert naoctl("download", job()["id"], "-o", str(tmp_path / "other")).code == ExitCode.CORRUPT


def test_evaluate_waits_for_the_results(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("naoctl.commands.artifacts.POLL_S", 0.001)
    evaluation = {
        "id": "eval_1",
        "state": "queued",
        "error": None,
        "waiting_reason": None,
        "summary": None,
        "spec": {"episodes": 10, "seed": 5, "confidence": 0.95},
    }
    done = {**evaluation, "state": "succeeded", "summary": {"results": [RESULT], "headline": [RESULT["name"]]}}
    server.on("GET", f"/jobs/{job()['id']}")(lambda request: request.json(job()))
    server.on("POST", f"/jobs/{job()['id']}/evaluations")(lambda request: request.json(evaluation, 202))
    server.on("GET", "/evaluations/eval_1")(
        lambda request: request.json(evaluation if len(server.received) < 4 else done)
    )
    ran = naoctl("eval", job()["id"], "--episodes", "10", "--seed", "5")
    assert ran.code == 0, ran.err
    assert "3.50 m [3.00, 4.00]" in ran.out
    body = server.received[1].body
    assert (body["spec"]["episodes"], body["spec"]["seed"], body["spec"]["task"]) == (10, 5, None)
    assert naoctl("eval", job()["id"], "--episodes", "0").code == ExitCode.USAGE


@pytest.mark.parametrize(("answer", "cancelled"), [("y\n", True), ("\n", False), (None, False)])
def test_ctrl_c_on_eval_offers_to_cancel_it(
    server: Any,
    naoctl: Callable[..., Ran],
    job: Jobs,
    monkeypatch: pytest.MonkeyPatch,
    answer: str | None,
    cancelled: bool,
) -> None:
    """Ctrl-C comes while the evaluation runs, as a signal to the waiting process."""
    name = "eval_01m7y0yae5d2d9p46g58mkcxxh"
    running = {
        "id": name,
        "job_id": job()["id"],
        "state": "running",
        "waiting_reason": None,
        "spec": {"episodes": 10, "seed": 5},
    }
    server.on("GET", f"/jobs/{job()['id']}")(lambda request: request.json(job()))
    server.on("POST", f"/jobs/{job()['id']}/evaluations")(lambda request: request.json(running, 202))

    looked = threading.Event()

    @server.on("GET", f"/evaluations/{name}")
    def look(request: Any) -> None:
        request.json(running)
        if not looked.is_set():  # the next look may come before the signal
            looked.set()
            os.kill(os.getpid(), signal.SIGINT)

    server.on("POST", f"/evaluations/{name}/cancel")(lambda request: request.json(running))
    monkeypatch.setattr("naoctl.commands.artifacts.stdin_is_terminal", lambda: answer is not None)
    monkeypatch.setattr("sys.stdin", io.StringIO(answer or ""))
    ran = naoctl("eval", job()["id"])
    assert ran.code == ExitCode.INTERRUPTED
    asked = [received.path for received in server.received if received.method == "POST"]
    assert (f"/evaluations/{name}/cancel" in asked) == cancelled
    assert (f"`naoctl cancel {name}` cancels it" in ran.err) == (not cancelled)


def test_the_report_is_the_one_that_the_service_has_drawn(
    server: Any, naoctl: Callable[..., Ran], job: Jobs, tmp_path: Path
) -> None:
    import hashlib

    page = b"<html>drawn by a worker</html>"
    file = {
        "name": "report.html",
        "size": len(page),
        "sha256": hashlib.sha256(page).hexdigest(),
        "url": "/evaluations/eval_1/files/report.html",
    }
    evaluated = {"id": "eval_1", "state": "succeeded", "files": [file], "finished_at": "2026-01-02T03:04:05Z"}
    server.on("GET", f"/jobs/{job()['id']}")(lambda request: request.json(job()))
    server.on("GET", f"/jobs/{job()['id']}/evaluations")(
        lambda request: request.json({"items": [evaluated], "next_cursor": None})
    )
    server.on("GET", file["url"])(lambda request: request.raw(page))
    ran = naoctl("report", job()["id"], "-o", str(tmp_path / "out"), "--json")
    assert ran.code == 0, ran.err
    shown = Path(json.loads(ran.out)["page"])
    assert (shown, shown.read_bytes()) == (tmp_path / "out" / "report" / "report.html", page)
    assert {received.path for received in server.received} == {
        f"/jobs/{job()['id']}",
        f"/jobs/{job()['id']}/evaluations",
        file["url"],
    }


def test_tokens_are_made_listed_and_revoked_over_http(server: Any, naoctl: Callable[..., Ran]) -> None:
    made = {
        "id": "token_1",
        "name": "laptop",
        "owner": "bob",
        "scopes": ["read"],
        "created_at": "2026-01-02T03:04:05Z",
        "expires_at": "2026-01-03T03:04:05Z",
        "revoked_at": None,
    }
    server.on("POST", "/tokens")(lambda request: request.json({**made, "token": "nao_secret"}, 201))
    server.on("GET", "/tokens")(lambda request: request.json({"items": [made], "next_cursor": None}))
    server.on("DELETE", "/tokens/token_1")(lambda request: request.raw(b"", 204))
    words = ("token", "create", "--owner", "bob", "--name", "laptop", "--scope", "read", "--days", "1")
    assert naoctl(*words).out == "nao_secret\n"
    assert server.received[0].body == {"owner": "bob", "name": "laptop", "scopes": ["read"], "expires_in_days": 1.0}
    listed = naoctl("token", "list").out
    assert "bob" in listed and "expired" in listed
    assert naoctl("token", "revoke", "token_1").out == "token_1: revoked\n"
    unknown = naoctl("token", "revoke", "../jobs")
    assert (unknown.code, server.received[-1].path) == (ExitCode.NOT_FOUND, "/tokens/..%2Fjobs")


def test_compare_shows_what_differs(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    algorithm = {**job()["spec"]["algorithm"], "learning_rate": 1e-3}
    other = job(id="job_" + "2" * 26, name="other", spec={**job()["spec"], "algorithm": algorithm})
    for one in (job(), other):
        server.on("GET", f"/jobs/{one['id']}")(lambda request, one=one: request.json(one))
        server.on("GET", f"/jobs/{one['id']}/evaluations")(
            lambda request: request.json({"items": [], "next_cursor": None})
        )
    ran = naoctl("compare", job()["id"], other["id"])
    assert "algorithm.learning_rate" in ran.out
    assert "0.0005" in ran.out and "0.001" in ran.out
    assert "preset" not in ran.out
    found = json.loads(naoctl("compare", job()["id"], other["id"], "--json").out)
    assert [item["spec"] for item in found] == [
        {"algorithm.learning_rate": 5e-4},
        {"algorithm.learning_rate": 1e-3},
    ]


def test_compare_of_other_robots_and_older_jobs_shows_no_setting_that_they_lack(
    server: Any, naoctl: Callable[..., Ran], job: Jobs
) -> None:
    nao, t1 = (TrainingSpec(robot=robot, task="sprint1").model_dump(mode="json") for robot in ("nao-0", "t1"))
    older = {**nao, "task": {name: value for name, value in nao["task"].items() if name != "history_steps"}}
    jobs = [job(id=f"job_{key * 26}", name=key, spec=spec) for key, spec in (("a", nao), ("b", t1), ("c", older))]
    for one in jobs:
        server.on("GET", f"/jobs/{one['id']}")(lambda request, one=one: request.json(one))
        server.on("GET", f"/jobs/{one['id']}/evaluations")(
            lambda request: request.json({"items": [], "next_cursor": None})
        )
    compared = json.loads(naoctl("compare", *(one["id"] for one in jobs), "--json").out)
    first, second, third = (item["spec"] for item in compared)
    assert first == third and "task.history_steps" not in first
    assert "simulator.action_delay" not in first and "simulator.action_delay" in second
    ran = naoctl("compare", jobs[0]["id"], jobs[1]["id"])
    assert "Settings of its own" in ran.out and "simulator.action_delay" not in ran.out


def test_webhooks_are_created_listed_and_deleted(server: Any, naoctl: Callable[..., Ran]) -> None:
    made = {
        "id": "hook_1",
        "url": "https://example.org/x",
        "events": ["job.ended"],
        "disabled_at": None,
        "created_at": "2026-01-02T03:04:05Z",
    }
    delivery = {
        "id": "msg_1",
        "type": "job.ended",
        "attempts": 2,
        "next_at": "2026-01-02T03:05:05Z",
        "delivered_at": None,
        "error": "the receiver answered 500",
        "created_at": "2026-01-02T03:04:05Z",
    }
    server.on("POST", "/webhooks")(lambda request: request.json({**made, "secret": "whsec_c2VjcmV0"}, 201))
    server.on("GET", "/webhooks")(lambda request: request.json({"items": [made], "next_cursor": None}))
    page = {"items": [delivery], "next_cursor": None}
    server.on("GET", "/webhooks/hook_1/deliveries")(lambda request: request.json(page))
    server.on("DELETE", "/webhooks/hook_1")(lambda request: request.raw(b"", 204))
    created = naoctl("webhook", "create", "https://example.org/x", "--event", "job.ended")
    assert (created.code, created.out) == (0, "whsec_c2VjcmV0\n")
    assert server.received[-1].body == {"url": "https://example.org/x", "events": ["job.ended"]}
    naoctl("webhook", "create", "https://example.org/x")
    assert server.received[-1].body == {"url": "https://example.org/x"}
    assert "active" in naoctl("webhook", "list").out
    listed = naoctl("webhook", "deliveries", "hook_1", "--json").out
    assert json.loads(listed) == [delivery]
    assert "attempt 3 follows" in naoctl("webhook", "deliveries", "hook_1").out
    assert naoctl("webhook", "delete", "hook_1").out == "Deleted hook_1\n"
    unknown = naoctl("webhook", "delete", "../jobs")
    assert (unknown.code, server.received[-1].path) == (ExitCode.NOT_FOUND, "/webhooks/..%2Fjobs")
    assert "naoctl webhook list" in unknown.err


def test_an_alert_is_created_without_its_address_on_the_command_line(
    server: Any, naoctl: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = {"id": "hook_2", "url": "mailtos://…@example.org", "events": ["job.ended"], "secret": ""}
    server.on("POST", "/webhooks")(lambda request: request.json(made, 201))
    monkeypatch.setattr("sys.stdin", io.StringIO("mailtos://ada:secret@example.org\n"))
    created = naoctl("webhook", "create", "-")
    assert server.received[-1].body == {"url": "mailtos://ada:secret@example.org"}
    assert created.out == "hook_2\n" and "Alerts go to mailtos://…@example.org." in created.err


def test_login_keeps_a_token_that_works(
    server: Any, naoctl: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch, home: Any
) -> None:
    server.on("GET", "/whoami")(lambda request: request.json({"owner": "ada", "scopes": ["submit"]}))
    monkeypatch.setattr("sys.stdin", io.StringIO("nao_good\n"))
    ran = naoctl("login", server.url, "--token-stdin")
    assert ran.code == 0, ran.err
    assert "ada" in ran.out
    assert "nao_good" not in ran.out + ran.err
    assert Config.load(home.config).tokens == {server.url: "nao_good"}
    assert server.received[0].headers["Authorization"] == "Bearer nao_good"
    assert naoctl("logout", server.url).code == 0
    assert Config.load(home.config).tokens == {}


def test_login_forgets_a_token_that_does_not(
    server: Any, naoctl: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch, home: Any
) -> None:
    server.on("GET", "/whoami")(lambda request: request.problem(401, "unknown"))
    monkeypatch.setattr("sys.stdin", io.StringIO("nao_bad\n"))
    assert naoctl("login", server.url, "--token-stdin").code == ExitCode.DENIED
    assert not home.config.exists()


def test_version_works_without_a_service(naoctl: Callable[..., Ran], server: Any) -> None:
    assert __version__ in naoctl("version").out
    assert json.loads(naoctl("version", "--json").out)["service"]["version"] is None
    assert naoctl("--version").out.strip() == __version__


def test_every_command_has_help_and_json(naoctl: Callable[..., Ran]) -> None:
    from typer.main import get_command

    group = get_command(build_app())
    commands = dict(group.commands)  # type: ignore[attr-defined]
    for parent in ("token", "policies", "study", "match", "team", "webhook", "mirror"):
        commands |= {f"{parent} {name}": sub for name, sub in commands.pop(parent).commands.items()}
    for name, command in commands.items():
        assert command.help, name
        flags = {flag for parameter in command.params for flag in parameter.opts}
        assert "--json" in flags or name == "demo", name


def test_an_application_that_is_built_again_has_the_same_commands() -> None:
    def sizes() -> dict[str | None, int]:
        groups = build_app().registered_groups
        return {group.name: len(group.typer_instance.registered_commands) for group in groups if group.typer_instance}

    first = sizes()
    assert first == sizes() and first["policies"] > 5


def test_shell_completes_commands() -> None:
    """Ask as bash does; which shell runs the tests plays no part."""
    question = {"_NAOCTL_COMPLETE": "complete_bash", "COMP_WORDS": "naoctl sub", "COMP_CWORD": "1"}
    program = Path(sys.executable).parent / "naoctl"
    ran = subprocess.run([program], env=os.environ | question, capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["submit"]


def test_shell_completes_names_of_jobs(server: Any, job: Jobs) -> None:
    jobs = [job(), job(id="job_" + "2" * 26, name="firework")]
    server.on("GET", "/jobs")(lambda request: request.json({"items": jobs, "next_cursor": None}))
    program = Path(sys.executable).parent / "naoctl"

    def completed(words: str) -> list[str]:
        question = {"_NAOCTL_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": "2"}
        environment = os.environ | question | {"NAOCTL_URL": server.url, "NAOCTL_TOKEN": "nao_test"}
        return subprocess.run([program], env=environment, capture_output=True, text=True, check=True).stdout.split()

    assert completed("naoctl status fir") == ["first", "firework"]
    assert completed("naoctl watch la") == ["last"]
    assert completed("naoctl cancel job_22") == ["job_" + "2" * 26]


def test_the_client_needs_neither_torch_nor_the_service() -> None:
    code = (
        "import sys, naoctl.cli; naoctl.cli.build_app(); "
        "heavy = {'torch', 'matplotlib', 'mujoco', 'sqlalchemy', 'celery', 'redis', 'psutil', 'naojobs'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_policies_are_listed_evaluated_and_exported_without_the_service(
    naoctl: Callable[..., Ran], server: Any, tmp_path: Path
) -> None:
    listed = naoctl("policies", "list", "--json")
    cards = {card["name"]: card for card in json.loads(listed.out)}
    assert "sprint" in cards
    shown = naoctl("policies", "list").out
    assert all(name in shown for name in cards)
    evaluated = naoctl("policies", "evaluate", "sprint", "--episodes", "4", "--json")
    assert evaluated.code == 0, evaluated.err
    summary = json.loads(evaluated.out)
    assert summary["episodes"] == 4
    assert summary["checkpoint"]["step"] == cards["sprint"]["lineage"][-1]["steps"]
    exported = naoctl("policies", "export", "sprint", "-o", str(tmp_path / "export"))
    assert [Path(line).name for line in exported.out.splitlines()] == [
        "policy.npz",
        "policy.onnx",
        "policy.json",
        "policy.h",
        "policy_check.c",
        "check.py",
        "terms.py",
        "Naosprint.py",
        "play.py",
        "runner.py",
        "policy.npz",
        "parity.npz",
    ]
    unknown = naoctl("policies", "replay", "sprnt")
    assert unknown.code == ExitCode.NOT_FOUND
    assert "choose one of" in unknown.err
    assert "sprint" in unknown.err
    # Bundled policies need no service: only a list and a name that is not bundled ask it.
    assert {item.path for item in server.received} == {"/policies", "/policies/sprnt"}


def test_exports_are_named_only_if_requested() -> None:
    assert export_flags(["c", "numpy"], None) == ["--format", "c", "--format", "numpy"]
    assert export_flags(None, "kick") == ["--name", "kick"]
    assert export_flags(["c"], "kick") == ["--format", "c", "--name", "kick"]
    with pytest.raises(InvalidInput, match="unknown format 'x'"):
        export_flags(["x"], None)


def test_chosen_fields_are_all_that_is_printed(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    server.on("GET", "/jobs")(lambda request: request.json({"items": [job()], "next_cursor": None}))
    ran = naoctl("list", "--columns", "name,algorithm.learning_rate,distance_m", "--json")
    assert json.loads(ran.out) == [{"name": "first", "algorithm.learning_rate": 5e-4, "distance_m": 2.25}]
    ran = naoctl("status", "first", "--field", "state", "--field", "distance_m", "--field", "tags")
    assert ran.out == 'running\n2.25\n["try"]\n'
    assert json.loads(naoctl("status", "first", "--field", "seed", "--json").out) == {"seed": 0}
    ran = naoctl("status", "first", "--field", "speed")
    assert ran.code == ExitCode.USAGE and "'speed'" in ran.err


def test_edit_sends_what_was_given(server: Any, naoctl: Callable[..., Ran], job: Jobs) -> None:
    server.on("GET", "/jobs")(lambda request: request.json({"items": [job()], "next_cursor": None}))
    server.on("PATCH", f"/jobs/{job()['id']}")(lambda request: request.json(job(priority=8)))
    ran = naoctl("edit", "first", "--priority", "8", "--tag", "")
    assert ran.code == 0, ran.err
    assert ran.out == f"{job()['id']}: changed tags and priority\n"
    assert server.received[-1].body == {"tags": [], "priority": 8}
    ran = naoctl("edit", "first")
    assert ran.code == ExitCode.USAGE and "--priority" in ran.err
