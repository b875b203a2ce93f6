"""Copies of jobs' metrics in MLflow and Weights & Biases.

A copy can be continued: a step that it has already is not written again. After a lost attempt a job repeats the steps
since its last checkpoint; the copy keeps the values that it got first.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from naospec.files import write_whole

from naoctl.client import ApiError, Client, Json
from naoctl.errors import CliError, Unreachable
from naoctl.follow import is_over
from naoctl.render import parse_time
from naoctl.transfer import plain_name

T = TypeVar("T")

JOB_TAG = "naosprint.job"
RETRY_S = 10.0
"""Seconds between two attempts to reach a tracking system."""
_PARAMS_AT_ONCE, _METRICS_AT_ONCE = 100, 1000
"""MLflow's limits of one request."""
_PARAM_LENGTH = 6000
_MLFLOW_STATES = {"succeeded": "FINISHED", "failed": "FAILED", "cancelled": "KILLED"}


class Copy(Protocol):
    """Copy of one job that is being written."""

    @property
    def last_step(self) -> int:
        """Step of the last row that it has; -1 without rows."""

    def add(self, step: int, wall_s: float, values: Mapping[str, float]) -> None:
        """Write a row of metrics."""

    def close(self, job: Json) -> None:
        """Write the results and the final state of a job that has ended or is paused."""


class DownloadMirror(Protocol):
    """Tracking system that keeps copies of jobs."""

    def finished(self) -> set[str]:
        """Return the ids of the jobs whose copies are complete."""

    def open(self, job: Json) -> Copy:
        """Begin the copy of a job, or continue it."""


def mirror_jobs(
    client: Client,
    connect: Callable[[], DownloadMirror],
    chosen: Collection[str] = (),
    *,
    note: Callable[[str], None] = lambda text: None,
    retry_s: float = RETRY_S,
) -> None:
    """Copy jobs to a tracking system: all that have not been copied yet and all later ones, or only the chosen ones.

    A tracking system or a service that fails is tried again for as long as it takes; trainings do not wait for it.

    Args:
        client: the service.
        connect: returns the tracking system.
        chosen: ids of jobs; the function returns when all of them have ended or are paused. All jobs if empty, and the
            function does not return.
        note: called with a line for each copy that begins or ends, and for each failure.
        retry_s: seconds between two attempts.
    """
    waiting = set(chosen)
    copies: dict[str, Copy] = {}

    def patiently(call: Callable[[], T]) -> T:
        while True:
            try:
                return call()
            except Exception as error:  # of any type that the package of a tracking system raises
                if isinstance(error, CliError) and not isinstance(error, Unreachable):
                    raise
                copies.clear()
                reason = next(iter(str(error).splitlines()), "")
                note(f"{type(error).__name__}: {reason}; next attempt in {retry_s:g} s")
                time.sleep(retry_s)

    def update(job: Json) -> None:
        if job["id"] not in copies:
            copies[job["id"]] = mirror.open(job)
            note(f"{job['id']}: copying from step {copies[job['id']].last_step + 1:,}")
        _copy_rows(client, job, copies[job["id"]])
        if is_over(job):
            copies.pop(job["id"]).close(job)
            waiting.discard(job["id"])
            note(f"{job['id']}: {job['state']}")

    mirror = patiently(connect)
    for event in client.events("/jobs/stream", patience_s=math.inf):
        if event.kind == "ready":
            known = patiently(mirror.finished)
            found = [job for job in client.every("/jobs") if job["id"] in waiting or not (chosen or job["id"] in known)]
            jobs = found[::-1]  # the oldest first
        elif event.kind == "job" and (event.data["id"] in waiting or not chosen):
            jobs = [event.data]
        else:
            continue
        for job in jobs:
            if job["started_at"]:
                try:
                    patiently(partial(update, job))
                except ApiError as error:
                    if error.status != 404:
                        raise
                    waiting.discard(job["id"])
                    note(f"{job['id']}: deleted")
            elif is_over(job):
                waiting.discard(job["id"])
        if chosen and not waiting:
            return


def _copy_rows(client: Client, job: Json, copy: Copy) -> None:
    """Add the rows of metrics that a copy does not have yet."""
    began = parse_time(job.get("started_at") or job.get("created_at"))
    began_s = began.timestamp() if began else 0.0
    columns = client.get(f"/jobs/{job['id']}/metrics", after_step=copy.last_step)["columns"]
    for step, *values in zip(*(columns[name] for name in ("step", *columns)), strict=True) if columns else ():
        row = {name: value for name, value in zip(columns, values, strict=True) if name != "step" and value is not None}
        copy.add(int(step), began_s + row.get("time_s", 0.0), row)


