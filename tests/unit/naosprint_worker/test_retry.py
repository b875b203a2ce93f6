"""Short failures are retried, longer ones end with a clear reason."""

from __future__ import annotations

import threading
import time

import pytest
from naosprint_worker.retry import PatienceExhaustedError, describe, retry


class Flaky:
    """Fail a number of times, then return."""

    def __init__(self, failures: int, error: type[Exception] = ConnectionError) -> None:
        self.failures = failures
        self.error = error
        self.calls = 0

    def __call__(self) -> str:
        self.calls += 1
        if self.calls <= self.failures:
            raise self.error(f"failure {self.calls}")
        return "done"


def test_transient_failures_are_repeated() -> None:
    heard: list[str] = []
    flaky = Flaky(3)
    result = retry(
        flaky,
        what="writing",
        transient=(ConnectionError,),
        patience_s=10,
        first_delay_s=0.001,
        on_retry=lambda error, _: heard.append(str(error)),
    )
    assert result == "done"
    assert heard == ["failure 1", "failure 2", "failure 3"]


def test_other_errors_are_not_repeated() -> None:
    flaky = Flaky(3, KeyError)
    with pytest.raises(KeyError):
        retry(flaky, what="writing", transient=(ConnectionError,), patience_s=10)
    assert flaky.calls == 1


def test_patience_ends_and_says_what_failed() -> None:
    flaky = Flaky(10**9)
    start = time.monotonic()
    with pytest.raises(
        PatienceExhaustedError, match=r"storing step 7: gave up after .*ConnectionError: failure"
    ) as caught:
        retry(flaky, what="storing step 7", transient=(ConnectionError,), patience_s=0.1, first_delay_s=0.01)
    assert isinstance(caught.value.__cause__, ConnectionError)
    assert 0.1 <= time.monotonic() - start < 5
    assert flaky.calls > 3


def test_stop_ends_the_waiting() -> None:
    stop = threading.Event()
    start = time.monotonic()
    with pytest.raises(PatienceExhaustedError, match="stopped"):
        retry(
            Flaky(10**9),
            what="writing",
            transient=(ConnectionError,),
            patience_s=600,
            first_delay_s=600,
            on_retry=lambda *_: stop.set(),
            stop=stop,
        )
    assert time.monotonic() - start < 60


def test_errors_are_described_on_one_bounded_line() -> None:
    assert describe(ValueError("a\n  b")) == "ValueError: a b"
    assert describe(ValueError()) == "ValueError"
    assert len(describe(ValueError("x" * 9000))) == 500
