"""Commands that show and control jobs: list, status, cancel, pause, resume, retry, edit, delete, compare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer
from naospec import TrainingSpec, flat, plugins, read_stored
from naospec.metrics import PROGRESS
from rich.table import Table

from naoctl.commands.artifacts import await_evaluation
from naoctl.context import (
    Context,
    JsonFlag,
    complete_job,
    completions,
    context_of,
    find_job,
    find_listed,
    stdin_is_terminal,
)
from naoctl.descriptions import Descriptions, common, section_name, value_text
from naoctl.errors import InvalidInput, plain
from naoctl.evaluations import TRAINING_MARK, TRAINING_NOTE, headline, job_evaluation
from naoctl.follow import ENDED, follow
from naoctl.render import (
    COLUMNS,
    MISSING,
    cell,
    chosen_table,
    job_details,
    jobs_table,
    listing,
    state_text,
    terminal_json,
    value_of,
)

STATES = ("queued", "starting", "running", "pausing", "paused", "evaluating", "succeeded", "failed", "cancelled")
Jobs = Annotated[
    list[str], typer.Argument(metavar="JOB...", help="Ids or names of jobs, or `last`.", autocompletion=complete_job)
]
EVALUATION_PREFIX = "eval_"
"""Beginning of an evaluation's id."""
WaitFlag = Annotated[bool, typer.Option("--wait", help="Return when it has happened, not when it is requested.")]


def _complete_state(incomplete: str) -> list[str]:
    return completions(STATES, incomplete)


def list_jobs(
    ctx: typer.Context,
    state: Annotated[
        list[str] | None,
        typer.Option(
            "--state", "-s", metavar="STATE", help="Only these; may be repeated.", autocompletion=_complete_state
        ),
    ] = None,
    tag: Annotated[
        list[str] | None, typer.Option("--tag", "-t", help="Only those with this tag; may be repeated.")
    ] = None,
    owner: Annotated[str | None, typer.Option(help="Only this owner's.")] = None,
    group: Annotated[str | None, typer.Option(metavar="ID", help="Only those of this sweep.")] = None,
    study: Annotated[str | None, typer.Option(metavar="STUDY", help="Only the trials of this study.")] = None,
    task: Annotated[str | None, typer.Option(help="Only those of this task.")] = None,
    robot: Annotated[str | None, typer.Option(help="Only those of this robot.")] = None,
    query: Annotated[str | None, typer.Option("--query", "-q", help="Only those whose name contains this.")] = None,
    columns: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Columns to show: fields such as id, name, state, task, robot; settings such as algorithm.gamma; "
            "results and metrics such as speed_mps.",
        ),
    ] = None,
    sort: Annotated[
        str | None, typer.Option(metavar="NAME", help="Sort by this column; -NAME sorts from high to low.")
    ] = None,
    limit: Annotated[int, typer.Option("--limit", "-l", min=1, max=10_000, help="Most jobs to show.")] = 20,
    as_json: JsonFlag = False,
) -> None:
    """List jobs, the newest first."""
    context = context_of(ctx)
    names = [name.strip() for name in (columns or "").split(",") if name.strip()]
    for word in state or []:
        if word not in STATES:
            raise InvalidInput(f"--state: unknown state {word!r}", fix=f"Choose from {', '.join(STATES)}.")
    with context.client() as client:
        if study:
            group = find_listed(client, "/studies", "study", study)["id"]
        wanted: dict[str, Any] = {"owner": owner, "group": group, "task": task, "robot": robot, "q": query}
        wanted |= {"state": state or None, "tag": tag or None}
        # the first by a column can be any of them
        jobs = list(client.pages("/jobs", limit=MOST_SORTED if sort else limit, **wanted))
        descriptions = Descriptions(client)
        for flag, given in (("--columns", names), ("--sort", [sort.removeprefix("-")] if sort else [])):
            require_known(flag, given, jobs, descriptions)
        if sort:
            jobs = sorted_jobs(jobs, sort)[:limit]
        if as_json:
            table = None
        else:
            table = chosen_table(jobs, names) if names else jobs_table(jobs, descriptions, context.out.width)
    if table is None:
        context.json([{name: value_of(job, name) for name in names} for job in jobs] if names else jobs)
    elif jobs:
        context.out.print(table)
        if any(TRAINING_MARK in str(text) for column in table.columns[-1:] for text in column.cells):
            context.note(TRAINING_NOTE)
        if len(jobs) == limit:
            context.note(f"The {'first' if sort else 'newest'} {limit}; --limit shows more.")
    else:
        context.note("No jobs." if any(wanted.values()) else "No jobs yet. Submit one with `naoctl submit`.")


