"""Measure the API under load: many queued jobs, many followers, several clients at once.

    python benchmarks/service/load.py [--jobs 1000] [--followers 50] [--clients 4] [--seconds 20] [--record FILE]

Starts Postgres, a broker and the API (`python -m naosprint_api`, one process) on loopback from wheels, queues the jobs
over HTTP, then lets every client list jobs and look at single ones as fast as it can while one running job writes
metrics and logs each 100 ms to all its followers. Prints the times of each kind of request, what the followers
received, and the API's memory; exits with 1 if a request failed, a follower missed a row, or a 99th percentile of
list or status is 50 ms or more.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import sys
import threading
import time
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
from naojobs import leases, outcomes, records
from naojobs.capabilities import Capabilities
from naojobs.leases import Lease
from naojobs.models import Job
from naojobs.states import WorkState
from naospec.json_text import json_text
from naosprint.programs import above_zero, integer, run_program
from sqlalchemy.orm import Session, sessionmaker
from stack import quantiles_ms, service_without_workers

LIMIT_MS = 50.0


class Load:
    """Thread-safe collection of what clients and followers receive."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.times: dict[str, list[float]] = defaultdict(list)
        self.statuses: Counter[int] = Counter()
        self._lock = threading.Lock()

    def request(self, client: httpx.Client, kind: str, method: str, path: str, **arguments: object) -> httpx.Response:
        """Send a request and record its time, in seconds."""
        started = time.perf_counter()
        response = client.request(method, path, **arguments)  # type: ignore[arg-type]
        elapsed = time.perf_counter() - started
        with self._lock:
            self.times[kind].append(elapsed)
            self.statuses[response.status_code] += 1
        return response

    def use(self, client: httpx.Client, jobs: list[str], number: int) -> None:
        """Send a dashboard's requests until stopped."""
        turn = number
        while not self.stop.is_set():
            turn += 1
            self.request(client, "list", "GET", "/jobs", params={"limit": 50})
            for job_id in jobs[turn % len(jobs) :][:4]:
                self.request(client, "status", "GET", f"/jobs/{job_id}")
            if turn % 5 == 0:
                self.request(client, "metrics", "GET", f"/jobs/{jobs[0]}/metrics", params={"max_points": 500})
                self.request(client, "list filtered", "GET", "/jobs", params={"state": "queued", "q": "bench 5"})


def follow(url: str, headers: dict[str, str], job_id: str) -> tuple[int, int]:
    """Read a job's stream until it ends; return the status and the rows of metrics that came."""
    received = 0
    with httpx.stream("GET", f"{url}/jobs/{job_id}/stream", headers=headers, timeout=60) as response:
        for line in response.iter_lines():
            received += line == "event: metrics"
        return response.status_code, received


def follow_all(url: str, headers: dict[str, str], job_id: str, count: int) -> list[tuple[int, int]]:
    """Read the same stream with many followers in parallel."""
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(follow, [url] * count, [headers] * count, [job_id] * count))


def write_metrics(sessions: sessionmaker[Session], lease: Lease, stop: threading.Event) -> int:
    """Play a worker that records a row of metrics and a line of log each 100 ms; return the rows."""
    step = 0
    while not stop.wait(0.1):
        step += 32_768
        row = {name: step / 7 for name in ("reward", "distance_m", "speed_mps", "policy_loss", "value_loss", "entropy")}
        rows = [records.MetricsRow(step, {"step": step, **row})]
        records.write(sessions, lease, records.Batch(metrics=rows, logs=[records.LogLine("info", f"step {step}")]))
    outcomes.transition(sessions, lease, WorkState.SUCCEEDED)
    return step // 32_768


def main() -> int:
    """Run the load and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--jobs", type=integer(), default=1000)
    parser.add_argument("--followers", type=integer(), default=50)
    parser.add_argument("--clients", type=integer(), default=4)
    parser.add_argument("--seconds", type=above_zero, default=20.0)
    parser.add_argument("--record", type=Path, help="file for the results, as JSON")
    options = parser.parse_args()

    with ExitStack() as stack:
        service = stack.enter_context(service_without_workers())
        sessions, url, headers, process = service.sessions, service.url, service.headers, service.api
        load = Load()
        clients = [
            stack.enter_context(httpx.Client(base_url=url, headers=headers, timeout=30)) for _ in range(options.clients)
        ]
        jobs: list[str] = []
        started = time.perf_counter()
        for number in range(options.jobs):
            body = {"name": f"bench {number}", "spec": {"seed": number}}
            jobs.append(load.request(clients[number % len(clients)], "submit", "POST", "/jobs", json=body).json()["id"])
        submit_s = time.perf_counter() - started

        can = Capabilities({"sprint1": 1}, ["nao-0"], ["embedded"], ["ppo"])
        claim = leases.claim_next(sessions, "load", models=[Job], capabilities=can)
        assert claim is not None
        outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
        before_mb = process.memory_info().rss / 1e6
        # In a process of their own: 50 readers and the clients would delay each other.
        readers = stack.enter_context(ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")))
        followers = readers.submit(follow_all, url, headers, jobs[0], options.followers)
        users = [
            threading.Thread(target=load.use, args=(client, jobs, 97 * number)) for number, client in enumerate(clients)
        ]
        for thread in users:
            thread.start()
        timer = threading.Timer(options.seconds, load.stop.set)
        timer.start()
        cpu = process.cpu_times()
        rows = write_metrics(sessions, claim.lease, load.stop)
        for thread in users:
            thread.join()
        received = []
        for status, count in followers.result(timeout=60):
            load.statuses[status] += 1
            received.append(count)
        used = process.cpu_times()
        after_mb = process.memory_info().rss / 1e6

    figures = {
        "machine": {"cpus": os.cpu_count(), "python": platform.python_version(), "system": platform.platform()},
        "options": {name: value for name, value in vars(options).items() if name != "record"},
        "submit_jobs_per_s": round(options.jobs / submit_s, 1),
        "requests": {kind: quantiles_ms(times) for kind, times in load.times.items()},
        "requests_per_s": round(
            sum(len(times) for kind, times in load.times.items() if kind != "submit") / options.seconds, 1
        ),
        "statuses": {str(status): count for status, count in sorted(load.statuses.items())},
        "metrics_rows_written": rows,
        "metrics_rows_received": {"least": min(received), "most": max(received)},
        "api_cpu_s": round(used.user + used.system - cpu.user - cpu.system, 1),
        "api_memory_mb": {"before": round(before_mb, 1), "after": round(after_mb, 1)},
    }
    print(json.dumps(figures, indent=1))
    if options.record:
        options.record.write_text(json_text(figures), encoding="utf-8")
    slow = [kind for kind in ("list", "status") if figures["requests"][kind]["p99_ms"] >= LIMIT_MS]
    lost = figures["metrics_rows_received"]["least"] != rows or len(received) != options.followers
    failed = any(status >= 400 for status in load.statuses)
    for wrong, words in (
        (slow, f"slower than {LIMIT_MS} ms: {slow}"),
        (lost, "followers missed rows"),
        (failed, "errors"),
    ):
        if wrong:
            print(words, file=sys.stderr)
    return 1 if slow or lost or failed else 0


if __name__ == "__main__":
    run_program(main)
