"""Errors are classified by their meaning for the job; a request to stop interrupts only where allowed."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from naojobs.errors import LeaseLostError
from naojobs.store import CorruptArtifactError, MissingArtifactError, StoreError
from naosim.launchers import LauncherUnavailableError
from naosim.simulator import ServerLostError, ServersUnavailableError
from naosprint import CheckpointError, TrainingDivergedError
from naosprint_worker.child_process import StopRequest, StopRequestedError, classify
from naosprint_worker.outcome import TrainerExitCode
from naosprint_worker.retry import PatienceExhaustedError
from naosprint_worker.runs import child_environment
from naosprint_worker.settings import WorkerSettings
from sqlalchemy.exc import OperationalError


@pytest.mark.parametrize(
    ("error", "code", "kind"),
    [
        (LeaseLostError("gone"), TrainerExitCode.FENCED, "lease_lost"),
        (TrainingDivergedError("loss is nan"), TrainerExitCode.PERMANENT, "diverged"),
        (CheckpointError("damaged"), TrainerExitCode.PERMANENT, "checkpoint"),
        (CorruptArtifactError("damaged"), TrainerExitCode.PERMANENT, "checkpoint"),
        (MissingArtifactError("gone"), TrainerExitCode.PERMANENT, "checkpoint"),
        (StoreError("refused"), TrainerExitCode.TRANSIENT, "service_unavailable"),
        (PatienceExhaustedError("gave up"), TrainerExitCode.TRANSIENT, "service_unavailable"),
        (OperationalError("SELECT", {}, Exception("down")), TrainerExitCode.TRANSIENT, "service_unavailable"),
        (OSError(errno.ENOSPC, "No space left on device"), TrainerExitCode.DISK_FULL, "disk_full"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), TrainerExitCode.DISK_FULL, "disk_full"),
        (OSError("12 requested and 0 written"), TrainerExitCode.TRANSIENT, "system"),
        (ConnectionResetError("simulator"), TrainerExitCode.TRANSIENT, "system"),
        (LauncherUnavailableError("Docker: refused"), TrainerExitCode.TRANSIENT, "service_unavailable"),
        (ServersUnavailableError("server 3: Docker: refused"), TrainerExitCode.TRANSIENT, "service_unavailable"),
        (ServerLostError("21 servers were lost"), TrainerExitCode.TRANSIENT, "system"),
        (MemoryError(), TrainerExitCode.TRANSIENT, "system"),
        (ValueError("n_envs: too many"), TrainerExitCode.PERMANENT, "error"),
        (SystemExit(0), TrainerExitCode.PERMANENT, "exit"),
        (SystemExit(75), TrainerExitCode.PERMANENT, "exit"),
        (SystemExit("done"), TrainerExitCode.PERMANENT, "exit"),
    ],
)
def test_judgement(error: BaseException, code: TrainerExitCode, kind: str, tmp_path: Path) -> None:
    outcome = classify(error, tmp_path)
    assert (outcome.code, outcome.kind) == (code, kind)
    assert code is TrainerExitCode.STOPPED or " ".join(str(error).split())[:100] in outcome.message


def test_judgement_keeps_the_traceback(tmp_path: Path) -> None:
    try:
        raise ValueError("n_envs: too many")
    except ValueError as error:
        outcome = classify(error, tmp_path)
    assert "test_judgement_keeps_the_traceback" in outcome.traceback


def test_full_disk_behind_another_error_is_found(tmp_path: Path) -> None:
    try:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise CheckpointError("cannot be written") from error
    except CheckpointError as error:
        outcome = classify(error, tmp_path / "attempt")
    assert (outcome.code, outcome.kind) == (TrainerExitCode.DISK_FULL, "disk_full")
    assert f"the worker's folder {tmp_path}" in outcome.message


@pytest.fixture
def stop() -> Iterator[StopRequest]:
    """A request that listens to this process's SIGTERM."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    request = StopRequest()
    request.install()
    yield request
    for number, handler in before.items():
        signal.signal(number, handler)


def test_request_is_only_noted_outside_of_interruptible_blocks(stop: StopRequest) -> None:
    assert not stop.requested()
    os.kill(os.getpid(), signal.SIGTERM)
    assert stop.requested()
    assert not stop.orphaned


def test_request_interrupts_a_block(stop: StopRequest) -> None:
    with pytest.raises(StopRequestedError), stop.interruptible():
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()


def test_earlier_request_keeps_a_block_from_starting(stop: StopRequest) -> None:
    stop.worker_died()
    entered = False
    with pytest.raises(StopRequestedError), stop.interruptible():
        entered = True
    assert not entered
    assert stop.orphaned


def test_block_that_is_over_is_not_interrupted(stop: StopRequest) -> None:
    with stop.interruptible():
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    assert stop.requested()


@pytest.mark.parametrize("name", ["NAOSPRINT_BROKER_URL", "NAOSPRINT_BROKER_URL_FILE", "naosprint_broker_url"])
def test_children_do_not_get_the_broker_s_password(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    url = "redis://worker:s3cr3t@broker:6379/0"
    monkeypatch.delenv("NAOSPRINT_BROKER_URL", raising=False)
    (tmp_path / "broker").write_text(url, encoding="utf-8")
    monkeypatch.setenv(name, str(tmp_path / "broker") if name.endswith("_FILE") else url)
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL", "postgresql://naosprint_worker:w0rker@database/naosprint")
    monkeypatch.setenv("NAOSPRINT_ARTIFACT_URL", "file:///artifacts")
    own = WorkerSettings()  # type: ignore[call-arg]  # the environment fills it
    assert own.broker_url.get_secret_value() == url
    environment = child_environment(own)
    assert not any("s3cr3t" in value or value == str(tmp_path / "broker") for value in environment.values())
    for one in [*os.environ]:
        monkeypatch.delenv(one)
    for one, value in environment.items():
        monkeypatch.setenv(one, value)
    theirs = WorkerSettings()  # type: ignore[call-arg]  # the environment fills it
    assert theirs.model_copy(update={"broker_url": own.broker_url}) == own, "the rest is the worker's"
