"""``naoctl tune`` and ``naoctl study``: start, list, show and end searches for settings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import naopolicies
import typer
from naospec.flags import expanded, read_value
from naospec.flat import as_chosen
from naospec.search import SearchSpec
from pydantic import ValidationError

from naoctl.client import Client
from naoctl.commands.submit import (
    COMMON_EVALUATION_SETTINGS,
    COMMON_SETTINGS,
    EVAL_PREFIX,
    EVALUATION_SETTINGS,
    JobFile,
    KeyOption,
    NotBeforeOption,
    PriorityOption,
    RecipeOption,
    TagOption,
    common_fields,
    hand_in,
    make_job,
    start_of,
)
from naoctl.context import JsonFlag, complete_job, context_of, find_job, find_listed
from naoctl.errors import InvalidInput, plain
from naoctl.help import HelpAllFlag, SettingsCommand
from naoctl.render import MISSING, ago, cell, listing, pairs
from naoctl.specflags import spec_parameters, training_settings, with_parameters

app = typer.Typer(
    help="List, show, extend, cancel and delete studies; take and report trials that run elsewhere.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Reference = Annotated[str, typer.Argument(metavar="STUDY", help="A study's id, the end of it, its name, or `last`.")]

DIRECTIONS = {"max": "maximize", "min": "minimize", "maximize": "maximize", "minimize": "minimize"}
_SPACE_EXAMPLE = "For example --space learning_rate=1e-4..1e-2:log --space 'n_epochs=5|10'."


def tune(
    ctx: typer.Context,
    file: JobFile = None,
    recipe: RecipeOption = None,
    space: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=RANGE",
            help="Setting to vary: LOW..HIGH, with :log for a logarithmic scale, or A|B|C; may be repeated.",
        ),
    ] = None,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RESULT[:max|:min]",
            help="Result to optimize; may be repeated.",
            show_default="the task's most important",
        ),
    ] = None,
    trials: Annotated[int, typer.Option(min=1, max=1000, help="Number of trials.")] = 20,
    parallel: Annotated[int, typer.Option(min=1, max=64, help="Trials that may wait or run at a time.")] = 2,
    sampler: Annotated[str, typer.Option(metavar="tpe|random|population", help="How settings are chosen.")] = "tpe",
    population: Annotated[
        int, typer.Option(min=4, max=100, help="Trials of one generation of sampler population.")
    ] = 8,
    sampler_seed: Annotated[int, typer.Option(min=0, help="Seed of the sampler.")] = 0,
    prune: Annotated[
        str, typer.Option(metavar="none|median|asha", help="Rule that ends unpromising trials early.")
    ] = "none",
    prune_metric: Annotated[
        str | None, typer.Option(metavar="METRIC", help="Training metric that trials are compared by.")
    ] = None,
    parent: Annotated[
        str | None,
        typer.Option(
            "--from", metavar="JOB", help="Start all trials from this job's policy.", autocompletion=complete_job
        ),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            "--from-policy",
            metavar="POLICY",
            help="Start all trials from a bundled or registered policy: NAME, NAME@VERSION, NAME@ALIAS.",
            autocompletion=lambda: list(naopolicies.names()),
        ),
    ] = None,
    elsewhere: Annotated[
        bool,
        typer.Option("--elsewhere", help="Submit no jobs: `naoctl study ask` takes trials, which you run elsewhere."),
    ] = False,
    name: Annotated[str | None, typer.Option("--name", "-n", metavar="NAME", help="Name of the study.")] = None,
    tag: TagOption = None,
    priority: PriorityOption = None,
    not_before: NotBeforeOption = None,
    key: KeyOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the study; start nothing.")] = False,
    as_json: JsonFlag = False,
    help_all: HelpAllFlag = False,
    spec: dict[str, Any] = {},  # noqa: B006 - filled by with_parameters
    evaluation: dict[str, Any] = {},  # noqa: B006
) -> None:
    """Search for the best settings of a training.

    A study runs trials, which are ordinary jobs, and chooses the settings of each by the results of those before.
    """
    del help_all
    context = context_of(ctx)
    start = start_of(context, recipe, parent, policy)
    job = make_job(file, recipe, spec, evaluation, start=start, parent_policy=policy)
    job |= common_fields(context, tag, priority, not_before, file=job)
    search = make_search(
        space or [],
        objective or [],
        base=job["spec"],
        trials=trials,
        parallel=parallel,
        sampler=sampler,
        population=population,
        seed=sampler_seed,
        elsewhere=elsewhere,
        pruning={"name": prune, "metric": prune_metric},
    )
    body = {"job": job, "search": search, "name": name}
    if dry_run:
        context.json(body)
        return
    with context.client() as client:
        if parent:
            job["parent_job_id"] = find_job(client, parent)["id"]
        study = hand_in(client, "/studies", body, key)
    if as_json:
        context.json(study)
        return
    context.out.print(f"Started {study['id']} ({plain(study['name'])}): {trials} trials", markup=False)
    context.note(f"Look at it with: naoctl study show {study['id']}")


def make_search(
    space: list[str], objectives: list[str], *, base: Mapping[str, Any] | None = None, **others: Any
) -> dict[str, Any]:
    """Return the search of ``POST /studies``.

    Args:
        space: values of ``--space``.
        objectives: values of ``--objective``.
        base: specification of the trials, whose plug-ins decide how values are read.
        **others: the search's other fields.

    Raises:
        InvalidInput: naming the flag that is wrong.
    """
    if not space:
        raise InvalidInput("--space is missing", fix=_SPACE_EXAMPLE)
    known = training_settings()
    known = as_chosen({**known, **{".".join(setting.path): setting for setting in known.values()}}, base or {})
    chosen: dict[str, Any] = {}
    for entry in space:
        field, sign, text = entry.partition("=")
        field = field.strip().lstrip("-").replace("-", "_")
        if not sign or not text.strip():
            raise InvalidInput(f"--space {entry!r} is not FIELD=RANGE", fix=_SPACE_EXAMPLE)
        if field not in known:
            raise InvalidInput(f"--space: there is no setting {field}", fix="`naoctl spec` lists the settings.")
        if field in chosen:
            raise InvalidInput(f"--space: {field} is given twice", fix="Give it once.")
        chosen[field] = _parameter(field, text, known)
    goals = []
    for entry in objectives:
        metric, sign, direction = entry.partition(":")
        if sign and direction not in DIRECTIONS:
            raise InvalidInput(f"--objective {entry!r} ends in neither :max nor :min", fix="For example speed_mps:max.")
        goals.append({"metric": metric, "direction": DIRECTIONS[direction] if sign else None})
    try:
        return SearchSpec.model_validate({"space": chosen, "objectives": goals, **others}).model_dump(mode="json")
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"] if part not in ("float", "int", "choice"))
        message = first["msg"].removeprefix("Value error, ")
        raise InvalidInput(f"{place}: {message}" if place else message, fix="Change the flag.") from None


def _parameter(field: str, text: str, known: dict[str, Any]) -> dict[str, Any]:
    if ".." in text:
        limits, _, scale = text.partition(":")
        if scale not in ("", "log"):
            raise InvalidInput(f"--space {field}: unknown scale {scale!r}", fix="Use :log or leave it out.")
        try:
            low, high = (float(expanded(part.strip())) for part in limits.split(".."))
        except ValueError:
            raise InvalidInput(f"--space {field}={text} is not LOW..HIGH", fix=_SPACE_EXAMPLE) from None
        whole = "float" not in str(known[field].info.annotation)
        if whole and not (low.is_integer() and high.is_integer()):
            raise InvalidInput(f"--space {field}={text}: {field} is a whole number", fix="For example 5..20.")
        kind: Any = int if whole else float
        return {"type": kind.__name__, "low": kind(low), "high": kind(high), "log": scale == "log"}
    values = [read_value(item, known[field].info) for item in text.split("|") if item.strip()]
    if len(values) < 2:
        raise InvalidInput(f"--space {field}={text} is neither LOW..HIGH nor A|B", fix=_SPACE_EXAMPLE)
    return {"type": "choice", "choices": values}


def find_study(client: Client, reference: str) -> dict[str, Any]:
    """Return a study with its trials by what a user typed. Raises CliError."""
    return find_listed(client, "/studies", "study", reference)


@app.command("list")
def list_studies(
    ctx: typer.Context,
    limit: Annotated[int, typer.Option("--limit", "-l", min=1, max=1000, help="Most studies to show.")] = 20,
    as_json: JsonFlag = False,
) -> None:
    """List studies, the newest first."""
    context = context_of(ctx)
    with context.client() as client:
        found = list(client.pages("/studies", limit=limit))
    if as_json:
        context.json(found)
        return
    table = listing("ID", "Name", "State", "Trials", "Started")
    for study in found:
        table.add_row(
            study["id"],
            cell(study["name"]),
            study["state"],
            str(study["spec"]["trials"]),
            ago(study["created_at"]),
        )
    context.out.print(table if found else "No studies yet. Start one with `naoctl tune`.")


@app.command("show")
def show_study(ctx: typer.Context, study: Reference = "last", as_json: JsonFlag = False) -> None:
    """Show a study: its trials, the best first, and the importance of the settings."""
    context = context_of(ctx)
    with context.client() as client:
        found = find_study(client, study)
    if as_json:
        context.json(found)
        return
    goals = found["spec"]["objectives"]
    ended = sum(trial["state"] != "running" for trial in found["trials"])
    rows: list[tuple[str, Any]] = [
        ("Study", cell(f"{found['name']} ({found['id']})")),
        ("State", found["state"]),
        ("Trials", f"{ended} of {found['spec']['trials']} ended"),
        ("Objectives", ", ".join(f"{goal['direction']} {goal['metric']}" for goal in goals)),
    ]
    for metric, shares in found["importance"].items():
        rows.append((f"Matters for {metric}", ", ".join(f"{name} {share:.0%}" for name, share in shares.items())))
    if found["error"]:
        rows.append(("Error", cell(found["error"])))
    context.out.print(pairs(rows))
    table = listing("", "Trial", "State")
    for goal in goals:
        table.add_column(goal["metric"], justify="right")
    for name in found["spec"]["space"]:
        table.add_column(name, justify="right")
    table.add_column("Job")
    factor = -1.0 if goals[0]["direction"] == "maximize" else 1.0

    def rank(trial: dict[str, Any]) -> tuple[bool, float, int]:
        values = trial["values"]
        return values is None, factor * values[0] if values else 0.0, trial["number"]

    for trial in sorted(found["trials"], key=rank):
        values = trial["values"] or [None] * len(goals)
        table.add_row(
            "*" if trial["number"] in found["best"] else "",
            str(trial["number"]),
            trial["state"],
            *(MISSING if value is None else f"{value:.4g}" for value in values),
            *(_short(trial["params"].get(name)) for name in found["spec"]["space"]),
            trial["job_id"] or MISSING,
        )
    if found["trials"]:
        context.out.print(table)
        context.note("* the best" if len(goals) == 1 else "* no other trial is better in all objectives")


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


@app.command("extend")
def extend_study(
    ctx: typer.Context,
    study: Reference,
    trials: Annotated[int, typer.Option(min=1, max=1000, help="Number of trials in all.")],
    as_json: JsonFlag = False,
) -> None:
    """Give a study more trials; one that has ended runs again."""
    context = context_of(ctx)
    with context.client() as client:
        found = client.post(f"/studies/{find_study(client, study)['id']}/extend", {"trials": trials})
    if as_json:
        context.json(found)
    else:
        context.out.print(f"{found['id']}: {found['state']}, {trials} trials", markup=False)


@app.command("ask")
def ask_for_trial(
    ctx: typer.Context,
    study: Reference,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write the training as a job file.", dir_okay=False),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Take a trial of a study started with `naoctl tune --elsewhere`.

    `naosprint train --spec FILE` runs the training that it stands for, on a machine without a worker.
    """
    context = context_of(ctx)
    with context.client() as client:
        trial = client.post(f"/studies/{find_study(client, study)['id']}/ask")
    if output:
        output.write_text(json.dumps({"spec": trial["spec"]}, indent=2) + "\n", encoding="utf-8")
    if as_json:
        context.json(trial)
        return
    context.out.print(f"Trial {trial['number']}", markup=False)
    context.out.print(pairs([(name, _short(value)) for name, value in trial["params"].items()]))
    context.note(f"Report its values with: naoctl study tell {study} {trial['number']} VALUE")


