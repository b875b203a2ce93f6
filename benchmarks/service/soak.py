"""Break a whole service again and again while it is used, then check that nothing was lost.

    python benchmarks/service/soak.py --faults 100 --record benchmarks/service/soak-runs/rounds.jsonl
    python benchmarks/service/soak.py --faults 30 --seed 1 [--longest 8]
    python benchmarks/service/soak.py --world --faults 300 [--longest 60]

Starts Postgres, a broker, an S3 store, the API and two workers as real processes, with a TCP proxy in front of each
service. Faults, alone and in pairs, are drawn from the seed, as are the requests of the user who submits, cancels,
pauses, resumes, retries and deletes jobs meanwhile. When all faults are over, every job has to end. Exits with 1 if
something was lost; prints what, and keeps all logs and the history of each job.

With `--world` the faults are those of the world around a service, two at a time: steps of the clock, every part
suspended, a store that answers with nonsense, a broker that comes and goes, full disks. Beside it a second service
trains on the same machine; nothing may happen to its jobs.

A long run is made of rounds, each with a new stack: `--record` appends the round to a file with one line each, and
without `--seed` the next seed after those in the file is used.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from random import Random
from typing import Any

import httpx
import psutil
from naojobs import retention
from naojobs.models import Checkpoint, Evaluation, Event, Job, LeaseClock, Log, MetricsRecord, Worker
from naojobs.states import ENDED, WorkState
from naojobs.store import StoreError, StoreManifest
from naospec.flat import nest
from naosprint.programs import above_zero, integer, run_program
from sqlalchemy import DateTime, func, select, update
from stack import SPOILED, Stack, wait_until_ready

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.integration.history import violations
from tests.integration.tiny import ROLLOUT, TINY

SEEDS = (1, 2)
"""Seeds of the trainings; the weights of each are known from an undisturbed run."""
OPEN_JOBS = 4
"""Jobs that are open at a time, at most."""
PATIENCE, LEAST_PATIENCE_S = 12.0, 240.0
"""Time that the jobs have to end after the last fault, in multiples of that of two undisturbed ones, and its
minimum.
"""


@dataclass
class Fault:
    """Way to break the stack, and to repair it."""

    name: str
    strike: Callable[[], object]
    heal: Callable[[], object]


class Nemesis:
    """Random sequence of faults."""

    def __init__(self, stack: Stack, random: Random, longest_s: float, *, world: bool = False) -> None:
        self._world = world
        self._stack = stack
        self._random = random
        self._longest_s = longest_s
        self.counts: Counter[str] = Counter()
        self._kinds: list[Callable[[], Fault]] = [
            self._kill_process,
            self._stop_process,
            self._kill_training,
            self._stop_training,
            self._network,
            self._network,
            self._broker,
            self._store,
            self._postgres,
            self._clock,
        ]
        if world:
            self._kinds = [
                self._clock,
                self._clock_of_worker,
                self._suspend,
                self._suspend,
                self._network,
                self._spoil,
                self._spoil,
                self._flap,
                self._fill,
                self._kill_process,
            ]

    def run(self, faults: int) -> None:
        """Apply faults, alone or in pairs, and repair each after a while."""
        left = faults
        while left > 0:
            chosen: dict[str, Fault] = {}
            for _ in range(min(left, 2 if self._world else self._random.choice((1, 1, 2)))):
                fault = self._random.choice(self._kinds)()
                chosen.setdefault(fault.name.split(":")[0], fault)  # a pair breaks two different things
            left -= len(chosen)
            suspends = self._world and any("SIGSTOP" in fault.name for fault in chosen.values())
            hold_s = self._random.uniform(min(5.0, self._longest_s) if suspends else 0.5, self._longest_s)
            rest_s = self._random.uniform(0.0, self._longest_s / 2)
            say(f"{', '.join(sorted(fault.name for fault in chosen.values()))} for {hold_s:.1f} s")
            for fault in chosen.values():
                self.counts[fault.name] += 1
                fault.strike()
            time.sleep(hold_s)
            for fault in chosen.values():
                fault.heal()
            for name in self._stack.restart_ended():
                say(f"{name} had ended and is started again")
            time.sleep(rest_s)

    def _kill_process(self) -> Fault:
        name = self._random.choice(("api", *self._stack.worker_names))
        return Fault(f"{name}: kill -9", lambda: self._stack.kill(name), lambda: self._stack.start(name))

    def _stop_process(self) -> Fault:
        name = self._random.choice(("api", *self._stack.worker_names))
        process = self._stack.process(name)

        def send(number: int) -> None:
            process.send_signal(number)  # checks first whether it still runs

        return Fault(f"{name}: SIGSTOP", lambda: send(signal.SIGSTOP), lambda: send(signal.SIGCONT))

    def _training(self) -> int | None:
        found = sorted(process.pid for process in self._stack.trainings())
        return self._random.choice(found) if found else None

    def _kill_training(self) -> Fault:
        return Fault("training: kill -9", lambda: send_signal(self._training(), signal.SIGKILL), lambda: None)

    def _stop_training(self) -> Fault:
        stopped: list[int | None] = []

        def strike() -> None:
            stopped.append(self._training())
            send_signal(stopped[-1], signal.SIGSTOP)

        return Fault("training: SIGSTOP", strike, lambda: send_signal(stopped[-1], signal.SIGCONT))

    def _network(self) -> Fault:
        name = self._random.choice(tuple(self._stack.proxies))
        proxy = self._stack.proxies[name]
        how = self._random.choice(("cut", "silent", "delayed"))
        strike = {"cut": proxy.cut, "silent": proxy.silence, "delayed": lambda: proxy.delay(0.3)}[how]
        return Fault(f"network of {name}: {how}", strike, proxy.heal)

    def _broker(self) -> Fault:
        if self._random.random() < 0.5:
            return Fault("broker: flushed", self._stack.flush_broker, lambda: None)
        return Fault("broker: restarted, empty", self._stack.stop_broker, self._stack.start_broker)

    def _store(self) -> Fault:
        if self._stack.can_fill("store") and self._random.random() < 0.5:
            return Fault("store: full", lambda: self._stack.fill("store"), lambda: self._stack.free("store"))
        return Fault("store: kill -9", lambda: self._stack.kill("store"), self._stack.start_store)

    def _postgres(self) -> Fault:
        postgres = self._stack.postgres
        return Fault("postgres: restarted", postgres.stop, postgres.ensure_postgres_running)

    def _clock(self) -> Fault:
        seconds = self._random.choice((-3600.0, 3600.0))

        def jump() -> None:
            # Shifting the times of all rows has the effect of a clock that jumps; leases have a clock of their own.
            with contextlib.suppress(Exception), self._stack.sessions.begin() as session:
                for model in (Job, Worker, LeaseClock):
                    own = {"lease_expires_at", "time"}
                    columns = model.__table__.columns
                    dates = [item for item in columns if isinstance(item.type, DateTime) and item.name not in own]
                    session.execute(update(model).values({date: date - timedelta(seconds=seconds) for date in dates}))

        return Fault(f"postgres: clock {seconds:+.0f} s", jump, lambda: None)

    def _clock_of_worker(self) -> Fault:
        name = self._random.choice(self._stack.worker_names)
        seconds = self._random.choice((-86_400, -3600, -2, 2, 3600, 86_400))
        return Fault(f"{name}: clock {seconds:+d} s", lambda: self._stack.step_clock(name, seconds), lambda: None)

    def _suspend(self) -> Fault:
        """Suspend any part, the services that others depend on included."""
        name = self._random.choice(("process", "training", "postgres", "broker", "store"))
        if name == "process":
            return self._stop_process()
        if name == "training":
            return self._stop_training()
        stopped: list[psutil.Process] = []

        def strike() -> None:
            if name == "postgres":
                stopped.extend(self._stack.suspend_postgres())
            else:
                stopped.append(self._stack.broker if name == "broker" else self._stack.store_process)
                stopped[0].suspend()

        def heal() -> None:
            for process in reversed(stopped):
                process.resume()

        return Fault(f"{name}: SIGSTOP", strike, heal)

    def _spoil(self) -> Fault:
        how, proxy = self._random.choice(tuple(SPOILED)), self._stack.proxies["store"]
        return Fault(f"network of store: {how}", lambda: proxy.spoil(how), proxy.heal)

    def _flap(self) -> Fault:
        name = self._random.choice(("broker", "broker", "postgres"))
        proxy, over = self._stack.proxies[name], threading.Event()

        def flap() -> None:
            while not over.wait(0.3):
                proxy.cut()
                over.wait(0.3)
                proxy.heal()

        thread = threading.Thread(target=flap, name="flap")

        def heal() -> None:
            over.set()
            thread.join()

        return Fault(f"network of {name}: comes and goes", thread.start, heal)

    def _fill(self) -> Fault:
        name = self._random.choice(("store", "work"))
        if not self._stack.can_fill(name):
            return self._store()
        return Fault(f"{name}: full", lambda: self._stack.fill(name), lambda: self._stack.free(name))


def send_signal(pid: int | None, number: int) -> None:
    """Send a signal to the group of a process, which may have ended meanwhile."""
    if pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, number)


@dataclass
class User:
    """User of the API, whose acknowledged requests must take effect."""

    stack: Stack
    random: Random
    submitted: dict[str, str] = field(default_factory=dict)
    """Acknowledged submits: id of the job by idempotency key."""
    acknowledged: list[tuple[str, str]] = field(default_factory=list)
    """Requests that were acknowledged, and those whose answer was lost, in the order of sending."""
    unknown: list[tuple[str, str]] = field(default_factory=list)
    stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        headers = {"Authorization": f"Bearer {self.stack.token}"}
        self._client = httpx.Client(base_url=self.stack.url, headers=headers, timeout=15)

    def submit(self, seed: int, steps: int) -> str | None:
        """Submit a training, again with the same key until it is acknowledged; return its id, None when stopped."""
        key = f"key-{len(self.submitted)}"
        spec = nest({**TINY, "seed": seed, "total_steps": steps, "checkpoint_interval_steps": ROLLOUT * 25})
        evaluation = {"task": {"name": "sprint2"}, "episodes": 2, "n_envs": 2, "bootstrap_resamples": 100}
        body = {"name": key, "spec": spec, "evaluation": evaluation, "max_attempts": 10}
        while not self.stop.is_set():
            with contextlib.suppress(httpx.TransportError):
                answer = self._client.post("/jobs", json=body, headers={"Idempotency-Key": key})
                if answer.is_success:
                    self.submitted[key] = answer.json()["id"]
                    return self.submitted[key]
                if answer.status_code < 500:
                    raise AssertionError(f"submit was refused: {answer.text}")
            time.sleep(0.3)
        return None

    def request(self, action: str, job_id: str) -> None:
        """Ask for one change; remember whether it was acknowledged, refused or unanswered."""
        try:
            method, path = ("DELETE", f"/jobs/{job_id}") if action == "delete" else ("POST", f"/jobs/{job_id}/{action}")
            answer = self._client.request(method, path)
        except httpx.TransportError:
            self.unknown.append((action, job_id))
            return
        if answer.is_success:
            self.acknowledged.append((action, job_id))
        elif answer.status_code >= 500:
            self.unknown.append((action, job_id))

    def run(self, steps: int) -> None:
        """Use the service until stopped."""
        jobs: list[str] = []
        while not self.stop.wait(self.random.uniform(0.2, 1.2)):
            jobs = [job for job in jobs if ("delete", job) not in self.acknowledged]
            action = self.random.choice(("submit", "submit", "cancel", "pause", "resume", "resume", "retry", "delete"))
            if action == "submit" or not jobs:
                if self._open(jobs) < OPEN_JOBS:
                    made = self.submit(self.random.choice(SEEDS), steps)
                    jobs += [] if made is None else [made]
            else:
                self.request(action, self.random.choice(jobs))

    def run_quietly(self, steps: int) -> None:
        """Train one job after the other until stopped."""
        jobs: list[str] = []
        while not self.stop.wait(0.5):
            if self._open(jobs) == 0:
                made = self.submit(SEEDS[len(jobs) % len(SEEDS)], steps)
                jobs += [] if made is None else [made]

    def _open(self, jobs: Iterable[str]) -> int:
        try:
            found = self._client.get("/jobs", params={"limit": 100}).json().get("items", ())
        except (httpx.TransportError, ValueError):
            return OPEN_JOBS
        return sum(WorkState(job["state"]) not in ENDED for job in found if job["id"] in jobs)


def wait_until_ended(stack: Stack, user: User, seconds: float) -> list[str]:
    """Resume what is paused and wait; return the jobs that have not ended in time."""
    deadline = time.monotonic() + seconds
    while True:
        with stack.sessions() as session:
            jobs = session.execute(select(Job.id, Job.state).where(Job.state.not_in(ENDED))).all()
        if not jobs or time.monotonic() > deadline:
            return [f"{job_id} is still {state} {seconds:.0f} s after the last fault" for job_id, state in jobs]
        for job_id, state in jobs:
            if state is WorkState.PAUSED:
                user.request("resume", job_id)
        time.sleep(0.5)


def check(stack: Stack, user: User, weights: dict[int, str], steps: int) -> list[str]:
    """Return what was lost or is wrong."""
    wrong: list[str] = []
    deleted = {job for action, job in user.acknowledged if action == "delete"}
    maybe_deleted = {job for action, job in user.unknown if action == "delete"}
    revived = {job for action, job in (*user.acknowledged, *user.unknown) if action in ("retry", "resume")}
    with stack.sessions() as session:
        jobs = {job.id: job for job in session.scalars(select(Job))}
        keys = Counter(job.idempotency_key for job in jobs.values())
        wrong += [f"{count} jobs have key {key}" for key, count in keys.items() if count != 1]
        for key, job_id in user.submitted.items():
            if job_id in deleted and job_id in jobs:
                wrong.append(f"{job_id} was deleted and is there")
            if job_id not in jobs and job_id not in deleted | maybe_deleted:
                wrong.append(f"{job_id} was acknowledged with {key} and is gone")
        for action, job_id in user.acknowledged:
            if action == "cancel" and job_id in jobs and job_id not in revived:
                state = jobs[job_id].state
                wrong += [] if state is WorkState.CANCELLED else [f"{job_id} was cancelled and is {state}"]
        for job in jobs.values():
            events = session.scalars(select(Event).where(Event.job_id == job.id).order_by(Event.id)).all()
            wrong += [f"{job.id}: {text}" for text in violations(event.kind for event in events)]
            for model, order in ((Event, Event.id), (Log, Log.id), (MetricsRecord, MetricsRecord.seq)):
                rows = select(model.attempt).where(model.job_id == job.id).order_by(order)
                attempts = [attempt for attempt in session.scalars(rows) if model is not Event or attempt]
                if attempts != sorted(attempts):
                    wrong.append(f"{job.id}: a {model.__tablename__} row of an attempt after a newer one's")
            if job.state is WorkState.FAILED:
                wrong.append(f"{job.id} failed: {job.error}")
            if job.state is not WorkState.SUCCEEDED:
                continue
            found = list(
                session.scalars(
                    select(MetricsRecord.step).where(MetricsRecord.job_id == job.id).order_by(MetricsRecord.step)
                )
            )
            if found != list(range(ROLLOUT, steps + 1, ROLLOUT)):
                wrong.append(f"{job.id} has {len(found)} rows of metrics for {steps // ROLLOUT} updates")
            count = session.scalar(select(func.count()).select_from(Evaluation).where(Evaluation.job_id == job.id))
            wrong += [] if count == 1 else [f"{job.id} has {count} evaluations"]
            seed = int(job.spec["seed"])
            if (sha := final_weights(stack, job.id)) != weights[seed]:
                wrong.append(f"{job.id}: weights {sha[:12]} instead of {weights[seed][:12]} (seed {seed})")
        artifacts = [
            *session.execute(select(Checkpoint.key, Checkpoint.manifest)),
            *session.execute(select(Evaluation.key, Evaluation.manifest).where(Evaluation.key.is_not(None))),
        ]
    retention.sweep(stack.sessions, stack.store, age_s=0)
    for key, manifest in artifacts:
        with tempfile.TemporaryDirectory() as folder:
            try:
                stack.store.get_directory(key, Path(folder), StoreManifest.model_validate(manifest))
            except StoreError as error:
                wrong.append(str(error))
    kept = {file.rsplit("/", 1)[0] for file in stack.store.list("jobs")}
    wrong += [f"{key} is left in the store" for key in kept - {key for key, _ in artifacts}]
    return wrong


def check_undisturbed(stack: Stack, user: User, weights: dict[int, str], steps: int, patience_s: float) -> list[str]:
    """Return what happened to a service that nobody broke: its jobs succeed, and no attempt failed.

    Attempts that waited for a database or a store are none: this process, between them, may get no time for a while.
    """
    wrong = wait_until_ended(stack, user, patience_s)
    stack.stop_services()
    wrong += check(stack, user, weights, steps)
    with stack.sessions() as session:
        states = session.execute(select(Job.id, Job.state).where(Job.state != WorkState.SUCCEEDED))
        wrong += [f"{job_id} is {state}" for job_id, state in states]
        failed = select(Event.job_id, Event.message).where(Event.data["failures"].as_integer() > 0)
        wrong += [f"{job_id}: {message}" for job_id, message in session.execute(failed)]
    return wrong


def final_weights(stack: Stack, job_id: str) -> str:
    """Return the SHA-256 of the policy in a job's last checkpoint."""
    with stack.sessions() as session:
        newest = select(Checkpoint.manifest).where(Checkpoint.job_id == job_id).order_by(Checkpoint.step.desc())
        manifest = session.scalar(newest.limit(1))
    entry = StoreManifest.model_validate(manifest).entry("policy.npz")
    assert entry is not None
    return entry.sha256


