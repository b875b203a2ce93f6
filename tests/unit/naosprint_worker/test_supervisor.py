"""A supervisor renews the lease, follows requests and never waits for ever; its children are real processes."""

from __future__ import annotations

import math
import os
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from naojobs.errors import LeaseLostError
from naojobs.leases import Requests
from naojobs.models import WorkKind
from naojobs.states import WorkState
from naosprint_worker.child import TrainingProcess
from naosprint_worker.memory import MemoryBudget
from naosprint_worker.outcome import TrainerExitCode
from naosprint_worker.runs import describe_ending
from naosprint_worker.settings import WorkerSettings
from naosprint_worker.supervisor import Ending, Intent, TrainingSupervisor
from sqlalchemy.exc import OperationalError

GO_ON = Requests(WorkState.RUNNING, cancel=False)

OBEDIENT = """
    import pathlib, signal, sys
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
    pathlib.Path("ready").write_text("")
    signal.pause()
"""
STUBBORN = """
    import pathlib, signal
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    pathlib.Path("ready").write_text("")
    while True:
        signal.pause()
"""


class Bench:
    """A supervisor, and the answers that its database gives."""

    def __init__(
        self,
        folder: Path,
        program: str,
        time_limit_s: float = math.inf,
        must_end: Callable[[int], bool] = lambda _held: False,
        **settings: float,
    ) -> None:
        os.mkfifo(folder / "ready")
        self.answer: Requests | Exception = GO_ON
        self.beats = 0
        self.stalls: list[float | None] = []
        self.ready = threading.Event()
        self._folder = folder
        self._program = textwrap.dedent(program)
        fields = {"worker_poll_s": 0.02, "heartbeat_s": 0.05, "worker_stop_grace_s": 30.0, **settings}
        self.supervisor = TrainingSupervisor(
            WorkerSettings.model_construct(**fields),  # type: ignore[arg-type]
            start=self._start,
            beat=self._beat,
            look=self._look,
            report_stall=self.stalls.append,
            must_end=must_end,
            workdir=folder,
            log_path=folder / "output.log",
            time_limit_s=time_limit_s,
        )
        self.ending: Ending | None = None
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        """Run the supervisor and wait until its child is ready."""
        self._thread.start()
        (self._folder / "ready").read_text()

    def join(self) -> Ending:
        """Return how it ended."""
        self._thread.join(30)
        assert self.ending is not None
        return self.ending

    def _run(self) -> None:
        self.ending = self.supervisor.run()

    def _start(self, on_exit: Callable[[], None]) -> TrainingProcess:
        return TrainingProcess(
            [sys.executable, "-c", self._program],
            env=dict(os.environ),
            cwd=self._folder,
            log_path=self._folder / "output.log",
            on_exit=on_exit,
        )

    def _beat(self) -> Requests:
        self.beats += 1
        return self._look()

    def _look(self) -> Requests:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Build benches; what still runs at the end of the test is stopped."""
    benches: list[Bench] = []

    def build(program: str, **settings: Any) -> Bench:
        folder = tmp_path / str(len(benches))
        folder.mkdir()
        benches.append(Bench(folder, program, **settings))
        return benches[-1]

    yield build
    for each in benches:
        each.answer = LeaseLostError("the test is over")
        each.join()


def test_child_that_ends_by_itself(bench: Callable[..., Bench]) -> None:
    each = bench("import pathlib, sys; pathlib.Path('ready').write_text(''); print('bye'); sys.exit(3)")
    each.start()
    ending = each.join()
    assert (ending.intent, ending.returncode, ending.last_output) == (Intent.NONE, 3, "bye")
    assert describe_ending("trainer", ending) == "the trainer ended by exit code 3; last output: bye"


@pytest.mark.parametrize(
    ("requests", "intent"),
    [
        (Requests(WorkState.RUNNING, cancel=True), Intent.CANCEL),
        (Requests(WorkState.PAUSING, cancel=False), Intent.PAUSE),
        (Requests(WorkState.PAUSING, cancel=True), Intent.CANCEL),
    ],
)
def test_requests_of_users_are_obeyed(bench: Callable[..., Bench], requests: Requests, intent: Intent) -> None:
    each = bench(OBEDIENT)
    each.start()
    each.answer = requests
    ending = each.join()
    assert (ending.intent, ending.returncode, ending.overstayed) == (intent, TrainerExitCode.STOPPED, False)


def test_an_evaluation_at_the_end_of_a_job_is_not_paused(bench: Callable[..., Bench]) -> None:
    each = bench(OBEDIENT)
    each.start()
    each.answer = Requests(WorkState.EVALUATING, cancel=False)
    beats = each.beats
    while each.beats < beats + 3:
        assert each.ending is None
    each.supervisor.shut_down()
    assert each.join().intent is Intent.SHUTDOWN


def test_a_child_that_runs_longer_than_it_may_is_stopped(bench: Callable[..., Bench]) -> None:
    each = bench(OBEDIENT, time_limit_s=0.3)
    each.start()
    ending = each.join()
    assert (ending.intent, ending.returncode) == (Intent.TIME_LIMIT, TrainerExitCode.STOPPED)


def test_child_that_does_not_stop_is_killed_after_the_grace_period(bench: Callable[..., Bench]) -> None:
    each = bench(STUBBORN, worker_stop_grace_s=0.2)
    each.start()
    each.supervisor.shut_down()
    ending = each.join()
    assert (ending.intent, ending.returncode, ending.overstayed) == (Intent.SHUTDOWN, -signal.SIGKILL, True)
    assert "did not stop within the grace period" in describe_ending("trainer", ending)


def test_lost_lease_kills_at_once(bench: Callable[..., Bench]) -> None:
    each = bench(STUBBORN)
    each.start()
    each.answer = LeaseLostError("another worker has it")
    ending = each.join()
    assert (ending.intent, ending.returncode, ending.overstayed) == (Intent.LEASE_LOST, -signal.SIGKILL, False)


def test_database_that_is_away_for_a_while_stops_nothing(bench: Callable[..., Bench]) -> None:
    each = bench(OBEDIENT, worker_patience_s=600)
    each.start()
    each.answer = OperationalError("SELECT 1", {}, ConnectionError("refused"))
    beats = each.beats
    while each.beats < beats + 5:
        assert each.ending is None
    each.answer = Requests(WorkState.RUNNING, cancel=True)
    assert each.join().intent is Intent.CANCEL


def test_database_that_stays_away_ends_the_attempt(bench: Callable[..., Bench]) -> None:
    each = bench(OBEDIENT, worker_patience_s=0.2)
    each.start()
    each.answer = OperationalError("SELECT 1", {}, ConnectionError("refused"))
    ending = each.join()
    assert (ending.intent, ending.returncode) == (Intent.CUT_OFF, TrainerExitCode.STOPPED)


FROZEN = """
    import faulthandler, os, pathlib, signal
    faulthandler.register(signal.SIGUSR2)
    pathlib.Path("progress").touch()
    pathlib.Path("ready").write_text("")
    def deadlock():
        os.kill(os.getpid(), signal.SIGSTOP)
        signal.pause()
    deadlock()
