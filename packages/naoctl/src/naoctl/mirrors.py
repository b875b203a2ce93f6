"""Copies of jobs and registered policies in tracking systems: MLflow and Weights & Biases.

A copy can be continued: a step that it has already is not written again. After a lost attempt a job repeats the steps
since its last checkpoint; the copy keeps the values that it got first. When a job has ended, its newest checkpoint and
its evaluation are attached.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from naoctl.client import ApiError, Client, Json
from naoctl.errors import CliError, ExitCode
from naoctl.evaluations import job_evaluation
from naoctl.follow import ENDED, is_over
from naoctl.policies import checkpoint_folder, policy_path
from naoctl.render import parse_time
from naoctl.transfer import RemoteFile, fetch

T = TypeVar("T")

RETRY_S = 10.0
"""Seconds between two attempts to reach a tracking system."""
EVALUATION, REPORT, FILM = "evaluation", "report.html", "run.mp4"
"""Folder of an evaluation's files, and those of them that a person looks at."""


class Copy(Protocol):
    """Copy of one job that is being written."""

    @property
    def last_step(self) -> int:
        """Step of the last row that it has; -1 without rows."""

    def add(self, step: int, wall_s: float, values: Mapping[str, float]) -> None:
        """Write a row of metrics."""

    def attach(self, folder: Path) -> None:
        """Write the files in a folder as an artifact of its name."""

    def close(self, job: Json) -> None:
        """Write the results and the final state of a job that has ended or is paused."""


class DownloadMirror(Protocol):
    """Tracking system that keeps copies of jobs and of registered policies."""

    def finished(self) -> set[str]:
        """Return the ids of the jobs whose copies are complete."""

    def open(self, job: Json) -> Copy:
        """Begin the copy of a job, or continue it."""

    def registered(self, name: str) -> Mapping[str, Collection[str]]:
        """Return the aliases of each version of a policy that has been copied, by reference."""

    def register(self, card: Json, name: str, folder: Path) -> bool:
        """Copy a version of a policy with its files, or its aliases only; return False without a copy of its job."""


