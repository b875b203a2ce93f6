"""Rate limits: a token bucket for each caller."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

_MAX_CALLERS = 10_000


class RateLimiter:
    """Rate limit: each caller may send `burst` requests at once and `per_s` on average; thread-safe."""

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._burst = burst
        self._clock = clock
        self._lock = threading.Lock()
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """caller -> (tokens left, at this time); the longest unseen first."""

    def take(self, caller: str) -> float:
        """Take one token of `caller`; return 0, or the seconds to wait when there is none."""
        now = self._clock()
        with self._lock:
            left, since = self._buckets.pop(caller, (float(self._burst), now))
            left = min(self._burst, left + (now - since) * self._per_s)
            wait = 0.0 if left >= 1 else (1 - left) / self._per_s
            self._buckets[caller] = (left - 1 if left >= 1 else left, now)
            while len(self._buckets) > _MAX_CALLERS:
                self._buckets.popitem(last=False)
        return wait

    def put_back(self, caller: str) -> None:
        """Return a token of `caller` that was taken: the request counts for another caller."""
        with self._lock:
            if caller in self._buckets:
                left, since = self._buckets[caller]
                self._buckets[caller] = (left + 1, since)
