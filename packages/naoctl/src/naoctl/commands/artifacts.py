"""Commands for the artifacts of a job: ``checkpoints``, ``download``, ``report``, ``export``, ``eval``."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from naospec import EvaluationSpec
from naospec.flags import parse_flags, read_value
from naospec.flat import as_chosen
from pydantic.fields import FieldInfo
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from naoctl.client import Client
from naoctl.commands.submit import (
    EVAL_PREFIX,
    EVALUATION_SETTINGS,
    KeyOption,
    NotBeforeOption,
    TagOption,
    common_fields,
    hand_in,
)
from naoctl.context import Context, JsonFlag, complete_job, context_of, find_checkpoint, find_job, stdin_is_terminal
from naoctl.descriptions import section_name
from naoctl.errors import CliError, ExitCode, InvalidInput
from naoctl.evaluations import headline, job_evaluation
from naoctl.follow import ENDED
from naoctl.help import SettingsCommand
from naoctl.policies import Trained, checkpoint_folder, find_trained, folder_name
from naoctl.render import ago, cell, listing, pairs, size, stall_text, state_text, waiting_text
from naoctl.specflags import build, spec_parameters, training_settings, with_parameters
from naoctl.transfer import RemoteFile, fetch

REPORT_PAGE = "report.html"
"""Name of a report's page."""
MAX_POINTS = 5_000
"""Maximum number of rows of metrics in one response."""
EXIT_CODES = {"failed": ExitCode.JOB_FAILED, "cancelled": ExitCode.JOB_CANCELLED}
"""Exit codes for states of an evaluation."""
POLL_S = 0.5
"""Seconds between two requests for a running evaluation."""
CheckpointOption = Annotated[
    str | None,
    typer.Option("--checkpoint", "-c", metavar="ID|STEP", help="Checkpoint to use (default: the newest)."),
]
OutputOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FOLDER", help="Output folder (default: named after the job)."),
]
Conditions = Annotated[
    list[str] | None,
    typer.Option("--with", metavar="NAME=VALUE", help="Setting of the task, such as friction_min=0.6; repeatable."),
]
Job = Annotated[
    str, typer.Argument(metavar="JOB", help="A job's id, its name, or `last`.", autocompletion=complete_job)
]
JobOrPolicy = Annotated[
    str,
    typer.Argument(
        metavar="JOB|POLICY",
        help="A job's id, its name, or `last`; or a policy: NAME, NAME@VERSION, NAME@ALIAS.",
        autocompletion=complete_job,
    ),
]


class What(StrEnum):
    """Artifacts to download."""

    ALL = "all"
    """Everything below; an evaluation that does not exist yet is no error then."""
    CHECKPOINT = "checkpoint"
    EVALUATION = "evaluation"
    METRICS = "metrics"


