"""Schemas of rows."""

from __future__ import annotations

from collections.abc import Container, Iterable
from urllib.parse import quote

from naojobs.models import Checkpoint, Evaluation, Event, Job, Log, Match, MatchGame
from naojobs.registry import WorkerStatus
from naojobs.states import WorkState
from naojobs.store import StoreManifest
from naojobs.teams import present_name
from naospec.match_results import rows, sums

from naosprint_api.schemas.artifacts import CheckpointPublic, EvaluationPublic
from naosprint_api.schemas.common import FilePublic
from naosprint_api.schemas.jobs import EventPublic, JobPublic, JobResult, LogPublic
from naosprint_api.schemas.matches import GamePublic, MatchDetails, MatchPublic
from naosprint_api.schemas.system import WorkerPublic


def job_view(job: Job, waiting_reason: str | None = None, result: JobResult | None = None) -> JobPublic:
    """Return a job, with the reason why no worker can take it, and its evaluation."""
    view = JobPublic.model_validate(job)
    view.waiting_reason, view.result = waiting_reason, result
    return view


def event_view(event: Event) -> EventPublic:
    """Return an event."""
    return EventPublic.model_validate(event)


def log_view(log: Log) -> LogPublic:
    """Return a line of a log."""
    return LogPublic.model_validate(log)


def checkpoint_view(checkpoint: Checkpoint) -> CheckpointPublic:
    """Return a checkpoint with the addresses of its files."""
    manifest = StoreManifest.model_validate(checkpoint.manifest)
    root = f"/checkpoints/{checkpoint.id}"
    return CheckpointPublic(
        id=checkpoint.id,
        job_id=checkpoint.job_id,
        attempt=checkpoint.attempt,
        step=checkpoint.step,
        created_at=checkpoint.created_at,
        size=manifest.size,
        files=files_view(manifest, root),
        archive_url=f"{root}/archive",
    )


def evaluation_view(evaluation: Evaluation, waiting_reason: str | None = None) -> EvaluationPublic:
    """Return an evaluation with the addresses of its files, and the reason why no worker can take it."""
    succeeded = evaluation.state is WorkState.SUCCEEDED
    manifest = StoreManifest.model_validate(evaluation.manifest) if succeeded and evaluation.manifest else None
    root = f"/evaluations/{evaluation.id}"
    given = {
        "waiting_reason": waiting_reason,
        "worker": evaluation.lease_owner,
        "summary": evaluation.summary if succeeded else None,
        "files": files_view(manifest, root) if manifest else [],
        "archive_url": f"{root}/archive" if manifest else None,
    }
    others = {name: getattr(evaluation, name) for name in EvaluationPublic.model_fields if name not in given}
    return EvaluationPublic.model_validate({**given, **others})


def match_view(match: Match, waiting_reason: str | None = None) -> MatchPublic:
    """Return a match, with the reason why no worker can take it."""
    spec, summary = match.spec, match.summary or {}
    given = {
        "teams": [present_name(team["name"], team["policies"]) for team in spec["teams"]],
        **{name: spec[name] for name in ("games", "players", "half_s", "gate")},
        "film": spec.get("film", "off"),
        "played": summary.get("games", 0),
        **{name: summary.get(name, 0) for name in ("wins", "draws", "losses")},
        "waiting_reason": waiting_reason,
        "worker": match.lease_owner,
    }
    others = {name: getattr(match, name) for name in MatchPublic.model_fields if name not in given}
    return MatchPublic.model_validate({**given, **others})


def match_details(match: Match, shown: MatchPublic, games: Iterable[MatchGame]) -> MatchDetails:
    """Return a match with its results and the games that are over."""
    finished = []
    for game in games:
        files = {}
        for file in files_view(StoreManifest.model_validate(game.manifest), ""):
            kind = "film" if file.name.endswith(".mp4") else "log"
            files[kind] = file.model_copy(update={"url": f"/matches/{match.id}/games/{game.number}/{kind}"})
        seen = {name: getattr(game, name) for name in GamePublic.model_fields if name not in ("log", "film")}
        finished.append(GamePublic.model_validate({**seen, **files}))
    return MatchDetails(
        **shown.model_dump(),
        summary=match.summary,
        table=rows(match.summary) if match.summary else [],
        sums=sums(match.summary) if match.summary else [],
        live=match.live,
        finished=finished,
    )


def worker_view(worker: WorkerStatus, visible: Container[str] | None = None) -> WorkerPublic:
    """Return a worker with what it runs of the ids in `visible`, all if it is none."""
    held = {"jobs": worker.jobs, "evaluations": worker.evaluations, "matches": worker.matches}
    shown = {name: [each for each in ids if visible is None or each in visible] for name, ids in held.items()}
    given = {"alive": worker.alive, "queues": worker.row.simulators, **shown}
    names = (name for name in WorkerPublic.model_fields if name not in given)
    return WorkerPublic.model_validate({**given, **{name: getattr(worker.row, name) for name in names}})


def files_view(manifest: StoreManifest, root: str) -> list[FilePublic]:
    """Return the files of an artifact with their addresses below `root`."""
    return [
        FilePublic(name=entry.name, size=entry.size, sha256=entry.sha256, url=f"{root}/files/{quote(entry.name)}")
        for entry in manifest.files
    ]
