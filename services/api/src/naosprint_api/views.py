"""Public views of rows."""

from __future__ import annotations

from urllib.parse import quote

from naojobs.models import Checkpoint, Evaluation, Event, Job, Log
from naojobs.schemas import CheckpointPublic, EvaluationPublic, EventPublic, FilePublic, JobPublic, LogPublic
from naojobs.store import Manifest


def job_view(job: Job) -> JobPublic:
    """Show a job."""
    return JobPublic.model_validate(job)


def event_view(event: Event) -> EventPublic:
    """Show an event."""
    return EventPublic.model_validate(event)


def log_view(log: Log) -> LogPublic:
    """Show a line of a log."""
    return LogPublic.model_validate(log)


def checkpoint_view(checkpoint: Checkpoint) -> CheckpointPublic:
    """Show a checkpoint with the addresses of its files."""
    manifest = Manifest.model_validate(checkpoint.manifest)
    root = f"/checkpoints/{checkpoint.id}"
    return CheckpointPublic(
        id=checkpoint.id,
        job_id=checkpoint.job_id,
        attempt=checkpoint.attempt,
        step=checkpoint.step,
        created_at=checkpoint.created_at,
        size=manifest.size,
        files=_files(manifest, root),
        archive_url=f"{root}/archive",
    )


def evaluation_view(evaluation: Evaluation) -> EvaluationPublic:
    """Show an evaluation with the addresses of its files."""
    manifest = Manifest.model_validate(evaluation.manifest) if evaluation.manifest is not None else None
    root = f"/evaluations/{evaluation.id}"
    return EvaluationPublic.model_validate(
        {
            "id": evaluation.id,
            "job_id": evaluation.job_id,
            "checkpoint_id": evaluation.checkpoint_id,
            "state": evaluation.state,
            "spec": evaluation.spec,
            "summary": evaluation.summary,
            "files": _files(manifest, root) if manifest else [],
            "archive_url": f"{root}/archive" if manifest else None,
            "error": evaluation.error,
            "created_at": evaluation.created_at,
            "finished_at": evaluation.finished_at,
        },
    )


def _files(manifest: Manifest, root: str) -> list[FilePublic]:
    return [
        FilePublic(name=entry.name, size=entry.size, sha256=entry.sha256, url=f"{root}/files/{quote(entry.name)}")
        for entry in manifest.files
    ]