def download(
    ctx: typer.Context,
    job: JobOrPolicy = "last",
    what: Annotated[What, typer.Option("--what", help="Which artifacts.")] = What.ALL,
    checkpoint: CheckpointOption = None,
    output: OutputOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Download the checkpoint, evaluation and metrics of a job or a policy, and check the SHA-256 of every file.

    Complete files are not downloaded again; an interrupted download resumes.
    """
    context = context_of(ctx)
    with context.client() as client:
        found = find_trained(client, job)
        folder = output or Path(found.folder)
        chosen: list[tuple[str, Path, dict[str, Any]]] = []
        if what in (What.ALL, What.CHECKPOINT):
            chosen.append(choose_files(client, found, checkpoint, folder))
        if what in (What.ALL, What.EVALUATION):
            evaluated = _evaluation_of(client, found)
            if evaluated:
                chosen.append(("evaluation", folder / "evaluation", evaluated))
            elif what is What.EVALUATION:
                raise CliError(
                    f"{job} has no finished evaluation",
                    fix=f"Start one with `naoctl eval {job}`.",
                    code=ExitCode.NOT_FOUND,
                )
        fetched = fetch_artifacts(context, client, chosen, quiet=as_json)
        if found.job is not None and what in (What.ALL, What.METRICS):
            fetched.append(write_metrics(client, found.job["id"], folder / "metrics.jsonl"))
    if as_json:
        context.json(fetched)
        return
    for item in fetched:
        checked = ", SHA-256 verified" if item["kind"] != "metrics" else ""
        context.say(item["kind"].capitalize(), f"{item['path']} ({size(item['size'])}{checked})")


def choose_files(
    client: Client, found: Trained, checkpoint: str | None, folder: Path
) -> tuple[str, Path, dict[str, Any]]:
    """Return a job's checkpoint or that of a policy for `fetch_artifacts`, in its folder below `folder`.

    Raises:
        CliError: if there is none, or if one is named for a policy.
    """
    if found.policy is None:
        assert found.job is not None
        point = find_checkpoint(client, found.job, checkpoint)
        return "checkpoint", folder / checkpoint_folder(point["step"]), point
    if checkpoint is not None:
        raise InvalidInput(
            "--checkpoint: a policy has one checkpoint", fix=f"Leave it out, or use {found.policy['name']}@VERSION."
        )
    files = {"id": found.policy["checkpoint_id"] or found.policy["name"], "files": found.policy["files"]}
    return "checkpoint", folder / "checkpoint", files


def _evaluation_of(client: Client, found: Trained) -> dict[str, Any] | None:
    if found.policy is None:
        assert found.job is not None
        return job_evaluation(client, found.job["id"])
    identifier = found.policy["evaluation_id"]
    evaluation: dict[str, Any] | None = client.get(f"/evaluations/{identifier}") if identifier else None
    return evaluation


def fetch_artifacts(
    context: Context, client: Client, chosen: list[tuple[str, Path, dict[str, Any]]], *, quiet: bool = False
) -> list[dict[str, Any]]:
    """Download artifacts, each with its kind, into their folders and return where they lie.

    Args:
        context: for the progress bar.
        client: the service.
        chosen: kind, folder and the artifact as the service shows it (``id`` and ``files``).
        quiet: show no progress.
    """
    fetched = []
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=context.err, disable=quiet or not context.err.is_terminal, transient=True) as bar:
        for kind, folder, artifact in chosen:
            paths = []
            for file in artifact["files"]:
                remote = RemoteFile(file["name"], file["url"], file["size"], file["sha256"])
                task = bar.add_task(remote.name, total=remote.size)
                paths.append(str(fetch(client, remote, folder, progress=_advance(bar, task))))
            total = sum(file["size"] for file in artifact["files"])
            fetched.append({"kind": kind, "id": artifact["id"], "path": str(folder), "size": total, "files": paths})
    return fetched


def write_metrics(client: Client, job_id: str, path: Path) -> dict[str, Any]:
    """Write a job's metrics as one JSON object a line, as a training without the service does; return what was written.

    Trainings of more than five thousand updates arrive thinned out.
    """
    columns = client.get(f"/jobs/{job_id}/metrics", max_points=MAX_POINTS)["columns"]
    lines = []
    for values in zip(*columns.values(), strict=True):
        row = {name: value for name, value in zip(columns, values, strict=True) if value is not None}
        lines.append(json.dumps(row) + "\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "".join(lines)
    path.write_text(text, encoding="utf-8")
    return {"kind": "metrics", "id": job_id, "path": str(path), "size": len(text.encode()), "files": [str(path)]}


def report(
    ctx: typer.Context,
    job: Job = "last",
    output: OutputOption = None,
    film: Annotated[
        bool | None,
        typer.Option(
            "--film/--no-film",
            help="Make the page here, with or without the film.",
            show_default="the service's page; else with film",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write a page with curves, results and a film of a job's policy.

    Uses the page that the service made, if there is one. Otherwise makes it here, which needs PyTorch.
    """
    context = context_of(ctx)
    with context.client() as client:
        found = find_job(client, job)
        evaluated = job_evaluation(client, found["id"])
        if evaluated is None:
            raise CliError(
                f"Job {found['id']} has no finished evaluation",
                fix=f"Start one with `naoctl eval {found['id']}`.",
                code=ExitCode.NOT_FOUND,
            )
        folder = output or Path(folder_name(found))
        fetch_artifacts(context, client, [("evaluation", folder / "evaluation", evaluated)], quiet=as_json)
        if film is None and any(file["name"] == REPORT_PAGE for file in evaluated["files"]):
            page = folder / "report" / REPORT_PAGE
            page.parent.mkdir(exist_ok=True)
            shutil.copyfile(folder / "evaluation" / REPORT_PAGE, page)  # all it shows is in it
        else:
            write_metrics(client, found["id"], folder / "metrics.jsonl")
            page = write_report(folder, title=found["name"], film=film is not False)
    if as_json:
        context.json({"page": str(page)})
    else:
        context.say("Report", str(page))


def write_report(folder: Path, *, title: str, film: bool = True) -> Path:
    """Write a report from the ``evaluation`` and ``metrics.jsonl`` in a folder and return the path of its page.

    Raises:
        CliError: when naosprint cannot run here or refuses.
    """
    charset = sys.getfilesystemencoding()
    title = title.encode(charset, "replace").decode(charset)
    arguments = [str(folder / "evaluation"), str(folder / "report"), "--title", title]
    if (folder / "metrics.jsonl").stat().st_size:
        arguments += ["--metrics", str(folder / "metrics.jsonl")]
    run_naosprint("report", *arguments, *([] if film else ["--no-film"]))
    return folder / "report" / REPORT_PAGE


EXPORT_FORMATS = ("numpy", "onnx", "c", "skill")
ExportFormats = Annotated[
    list[str] | None,
    typer.Option(
        "--format",
        "-f",
        metavar="|".join(EXPORT_FORMATS),
        help="Format of the policy; may be repeated.",
        show_default="all that the robot has",
        autocompletion=lambda: list(EXPORT_FORMATS),
    ),
]


ExportName = Annotated[
    str | None,
    typer.Option(
        "--name", help="Name of the files, of all that the C header defines, and of the skill.", show_default="policy"
    ),
]


def export(
    ctx: typer.Context,
    job: JobOrPolicy = "last",
    checkpoint: CheckpointOption = None,
    output: OutputOption = None,
    formats: ExportFormats = None,
    name: ExportName = None,
    as_json: JsonFlag = False,
) -> None:
    """Export a policy for NumPy, as ONNX, as a C header, and as a skill for team code. Needs PyTorch."""
    context = context_of(ctx)
    flags = export_flags(formats, name)
    with context.client() as client:
        found = find_trained(client, job)
        folder = output or Path(found.folder)
        chosen = choose_files(client, found, checkpoint, folder)
        fetch_artifacts(context, client, [chosen], quiet=as_json)
    source = chosen[1]
    target = folder / source.name.replace("checkpoint", "export")
    run_naosprint("export", str(source), str(target), *flags)
    files = sorted(str(path) for path in target.iterdir())
    if as_json:
        context.json({"path": str(target), "files": files})
    else:
        context.say("Export", str(target))


def export_flags(formats: list[str] | None, name: str | None) -> list[str]:
    """Return the flags of ``naosprint export``. Raises InvalidInput for an unknown format."""
    words = []
    for each in formats or []:
        if each not in EXPORT_FORMATS:
            raise InvalidInput(f"--format: unknown format {each!r}", fix=f"Choose from {', '.join(EXPORT_FORMATS)}.")
        words += ["--format", each]
    return [*words, *(("--name", name) if name else ())]


def run_naosprint(*words: str) -> str:
    """Run ``python -m naosprint`` and return what it printed.

    A process of its own: the command line itself stays light and never imports PyTorch.

    Raises:
        CliError: when naosprint cannot run here, or with its last words when it fails.
    """
    if importlib.util.find_spec("torch") is None:
        raise CliError(
            "PyTorch is not installed here", fix="Install naosprint[train], or run this where it is installed."
        )
    command = [sys.executable, "-P", "-m", "naosprint", *words]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(
        command, check=False, capture_output=True, encoding="utf-8", errors="replace", env=environment
    )
    if done.returncode:
        last = done.stderr.strip().splitlines()
        raise CliError(f"naosprint {words[0]} failed: {last[-1] if last else f'exit code {done.returncode}'}")
    for line in done.stderr.splitlines():
        if line.startswith("warning: "):
            sys.stderr.write(f"{line}\n")
    return done.stdout


def _advance(bar: Progress, task: TaskID) -> Callable[[int], None]:
    return lambda done: bar.update(task, completed=done)


def checkpoints(ctx: typer.Context, job: Job = "last", as_json: JsonFlag = False) -> None:
    """List a job's checkpoints."""
    context = context_of(ctx)
    with context.client() as client:
        points = client.every(f"/jobs/{find_job(client, job)['id']}/checkpoints")
    if as_json:
        context.json(points)
        return
    table = listing("ID", "Step", "Size", "Saved")
    for point in sorted(points, key=lambda p: p["step"]):
        table.add_row(point["id"], f"{point['step']:,}", size(point["size"]), ago(point["created_at"]))
    context.out.print(table if points else "No checkpoint yet.")


class ReportKind(StrEnum):
    """Report that a worker draws with an evaluation."""

    FILM = "film"
    PICTURES = "pictures"
    OFF = "off"


def evaluate(
    ctx: typer.Context,
    job: JobOrPolicy = "last",
    checkpoint: CheckpointOption = None,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait for the results.")] = True,
    time_limit: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=1, help="Time limit of the evaluation.", show_default="6 hours"),
    ] = None,
    report_kind: Annotated[
        ReportKind | None,
        typer.Option("--report", help="Have the worker draw a report with it.", show_default="as the worker is set to"),
    ] = None,
    tag: TagOption = None,
    priority: Annotated[
        int | None,
        typer.Option(
            metavar="0-9", min=0, max=9, help="Work of higher priority starts first.", show_default="the job's"
        ),
    ] = None,
    not_before: NotBeforeOption = None,
    key: KeyOption = None,
    show: Annotated[bool, typer.Option("--list", help="List the job's evaluations instead.")] = False,
    conditions: Conditions = None,
    as_json: JsonFlag = False,
    evaluation: dict[str, Any] = {},  # noqa: B006 - filled by with_parameters
) -> None:
    """Evaluate a job's policy and show the results.

    Ctrl-C offers to cancel the evaluation.
    """
    context = context_of(ctx)
    with context.client() as client:
        trained = find_trained(client, job)
        found = trained.job
        if found is None:
            raise InvalidInput(
                f"{job} is a bundled policy, which the service does not evaluate",
                fix=f"`naoctl policies evaluate {job}` evaluates it on this machine.",
            )
        if show:
            _list_evaluations(context, client.every(f"/jobs/{found['id']}/evaluations"), as_json=as_json)
            return
        body = common_fields(context, tag, priority, not_before)
        body |= {} if time_limit is None else {"time_limit_s": time_limit}
        body |= {} if report_kind is None else {"report": report_kind.value}
        if checkpoint is not None or trained.policy is not None:
            body["checkpoint_id"] = choose_files(client, trained, checkpoint, Path())[2]["id"]
        if evaluation:
            values = parse_flags(EVALUATION_SETTINGS, evaluation, prefix=EVAL_PREFIX)
            from_flags = {name: EVALUATION_SETTINGS[name] for name in values}
            body["spec"] = build(EvaluationSpec, values, from_flags=from_flags).model_dump(mode="json")
        if conditions:
            name = last_task(found["spec"])
            body["spec"] = {**body.get("spec", {}), "task": {"name": name, **condition_values(conditions, name)}}
        asked = hand_in(client, f"/jobs/{found['id']}/evaluations", body, key)
        if wait:
            try:
                asked = await_evaluation(client, asked, context.note)
            except KeyboardInterrupt:
                _interrupted(client, asked)
    if as_json:
        context.json(asked)
    else:
        show_evaluation(context, asked)
    if asked["state"] in EXIT_CODES:
        raise typer.Exit(EXIT_CODES[asked["state"]])


