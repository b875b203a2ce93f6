"""Values that requests share for a second."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from cachetools import LRUCache, TTLCache

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")

KEEP_S = 1.0
"""How long a value is kept, in seconds."""


class Recent(Generic[Key, Value]):
    """Values that were looked up within the last second; thread-safe. None is not kept."""

    def __init__(
        self,
        look_up: Callable[[Key], Value | None],
        *,
        most: int = 10_000,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._look_up = look_up
        self._values: TTLCache[Key, Value] = TTLCache(most, KEEP_S, timer=clock)
        self._found: LRUCache[Key, bool] = LRUCache(most)
        self._lock = threading.Lock()

    def find(self, key: Key) -> Value | None:
        """Return the value if it is kept; it is never looked up."""
        with self._lock:
            return self._values.get(key)

    def found(self, key: Key) -> bool:
        """Return whether the last look-up of a key, which may be long ago, found a value."""
        with self._lock:
            return self._found.get(key, False)

    def get(self, key: Key) -> Value | None:
        """Return the value that is kept, else look it up."""
        if (value := self.find(key)) is not None:
            return value
        value = self._look_up(key)
        with self._lock:
            if value is None:
                self._found.pop(key, None)
            else:
                self._values[key], self._found[key] = value, True
        return value

    def forget(self) -> None:
        """Drop all values, because one of them has changed."""
        with self._lock:
            self._values.clear()
