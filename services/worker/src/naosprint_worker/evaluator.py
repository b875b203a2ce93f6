"""Child process of one attempt at an evaluation that a user requested.

Run as ``python -m naosprint_worker.evaluator --workdir FOLDER`` by a worker, with the assignment in that folder.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from naojobs import outcomes, records
from naojobs.leases import EvaluationClaim
from naojobs.states import WorkState
from naojobs.store import StoreError, StoreManifest, evaluation_key, new_nonce
from naosprint.threads import quiet_openmp

from naosprint_worker.assignment import read_assignment
from naosprint_worker.child_process import EVALUATOR_OOM_SCORE, Services, StopRequestedError, run_child
from naosprint_worker.database import DATABASE_ERRORS
from naosprint_worker.evaluation import evaluate_into
from naosprint_worker.outcome import Outcome, TrainerExitCode
from naosprint_worker.report import add_report
from naosprint_worker.retry import retry


def work(services: Services) -> Outcome:
    """Run the assignment in the working folder."""
    claim = read_assignment(EvaluationClaim, services.workdir)
    try:
        return _evaluate(services, claim)
    except StopRequestedError:
        services.requeue_if_orphaned(claim.lease)
        return Outcome(TrainerExitCode.STOPPED, "stopped", "stopped on request")


def _evaluate(services: Services, claim: EvaluationClaim) -> Outcome:
    lease, patience_s = claim.lease, services.settings.worker_patience_s
    checkpoint, result = services.workdir / "checkpoint", services.workdir / "evaluation"
    with services.stop.interruptible():
        services.fetch(claim.checkpoint.key, checkpoint, StoreManifest.model_validate(claim.checkpoint.manifest))
    _database(services, lambda: outcomes.transition(services.sessions, lease, WorkState.RUNNING, message="running"))
    summary = evaluate_into(
        result, checkpoint, claim.spec, threads=services.settings.worker_evaluation_threads, services=services
    )
    add_report(services, result, lease.job_id, claim.checkpoint.step, asked=claim.report)
    key = evaluation_key(lease.job_id, lease.id, lease.attempt, new_nonce())
    manifest = retry(
        lambda: services.store.put_directory(key, result),
        what="storing the evaluation",
        transient=(StoreError,),
        patience_s=patience_s,
    ).model_dump(mode="json")
    _database(
        services,
        lambda: records.record_result(services.sessions, lease, summary=summary, key=key, manifest=manifest),
    )
    return Outcome(TrainerExitCode.FINISHED, "finished", "the evaluator finished")


def _database(services: Services, call: Callable[[], object]) -> None:
    patience_s = services.settings.worker_patience_s
    retry(call, what="recording the evaluation", transient=DATABASE_ERRORS, patience_s=patience_s)


if __name__ == "__main__":
    quiet_openmp()
    sys.exit(run_child(work, oom_score=EVALUATOR_OOM_SCORE))
