"""Recovery of what was lost: work of dead workers, and processes and servers of a dead worker on this machine."""

from __future__ import annotations

import contextlib
import logging
import random
from collections.abc import Callable, Iterable
from functools import partial

from naojobs import outcomes, registry
from naojobs.database import Sessions
from naojobs.states import WorkState
from naosim.launchers import reap_servers

from naosprint_worker.context import WorkerContext
from naosprint_worker.orphans import OrphanSweeper, attempt_is_over, touch_owner

logger = logging.getLogger(__name__)

_TURNS = 10
"""Workers that look for lost work in one interval, on average. All of a thousand would be a load by themselves."""


class LostWork:
    """Recovery of work whose worker no longer renews its lease."""

    def __init__(self, sessions: Sessions, lease_s: float) -> None:
        self._sessions = sessions
        self._lease_s = lease_s
        self.workers = 1
        """Workers of the service that are alive, this one included."""

    def sweep(self) -> list[outcomes.Requeued]:
        """Requeue what is lost, unless others of many workers look for it now; return it."""
        if random.random() * self.workers > _TURNS:  # noqa: S311 - no secret
            return []
        requeued = outcomes.requeue_stale(self._sessions, lease_s=self._lease_s)
        registry.forget(self._sessions)
        return requeued


class Reaper:
    """Periodic recovery; any number of workers may run one at once."""

    def __init__(self, context: WorkerContext, wake: Callable[[Iterable[tuple[str, str]]], None]) -> None:
        """Prepare; `wake` sends wake-up messages for pairs of work and queue."""
        self._context = context
        self._wake = wake
        is_over = partial(attempt_is_over, context.sessions)
        grace_s = context.settings.worker_orphan_grace_s + 5
        self._orphans = OrphanSweeper(context.settings.worker_dir, is_over, grace_s=grace_s)
        self.lost = LostWork(context.sessions, context.settings.lease_s)

    def sweep(self) -> None:
        """Check everything once."""
        with contextlib.suppress(OSError):  # on a full disk the rest still has to be done
            touch_owner(self._context.folder)
        for pid in self._orphans.sweep():
            logger.warning("ended process %d, whose worker is gone", pid)
        self._remove_servers()
        lost = self.lost.sweep()
        for each in lost:
            logger.warning("worker of %s %s was lost; it is now %s", each.kind, each.id, each.state)
        self._wake((each.id, each.simulator) for each in lost if each.state is WorkState.QUEUED)

    def _remove_servers(self) -> None:
        """Remove the containers of servers and agents whose training or match has ended."""
        try:
            settings = self._context.settings
            agents = f"docker:{settings.relay_image}" if settings.relay_image else ""
            removed = reap_servers(settings.simserver, settings.rcssservermj, agents)
        except OSError as error:
            logger.warning("looking for servers without an owner: %s", error)
        else:
            if removed:
                logger.warning("removed %d containers, whose training or match has ended", removed)
