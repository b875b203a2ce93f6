"""Copies of jobs and registered policies in Weights & Biases."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from naospec.files import write_whole

from naoctl.client import Json
from naoctl.mirrors import EVALUATION, FILM, REPORT, Copy, results_of
from naoctl.transfer import plain_name

_REGISTRY = "registry.json"
"""File in the folder with the aliases of each version of each policy that has been written."""


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
        # Files of artifacts are copied to the folder too: an upload may come later.
        os.environ.setdefault("WANDB_DATA_DIR", str(folder.resolve()))

    def finished(self) -> set[str]:
        """Return the ids of the jobs whose runs have ended."""
        notes = ((path.stem, json.loads(path.read_text(encoding="utf-8"))) for path in self._folder.glob("job_*.json"))
        return {job for job, note in notes if note["ended"]}

    def open(self, job: Json) -> Copy:
        """Begin or continue the run of a job."""
        if job["id"] not in self._runs:  # it is, after an error
            config = {**job["spec"], "owner": job["owner"]}
            self._runs[job["id"]] = self._init(
                job["id"], name=job["name"] or job["id"], tags=job["tags"], config=config
            )
        return _WandbCopy(self._runs, job["id"], self._note_of(job["id"]))

    def registered(self, name: str) -> dict[str, Collection[str]]:
        """Return the aliases of each version of a policy that has been written, by reference."""
        return {**self._registry().get(name, {})}

    def register(self, card: Json, name: str, folder: Path) -> bool:
        """Add a version of a policy to the artifact of its name, or move its aliases; False without a run of its job.

        The run of the job is continued for it. Contents that the artifact has already get the aliases only.
        """
        import wandb

        job_id = card["job_id"]
        if not self._note_of(job_id).exists():
            return False
        run = self._runs.get(job_id) or self._init(job_id)
        metadata = {key: card[key] for key in ("reference", "checkpoint_id", "spec_sha256", "robot", "task", "steps")}
        artifact = wandb.Artifact(name, type="model", description=card["notes"] or None, metadata=metadata)
        _add_files(artifact, folder)
        run.log_artifact(artifact, aliases=[f"version-{card['version']}", *card["aliases"]])
        if job_id not in self._runs:
            run.finish()
        known = self._registry()
        known.setdefault(name, {})[card["reference"]] = card["aliases"]
        write_whole(self._folder / _REGISTRY, json.dumps(known))
        return True

    def _init(self, job_id: str, **fields: Any) -> Any:
        import wandb

        settings = wandb.Settings(
            console="off", disable_code=True, disable_git=True, silent=True, x_disable_stats=True, x_disable_meta=True
        )
        return wandb.init(
            project=self._project,
            entity=self._entity,
            id=job_id,
            dir=self._folder,
            mode="offline" if self._offline else "online",
            resume=None if self._offline else "allow",
            reinit="create_new",
            settings=settings,
            **fields,
        )

    def _note_of(self, job_id: str) -> Path:
        return self._folder / f"{plain_name(job_id)}.json"

    def _registry(self) -> dict[str, dict[str, list[str]]]:
        path = self._folder / _REGISTRY
        known: dict[str, dict[str, list[str]]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        return known


def _add_files(artifact: Any, folder: Path) -> None:
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):  # `add_dir` prints a line
        artifact.add_file(str(path), name=path.relative_to(folder).as_posix())


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

    def attach(self, folder: Path) -> None:
        import wandb

        is_evaluation = folder.name == EVALUATION
        name = f"{self._id}-{EVALUATION if is_evaluation else 'policy'}"
        artifact = wandb.Artifact(name, type="evaluation" if is_evaluation else "model")
        _add_files(artifact, folder)
        self._run.log_artifact(artifact, aliases=["latest", folder.name])
        shown: dict[str, Any] = {}
        if (folder / REPORT).exists():
            shown["report"] = wandb.Html(str(folder / REPORT), inject=False)
        if (folder / FILM).exists():
            shown["film"] = wandb.Video(str(folder / FILM), format="mp4")
        if shown:
            self._run.log(shown, step=max(self.last_step, 0))

    def close(self, job: Json) -> None:
        self._run.summary.update({**results_of(job), "state": job["state"]})
        self._run.finish(exit_code=int(job["state"] == "failed"))
        del self._runs[self._id]
        self._write(ended=job["state"] == "succeeded")

    def _write(self, *, ended: bool) -> None:
        write_whole(self._note, json.dumps({"step": self.last_step, "ended": ended}))