def condition_values(conditions: Sequence[str] | None, task: str = "") -> dict[str, Any]:
    """Return settings of a task by name, read as their flags are; those of tasks that are only at the service, as JSON.

    Raises:
        InvalidInput: if one is not NAME=VALUE.
    """
    settings = as_chosen(training_settings(), {"task": task} if task else {}).values()
    known = {setting.path[1]: setting.info for setting in settings if setting.path[0] == "task"}
    found: dict[str, Any] = {}
    for text in conditions or ():
        name, sign, value = text.partition("=")
        if not sign or not name:
            raise InvalidInput(f"--with: {text!r} is not NAME=VALUE", fix="Write for example --with friction_min=0.6.")
        found[name] = read_value(value, known.get(name, FieldInfo(annotation=Any)))
    return found


def last_task(spec: Mapping[str, Any]) -> str:
    """Return the name of the task of a specification's last stage."""
    stages = [stage.get("task") or {} for stage in spec.get("stages") or []]
    return next((stage["name"] for stage in reversed(stages) if stage.get("name")), section_name(spec, "task"))


def _interrupted(client: Client, evaluation: dict[str, Any]) -> NoReturn:
    """Offer to cancel an evaluation that is waited for no longer.

    Raises:
        CliError: stating whether the evaluation continues.
    """
    name = evaluation["id"]
    try:
        wanted = stdin_is_terminal() and typer.confirm(f"\nCancel {name} too?", default=False, err=True)
    except (typer.Abort, KeyboardInterrupt):
        wanted = False
    if wanted:
        client.post(f"/evaluations/{name}/cancel")
        raise CliError(f"Cancel requested for {name}", code=ExitCode.INTERRUPTED)
    raise CliError(
        f"Stopped waiting; {name} continues",
        fix=f"`naoctl eval {evaluation['job_id']} --list` shows its state, `naoctl cancel {name}` cancels it.",
        code=ExitCode.INTERRUPTED,
    )


