"""Reporter of a training that writes to the database and the store from threads of its own."""

from __future__ import annotations

import logging
import math
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

from naojobs.records import Batch, EventRecord, LogLine, MetricsRow, StoredCheckpoint

from naosprint_worker.retry import describe, retry
from naosprint_worker.spool import Entry, Spool
from naosprint_worker.usage import Usage

logger = logging.getLogger(__name__)

T = TypeVar("T")

MAX_PENDING_LOGS = 5_000
"""Log lines kept while the database does not answer; beyond them the oldest are dropped and counted."""
MAX_BATCH = 500
"""Rows of one transaction."""
_LOOK_S = 0.5
"""Seconds between two calls of `stop` while a training waits."""


Item = MetricsRow | LogLine | EventRecord | StoredCheckpoint


class Sink(Protocol):
    """Destination of records. Both calls may be repeated with the same arguments after an error."""

    transient: tuple[type[Exception], ...]
    """Errors after which a call is tried again."""

    def write(self, batch: Batch) -> None:
        """Store ``batch`` in one transaction."""

    def upload(self, directory: Path, step: int) -> StoredCheckpoint:
        """Write the files of a checkpoint to the store, its manifest last."""


class Recorder:
    """The reporter of a training in a worker (`naosprint.reporter.Reporter`).

    Reporting does not wait for the database or the store. One thread writes rows in batches, another uploads
    checkpoints; a checkpoint's row is written after every metrics row reported before it, so a checkpoint that can be
    found has its metrics.

    While the store fails, checkpoints accumulate in ``spool``; above ``spool_bytes`` the call of `checkpoint` blocks,
    and with it the training. While the database fails, its thread tries again for ``patience_s`` seconds; then
    `failure` is set, `failed` turns true and only checkpoints are taken, into the spool.
    """

    def __init__(
        self,
        sink: Sink,
        *,
        spool: Spool,
        spool_bytes: float = math.inf,
        flush_s: float = 1.0,
        patience_s: float = 300.0,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Start the threads; checkpoints wait in ``spool`` until they are recorded.

        ``stop`` is called while a call waits, and ends the waiting for room.
        """
        self._sink = sink
        self._spool = spool
        self._flush_s = flush_s
        self._spool_bytes = spool_bytes
        self._patience_s = patience_s
        self._stop = stop
        self._usage = Usage()
        self._changed = threading.Condition()
        self._rows: deque[Item] = deque()
        self._batch = Batch()
        """Rows that are being written."""
        self._uploads: deque[Entry] = deque()
        self._taken: set[int] = set()
        self._previous: Path | None = None
        self._spooled_step = -1
        """Step of the last checkpoint in the spool: its metrics are there, too."""
        self._writing = False
        self._uploading = False
        self._reported = False
        self._dropped = 0
        self._hurry = False
        self._closed = False
        self._abandon = threading.Event()
        self._warned_at: dict[str, float] = {}
        self.failure: Exception | None = None
        self._threads = [
            threading.Thread(target=self._run, args=(work,), name=name, daemon=True)
            for name, work in (("record-rows", self._write_rows), ("record-checkpoints", self._upload_checkpoints))
        ]
        for thread in self._threads:
            thread.start()

    # Interface for the training

    def metrics(self, row: dict[str, float]) -> None:
        """Record the metrics of one update; ``row`` has at least ``step``. Values that are not finite are left out."""
        self._reported = True
        row = {**row, **self._usage.read()}
        values = {key: float(value) for key, value in row.items() if math.isfinite(value)}
        missing = sorted(row.keys() - values.keys())
        if missing:
            self.log("warning", f"metrics at step {row.get('step')}: not finite, left out: {', '.join(missing)}")
        self._put(MetricsRow(int(values["step"]), values))

    def checkpoint(self, path: Path, step: int) -> None:
        """Take over a complete checkpoint directory for upload, and delete the directory of the one before it.

        Waits while the spool is over its limit, with this checkpoint already in it.
        """
        if step in self._taken:
            return  # a step is stored once in an attempt
        self._reported = True
        self._taken.add(step)
        with self._changed:
            waiting = [*self._batch.metrics, *(row for row in self._rows if isinstance(row, MetricsRow))]
        entry = self._spool.add(path, step, [row for row in waiting if row.step > self._spooled_step])
        self._spooled_step = step
        # A training needs only the last one; hundreds of them would fill the disk.
        if self._previous is not None and self._previous != path:
            shutil.rmtree(self._previous, ignore_errors=True)
        self._previous = path
        self._enqueue(entry)
        self._wait_for_room()

    def log(self, level: str, message: str) -> None:
        """Record a line of the job's log."""
        self._put(LogLine(level, message))

    # Interface for the training process around it

    def already_stored(self, step: int) -> None:
        """Take no checkpoint of ``step``: it is the one that the training resumed from."""
        self._taken.add(step)

    def not_stored(self, step: int) -> None:
        """Take a checkpoint of ``step`` after all: the one that is stored cannot be resumed from."""
        self._taken.discard(step)

    def adopt(self, entry: Entry, known: Collection[int] = ()) -> None:
        """Record a checkpoint that an earlier attempt has left, which is in this attempt's spool now.

        Its metrics of ``known`` steps are left out: they were recorded after all.
        """
        for row in entry.metrics():
            if row.step not in known:
                self._put(row)
        self._taken.add(entry.step)
        self._enqueue(entry)

    def event(self, kind: str, message: str, data: Mapping[str, object] | None = None) -> None:
        """Record an event of the attempt."""
        self._put(EventRecord(kind, message, data or {}))

    @property
    def reported(self) -> bool:
        """Whether a training has reported metrics or a checkpoint."""
        return self._reported

    @property
    def failed(self) -> bool:
        """Whether recording has ended because of `failure`."""
        return self.failure is not None

    def flush(self, timeout_s: float | None = None) -> None:
        """Return when everything reported so far is stored.

        Raises:
            Exception: what `failure` holds.
            TimeoutError: it was not stored within ``timeout_s`` seconds.
        """
        with self._changed:
            self._hurry = True
            self._changed.notify_all()
            until = math.inf if timeout_s is None else time.monotonic() + timeout_s
            while not (done := self.failed or self._idle()) and (left_s := until - time.monotonic()) > 0:
                self._changed.wait(min(left_s, _LOOK_S))
                self._stop()
            self._hurry = False
        if self.failure is not None:
            raise self.failure
        if not done:
            raise TimeoutError(f"records were not stored within {timeout_s} s")

    def close(self, timeout_s: float | None = None) -> None:
        """Flush, then end the threads; raises as `flush` does, after ending the threads."""
        try:
            self.flush(timeout_s)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """End the threads at once and discard what is not stored yet."""
        self._abandon.set()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(timeout=10)

    def _enqueue(self, entry: Entry) -> None:
        with self._changed:
            if self._closed or self.failed:
                return  # it stays in the spool, for the next attempt
            self._uploads.append(entry)
            self._changed.notify_all()

    def _wait_for_room(self) -> None:
        """Wait until the spool is within its limit, recording ends or this process is asked to stop."""
        if self._spool.size <= self._spool_bytes or self.failed:
            return
        mib = self._spool.size / 2**20
        message = f"{mib:.0f} MiB of checkpoints wait for the store, which is the limit: the training waits"
        logger.warning(message)
        self.log("warning", message)
        began = time.monotonic()
        with self._changed:
            while self._spool.size > self._spool_bytes and not (self._closed or self.failed or self._stop()):
                self._changed.wait(_LOOK_S)
        self.log("info", f"the training continues after {time.monotonic() - began:.0f} s without a store")

    # The threads

    def _put(self, item: Item) -> None:
        with self._changed:
            if self._closed or (self.failed and not isinstance(item, MetricsRow)):
                return
            if isinstance(item, LogLine) and len(self._rows) >= MAX_PENDING_LOGS:
                self._drop_oldest_log()
            self._rows.append(item)
            self._changed.notify_all()

    def _drop_oldest_log(self) -> None:
        for index, item in enumerate(self._rows):
            if isinstance(item, LogLine):
                del self._rows[index]
                self._dropped += 1
                return

    def _idle(self) -> bool:
        return not (self._rows or self._uploads or self._writing or self._uploading)

    def _run(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            if not self._abandon.is_set():
                logger.exception("recording ended")
            with self._changed:
                self.failure = self.failure or error
                self._uploads.clear()
                self._changed.notify_all()
            self._abandon.set()

    def _write_rows(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._rows or self._closed)
                if self._closed:
                    return
                # Collect records for a moment, unless a caller waits for them.
                self._changed.wait_for(self._should_write, self._flush_s)
                batch = self._batch = self._gather()
                self._writing = True
            if self._dropped:
                dropped, self._dropped = self._dropped, 0
                batch.logs.append(LogLine("warning", f"{dropped} log lines were dropped"))
            write = partial(self._sink.write, batch)
            self._persist(write, "writing to the database", self._patience_s)
            with self._changed:
                for stored in batch.checkpoints:
                    self._spool.remove(stored.step)
                self._batch = Batch()
                self._writing = False
                self._changed.notify_all()

    def _should_write(self) -> bool:
        return self._hurry or self._closed or len(self._rows) >= MAX_BATCH

    def _gather(self) -> Batch:
        batch = Batch()
        while self._rows and len(batch) < MAX_BATCH:
            match self._rows.popleft():
                case MetricsRow() as row:
                    batch.metrics.append(row)
                case LogLine() as line:
                    batch.logs.append(line)
                case EventRecord() as event:
                    batch.events.append(event)
                case StoredCheckpoint() as checkpoint:
                    batch.checkpoints.append(checkpoint)
        return batch

    def _upload_checkpoints(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._uploads or self._closed)
                if self._closed:
                    return
                entry = self._uploads.popleft()
                self._uploading = True
            upload = partial(self._sink.upload, entry.checkpoint, entry.step)
            # A store may be unavailable for a day: the checkpoint is on the disk meanwhile.
            stored = self._persist(upload, f"storing the checkpoint of step {entry.step}", math.inf)
            self._put(stored)
            with self._changed:
                self._uploading = False
                self._changed.notify_all()

    def _persist(self, call: Callable[[], T], what: str, patience_s: float) -> T:
        return retry(
            call,
            what=what,
            transient=self._sink.transient,
            patience_s=patience_s,
            stop=self._abandon,
            on_retry=lambda error, pause_s: self._warn(what, error, pause_s),
        )

    def _warn(self, what: str, error: Exception, pause_s: float) -> None:
        """Write a warning to the job's log, at most every ten seconds per kind of failure."""
        now = time.monotonic()
        if now - self._warned_at.get(what, -math.inf) < 10:
            return
        self._warned_at[what] = now
        message = f"{what} failed, next try in {pause_s:.1f} s: {describe(error)}"
        logger.warning(message)
        self.log("warning", message)
