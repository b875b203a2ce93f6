"""Child process of one attempt at an evaluation that a user requested.

Run as ``python -m naosprint_worker.evaluator --workdir FOLDER`` by a worker, with the assignment in that folder.
"""

from __future__ import annotations

import sys

from naojobs import outcomes, records
from naojobs.leases import EvaluationClaim
from naojobs.states import WorkState
from naojobs.store import StoreManifest, evaluation_key, new_nonce
from naosprint.threads import quiet_openmp

from naosprint_worker.assignment import read_assignment
from naosprint_worker.child_process import EVALUATOR_OOM_SCORE, Services, run_child
from naosprint_worker.evaluation import evaluate_into
from naosprint_worker.outcome import Outcome, TrainerExitCode
from naosprint_worker.report import add_report


def work(services: Services) -> Outcome:
    """Run the assignment in the working folder."""
    claim = read_assignment(EvaluationClaim, services.workdir)
    lease, what = claim.lease, "recording the evaluation"
    checkpoint, result = services.workdir / "checkpoint", services.workdir / "evaluation"
    with services.stop.interruptible():
        services.fetch(claim.checkpoint.key, checkpoint, StoreManifest.model_validate(claim.checkpoint.manifest))
    services.database(lambda: outcomes.transition(services.sessions, lease, WorkState.RUNNING, message="running"), what)
    summary = evaluate_into(
        result, checkpoint, claim.spec, threads=services.settings.worker_evaluation_threads, services=services
    )
    add_report(services, result, lease.job_id, claim.checkpoint.step, asked=claim.report)
    key = evaluation_key(lease.job_id, lease.id, lease.attempt, new_nonce())
    manifest = services.put(key, result, what="the evaluation").model_dump(mode="json")
    services.database(
        lambda: records.record_result(services.sessions, lease, summary=summary, key=key, manifest=manifest), what
    )
    return Outcome(TrainerExitCode.FINISHED, "finished", "the evaluator finished")


if __name__ == "__main__":
    quiet_openmp()
    sys.exit(run_child(work, oom_score=EVALUATOR_OOM_SCORE))