def await_evaluation(
    client: Client, evaluation: dict[str, Any], note: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Return an evaluation once it has ended; note why it waits for a worker, if it does."""
    noted = None
    while evaluation["state"] not in ENDED:
        if evaluation["waiting_reason"] not in (None, noted):
            noted = evaluation["waiting_reason"]
            note(f"Waiting: {waiting_text(evaluation)}")
        time.sleep(POLL_S)
        evaluation = client.get(f"/evaluations/{evaluation['id']}")
    return evaluation


def show_evaluation(context: Context, evaluation: dict[str, Any]) -> None:
    """Print an evaluation's main results; ``--json`` and the downloaded ``evaluation.json`` have all of them."""
    rows: list[tuple[str, Any]] = [
        ("Evaluation", evaluation["id"]),
        ("State", state_text(evaluation["state"])),
        (
            "Episodes",
            f"{evaluation['spec']['episodes']:,}, seed {evaluation['spec']['seed']};"
            f" {evaluation['spec']['confidence']:.0%} confidence intervals",
        ),
    ]
    rows += headline(evaluation.get("summary") or {}).items()
    if evaluation.get("waiting_reason"):
        rows.append(("Waiting", waiting_text(evaluation)))
    if evaluation.get("stalled_since"):
        rows.append(("Stalled", stall_text(evaluation)))
    if evaluation.get("error"):
        rows.append(("Error", cell(evaluation["error"])))
    context.out.print(pairs(rows))


def _list_evaluations(context: Context, evaluations: list[dict[str, Any]], *, as_json: bool) -> None:
    if as_json:
        context.json(evaluations)
        return
    table = listing("ID", "State", "Episodes", "Checkpoint", "Requested")
    for item in evaluations:
        table.add_row(
            item["id"],
            state_text(item["state"]),
            f"{item['spec']['episodes']:,}",
            item["checkpoint_id"],
            ago(item["created_at"]),
        )
    context.out.print(table if evaluations else "No evaluation yet.")


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for function in (checkpoints, download, report, export):
        app.command(function.__name__)(function)
    parameters = spec_parameters(EVALUATION_SETTINGS, panel="Evaluation", prefix=EVAL_PREFIX, flag_prefix="")
    app.command("eval", cls=SettingsCommand)(with_parameters(evaluate, {"evaluation": parameters}))