def next_seed(record: Path | None) -> int:
    """Return the seed after those of a record; 1 where there is none."""
    rounds = record.read_text().splitlines() if record is not None and record.exists() else []
    return 1 + max((json.loads(line)["options"]["seed"] for line in rounds), default=0)


def keep_evidence(stack: Stack) -> Path:
    """Copy all logs and write the history of each job; return the folder."""
    kept = Path(tempfile.mkdtemp(prefix="naosoak-logs-"))
    for log in stack.folder.glob("*.log"):
        (kept / log.name).write_bytes(log.read_bytes())
    with stack.sessions() as session, (kept / "jobs.txt").open("w") as file:
        for job in session.scalars(select(Job).order_by(Job.id)):
            print(f"{job.id} {job.state} step {job.progress_step} error {job.error}", file=file)
            events = session.scalars(select(Event).where(Event.job_id == job.id).order_by(Event.id))
            lines = [(event.at, f"{event.kind}: {event.message}") for event in events]
            logs = session.scalars(select(Log).where(Log.job_id == job.id))
            lines += [(log.at, f"{log.level}: {log.message}") for log in logs]
            for at, text in sorted(lines):
                print(f"  {at:%H:%M:%S} {text}", file=file)
    return kept


def say(text: str) -> None:
    """Print a line with the time."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


def main() -> int:
    """Run and report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--faults", type=integer(), default=30)
    parser.add_argument("--seed", type=integer(0), help="left out: the one after those in the record")
    parser.add_argument("--world", action="store_true", help="faults of the world around the service")
    parser.add_argument("--longest", type=above_zero, help="seconds that a fault lasts at most: 8; in the world 60")
    parser.add_argument("--updates", type=integer(), default=300, help="updates of each training")
    parser.add_argument(
        "--patience",
        type=above_zero,
        help=f"seconds after the last fault for jobs to end; left out: {PATIENCE:g} times those that two jobs take "
        f"undisturbed, at least {LEAST_PATIENCE_S:g}",
    )
    parser.add_argument("--record", type=Path, help="file to which the results are appended, as one line of JSON")
    options = parser.parse_args()
    if options.seed is None:
        options.seed = next_seed(options.record)
    options.longest = options.longest or (60.0 if options.world else 8.0)
    random = Random(options.seed)
    steps = options.updates * ROLLOUT
    begun = time.monotonic()
    stack = Stack(world=options.world)
    neighbour = Stack(workers=1) if options.world else None
    try:
        user = User(stack, Random(options.seed + 1))
        ready = time.monotonic()
        first = {seed: user.submit(seed, steps) for seed in SEEDS}
        wrong = wait_until_ended(stack, user, options.patience or LEAST_PATIENCE_S)
        undisturbed_s = time.monotonic() - ready
        patience_s = options.patience or max(LEAST_PATIENCE_S, PATIENCE * undisturbed_s)
        weights = {seed: final_weights(stack, str(job_id)) for seed, job_id in first.items()}
        say(f"undisturbed: {weights}")
        using = threading.Thread(target=user.run, args=(steps,), name="user", daemon=True)
        using.start()
        if neighbour is not None:
            other = User(neighbour, random)
            training = threading.Thread(target=other.run_quietly, args=(steps,), name="neighbour", daemon=True)
            training.start()
        nemesis = Nemesis(stack, random, options.longest, world=options.world)
        nemesis.run(options.faults)
        user.stop.set()
        using.join()
        wait_until_ready(stack.url, seconds=120.0)
        healed = time.monotonic()
        wrong += wait_until_ended(stack, user, patience_s)
        settled_s = time.monotonic() - healed
        stack.stop_services()
        deadline = time.monotonic() + 60
        while stack.leftovers() and time.monotonic() < deadline:
            time.sleep(0.5)
        wrong += [f"a process is left: {process}" for process in stack.leftovers()]
        wrong += check(stack, user, weights, steps)
        if neighbour is not None:
            other.stop.set()
            training.join()
            wrong += [f"neighbour: {text}" for text in check_undisturbed(neighbour, other, weights, steps, patience_s)]
        with stack.sessions() as session:
            states = Counter(str(state) for state in session.scalars(select(Job.state)))
            attempts = session.scalar(select(func.sum(Job.attempt)))
        results: dict[str, Any] = {
            "machine": {"cpus": os.cpu_count(), "python": platform.python_version(), "system": platform.platform()},
            "load": [round(load, 1) for load in os.getloadavg()],
            "options": {name: value for name, value in vars(options).items() if name not in ("record", "patience")},
            "patience_s": round(patience_s),
            "undisturbed_s": round(undisturbed_s, 1),
            "faults": dict(sorted(nemesis.counts.items())),
            "fault_count": sum(nemesis.counts.values()),
            "jobs": dict(sorted(states.items())),
            "submitted": len(user.submitted),
            **({} if neighbour is None else {"jobs_of_the_neighbour": len(other.submitted)}),
            "attempts": attempts,
            "acknowledged_requests": dict(Counter(action for action, _ in user.acknowledged)),
            "requests_without_an_answer": len(user.unknown),
            "seconds_until_all_jobs_ended": round(settled_s, 1),
            "seconds": round(time.monotonic() - begun, 1),
            "wrong": wrong,
        }
        print(json.dumps(results, indent=1))
        if options.record:
            with options.record.open("a") as file:
                file.write(json.dumps(results) + "\n")
        if wrong:
            print(f"logs: {keep_evidence(stack)}", file=sys.stderr)
            if neighbour is not None:
                print(f"logs of the neighbour: {keep_evidence(neighbour)}", file=sys.stderr)
        return 1 if wrong else 0
    finally:
        stack.close()
        if neighbour is not None:
            neighbour.close()


if __name__ == "__main__":
    run_program(main)
