"""The child process of one attempt at an evaluation that a user asked for.

Run as ``python -m naosprint_worker.evaluator --workdir FOLDER`` by a worker, with the assignment in that folder.
"""

from __future__ import annotations

import sys

from naojobs import records
from naojobs.store import Manifest, StoreError, evaluation_key
from naosprint.threads import quiet_openmp

from naosprint_worker.assignment import EvaluationAssignment
from naosprint_worker.child_process import Services, run_child
from naosprint_worker.database import DATABASE_TROUBLE
from naosprint_worker.evaluation import evaluate_into
from naosprint_worker.outcome import ExitCode
from naosprint_worker.report import add_report
from naosprint_worker.retry import retry


def work(services: Services) -> ExitCode:
    """Do the assignment in the working folder."""
    claim = EvaluationAssignment.read(services.workdir).claim
    patience_s = services.settings.worker_patience_s
    checkpoint, result = services.workdir / "checkpoint", services.workdir / "evaluation"
    with services.stop.interruptible():
        services.fetch(claim.checkpoint.key, checkpoint, Manifest.model_validate(claim.checkpoint.manifest))
    summary = evaluate_into(
        result, checkpoint, claim.spec, threads=services.settings.worker_evaluation_threads, stop=services.stop
    )
    add_report(services, result, claim.job_id, claim.checkpoint.step)
    key = evaluation_key(claim.job_id, claim.id, claim.attempt)
    manifest = retry(
        lambda: services.store.put_directory(key, result),
        what="storing the evaluation",
        transient=(StoreError,),
        patience_s=patience_s,
    )
    retry(
        lambda: records.finish_evaluation(
            services.sessions, claim, summary=summary, key=key, manifest=manifest.model_dump(mode="json")
        ),
        what="recording the evaluation",
        transient=DATABASE_TROUBLE,
        patience_s=patience_s,
    )
    return ExitCode.FINISHED


if __name__ == "__main__":
    quiet_openmp()
    sys.exit(run_child(work))
