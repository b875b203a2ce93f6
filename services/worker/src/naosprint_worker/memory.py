"""Memory of a worker's children as a sum, so that the kernel never has to choose which of them to end."""

from __future__ import annotations

import contextlib
import math
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from naojobs.models import WorkKind

from naosprint_worker.settings import WorkerSettings

MIB = 1 << 20

_USED_SHARE = 0.9
"""Share of a container's limit that is used; the rest is for the kernel and for what grows between two checks."""
_EVALUATION_BYTES = 512 * MIB
"""What must be free to start an evaluation beside a training."""


@dataclass(eq=False)
class Share:
    """Memory of one child, as part of a budget."""

    kind: WorkKind
    _budget: MemoryBudget = field(repr=False)
    held_bytes: int = 0
    crowded: bool = False
    """Whether there were other children when it had to end."""

    def must_end(self, held_bytes: int) -> bool:
        """Record what the child holds; return whether it has to end because all together exceed the budget."""
        self.held_bytes = held_bytes
        if self._budget.victim() is not self:
            return False
        self.crowded = self._budget.count > 1
        return True


class MemoryBudget:
    """Memory that a worker, its children and their files on a tmpfs may hold together; thread-safe.

    When it is exceeded, evaluations that users requested end before trainings, and the largest child first.
    """

    def __init__(self, limit_bytes: float = math.inf, tmpfs: Path | None = None) -> None:
        """Watch a limit; ``tmpfs`` is a folder whose files are in memory."""
        self.limit_bytes = limit_bytes
        self._tmpfs = tmpfs
        self._shares: list[Share] = []
        self._lock = threading.Lock()

    @classmethod
    def of_worker(cls, settings: WorkerSettings) -> MemoryBudget:
        """Return the budget that the settings name, else one for the limit of the container."""
        total_mb = settings.worker_memory_total_mb
        limit = _USED_SHARE * container_limit(Path("/sys/fs/cgroup")) if total_mb is None else float(total_mb * MIB)
        folder = settings.worker_dir if math.isfinite(limit) and _is_tmpfs(settings.worker_dir) else None
        return cls(limit, folder)

    @property
    def count(self) -> int:
        """Number of children."""
        return len(self._shares)

    @contextlib.contextmanager
    def share(self, kind: WorkKind) -> Iterator[Share]:
        """Count a child while it runs."""
        share = Share(kind, self)
        with self._lock:
            self._shares.append(share)
        try:
            yield share
        finally:
            with self._lock:
                self._shares.remove(share)

    def used_bytes(self) -> int:
        """Return what the worker, its children and their files hold together."""
        with self._lock:
            held = sum(share.held_bytes for share in self._shares)
        with contextlib.suppress(OSError):
            held += shutil.disk_usage(self._tmpfs).used if self._tmpfs is not None else 0
        return held + int(psutil.Process().memory_info().rss)

    def victim(self) -> Share | None:
        """Return the child that has to end; none while the budget suffices."""
        if math.isinf(self.limit_bytes) or self.used_bytes() <= self.limit_bytes:
            return None
        with self._lock:
            return max(self._shares, key=lambda each: (each.kind is WorkKind.EVALUATION, each.held_bytes), default=None)

    def has_room(self) -> bool:
        """Return whether an evaluation may start beside what runs."""
        return math.isinf(self.limit_bytes) or self.limit_bytes - self.used_bytes() >= _EVALUATION_BYTES


def container_limit(cgroup: Path) -> float:
    """Return the limit of this container's memory in bytes, infinity where there is none."""
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # version 2, version 1
        with contextlib.suppress(OSError, ValueError):
            limit = int((cgroup / name).read_text(encoding="ascii"))
            if limit < psutil.virtual_memory().total:  # version 1 writes a huge number for no limit
                return limit
    return math.inf


def _is_tmpfs(folder: Path) -> bool:
    mounts = {Path(mount.mountpoint): mount.fstype for mount in psutil.disk_partitions(all=True)}
    place = folder.absolute()
    found = next((mounts[parent] for parent in (place, *place.parents) if parent in mounts), "")
    return found in ("tmpfs", "ramfs")
