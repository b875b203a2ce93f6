"""Settings, services and identity that the parts of one worker share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from naojobs.capabilities import Capabilities
from naojobs.database import Sessions

from naosprint_worker.memory import MemoryBudget
from naosprint_worker.settings import WorkerSettings


@dataclass(frozen=True)
class WorkerContext:
    """Settings, services and identity of a worker."""

    settings: WorkerSettings
    sessions: Sessions
    worker_id: str
    capabilities: Capabilities
    folder: Path
    """Folder of the working folders of this worker's attempts."""
    memory: MemoryBudget = field(default_factory=MemoryBudget)