"""
BUSY = """
    import pathlib, signal, sys, threading
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
    pathlib.Path("ready").write_text("")
    while True:
        pathlib.Path("progress").touch()
        threading.Event().wait(0.01)
"""


def test_child_that_makes_no_step_prints_where_it_is_and_is_killed(bench: Callable[..., Bench]) -> None:
    """A stopped process cannot be asked to stop."""
    each = bench(FROZEN, worker_stall_s=0.5)
    each.start()
    ending = each.join()
    assert (ending.intent, ending.returncode, ending.overstayed) == (Intent.STALLED, -signal.SIGKILL, False)
    assert "in deadlock" in ending.last_output


PAUSING = """
    import pathlib, signal, sys, threading
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
    pathlib.Path("ready").write_text("")
    while not pathlib.Path("go").exists():
        threading.Event().wait(0.01)
    while True:
        pathlib.Path("progress").touch()
        threading.Event().wait(0.01)
"""


def test_stall_is_reported_once_and_so_is_its_end(bench: Callable[..., Bench], tmp_path: Path) -> None:
    each = bench(PAUSING, worker_stall_s=600.0, worker_stall_warn_s=0.3)
    each.start()
    for count in (1, 2):
        wait_for(lambda count=count: len(each.stalls) == count)
        (tmp_path / "0" / "go").touch()
    idle_s, end = each.stalls
    assert idle_s is not None
    assert idle_s > 0.3
    assert end is None


def wait_for(condition: Callable[[], bool], timeout_s: float = 30) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_child_that_makes_steps_is_left_alone(bench: Callable[..., Bench]) -> None:
    each = bench(BUSY, worker_stall_s=1.0)
    each.start()
    beats = each.beats
    while each.beats < beats + 40:  # two seconds
        assert each.ending is None
    each.answer = Requests(WorkState.RUNNING, cancel=True)
    assert each.join().intent is Intent.CANCEL


def test_child_over_the_memory_limit_is_killed(bench: Callable[..., Bench]) -> None:
    hungry = "import pathlib, signal; x = bytes(96 << 20); pathlib.Path('ready').write_text(''); signal.pause()"
    each = bench(hungry.replace("bytes(", "bytearray(b'x') * ("), worker_memory_mb=64)
    each.start()
    ending = each.join()
    assert (ending.intent, ending.returncode) == (Intent.MEMORY, -signal.SIGKILL)
    assert ending.peak_bytes > 64 << 20


def test_requested_evaluation_ends_before_a_training_when_both_hold_too_much(bench: Callable[..., Bench]) -> None:
    """The training is larger: it is another user's, and has worked for longer."""
    hungry = """
        import pathlib, signal
        x = bytearray(b"x") * ({} << 20)
        pathlib.Path("ready").write_text("")
        signal.pause()
    """
    budget = MemoryBudget(psutil.Process().memory_info().rss + (192 << 20))
    with budget.share(WorkKind.JOB) as large, budget.share(WorkKind.EVALUATION) as small:
        training = bench(hungry.format(128), must_end=large.must_end)
        evaluation = bench(hungry.format(96), must_end=small.must_end)
        training.start()
        evaluation.start()
        ending = evaluation.join()
        assert (ending.intent, ending.returncode) == (Intent.CROWDED, -signal.SIGKILL)
        assert small.crowded
        beats = training.beats
        wait_for(lambda: training.beats > beats + 5)
        assert training.ending is None
        assert not large.crowded
        training.supervisor.shut_down()
        training.join()


def test_child_killed_from_outside_is_told_apart(bench: Callable[..., Bench]) -> None:
    each = bench("import os, pathlib, signal; pathlib.Path('ready').write_text(''); os.kill(os.getpid(), 9)")
    each.start()
    ending = each.join()
    assert (ending.intent, ending.returncode) == (Intent.NONE, -signal.SIGKILL)
    assert "signal 9 (SIGKILL)" in describe_ending("trainer", ending)
