"""``naoctl watch`` and ``naoctl logs``: follow a job live."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Annotated, Any

import typer
from rich.live import Live

from naoctl.client import Client
from naoctl.context import Context, JsonFlag, complete_job, context_of, find_job
from naoctl.descriptions import Descriptions, value_text
from naoctl.errors import CliError, ExitCode, plain
from naoctl.evaluations import evaluated, headline, shown_result
from naoctl.follow import follow, is_over, result_of
from naoctl.render import Curve, clock, duration, live_view, print_json_line, progress_line, stall_text, waiting_text

LINE_EVERY_S = 5.0
"""Seconds between two lines of progress where there is no terminal."""
LEVEL_STYLE = {"warning": "yellow", "error": "red", "critical": "red", "debug": "bright_black", "event": "cyan"}


def watch(
    ctx: typer.Context,
    job: Annotated[
        str, typer.Argument(metavar="JOB", help="A job's id, its name, or `last`.", autocompletion=complete_job)
    ] = "last",
    as_json: JsonFlag = False,
) -> None:
    """Follow a job live until it ends; the exit code is its result.

    0 succeeded, 10 failed, 11 cancelled, 12 paused. Ctrl-C leaves the job running.
    """
    context = context_of(ctx)
    with context.client() as client:
        watch_job(context, client, find_job(client, job), as_json=as_json)


def watch_job(context: Context, client: Client, job: dict[str, Any], *, as_json: bool) -> None:
    """Show a job until it ends, then exit with its result unless it succeeded.

    Raises:
        typer.Exit: with the code of a job that did not succeed.
    """
    try:
        if as_json:
            last = _watch_json(context, client, job)
        elif context.out.is_terminal:
            last = _watch_live(context, client, job)
        else:
            last = _watch_lines(context, client, job)
    except KeyboardInterrupt:
        raise CliError(
            "Stopped watching; the job continues",
            fix=f"`naoctl watch {job['id']}` follows it again.",
            code=ExitCode.INTERRUPTED,
        ) from None
    code = result_of(last)
    if not as_json:
        say_result(context, last, Descriptions(client))
    if code:
        raise typer.Exit(code)


def say_result(context: Context, job: dict[str, Any], descriptions: Descriptions) -> None:
    """Print one line with a job's final state."""
    row = job.get("latest_metrics") or {}
    listed = [metric for metric in descriptions.listed(job) if metric.name in row]
    style = {"succeeded": "green", "failed": "red"}.get(job["state"], "yellow")
    text = f"Job {job['id']} {job['state']} at {job['progress_step']:,} steps"
    if job["state"] == "failed" and job.get("error"):
        text += f": {plain(job['error'])}"
    elif result := shown_result(job):
        values = ", ".join(f"{title.lower()} {value}" for title, value in headline(result).items())
        text += f". Evaluation, {evaluated(result)}: {values}"
    elif listed:
        values = ", ".join(f"{metric.title.lower()} {value_text(metric, row)}" for metric in listed)
        text += f". In training: {values}"
    context.out.print(text, style=style, markup=False, soft_wrap=True)
    if job["state"] == "failed":
        context.note(f"`naoctl logs {job['id']}` shows why; `naoctl retry {job['id']}` queues it again.")


def _watch_live(context: Context, client: Client, job: dict[str, Any]) -> dict[str, Any]:
    curve = Curve()
    metrics = Descriptions(client).shown(job)
    console = context.out
    ascii_only = not console.encoding.lower().startswith("utf")
    note = ""

    def picture() -> Any:
        return live_view(job, curve, metrics, width=console.width, ascii_only=ascii_only, note=note)

    with Live(picture(), console=console, refresh_per_second=4, transient=False) as live:

        def lost(reason: str, wait_s: float) -> None:
            live.update(
                live_view(
                    job,
                    curve,
                    metrics,
                    width=console.width,
                    ascii_only=ascii_only,
                    note=f"Connection lost ({reason}); next attempt in {wait_s:g} s",
                ),
                refresh=True,
            )

        for update in follow(client, job, on_lost=lost):
            job = update.job
            if update.kind == "metrics":
                curve.add(update.data)
            elif update.kind == "event":
                note = plain(update.data.get("message", ""))
            elif update.kind == "job" and job["state"] == "running":
                note = ""
            live.update(picture())
        note = ""
        live.update(picture())
    return job


