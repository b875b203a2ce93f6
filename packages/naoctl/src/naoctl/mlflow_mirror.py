"""Copies of jobs and registered policies in MLflow."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from naoctl.client import Json
from naoctl.mirrors import Copy, flat, results_of
from naoctl.render import parse_time

JOB_TAG = "naosprint.job"
REFERENCE_TAG = "naosprint.reference"
"""Tag of a model version: the policy's name and version in the service."""
_PARAMS_AT_ONCE, _METRICS_AT_ONCE = 100, 1000
"""MLflow's limits of one request."""
_PARAM_LENGTH = 6000
_STATES = {"succeeded": "FINISHED", "failed": "FAILED", "cancelled": "KILLED"}


class MlflowMirror:
    """Runs of an MLflow experiment, one for each job, and versions of registered models, one for each of a policy.

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

        if run_id := self._run_of(job["id"]):
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

    def registered(self, name: str) -> dict[str, Collection[str]]:
        """Return the aliases of each version of a policy that the registry has, by reference."""
        aliases = self._aliases(name)
        return {
            reference: [alias for alias, number in aliases.items() if number == str(version.version)]
            for reference, version in self._versions(name).items()
        }

    def register(self, card: Json, name: str, folder: Path) -> bool:
        """Add a version of a policy to the registry, or move its aliases; return False without a run of its job."""
        from mlflow.exceptions import MlflowException

        reference = card["reference"]
        version = self._versions(name).get(reference)
        if version is None:
            run_id = self._run_of(card["job_id"])
            if run_id is None:
                return False
            self._client.log_artifacts(run_id, str(folder), folder.name)
            try:
                self._client.create_registered_model(name, description="A policy of naosprint's registry.")
            except MlflowException as error:
                if error.error_code != "RESOURCE_ALREADY_EXISTS":
                    raise
            version = self._client.create_model_version(
                name,
                source=f"{self._client.get_run(run_id).info.artifact_uri}/{folder.name}",
                run_id=run_id,
                tags={
                    REFERENCE_TAG: reference,
                    "naosprint.checkpoint": card["checkpoint_id"],
                    "naosprint.spec_sha256": card["spec_sha256"],
                },
                description=card["notes"] or None,
            )
        known = self._aliases(name)
        for alias in card["aliases"]:
            self._client.set_registered_model_alias(name, alias, version.version)
        for alias, number in known.items():
            if number == str(version.version) and alias not in card["aliases"]:
                self._client.delete_registered_model_alias(name, alias)
        return True

    def _run_of(self, job_id: str) -> str | None:
        filter_string = f"tags.`{JOB_TAG}` = '{job_id}'"
        found = self._client.search_runs([self._experiment], filter_string=filter_string, max_results=1)
        return found[0].info.run_id if found else None

    def _versions(self, name: str) -> dict[str, Any]:
        versions: list[Any] = []
        token = None
        while True:
            page = self._client.search_model_versions(f"name = '{name}'", max_results=1000, page_token=token)
            versions += page
            token = page.token
            if not token:
                return {each.tags[REFERENCE_TAG]: each for each in versions if REFERENCE_TAG in each.tags}

    def _aliases(self, name: str) -> dict[str, str]:
        from mlflow.exceptions import MlflowException

        try:
            model = self._client.get_registered_model(name)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return {}
        return {alias: str(number) for alias, number in model.aliases.items()}


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

    def attach(self, folder: Path) -> None:
        self._client.log_artifacts(self._run_id, str(folder), folder.name)

    def close(self, job: Json) -> None:
        ended = parse_time(job.get("finished_at"))
        if results := results_of(job):
            self.add(max(self.last_step, 0), ended.timestamp() if ended else 0.0, results)
        self._client.set_terminated(
            self._run_id,
            _STATES.get(job["state"], "SCHEDULED"),
            int(ended.timestamp() * 1000) if ended else None,
        )
