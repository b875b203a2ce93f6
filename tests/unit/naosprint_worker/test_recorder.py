"""Records arrive once, in order, also after failures of services, and reporting never blocks on them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from naojobs.records import Batch, StoredCheckpoint
from naosprint_worker import recorder as module
from naosprint_worker.recorder import Recorder
from naosprint_worker.retry import PatienceExhaustedError
from naosprint_worker.spool import Spool


class Memory:
    """A sink in memory that can be made to fail or to block."""

    transient: tuple[type[Exception], ...] = (ConnectionError,)

    def __init__(self) -> None:
        self.kept: list[tuple[str, object]] = []
        self.files: dict[int, dict[str, bytes]] = {}
        self.fail_writes: Exception | None = None
        self.fail_uploads: Exception | None = None
        self.tried = threading.Semaphore(0)
        self.gate = threading.Event()
        self.gate.set()

    def write(self, batch: Batch) -> None:
        self.gate.wait(30)
        self.tried.release()
        if self.fail_writes is not None:
            raise self.fail_writes
        self.kept += [("metrics", row.step) for row in batch.metrics]
        self.kept += [("log", f"{line.level}: {line.message}") for line in batch.logs]
        self.kept += [("event", event.kind) for event in batch.events]
        self.kept += [("checkpoint", checkpoint.step) for checkpoint in batch.checkpoints]

    def upload(self, directory: Path, step: int) -> StoredCheckpoint:
        self.tried.release()
        if self.fail_uploads is not None:
            raise self.fail_uploads
        self.files[step] = {path.name: path.read_bytes() for path in directory.iterdir()}
        return StoredCheckpoint(step, f"key-{step}", {})

    def of(self, kind: str) -> list[object]:
        """Return what was kept of one kind, in order."""
        return [value for name, value in self.kept if name == kind]


@pytest.fixture
def sink() -> Memory:
    return Memory()


@pytest.fixture
def make(sink: Memory, tmp_path: Path) -> Iterator[Callable[..., Recorder]]:
    """Build recorders that end with the test."""
    made: list[Recorder] = []

    def build(flush_s: float = 0.01, spool: str = "spool", **options: Any) -> Recorder:
        options = {"patience_s": 30.0, **options}
        recorder = Recorder(sink, spool=Spool(tmp_path / spool), flush_s=flush_s, **options)
        made.append(recorder)
        return recorder

    yield build
    sink.gate.set()
    for recorder in made:
        recorder.abandon()


def checkpoint_directory(tmp_path: Path, content: str = "weights") -> Path:
    """Write a directory that looks like a checkpoint."""
    directory = tmp_path / "checkpoint"
    directory.mkdir(exist_ok=True)
    (directory / "policy.npz").write_text(content)
    return directory


def test_everything_arrives_in_order(make: Callable[..., Recorder], sink: Memory, tmp_path: Path) -> None:
    recorder = make()
    for step in range(0, 2000, 10):
        recorder.metrics({"step": step, "time_s": step / 100, "reward": 1.0})
    recorder.log("info", "half way")
    recorder.event("note", "something")
    recorder.checkpoint(checkpoint_directory(tmp_path), 1990)
    recorder.close(30)
    assert sink.of("metrics") == list(range(0, 2000, 10))
    assert sink.of("log") == ["info: half way"]
    assert sink.of("event") == ["note"]
    assert sink.files == {1990: {"policy.npz": b"weights"}}
    assert sink.kept[-1] == ("checkpoint", 1990)
    assert list((tmp_path / "spool").iterdir()) == []


def test_flush_does_not_wait_for_the_gathering_time(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make(flush_s=3600)
    recorder.metrics({"step": 1})
    recorder.flush(30)
    assert sink.of("metrics") == [1]


def test_rows_written_together_are_gathered(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make(flush_s=3600)
    sink.gate.clear()
    for step in range(module.MAX_BATCH + 7):
        recorder.metrics({"step": step})
    sink.gate.set()
    recorder.flush(30)
    assert len(sink.of("metrics")) == module.MAX_BATCH + 7
    assert sink.tried.acquire(blocking=False)
    assert sink.tried.acquire(blocking=False)
    assert not sink.tried.acquire(blocking=False)


def test_reporting_does_not_wait_for_a_stalled_database(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make()
    sink.gate.clear()
    for step in range(1000):
        recorder.metrics({"step": step})
    assert sink.kept == []
    sink.gate.set()
    recorder.flush(30)
    assert sink.of("metrics") == list(range(1000))


def test_a_checkpoint_is_taken_over_before_the_call_returns(
    make: Callable[..., Recorder], sink: Memory, tmp_path: Path
) -> None:
    recorder = make()
    sink.fail_uploads = ConnectionError("store down")
    directory = checkpoint_directory(tmp_path)
    recorder.checkpoint(directory, 5)
    (directory / "policy.npz").unlink()
    directory.rmdir()
    sink.fail_uploads = None
    recorder.flush(30)
    assert sink.files == {5: {"policy.npz": b"weights"}}


def test_only_the_last_directory_of_a_training_is_kept(
    make: Callable[..., Recorder], sink: Memory, tmp_path: Path
) -> None:
    recorder = make()
    for step in (1, 2, 3):
        directory = tmp_path / f"step-{step}"
        directory.mkdir()
        (directory / "policy.npz").write_text(str(step))
        recorder.checkpoint(directory, step)
    recorder.flush(30)
    assert [path.name for path in tmp_path.glob("step-*")] == ["step-3"]
    assert sink.files == {step: {"policy.npz": str(step).encode()} for step in (1, 2, 3)}


def test_the_checkpoint_resumed_from_is_not_stored_again(
    make: Callable[..., Recorder], sink: Memory, tmp_path: Path
) -> None:
    recorder = make()
    recorder.already_stored(5)
    recorder.checkpoint(checkpoint_directory(tmp_path), 5)
    recorder.flush(30)
    assert sink.files == {}


def test_a_step_is_stored_once(make: Callable[..., Recorder], sink: Memory, tmp_path: Path) -> None:
    recorder = make()
    recorder.checkpoint(checkpoint_directory(tmp_path, "first"), 5)
    recorder.flush(30)
    recorder.checkpoint(checkpoint_directory(tmp_path, "second"), 5)
    recorder.flush(30)
    assert sink.files == {5: {"policy.npz": b"first"}}
    assert sink.of("checkpoint") == [5]


def test_metrics_flow_while_the_store_fails(make: Callable[..., Recorder], sink: Memory, tmp_path: Path) -> None:
    recorder = make()
    sink.fail_uploads = ConnectionError("no route to store")
    recorder.checkpoint(checkpoint_directory(tmp_path), 10)
    assert sink.tried.acquire(timeout=30)
    recorder.metrics({"step": 20})
    while ("metrics", 20) not in sink.kept:
        assert sink.tried.acquire(timeout=30)
    assert sink.of("checkpoint") == []
    sink.fail_uploads = None
    recorder.flush(30)
    assert sink.of("checkpoint") == [10]
    warning = sink.of("log")[0]
    assert isinstance(warning, str)
    assert "storing the checkpoint of step 10 failed" in warning
    assert "no route to store" in warning


def test_a_database_that_comes_back_loses_nothing(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make()
    sink.fail_writes = ConnectionError("restarting")
    for step in range(50):
        recorder.metrics({"step": step})
    for _ in range(3):
        assert sink.tried.acquire(timeout=30)
    sink.fail_writes = None
    recorder.flush(30)
    assert sink.of("metrics") == list(range(50))


def test_patience_ends_with_the_reason(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make(patience_s=0.2)
    sink.fail_writes = ConnectionError("gone for good")
    recorder.metrics({"step": 1})
    with pytest.raises(PatienceExhaustedError, match=r"writing to the database: gave up after .*gone for good"):
        recorder.flush(30)
    assert recorder.failed


def test_a_store_that_is_away_is_waited_for_within_the_limit_of_the_disk(
    make: Callable[..., Recorder], sink: Memory, tmp_path: Path
) -> None:
    """The patience with the database does not count; the training waits once its checkpoints are too many."""
    recorder = make(patience_s=0.01, spool_bytes=250)
    sink.fail_uploads = ConnectionError("store down")
    for step in (1, 2):
        recorder.checkpoint(checkpoint_directory(tmp_path, "x" * 100), step)
    returned = threading.Event()

    def third() -> None:
        recorder.checkpoint(checkpoint_directory(tmp_path, "x" * 100), 3)
        returned.set()

    thread = threading.Thread(target=third)
    thread.start()
    while not any("the training waits" in str(line) for line in sink.of("log")):
        assert sink.tried.acquire(timeout=30)
    assert not returned.is_set()
    assert not recorder.failed
    sink.fail_uploads = None
    thread.join(30)
    recorder.flush(30)
    assert returned.is_set()
    assert sink.of("checkpoint") == [1, 2, 3]
    assert list((tmp_path / "spool").iterdir()) == []


def test_a_request_to_stop_ends_the_waiting_for_the_store(
    make: Callable[..., Recorder], sink: Memory, tmp_path: Path
) -> None:
    recorder = make(spool_bytes=1, stop=lambda: True)
    sink.fail_uploads = ConnectionError("store down")
    recorder.checkpoint(checkpoint_directory(tmp_path), 1)
    assert [path.name for path in (tmp_path / "spool").iterdir()] == ["000000000001"]


def test_the_next_attempt_takes_over_what_is_not_recorded(
    make: Callable[..., Recorder], sink: Memory, tmp_path: Path
) -> None:
    """The database was unavailable, too: the metrics before each checkpoint are stored beside it, each row once."""
    recorder = make(patience_s=0.05, spool="job/1")
    sink.fail_uploads = sink.fail_writes = ConnectionError("everything is down")
    for step in (10, 20):
        for row in (step - 5, step):
            recorder.metrics({"step": row, "reward": 1.0})
        folder = tmp_path / f"step-{step}"
        folder.mkdir()
        recorder.checkpoint(checkpoint_directory(folder, str(step)), step)
    with pytest.raises(PatienceExhaustedError):
        recorder.flush(30)
    recorder.abandon()

    sink.fail_uploads = sink.fail_writes = None
    spool = Spool(tmp_path / "job" / "2", 2)
    left = spool.left_by_others(0)
    assert [entry.step for entry in left] == [10, 20]
    second = Recorder(sink, spool=spool, flush_s=0.01)
    for entry in left:
        second.adopt(spool.adopt(entry), known={5})
    second.close(30)
    assert sink.of("metrics") == [10, 15, 20]
    assert sink.of("checkpoint") == [10, 20]
    assert sink.files == {step: {"policy.npz": str(step).encode()} for step in (10, 20)}
    spool.discard_others()
    spool.close()
    assert not (tmp_path / "job").exists()


def test_an_error_that_is_not_transient_ends_recording_at_once(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make()
    sink.fail_writes = KeyError("lease lost")
    recorder.metrics({"step": 1})
    with pytest.raises(KeyError):
        recorder.flush(30)


def test_flush_says_when_time_is_up(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make()
    sink.gate.clear()
    recorder.metrics({"step": 1})
    with pytest.raises(TimeoutError):
        recorder.flush(0.05)


def test_values_that_are_not_finite_are_left_out_and_named(make: Callable[..., Recorder], sink: Memory) -> None:
    recorder = make()
    recorder.metrics({"step": 3, "reward": float("nan"), "loss": float("inf"), "kl": 0.1})
    recorder.flush(30)
    assert sink.of("metrics") == [3]
    assert sink.of("log") == ["warning: metrics at step 3: not finite, left out: loss, reward"]


def test_logs_are_bounded_while_the_database_is_away(
    make: Callable[..., Recorder], sink: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_PENDING_LOGS", 100)
    recorder = make()
    sink.gate.clear()
    for number in range(1000):
        recorder.log("info", str(number))
        if number == 500:
            recorder.metrics({"step": 500})
    sink.gate.set()
    recorder.flush(30)
    logs = sink.of("log")
    assert sink.of("metrics") == [500]
    assert "info: 999" in logs
    assert any("log lines were dropped" in str(line) for line in logs)
    assert len(logs) <= 202
