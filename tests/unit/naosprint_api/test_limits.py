"""The token buckets."""

from __future__ import annotations

from naosprint_api.limits import RateLimiter


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_burst_then_the_rate() -> None:
    clock = Clock()
    limiter = RateLimiter(per_s=2, burst=3, clock=clock)
    assert [limiter.take("a") for _ in range(4)] == [0, 0, 0, 0.5]
    assert limiter.take("b") == 0, "callers have buckets of their own"
    clock.now += 0.5
    assert limiter.take("a") == 0
    assert limiter.take("a") == 0.5
    clock.now += 1000
    assert [limiter.take("a") for _ in range(4)][:3] == [0, 0, 0], "no more than a burst is saved up"


def test_a_refused_request_costs_nothing() -> None:
    clock = Clock()
    limiter = RateLimiter(per_s=1, burst=1, clock=clock)
    limiter.take("a")
    for _ in range(100):
        assert limiter.take("a") == 1
    clock.now += 1
    assert limiter.take("a") == 0


def test_what_is_put_back_can_be_taken_again_but_fills_no_bucket_beyond_its_burst() -> None:
    limiter = RateLimiter(per_s=1, burst=2, clock=Clock())
    for _ in range(9):
        assert limiter.take("a") == 0
        limiter.put_back("a")
    limiter.put_back("a")
    assert [limiter.take("a") for _ in range(3)] == [0, 0, 1]
    limiter.put_back("b")
    assert [limiter.take("b") for _ in range(3)] == [0, 0, 1]


def test_memory_is_bounded() -> None:
    limiter = RateLimiter(per_s=1, burst=1, clock=Clock())
    for number in range(20_000):
        limiter.take(str(number))
    assert len(limiter._buckets) == 10_000