def _watch_lines(context: Context, client: Client, job: dict[str, Any]) -> dict[str, Any]:
    state, reason, stalled, printed_at, pending = "", None, None, 0.0, None
    metrics = Descriptions(client).shown(job)

    def lost(reason: str, wait_s: float) -> None:
        context.note(f"Connection lost ({reason}); next attempt in {duration(wait_s)}")

    for update in follow(client, job, on_lost=lost):
        job = update.job
        if update.kind == "job" and job["state"] != state:
            if pending:
                context.out.print(pending, markup=False, soft_wrap=True)
                pending = None
            state = job["state"]
            context.out.print(state, markup=False)
        if update.kind == "job" and job.get("waiting_reason") not in (None, reason):
            reason = job["waiting_reason"]
            context.out.print(f"Waiting: {waiting_text(job)}", markup=False, soft_wrap=True)
        elif update.kind == "job" and job.get("stalled_since") != stalled:
            stalled = job.get("stalled_since")
            words = f"Stalled: {stall_text(job)}" if stalled else "The job makes steps again."
            context.out.print(words, markup=False, soft_wrap=True)
        elif update.kind == "metrics":
            pending = progress_line(job, update.data, metrics)
            if time.monotonic() - printed_at >= LINE_EVERY_S:
                context.out.print(pending, markup=False, soft_wrap=True)
                printed_at, pending = time.monotonic(), None
        context.out.file.flush()
    if pending:
        context.out.print(pending, markup=False, soft_wrap=True)
    return job


def _watch_json(context: Context, client: Client, job: dict[str, Any]) -> dict[str, Any]:
    for update in follow(client, job):
        job = update.job
        print_json_line(context.out, {"kind": update.kind, "data": update.data})
    return job


def logs(
    ctx: typer.Context,
    job: Annotated[
        str, typer.Argument(metavar="JOB", help="A job's id, its name, or `last`.", autocompletion=complete_job)
    ] = "last",
    follow_it: Annotated[
        bool, typer.Option("--follow", "-f", help="Continue until the job ends; the exit code is its result.")
    ] = False,
    tail: Annotated[
        int | None, typer.Option("--tail", "-n", min=0, help="Show only this number of lines, the newest.")
    ] = None,
    events: Annotated[bool, typer.Option("--events/--no-events", help="Also show the job's history.")] = True,
    as_json: JsonFlag = False,
) -> None:
    """Show a job's log and history.

    With --follow the exit code is the job's result: 0 succeeded, 10 failed, 11 cancelled, 12 paused.
    """
    context = context_of(ctx)
    kinds = ("log", "event") if events else ("log",)
    with context.client() as client:
        found = find_job(client, job)
        seen = {"log": 0, "event": 0}

        def show(kind: str, line: dict[str, Any]) -> None:
            if line["id"] > seen[kind]:
                seen[kind] = line["id"]
                _print_line(context, kind, line, as_json=as_json)

        lines = [(kind, line) for kind in kinds for line in _stored(client, found["id"], kind)]
        lines.sort(key=lambda item: str(item[1]["at"]))
        for kind, line in lines if tail is None else lines[len(lines) - min(tail, len(lines)) :]:
            show(kind, line)
        if not follow_it:
            return
        # Lines that --tail left out count as seen.
        for kind, line in lines:
            seen[kind] = max(seen[kind], line["id"])
        found = client.get(f"/jobs/{found['id']}")
        try:
            updates = follow(client, found, only=(*kinds, "state"), logs_after=seen["log"], events_after=seen["event"])
            for update in () if is_over(found) else updates:
                found = update.job
                if update.kind in kinds:
                    show(update.kind, update.data)
        except KeyboardInterrupt:
            raise CliError("Stopped reading; the job continues", code=ExitCode.INTERRUPTED) from None
        # What was written between the last look and the end.
        for kind in kinds:
            for line in _stored(client, found["id"], kind, after=seen[kind]):
                show(kind, line)
    code = result_of(found)
    if code:
        raise typer.Exit(code)


def _stored(client: Client, job_id: str, kind: str, after: int = 0) -> Iterator[dict[str, Any]]:
    while True:
        page = client.get(f"/jobs/{job_id}/{kind}s", after=after, limit=1000)
        yield from page["items"]
        if not page["items"] or page["next_after"] is None:
            return
        after = page["next_after"]


def _print_line(context: Context, kind: str, line: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print_json_line(context.out, {"type": kind, **line})
        return
    level = str(line["level"]).lower() if kind == "log" else "event"
    text = f"{clock(line['at'])}  {level:<7}  {plain(line['message'])}"
    context.out.print(text, style=LEVEL_STYLE.get(level), markup=False, soft_wrap=True)
    context.out.file.flush()


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("watch")(watch)
    app.command("logs")(logs)
