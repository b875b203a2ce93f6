"""The child process of one attempt at a job: resume, train, evaluate.

Run as ``python -m naosprint_worker.trainer --workdir FOLDER`` by a worker, with the assignment in that folder.
"""

from __future__ import annotations

import logging
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import naopolicies
import naosprint
from naojobs import outcomes, records
from naojobs.checkpoints import CheckpointRef, checkpoints_of
from naojobs.errors import ConflictError
from naojobs.ids import same_id
from naojobs.leases import JobClaim
from naojobs.states import WorkState
from naojobs.store import (
    CorruptArtifactError,
    MissingArtifactError,
    StoreManifest,
    evaluation_key,
    new_nonce,
)
from naospec import EvaluationSpec
from naosprint.threads import quiet_openmp

from naosprint_worker.assignment import read_assignment
from naosprint_worker.child_process import CheckpointsUnusableError, Services, StopRequestedError, run_child
from naosprint_worker.evaluation import evaluate_into
from naosprint_worker.memory import MIB
from naosprint_worker.outcome import Outcome, TrainerExitCode
from naosprint_worker.recorder import Recorder
from naosprint_worker.report import add_report
from naosprint_worker.sink import JobSink
from naosprint_worker.software import software
from naosprint_worker.spool import Entry, Spool, link_or_copy

logger = logging.getLogger(__name__)


_FLUSH_SHARE = 0.75
"""Share of the grace period in which a stopped training waits for its last records to be stored."""


@dataclass(frozen=True)
class _Start:
    """Checkpoint that an attempt resumes from."""

    step: int
    checkpoint_id: str | None
    """Its id; none if it is not recorded yet."""
    folder: Path
    waiting: Sequence[Entry] = ()
    """Checkpoints up to this one that the attempt before could not store."""


