"""Measure one service with a thousand workers that do everything but train.

    python benchmarks/service/workers.py [--workers 1000] [--seconds 300] [--flush-s 10] [--poll-s 5] [--record FILE]

Starts Postgres, which waits for the disk at every commit, a broker and the API on loopback. Every stub of a worker
claims jobs, renews its own registration and its lease, looks for requests and for lost work and writes metrics and
logs, by the functions and at the rates of a real worker; the stubs share a few processes and connections, as with a
pooler. Meanwhile a user submits jobs over HTTP as fast as jobs end, so that each worker gets another one. A stub's time
begins when the call is due, so it includes the waiting for a free thread.

Prints times, rates and what Postgres's sessions waited for; exits with 1 if the 99th percentile of submits is a second
or more, that of heartbeats a third of the lease or more, a lease was lost, or a row was not written exactly once.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import json
import multiprocessing
import os
import platform
import queue
import random
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from naojobs import leases, outcomes, records, registry
from naojobs.capabilities import Capabilities
from naojobs.database import Sessions, make_engine, make_sessions
from naojobs.errors import LeaseLostError
from naojobs.leases import Lease
from naojobs.models import Job, MetricsRecord
from naojobs.records import Batch, LogLine, MetricsRow
from naojobs.states import WorkState
from naospec.json_text import json_text
from naosprint.programs import above_zero, integer, run_program
from naosprint_worker.capabilities import installed_capabilities
from naosprint_worker.reaper import LostWork
from naosprint_worker.settings import WorkerSettings
from sqlalchemy import func, select, text
from stack import Service, quantiles_ms, service_without_workers

SUBMIT_LIMIT_S = 1.0
METRICS = (
    *("time_s", "episodes", "reward", "episode_length", "distance_m", "fall_rate", "speed_mps", "policy_loss"),
    *("value_loss", "approx_kl", "clip_fraction", "explained_variance", "action_std", "entropy", "learning_rate"),
    *("steps_per_s", "collect_s", "simulator_s", "cpu_s", "memory_mb"),
)
"""What a training reports with each update, and how often at the full speed of two cores."""
ROWS_PER_S = 3.7
UPDATE_STEPS = 8_192


@dataclass(frozen=True)
class Rates:
    """Seconds between the calls of a worker, and the mean length of its jobs."""

    flush_s: float
    poll_s: float
    heartbeat_s: float
    reap_s: float
    claim_s: float
    lease_s: float
    job_s: float


@dataclass
class Outcome:
    """What the stubs of one process did."""

    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    events: Counter[str] = field(default_factory=Counter)
    rows: int = 0
    ended: dict[str, int] = field(default_factory=dict)
    """Jobs that have ended, with the rows that were written for each."""


class Stub:
    """One worker; its calls of one kind never overlap, those of different kinds may, as in a real one."""

    def __init__(
        self, name: str, rates: Rates, capabilities: Capabilities, outcome: Outcome, sessions: Sessions
    ) -> None:
        self._name, self._rates, self._outcome, self._sessions = name, rates, outcome, sessions
        self._capabilities = capabilities
        self._lost = LostWork(sessions, rates.lease_s)
        self._lease: Lease | None = None
        self._ends_at = 0.0
        self._rows = 0
        self.duties = {
            "beat": (rates.heartbeat_s, self._beat),
            "heartbeat": (rates.heartbeat_s, self._heartbeat),
            "requests": (rates.poll_s, self._look),
            "write": (rates.flush_s, self._write),
            "reap": (rates.reap_s, self._reap),
            "claim": (rates.claim_s, self._claim),
        }

    def _beat(self) -> bool:
        self._lost.workers = registry.beat(
            self._sessions,
            self._name,
            host="load",
            pid=1,
            capabilities=self._capabilities,
            version="1",
            stale_s=self._rates.lease_s,
        )
        return True

    def _heartbeat(self) -> bool:
        lease = self._lease
        if lease is not None:
            leases.heartbeat(self._sessions, lease, lease_s=self._rates.lease_s)
        return lease is not None

    def _look(self) -> bool:
        lease = self._lease
        if lease is not None:
            leases.read_requests(self._sessions, lease)
        return lease is not None

    def _reap(self) -> bool:
        self._outcome.events["requeued"] += len(self._lost.sweep())
        return True

    def _claim(self) -> bool:
        if self._lease is not None:
            return False
        claim = leases.claim_next(
            self._sessions,
            self._name,
            capabilities=self._capabilities,
            lease_s=self._rates.lease_s,
        )
        if claim is not None:
            outcomes.transition(self._sessions, claim.lease, WorkState.RUNNING)
            outcomes.begin(self._sessions, claim.lease, step=0)
            self._rows = 0
            self._ends_at = time.monotonic() + random.expovariate(1 / self._rates.job_s)
            self._lease = claim.lease
        return True

    def _write(self) -> bool:
        lease = self._lease
        if lease is None:
            return False
        count = round(ROWS_PER_S * self._rates.flush_s)
        steps = [UPDATE_STEPS * (self._rows + number) for number in range(1, count + 1)]
        rows = [MetricsRow(step, {name: random.random() for name in METRICS}) for step in steps]
        records.write(self._sessions, lease, Batch(metrics=rows, logs=[LogLine("info", f"step {steps[-1]}")]))
        self._rows += count
        self._outcome.rows += count
        if time.monotonic() >= self._ends_at:
            self._lease = None  # no further call for this job
            outcomes.transition(self._sessions, lease, WorkState.SUCCEEDED)
            self._outcome.ended[lease.id] = self._rows
        return True


def run_stubs(
    database_url: str, first: int, count: int, threads: int, rates: Rates, ramp_s: float, seconds: float
) -> Outcome:
    """Run `count` stubs with `threads` connections for so long, after a start at random; return what they did."""
    os.nice(10)  # they stand for other machines, and must not take the processors of API and database
    engine = make_engine(database_url, pool_size=threads, application_name="stubs")
    sessions = make_sessions(engine)
    outcome = Outcome()
    due: list[tuple[float, int, str, Stub]] = []
    ready: queue.SimpleQueue[tuple[float, str, Stub] | None] = queue.SimpleQueue()
    order = itertools.count()
    changed = threading.Condition()
    unused = {"broker_url": "redis://unused", "artifact_url": "file:///unused"}
    settings = WorkerSettings.model_validate({"mode": "local", "database_url": database_url, **unused})
    capabilities = installed_capabilities(settings)
    start = time.monotonic()
    for number in range(first, first + count):
        began = start + random.uniform(0, ramp_s)
        stub = Stub(f"load:{number}", rates, capabilities, outcome, sessions)
        for kind, (period_s, _) in stub.duties.items():
            due.append((began + random.uniform(0, period_s), next(order), kind, stub))
    heapq.heapify(due)

    def work() -> None:
        while (item := ready.get()) is not None:
            at, kind, stub = item
            period_s, duty = stub.duties[kind]
            called = False
            try:
                called = duty()
            except LeaseLostError:
                # A job that has just ended is no longer leased; one that runs has been lost.
                outcome.events["lease lost" if stub._lease is not None else "ended meanwhile"] += 1
            except Exception as error:
                outcome.events[f"{kind}: {type(error).__name__}: {str(error)[:120]}"] += 1
            now = time.monotonic()
            if called:
                outcome.seconds[kind].append(now - at)
            with changed:
                heapq.heappush(due, (now + period_s, next(order), kind, stub))
                changed.notify()

    pool = [threading.Thread(target=work, daemon=True) for _ in range(threads)]
    for thread in pool:
        thread.start()
    while (now := time.monotonic()) < start + seconds:
        with changed:
            if due and due[0][0] <= now:
                at, _, kind, stub = heapq.heappop(due)
                ready.put((at, kind, stub))
            else:
                changed.wait(min(due[0][0] - now if due else 1.0, 0.2))
    for _ in pool:
        ready.put(None)
    for thread in pool:
        thread.join()
    engine.dispose()
    return outcome


def submit_jobs(service: Service, rate: float, seconds: float) -> tuple[list[float], Counter[int]]:
    """Submit `rate` jobs a second at random times; return the seconds of each request since it was due."""
    times: list[float] = []
    statuses: Counter[int] = Counter()
    due = time.monotonic()
    until = due + seconds
    with httpx.Client(base_url=service.url, headers=service.headers, timeout=60) as client:
        while (due := due + random.expovariate(rate)) < until:
            time.sleep(max(0.0, due - time.monotonic()))
            statuses[client.post("/jobs", json={"spec": {"task": "sprint1"}}).status_code] += 1
            times.append(time.monotonic() - due)
    return times, statuses


@contextmanager
def watched(service: Service) -> Iterator[dict[str, object]]:
    """Measure the database meanwhile: commits, log, and what its sessions wait for."""
    figures: dict[str, object] = {}
    waits: Counter[str] = Counter()
    stop = threading.Event()

    def totals() -> tuple[int, int, float]:
        with service.sessions() as session:
            commits, log = session.execute(
                text("SELECT sum(xact_commit), pg_wal_lsn_diff(pg_current_wal_lsn(), '0/0') FROM pg_stat_database")
            ).one()
        return int(commits), int(log), time.monotonic()

    def sample() -> None:
        while not stop.wait(0.25):
            with service.sessions() as session:
                rows = session.execute(
                    text(
                        "SELECT coalesce(wait_event_type || ': ' || wait_event, 'none: works') FROM pg_stat_activity "
                        "WHERE state = 'active' AND pid <> pg_backend_pid() AND backend_type = 'client backend'"
                    )
                ).scalars()
                waits.update(rows)

    thread = threading.Thread(target=sample)
    before = totals()
    thread.start()
    try:
        yield figures
    finally:
        stop.set()
        thread.join()
        after = totals()
        lasted_s = after[2] - before[2]
        figures["commits_per_s"] = round((after[0] - before[0]) / lasted_s, 1)
        figures["log_mb_per_s"] = round((after[1] - before[1]) / lasted_s / 1e6, 2)
        figures["sessions_at_work_by_wait"] = {
            name: round(count / (4 * lasted_s), 2) for name, count in waits.most_common(8)
        }


def main() -> int:
    """Run the load and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--workers", type=integer(), default=1000)
    parser.add_argument("--seconds", type=above_zero, default=300.0)
    parser.add_argument("--flush-s", type=above_zero, default=10.0, help="NAOSPRINT_WORKER_FLUSH_S")
    parser.add_argument("--poll-s", type=above_zero, default=5.0, help="NAOSPRINT_WORKER_POLL_S")
    parser.add_argument("--job-s", type=above_zero, default=300.0, help="mean length of a job")
    parser.add_argument("--ramp-s", type=above_zero, default=60.0, help="time within which the workers start")
    parser.add_argument("--processes", type=integer(), default=4)
    parser.add_argument("--threads", type=integer(), default=4, help="connections of each process")
    parser.add_argument("--record", type=Path, help="file for the results, as JSON")
    options = parser.parse_args()
    defaults = WorkerSettings.model_fields
    rates = Rates(
        flush_s=options.flush_s,
        poll_s=options.poll_s,
        heartbeat_s=defaults["heartbeat_s"].default,
        reap_s=defaults["worker_reap_s"].default,
        claim_s=defaults["worker_claim_s"].default,
        lease_s=defaults["lease_s"].default,
        job_s=options.job_s,
    )

    with ExitStack() as stack:
        service = stack.enter_context(service_without_workers())
        with httpx.Client(base_url=service.url, headers=service.headers, timeout=60) as client:
            for number in range(options.workers):
                client.post("/jobs", json={"spec": {"seed": number}}).raise_for_status()
        with service.sessions() as session:
            names = ("fsync", "synchronous_commit", "max_connections")
            settings = {name: session.execute(text(f"SHOW {name}")).scalar_one() for name in names}
        pool = stack.enter_context(
            ProcessPoolExecutor(options.processes, mp_context=multiprocessing.get_context("spawn"))
        )
        with watched(service) as database:
            share = -(-options.workers // options.processes)
            parts = [
                pool.submit(
                    run_stubs,
                    service.database_url,
                    first,
                    min(share, options.workers - first),
                    options.threads,
                    rates,
                    options.ramp_s,
                    options.seconds,
                )
                for first in range(0, options.workers, share)
            ]
            submits, statuses = submit_jobs(service, options.workers / options.job_s, options.seconds)
            outcomes = [part.result() for part in parts]
        with service.sessions() as session:
            stored = session.execute(select(func.count()).select_from(MetricsRecord)).scalar_one()
            by_state = {
                str(state): count
                for state, count in session.execute(select(Job.state, func.count()).group_by(Job.state))
            }
            repeated = session.execute(select(func.count()).where(Job.attempt > 1)).scalar_one()

    times: dict[str, list[float]] = defaultdict(list)
    events: Counter[str] = Counter()
    for outcome in outcomes:
        events += outcome.events
        for kind, seconds in outcome.seconds.items():
            times[kind] += seconds
    written = sum(outcome.rows for outcome in outcomes)
    lost = events["lease lost"] + events["requeued"] + repeated
    figures = {
        "machine": {"cpus": os.cpu_count(), "python": platform.python_version(), "system": platform.platform()},
        "options": {name: value for name, value in vars(options).items() if name != "record"},
        "postgres": settings,
        "submit": quantiles_ms(submits),
        "calls": {kind: quantiles_ms(seconds) for kind, seconds in sorted(times.items()) if len(seconds) > 1},
        "calls_per_s": round(sum(map(len, times.values())) / options.seconds, 1),
        "rows_per_s": round(written / options.seconds, 1),
        "rows": {"written": written, "stored": stored},
        "database": database,
        "jobs": by_state,
        "events": dict(events),
        "leases_lost": lost,
    }
    print(json.dumps(figures, indent=1))
    if options.record:
        options.record.write_text(json_text(figures), encoding="utf-8")
    misses = [
        words
        for wrong, words in (
            (figures["submit"]["p99_ms"] >= 1000 * SUBMIT_LIMIT_S, "submits take too long"),
            (quantiles_ms(times["heartbeat"])["p99_ms"] >= 1000 * rates.lease_s / 3, "heartbeats take too long"),
            (lost > 0, f"{lost} leases were lost"),
            (written != stored, "rows are missing"),
            (statuses.total() != statuses[201], f"statuses of submits: {dict(statuses)}"),
            (settings["fsync"] != "on" or settings["synchronous_commit"] != "on", "commits do not wait for the disk"),
            (any(": " in name for name in events), "calls failed"),
        )
        if wrong
    ]
    for miss in misses:
        print(miss, file=sys.stderr)
    return 1 if misses else 0


if __name__ == "__main__":
    run_program(main)