MOST_SORTED = 10_000
"""Most jobs of which ``--sort`` finds the first."""


def require_known(flag: str, names: list[str], jobs: list[dict[str, Any]], descriptions: Descriptions) -> None:
    """Check that names are fields, settings, or results and metrics of the jobs' tasks.

    Raises:
        InvalidInput: naming the first that is none.
    """
    tasks = [descriptions.task(name) for name in {section_name(job["spec"], "task") for job in jobs}]
    measured = {metric["name"] for task in tasks for part in ("results", "metrics") for metric in task.get(part, ())}
    known = {*COLUMNS, *measured, *(metric.name for metric in PROGRESS)}
    for name, setting in flat.settings().items():
        known |= {name, ".".join(setting.path)}
    for name in names:
        if jobs and name not in known and all(value_of(job, name) is None for job in jobs):
            raise InvalidInput(
                f"{flag}: none of these jobs has {name!r}",
                fix=f"Fields are {', '.join(COLUMNS)}; results and metrics are {', '.join(sorted(measured))}; "
                "`naoctl spec` lists settings.",
            )


def sorted_jobs(jobs: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """Return jobs by a column, those without it last; a minus before the name reverses the order."""
    key = name.removeprefix("-")
    having = [job for job in jobs if value_of(job, key) is not None]
    numeric = all(isinstance(value_of(job, key), int | float) for job in having)
    ordered = sorted(
        having,
        key=lambda job: value_of(job, key) if numeric else str(value_of(job, key)),
        reverse=name.startswith("-"),
    )
    return ordered + [job for job in jobs if job not in having]


def status(
    ctx: typer.Context,
    job: Annotated[
        str, typer.Argument(metavar="JOB", help="A job's id, its name, or `last`.", autocompletion=complete_job)
    ] = "last",
    field: Annotated[
        list[str] | None,
        typer.Option(
            "--field",
            metavar="NAME",
            help="Print this value only: a field, a setting such as algorithm.gamma, a result or a metric; may be "
            "repeated.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Show one job: state, progress, results, and its error."""
    context = context_of(ctx)
    with context.client() as client:
        found = find_job(client, job)
        metrics = [] if as_json or field else Descriptions(client).shown(found)
    values = {name: value_of(found, name) for name in field or ()}
    for name, value in values.items():
        if value is None and name not in found:
            raise InvalidInput(
                f"--field: the job has no {name!r}", fix="`naoctl status --json` shows its fields and settings."
            )
    if as_json:
        context.json(values if field else found)
    elif field:
        for value in values.values():
            context.out.print(plain(terminal_json(value) if isinstance(value, dict | list) else value), markup=False)
    else:
        context.out.print(job_details(found, metrics))


def _steer(
    context: Context, references: list[str], verb: str, done: str, *, as_json: bool, until: frozenset[str] | None = None
) -> None:
    changed = []
    with context.client() as client:
        for reference in references:
            if verb == "cancel" and reference.startswith(EVALUATION_PREFIX):
                job = client.post(f"/evaluations/{reference}/cancel")
                if until:
                    job = await_evaluation(client, job)
            else:
                job = client.post(f"/jobs/{find_job(client, reference)['id']}/{verb}")
            if until and job["state"] not in until:
                for update in follow(client, job):
                    job = update.job
                    if job["state"] in until:
                        break
            changed.append(job)
            if not as_json:
                pending = job["state"] not in (until or ENDED | {"paused", "queued"})
                context.out.print(f"{job['id']}: {done if pending else job['state']}", markup=False)
    if as_json:
        context.json(changed)


def cancel(
    ctx: typer.Context,
    work: Annotated[
        list[str],
        typer.Argument(
            metavar="JOB|EVALUATION...",
            help="Ids or names of jobs, `last`, or ids of evaluations.",
            autocompletion=complete_job,
        ),
    ],
    wait: WaitFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Cancel jobs or evaluations. What a job saved is kept, and `retry` queues it again."""
    _steer(context_of(ctx), work, "cancel", "cancel requested", as_json=as_json, until=ENDED if wait else None)


def pause(ctx: typer.Context, jobs: Jobs, wait: WaitFlag = False, as_json: JsonFlag = False) -> None:
    """Pause jobs: they save a checkpoint and free their worker."""
    until = ENDED | {"paused"} if wait else None
    _steer(context_of(ctx), jobs, "pause", "pause requested", as_json=as_json, until=until)


def resume(ctx: typer.Context, jobs: Jobs, as_json: JsonFlag = False) -> None:
    """Resume paused jobs from their last checkpoint."""
    _steer(context_of(ctx), jobs, "resume", "resumed", as_json=as_json)


def retry(ctx: typer.Context, jobs: Jobs, as_json: JsonFlag = False) -> None:
    """Queue failed or cancelled jobs again; they resume from their last checkpoint."""
    _steer(context_of(ctx), jobs, "retry", "queued", as_json=as_json)


def edit(
    ctx: typer.Context,
    job: Annotated[
        str, typer.Argument(metavar="JOB", help="A job's id, its name, or `last`.", autocompletion=complete_job)
    ],
    name: Annotated[str | None, typer.Option("--name", "-n", metavar="NAME", help="New name.")] = None,
    tag: Annotated[
        list[str] | None,
        typer.Option("--tag", "-t", metavar="TAG", help="Tags from now on; may be repeated, '' removes all."),
    ] = None,
    notes: Annotated[str | None, typer.Option(metavar="TEXT", help="Notes from now on.")] = None,
    priority: Annotated[
        int | None,
        typer.Option(metavar="0-9", min=0, max=9, help="Priority of a job that waits; a higher one starts first."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Change a job's name, tags, notes or priority. What is left out stays as it is."""
    context = context_of(ctx)
    tags = None if tag is None else [one for one in tag if one]
    given = {"name": name, "tags": tags, "notes": notes, "priority": priority}
    body = {field: value for field, value in given.items() if value is not None}
    if not body:
        raise InvalidInput("There is nothing to change", fix="Give --name, --tag, --notes or --priority.")
    with context.client() as client:
        changed = client.request("PATCH", f"/jobs/{find_job(client, job)['id']}", json_body=body)
    if as_json:
        context.json(changed)
    else:
        context.out.print(f"{changed['id']}: changed {' and '.join(body)}", markup=False)


def delete(
    ctx: typer.Context,
    jobs: Jobs,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Delete jobs that have ended, with their checkpoints, evaluations and metrics."""
    context = context_of(ctx)
    gone = []
    with context.client() as client:
        found = [find_job(client, reference) for reference in jobs]
        if not yes:
            if not stdin_is_terminal():
                raise InvalidInput(
                    "Deleting needs a confirmation, and standard input is not a terminal", fix="Add --yes."
                )
            typer.confirm(f"Delete {', '.join(plain(job['name']) for job in found)} and all they saved?", abort=True)
        for job in found:
            client.request("DELETE", f"/jobs/{job['id']}")
            gone.append(job["id"])
            if not as_json:
                context.out.print(f"{job['id']}: deleted", markup=False)
    if as_json:
        context.json(gone)


def compare(
    ctx: typer.Context,
    jobs: Annotated[
        list[str], typer.Argument(metavar="JOB JOB...", help="Two or more jobs.", autocompletion=complete_job)
    ],
    as_json: JsonFlag = False,
) -> None:
    """Compare jobs: the settings that differ, and the results."""
    context = context_of(ctx)
    if len(jobs) < 2:
        raise InvalidInput("compare needs two jobs or more", fix="Name another job.")
    with context.client() as client:
        found = [find_job(client, reference) for reference in jobs]
        evaluations = [job_evaluation(client, job["id"]) or {} for job in found]
        summaries = [evaluation.get("summary") for evaluation in evaluations]
        descriptions = Descriptions(client)
        metrics = common([descriptions.shown(job) for job in found])
    if len({job["id"] for job in found}) < len(found):
        raise InvalidInput("The same job is named twice", fix="`naoctl list` shows their ids.")
    specs = [settings_of(job["spec"]) for job in found]
    paths = dict.fromkeys(path for spec in specs for path in spec)
    differing = [path for path in paths if len({str(spec.get(path)) for spec in specs}) > 1]
    if as_json:
        context.json(
            [
                {
                    "id": job["id"],
                    "name": job["name"],
                    "state": job["state"],
                    "spec": {path: spec[path] for path in differing if path in spec},
                    "latest_metrics": job.get("latest_metrics") or {},
                    "evaluation_id": evaluation.get("id"),
                    "evaluation": evaluation.get("summary"),
                }
                for job, spec, evaluation in zip(found, specs, evaluations, strict=True)
            ]
        )
        return
    table = listing("")
    for job in found:
        table.add_column(cell(job["name"]), justify="right", overflow="fold")
    table.add_row("ID", *(job["id"] for job in found))
    table.add_row("State", *(state_text(job["state"]) for job in found))
    table.add_row("Steps", *(f"{job['progress_step']:,}" for job in found))
    add_settings(table, specs, differing)
    results = [headline(summary or {}) for summary in summaries]
    names = dict.fromkeys(name for result in results for name in result)
    if names:
        table.add_row("[bold]Evaluation[/bold]", *(evaluation.get("id", MISSING) for evaluation in evaluations))
        episodes = [(summary or {}).get("episodes") for summary in summaries]
        table.add_row("Episodes", *(MISSING if count is None else f"{count:,}" for count in episodes))
        for name in names:
            table.add_row(name, *(result.get(name, MISSING) for result in results))
    training = []
    for metric in metrics:
        cells = [value_text(metric, job.get("latest_metrics") or {}) for job in found]
        if any(text != MISSING for text in cells):
            training.append((metric.title, *cells))
    if training:
        table.add_row("[bold]In training[/bold]", *("" for _ in found))
        for row in training:
            table.add_row(*row)
    context.out.print(table)


def add_settings(table: Table, specs: Sequence[Mapping[str, Any]], differing: Sequence[str]) -> None:
    """Add a row for each setting that differs, and the number of those that only one of several has."""
    shared = [path for path in differing if sum(path in spec for spec in specs) > 1]
    for path in shared:
        table.add_row(path, *(cell(spec.get(path, MISSING)) for spec in specs))
    own = [sum(path in spec and path not in shared for path in differing) for spec in specs]
    if any(own):
        table.add_row("Settings of its own", *(f"{count:,}" if count else MISSING for count in own))


def settings_of(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored specification's settings by path, with the defaults of those that an older version lacked."""
    try:
        return flattened(read_stored(TrainingSpec, spec).model_dump(mode="json"))
    except (ValueError, plugins.BrokenPluginError):  # of plug-ins that are not installed here
        return flattened(spec)


def flattened(value: Any, path: str = "") -> dict[str, Any]:
    """Return a stored specification by path with dots: ``{"algorithm.learning_rate": 0.0005}``."""
    if not isinstance(value, dict):
        return {path: value}
    found: dict[str, Any] = {}
    for key, item in value.items():
        found |= flattened(item, f"{path}.{key}" if path else key)
    return found


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("list")(list_jobs)
    app.command("status")(status)
    for function in (cancel, pause, resume, retry, edit, delete, compare):
        app.command(function.__name__)(function)