class Attempt:
    """One attempt at a job, from the last usable checkpoint to the stored evaluation."""

    def __init__(self, services: Services, claim: JobClaim) -> None:
        """Start recording; nothing else happens yet."""
        self._services = services
        self._claim = claim
        self._lease = claim.lease
        self._resumed_from: str | None = None
        """The recorded checkpoint that was resumed from, and the steps of all by id."""
        self._steps: dict[str, int] = {}
        self._sink = JobSink(services.sessions, services.store, claim.lease, retention=services.settings.retention)
        settings = services.settings
        self._spool = Spool.of_attempt(settings.worker_dir, claim.lease)
        self._recorder = Recorder(
            self._sink,
            spool=self._spool,
            spool_bytes=settings.worker_spool_mb * MIB,
            flush_s=settings.worker_flush_s,
            patience_s=settings.worker_patience_s,
            stop=services.step,
        )

    def run(self) -> Outcome:
        """Complete the job; return how it ended."""
        try:
            return self._run()
        finally:
            self._recorder.abandon()
            self._spool.close()

    def _run(self) -> Outcome:
        from naosprint import CheckpointError  # loads NumPy, which has to wait for `quiet_openmp`

        refused: dict[str, Exception] = {}
        while True:
            try:
                return self._train(refused)
            except CheckpointError as error:
                # Complete, but not usable, at least not by this version: the one before it may be.
                if self._resumed_from is None or self._recorder.reported:
                    raise
                refused[self._resumed_from] = error
                self._recorder.not_stored(self._steps[self._resumed_from])
                self._note_unusable(self._resumed_from, error)

    def _train(self, refused: Mapping[str, Exception]) -> Outcome:
        """Train from the newest checkpoint that is not ``refused``, and evaluate."""
        services, spec, lease = self._services, self._claim.spec, self._lease
        with services.stop.interruptible():
            train = naosprint.train  # loads PyTorch, which takes a while: still part of starting
            start = self._fetch_resume(refused)
            initial = None if start else self._fetch_initial_policy()
            step, resumed_from = (start.step, start.checkpoint_id) if start else (0, None)
            self._resumed_from = resumed_from
            if resumed_from is not None:
                self._recorder.already_stored(step)
            services.database(
                lambda: outcomes.begin(
                    services.sessions, lease, step=step, resumed_from=resumed_from, software=software()
                ),
                "starting the attempt",
            )
            if start and start.waiting:
                known = services.database(
                    lambda: records.metrics_steps(services.sessions, lease.job_id), "listing the metrics"
                )
                for entry in start.waiting:
                    self._recorder.adopt(entry, known)
            self._enter(WorkState.RUNNING, "training")
        result = train(
            spec,
            workdir=services.workdir / "training",
            reporter=self._recorder,
            resume=start.folder if start else None,
            initial_policy=initial,
            stop=lambda: services.step() or self._recorder.failed,
            min_checkpoint_s=services.settings.worker_checkpoint_s,
        )
        if result.status == "stopped":
            return self._stopped(result.steps)
        with services.stop.interruptible():
            self._recorder.flush()
        services.database(self._sink.prune, "removing old checkpoints")
        evaluation = self._claim.evaluation
        if evaluation is not None:
            checkpoint_id = self._sink.checkpoint_id(result.steps) or resumed_from
            if checkpoint_id is None:
                raise RuntimeError(f"training ended at step {result.steps} without reporting a checkpoint of it")
            if services.stop.requested():
                raise StopRequestedError
            self._enter(WorkState.EVALUATING, f"evaluating {evaluation.episodes} episodes")
            self._evaluate(result, checkpoint_id, evaluation)
        with services.stop.interruptible():
            self._recorder.close()
        return Outcome(TrainerExitCode.FINISHED, "finished", "the trainer finished")

    def _stopped(self, step: int) -> Outcome:
        """Record what is possible within the grace period; the rest stays for the next attempt."""
        services = self._services
        settings = services.settings
        grace_s = settings.worker_orphan_grace_s if services.stop.orphaned else settings.worker_stop_grace_s
        message = f"stopped at step {step}"
        try:
            self._recorder.flush(_FLUSH_SHARE * grace_s)
            services.database(self._sink.prune, "removing old checkpoints")
        except TimeoutError:
            mib = self._spool.size / MIB
            message += f"; {mib:.1f} MiB of checkpoints wait on the worker's disk"
            logger.warning("the store does not answer: %s", message)
        return Outcome(TrainerExitCode.STOPPED, "stopped", message)

    def _evaluate(self, trained: naosprint.TrainResult, checkpoint_id: str, spec: EvaluationSpec) -> None:
        services, lease = self._services, self._lease
        # One id for all attempts: the one before may have died between recording its result and the job's end.
        identifier = same_id("eval", checkpoint_id)
        if services.database(
            lambda: records.has_evaluation(services.sessions, identifier), "looking for the evaluation"
        ):
            return
        folder = services.workdir / "evaluation"
        threads = self._claim.spec.runtime.simulator_threads
        warn = partial(self._recorder.log, "warning")
        summary = evaluate_into(folder, trained.checkpoint, spec, threads=threads, services=services, warn=warn)
        add_report(services, folder, lease.job_id, trained.steps, warn=warn)
        key = evaluation_key(lease.job_id, identifier, lease.attempt, new_nonce())
        manifest = services.put(
            key,
            folder,
            what="the evaluation",
            on_retry=lambda error, _: self._recorder.log("warning", f"storing the evaluation again: {error}"),
        )
        services.database(
            lambda: records.record_evaluation(
                services.sessions,
                lease,
                checkpoint_id=checkpoint_id,
                spec=spec,
                summary=summary,
                key=key,
                manifest=manifest.model_dump(mode="json"),
                evaluation_id=identifier,
            ),
            "recording the evaluation",
        )

    # Start

    def _fetch_resume(self, refused: Mapping[str, Exception]) -> _Start | None:
        """Find the newest checkpoint of this job that is undamaged, on this disk or in the store; record damaged ones.

        All checkpoints together have the worker's patience: a store that fails for a while damages none.

        Returns:
            The checkpoint and its files; none for a job that has no checkpoint yet.

        Raises:
            CheckpointsUnusableError: all are damaged or gone. Starting again would lose the training so far.
            StoreError: the store does not return a new file either.
        """
        listed = self._services.database(
            lambda: checkpoints_of(self._services.sessions, self._lease.job_id), "listing checkpoints"
        )
        self._steps.update((reference.id, reference.step) for reference in listed)
        last: Exception | None = None
        waiting = self._take_over(listed)
        if waiting:
            newest = waiting[-1]
            # A copy: the entry is deleted once it is in the store.
            folder = self._services.workdir / "fetched" / newest.folder.name
            shutil.copytree(newest.checkpoint, folder, copy_function=link_or_copy)
            return _Start(newest.step, None, folder, waiting)
        until = time.monotonic() + self._services.settings.worker_patience_s
        for reference in listed:
            if reference.id in refused:
                last = last or refused[reference.id]
                continue
            try:
                patience_s = max(0.0, until - time.monotonic())
                return _Start(reference.step, reference.id, self._fetch(reference, patience_s))
            except (CorruptArtifactError, MissingArtifactError) as error:
                self._note_unusable(reference.id, error)
                last = last or error
        if last is not None:
            raise CheckpointsUnusableError(
                f"none of its {len(listed)} checkpoints can be used; restore their files and retry the job, or submit "
                f"a new one; the newest: {last}"
            )
        return None

    def _note_unusable(self, checkpoint_id: str, error: Exception) -> None:
        step = self._steps[checkpoint_id]
        self._recorder.event(
            "checkpoint_unusable",
            f"checkpoint at step {step} cannot be used: {error}",
            {"checkpoint_id": checkpoint_id, "step": step},
        )

    def _take_over(self, recorded: Sequence[CheckpointRef]) -> list[Entry]:
        """Move what the attempt before has left on this disk into this attempt's spool.

        Only what continues the recorded checkpoints counts: the job may have resumed elsewhere meanwhile.
        """
        from naosprint.rl.checkpoint import CheckpointError, verify_checkpoint  # loads NumPy, which is loaded by now

        newest = max((reference.step for reference in recorded), default=-1)
        attempt = max((reference.attempt for reference in recorded), default=0)
        taken = []
        for entry in self._spool.left_by_others(attempt):
            if entry.step <= newest:
                continue
            try:
                verify_checkpoint(entry.checkpoint)
                try:
                    entry.metrics()
                except (OSError, ValueError) as error:
                    message = f"metrics up to step {entry.step} on the worker's disk cannot be used: {error}"
                    self._recorder.event("metrics_unusable", message, {"step": entry.step})
                    entry = entry.without_metrics()
                taken.append(self._spool.adopt(entry))
            except (CheckpointError, OSError) as error:
                message = f"checkpoint at step {entry.step} on the worker's disk cannot be used: {error}"
                self._recorder.event("checkpoint_unusable", message, {"step": entry.step})
                break  # later ones would lack its metrics
        self._spool.discard_others()
        return taken

    def _fetch_initial_policy(self) -> Path | None:
        reference, bundled = self._claim.initial_policy, self._claim.bundled_policy
        if bundled is not None:
            message = f"starts from the bundled policy {bundled}"
            self._recorder.event("initial_policy", message, {"policy": bundled})
            return naopolicies.folder(bundled)
        if reference is None:
            return None
        folder = self._fetch(reference)
        self._recorder.event(
            "initial_policy",
            f"starts from the policy of job {reference.job_id} at step {reference.step}",
            {"job_id": reference.job_id, "checkpoint_id": reference.id, "step": reference.step},
        )
        return folder

    def _fetch(self, reference: CheckpointRef, patience_s: float | None = None) -> Path:
        folder = self._services.workdir / "fetched" / reference.id
        self._services.fetch(
            reference.key,
            folder,
            StoreManifest.model_validate(reference.manifest),
            patience_s=patience_s,
            on_retry=lambda error, _: self._recorder.log("warning", f"fetching {reference.key} again: {error}"),
        )
        return folder

    # Small helpers

    def _enter(self, state: WorkState, message: str) -> None:
        """Change the job to ``state``; a pause that was requested while the training starts has precedence."""

        def enter() -> None:
            try:
                outcomes.transition(self._services.sessions, self._lease, state, message=message)
            except ConflictError:
                if state is not WorkState.RUNNING:
                    raise
                # It is pausing: the worker asks this process to stop within a moment.

        self._services.database(enter, f"entering state {state}")


def work(services: Services) -> Outcome:
    """Run the assignment in the working folder."""
    return Attempt(services, read_assignment(JobClaim, services.workdir)).run()


if __name__ == "__main__":
    quiet_openmp()
    sys.exit(run_child(work))