def mirror_jobs(
    client: Client,
    connect: Callable[[], DownloadMirror],
    chosen: Collection[str] = (),
    *,
    artifacts: bool = True,
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
        artifacts: copy checkpoints, evaluations and registered policies, too.
        note: called with a line for each copy that begins or ends, and for each failure.
        retry_s: seconds between two attempts.
    """
    waiting = set(chosen)
    copies: dict[str, Copy] = {}
    behind: dict[str, Json] = {}  # jobs that could not be copied while the tracking system answered
    tried_at = -math.inf

    def failed(what: str, error: Exception, then: str) -> None:
        copies.clear()
        reason = next(iter(str(error).splitlines()), "")
        note(f"{what}{type(error).__name__}: {reason}; {then}")

    def patiently(call: Callable[[], T]) -> T:
        while True:
            try:
                return call()
            except Exception as error:  # of any type that the package of a tracking system raises
                if not _passes(error):
                    raise
                failed("", error, f"next attempt in {retry_s:g} s")
                time.sleep(retry_s)

    def attempt(what: str, call: Callable[[], None], *, again: bool = True) -> bool:
        """Return whether a call succeeds, once the tracking system answers: one that never does keeps no others."""
        try:
            call()
        except Exception as error:
            if isinstance(error, CliError) and error.code is ExitCode.DENIED:
                raise
            if not again:
                failed(f"{what}: ", error, "it is tried again later")
                return False
            failed("", error, f"next attempt in {retry_s:g} s")
            time.sleep(retry_s)
            patiently(mirror.finished)
            return attempt(what, call, again=False)
        return True

    def update(job: Json) -> None:
        if not job["started_at"]:
            if is_over(job):
                waiting.discard(job["id"])
            return
        if job["id"] not in copies:
            copies[job["id"]] = mirror.open(job)
            note(f"{job['id']}: copying from step {copies[job['id']].last_step + 1:,}")
        try:
            _copy_rows(client, job, copies[job["id"]])
        except ApiError as error:
            if error.status != 404:
                raise
            waiting.discard(job["id"])
            note(f"{job['id']}: deleted")
            return
        if is_over(job):
            if artifacts and job["state"] in ENDED:
                _attach_artifacts(client, job, copies[job["id"]], note)
            copies.pop(job["id"]).close(job)
            waiting.discard(job["id"])
            note(f"{job['id']}: {job['state']}")

    def update_all(jobs: Collection[Json]) -> None:
        nonlocal tried_at
        late = list(behind.values()) if time.monotonic() - tried_at >= retry_s else []
        known = {job["id"] for job in jobs}
        for job in (*jobs, *(job for job in late if job["id"] not in known)):
            if attempt(job["id"], partial(update, job), again=job["id"] not in behind):
                behind.pop(job["id"], None)
            else:
                behind[job["id"]], tried_at = job, time.monotonic()

    mirror = patiently(connect)
    for event in client.events("/jobs/stream", patience_s=math.inf):
        if event.kind == "ready":
            known = patiently(mirror.finished)
            every = patiently(partial(client.every, "/jobs"))
            found = [job for job in every if job["id"] in waiting or not (chosen or job["id"] in known)]
            jobs = found[::-1]  # the oldest first
        elif event.kind == "job" and (event.data["id"] in waiting or not chosen):
            jobs = [event.data]
        else:
            continue
        update_all(jobs)
        while waiting and all(job_id in behind and is_over(behind[job_id]) for job_id in waiting):
            time.sleep(retry_s)
            update_all(())
        if artifacts and (any(map(is_over, jobs)) or event.kind == "ready"):
            for policy, name in patiently(partial(_registered, client)):
                attempt(name, partial(_copy_versions, client, mirror, chosen, note, policy, name))
        if chosen and not waiting:
            return


def _passes(error: Exception) -> bool:
    """Return whether an error may pass: one of a tracking system, or of a service that is unavailable."""
    if isinstance(error, ApiError):
        return error.status == 429 or error.status >= 500
    return not isinstance(error, CliError) or error.code is ExitCode.UNREACHABLE


def _attach_artifacts(client: Client, job: Json, copy: Copy, note: Callable[[str], None]) -> None:
    """Attach a job's newest checkpoint and its evaluation to its copy; files that are gone or damaged are left out."""
    points = client.every(f"/jobs/{job['id']}/checkpoints")
    newest = max(points, key=lambda point: (point["step"], point["attempt"]), default=None)
    found = [(checkpoint_folder(newest["step"]), newest)] if newest else []
    if evaluation := job_evaluation(client, job["id"]):
        found.append((EVALUATION, evaluation))
    for name, artifact in found:
        with tempfile.TemporaryDirectory(prefix="naoctl-mirror-") as temporary:
            folder = Path(temporary) / name
            try:
                _download(client, artifact, folder)
            except CliError as error:
                if _passes(error):
                    raise
                note(f"{job['id']}: {name} is not copied: {error}")
            else:
                copy.attach(folder)


def _registered(client: Client) -> list[tuple[Json, str]]:
    """Return the registered policies with the names of their copies."""
    by_name: dict[str, list[Json]] = defaultdict(list)
    for policy in client.every("/policies"):
        if policy["owner"] is not None:
            by_name[policy["name"]].append(policy)
    # An admin sees the policies of all owners, among which may be two of one name.
    return [
        (policy, name if len(policies) == 1 else f"{policy['owner']}.{name}")
        for name, policies in by_name.items()
        for policy in policies
    ]


def _copy_versions(
    client: Client,
    mirror: DownloadMirror,
    chosen: Collection[str],
    note: Callable[[str], None],
    policy: Json,
    name: str,
) -> None:
    """Copy the versions of a policy, and their aliases, that differ from the tracking system's, under `name`."""
    known = mirror.registered(name)
    for card in client.every(f"{policy_path(policy['name'])}/versions", owner=policy["owner"])[::-1]:  # oldest first
        card["aliases"] = sorted(alias for alias in card["aliases"] if alias != "latest")
        same = card["reference"] in known and sorted(known[card["reference"]]) == card["aliases"]
        if same or (chosen and card["job_id"] not in chosen):
            continue
        with tempfile.TemporaryDirectory(prefix="naoctl-mirror-") as temporary:
            try:
                checkpoint = client.get(f"/checkpoints/{card['checkpoint_id']}")
                folder = Path(temporary) / checkpoint_folder(checkpoint["step"])
                _download(client, checkpoint, folder)
            except CliError as error:
                if _passes(error):
                    raise
                note(f"{card['reference']} is not copied: {error}")
                continue
            if mirror.register(card, name, folder):
                note(f"{card['reference']}: registered as {name}")


def _download(client: Client, artifact: Json, folder: Path) -> None:
    for file in artifact["files"]:
        fetch(client, RemoteFile(file["name"], file["url"], file["size"], file["sha256"]), folder)


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
