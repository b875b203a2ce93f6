"""Probes of the services that the API depends on."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import anyio

_log = logging.getLogger(__name__)

DEADLINE_S = 3.0
"""Seconds within which a service has to answer."""
KEEP_S = 1.0
"""Seconds for which a result is reused."""


@dataclass(frozen=True, slots=True)
class Probe:
    """Check of one service."""

    names: Sequence[str]
    """What the check reports on."""
    check: Callable[[], set[str]]
    """Returns which of the names work; an error counts as none."""


class Probes:
    """Results of probes, shared by concurrent and shortly following requests.

    At most one probe of a service runs at a time: one that does not answer blocks one thread.
    """

    def __init__(self, probes: Sequence[Probe]) -> None:
        self._probes = [(probe, anyio.CapacityLimiter(1)) for probe in probes]
        self._task: asyncio.Task[Mapping[str, bool]] | None = None
        self._latest: tuple[float, Mapping[str, bool]] | None = None

    async def results(self) -> Mapping[str, bool]:
        """Return by name whether each service works."""
        if self._latest is not None and time.monotonic() - self._latest[0] < KEEP_S:
            return self._latest[1]
        if self._task is None:
            self._task = asyncio.create_task(self._ask())
        # A request that is cancelled must not cancel the probes of the others.
        return await asyncio.shield(self._task)

    async def _ask(self) -> Mapping[str, bool]:
        good: set[str] = set()

        async def ask(probe: Probe, limiter: anyio.CapacityLimiter) -> None:
            # An abandoned thread stays in use until the service answers.
            with anyio.move_on_after(DEADLINE_S):
                try:
                    good.update(await anyio.to_thread.run_sync(probe.check, limiter=limiter, abandon_on_cancel=True))
                except Exception:
                    _log.exception("the check of %s failed", " and ".join(probe.names))

        try:
            async with anyio.create_task_group() as group:
                for probe, limiter in self._probes:
                    group.start_soon(ask, probe, limiter)
            results = {name: name in good for probe, _ in self._probes for name in probe.names}
            self._latest = time.monotonic(), results
            return results
        finally:
            self._task = None
