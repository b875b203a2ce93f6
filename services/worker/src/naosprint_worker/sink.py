"""Sink of a recorder's records: rows under the job's lease, files under immutable keys."""

from __future__ import annotations

import logging
from pathlib import Path

from naojobs import records
from naojobs.database import Sessions
from naojobs.leases import Lease
from naojobs.records import Batch, StoredCheckpoint
from naojobs.retention import Retention, delete_files, prune_checkpoints
from naojobs.store import ArtifactStore, StoreError, checkpoint_key, new_nonce

from naosprint_worker.database import DATABASE_ERRORS

logger = logging.getLogger(__name__)


class JobSink:
    """Sink of one attempt at a job (`naosprint_worker.recorder.Sink`).

    Every write checks the lease: an attempt that lost it gets `naojobs.errors.LeaseLostError` and changes nothing.
    """

    transient: tuple[type[Exception], ...] = (*DATABASE_ERRORS, StoreError)

    def __init__(
        self, sessions: Sessions, store: ArtifactStore, lease: Lease, *, retention: Retention | None = None
    ) -> None:
        """Write under ``lease``; without ``retention`` every checkpoint is kept."""
        self._sessions = sessions
        self._store = store
        self._lease = lease
        self._retention = retention
        self._nonce = new_nonce()
        self._checkpoint_ids: dict[int, str] = {}

    def write(self, batch: Batch) -> None:
        """Write ``batch`` in one transaction."""
        self._checkpoint_ids |= records.write(self._sessions, self._lease, batch)

    def upload(self, directory: Path, step: int) -> StoredCheckpoint:
        """Write a checkpoint's files to the store, after deleting those that need not be kept."""
        self.prune()
        key = checkpoint_key(self._lease.job_id, step, self._lease.attempt, self._nonce)
        manifest = self._store.put_directory(key, directory)
        return StoredCheckpoint(step, key, manifest.model_dump(mode="json"))

    def checkpoint_id(self, step: int) -> str | None:
        """Return the id under which this attempt recorded the checkpoint of ``step``."""
        return self._checkpoint_ids.get(step)

    def prune(self) -> None:
        """Delete the recorded checkpoints that need not be kept; the sweep deletes remaining files."""
        if self._retention is None:
            return
        for key in prune_checkpoints(self._sessions, self._lease, self._retention):
            try:
                delete_files(self._sessions, self._store, key)
            except StoreError as error:
                logger.warning("%s stays for now: %s", key, error)