def results_of(job: Json) -> dict[str, float]:
    """Return the results of a job's evaluation as ``evaluation/NAME``."""
    results = (job.get("result") or {}).get("results") or ()
    return {f"evaluation/{result['name']}": result["value"] for result in results if result["value"] is not None}


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of a specification as ``section.field`` and value."""
    if isinstance(value, Mapping) and value:
        for key, entry in value.items():
            yield from flat(entry, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


class MlflowMirror:
    """Runs of an MLflow experiment, one for each job.

    Args:
        uri: tracking server, as in ``MLFLOW_TRACKING_URI``.
        experiment: name; it is created if it is missing.
    """

    def __init__(self, uri: str, experiment: str) -> None:
        from mlflow.tracking import MlflowClient

        self._client = MlflowClient(tracking_uri=uri)
        found = self._client.get_experiment_by_name(experiment)
        self._experiment = found.experiment_id if found else self._client.create_experiment(experiment)

    def finished(self) -> set[str]:
        """Return the ids of the jobs whose runs have ended."""
        runs: list[Any] = []
        token = None
        while True:
            page = self._client.search_runs(
                [self._experiment], filter_string="attributes.status = 'FINISHED'", max_results=1000, page_token=token
            )
            runs += page
            token = page.token
            if not token:
                return {run.data.tags[JOB_TAG] for run in runs if JOB_TAG in run.data.tags}

    def open(self, job: Json) -> Copy:
        """Begin or continue the run of a job."""
        from mlflow.entities import Param, RunTag

        filter_string = f"tags.`{JOB_TAG}` = '{job['id']}'"
        found = self._client.search_runs([self._experiment], filter_string=filter_string, max_results=1)
        if found:
            run_id = found[0].info.run_id
            self._client.set_terminated(run_id, "RUNNING")
            history = self._client.get_metric_history(run_id, "time_s")
            return _MlflowCopy(self._client, run_id, max((point.step for point in history), default=-1))
        began = parse_time(job.get("started_at") or job.get("created_at"))
        run = self._client.create_run(
            self._experiment,
            start_time=int(began.timestamp() * 1000) if began else None,
            run_name=job["name"] or job["id"],
        )
        params = [Param(name, str(value)[:_PARAM_LENGTH]) for name, value in flat(job["spec"])]
        tags = {JOB_TAG: job["id"], "naosprint.owner": job["owner"], "naosprint.tags": ", ".join(job["tags"])}
        for first in range(0, len(params), _PARAMS_AT_ONCE):
            self._client.log_batch(run.info.run_id, params=params[first : first + _PARAMS_AT_ONCE])
        # The tag comes last: without it the run counts as never begun.
        self._client.log_batch(run.info.run_id, tags=[RunTag(name, value) for name, value in tags.items()])
        return _MlflowCopy(self._client, run.info.run_id, -1)


class _MlflowCopy:
    def __init__(self, client: Any, run_id: str, last_step: int) -> None:
        self._client = client
        self._run_id = run_id
        self.last_step = last_step

    def add(self, step: int, wall_s: float, values: Mapping[str, float]) -> None:
        from mlflow.entities import Metric

        points = [Metric(name, value, int(wall_s * 1000), step) for name, value in values.items()]
        self._client.log_batch(self._run_id, metrics=points[:_METRICS_AT_ONCE])
        self.last_step = step

    def close(self, job: Json) -> None:
        ended = parse_time(job.get("finished_at"))
        if results := results_of(job):
            self.add(max(self.last_step, 0), ended.timestamp() if ended else 0.0, results)
        self._client.set_terminated(
            self._run_id,
            _MLFLOW_STATES.get(job["state"], "SCHEDULED"),
            int(ended.timestamp() * 1000) if ended else None,
        )


class WandbMirror:
    """Runs of a Weights & Biases project, one for each job; its id is the job's.

    Args:
        project: name of the project.
        entity: user or team; None for the default of the account.
        folder: where runs are kept that are not uploaded, and what has been copied.
        offline: write to the folder only; ``wandb sync`` uploads it later.
    """

    def __init__(self, project: str, entity: str | None, folder: Path, *, offline: bool) -> None:
        self._project, self._entity, self._offline = project, entity, offline
        self._folder = folder
        self._runs: dict[str, Any] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def finished(self) -> set[str]:
        """Return the ids of the jobs whose runs have ended."""
        notes = ((path.stem, json.loads(path.read_text(encoding="utf-8"))) for path in self._folder.glob("job_*.json"))
        return {job for job, note in notes if note["ended"]}

    def open(self, job: Json) -> Copy:
        """Begin or continue the run of a job."""
        import wandb

        note = self._folder / f"{plain_name(job['id'])}.json"
        if job["id"] in self._runs:  # after an error
            return _WandbCopy(self._runs, job["id"], note)
        settings = wandb.Settings(
            console="off", disable_code=True, disable_git=True, silent=True, x_disable_stats=True, x_disable_meta=True
        )
        self._runs[job["id"]] = wandb.init(
            project=self._project,
            entity=self._entity,
            id=job["id"],
            name=job["name"] or job["id"],
            tags=job["tags"],
            config={**job["spec"], "owner": job["owner"]},
            dir=self._folder,
            mode="offline" if self._offline else "online",
            resume=None if self._offline else "allow",
            reinit="create_new",
            settings=settings,
        )
        return _WandbCopy(self._runs, job["id"], note)


class _WandbCopy:
    def __init__(self, runs: dict[str, Any], job_id: str, note: Path) -> None:
        self._runs, self._id = runs, job_id
        self._run = runs[job_id]
        self._note = note
        known = json.loads(note.read_text(encoding="utf-8"))["step"] if note.exists() else -1
        self.last_step = max(known, self._run.step - 1)

    def add(self, step: int, wall_s: float, values: Mapping[str, float]) -> None:
        self._run.log({**values, "_timestamp": wall_s}, step=step)
        self.last_step = step
        self._write(ended=False)

    def close(self, job: Json) -> None:
        self._run.summary.update({**results_of(job), "state": job["state"]})
        self._run.finish(exit_code=int(job["state"] == "failed"))
        del self._runs[self._id]
        self._write(ended=job["state"] == "succeeded")

    def _write(self, *, ended: bool) -> None:
        write_whole(self._note, json.dumps({"step": self.last_step, "ended": ended}))