@app.command("tell", context_settings={"ignore_unknown_options": True})  # values can be negative
def tell_trial(
    ctx: typer.Context,
    study: Reference,
    number: Annotated[int, typer.Argument(metavar="TRIAL", min=0, help="Number of the trial.")],
    values: Annotated[
        list[float] | None, typer.Argument(metavar="[VALUE...]", help="Values, in the order of the objectives.")
    ] = None,
    error: Annotated[
        str | None, typer.Option("--failed", metavar="REASON", help="It has no values, for this reason.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Report the values of a trial that has run elsewhere."""
    context = context_of(ctx)
    if bool(values) == bool(error):
        raise InvalidInput("Expected the values of the trial, or --failed REASON", fix="Give one of them.")
    if values and not all(map(math.isfinite, values)):
        raise InvalidInput("VALUE: expected finite numbers", fix="Report a trial without a value with --failed REASON.")
    with context.client() as client:
        path = f"/studies/{find_study(client, study)['id']}/trials/{number}/tell"
        trial = client.post(path, {"error": error} if error else {"values": values})
    if as_json:
        context.json(trial)
    else:
        context.out.print(f"Trial {number}: reported", markup=False)


@app.command("cancel")
def cancel_study(ctx: typer.Context, study: Reference, as_json: JsonFlag = False) -> None:
    """Cancel a study and its open jobs."""
    context = context_of(ctx)
    with context.client() as client:
        found = client.post(f"/studies/{find_study(client, study)['id']}/cancel")
    if as_json:
        context.json(found)
    else:
        context.out.print(f"{found['id']}: {found['state']}", markup=False)


@app.command("delete")
def delete_study(ctx: typer.Context, study: Reference, as_json: JsonFlag = False) -> None:
    """Delete a study that has ended; its jobs stay."""
    context = context_of(ctx)
    with context.client() as client:
        found = find_study(client, study)
        client.request("DELETE", f"/studies/{found['id']}")
    if as_json:
        context.json({"deleted": found["id"]})
        return
    context.out.print(f"Deleted {found['id']}; its jobs stay", markup=False)


def register(application: typer.Typer) -> None:
    """Add the commands, ``tune`` with one flag per setting of the specifications."""
    training = spec_parameters(training_settings(), panel="Training", shown=COMMON_SETTINGS)
    evaluation = spec_parameters(
        EVALUATION_SETTINGS, panel="Evaluation", prefix=EVAL_PREFIX, shown=COMMON_EVALUATION_SETTINGS
    )
    application.command("tune", cls=SettingsCommand)(
        with_parameters(tune, {"spec": training, "evaluation": evaluation})
    )
    application.add_typer(app, name="study")
