"""``naoctl tensorboard``: event files of jobs, and TensorBoard to look at them."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from naoctl.client import Client
from naoctl.context import Context, JsonFlag, complete_job, context_of, find_job
from naoctl.errors import CliError
from naoctl.follow import follow
from naoctl.policies import folder_name
from naoctl.render import parse_time


def tensorboard(
    ctx: typer.Context,
    jobs: Annotated[
        list[str] | None,
        typer.Argument(metavar="JOB...", help="Jobs by id or name.", show_default="last", autocompletion=complete_job),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Where to put the event files.",
            show_default="a temporary one",
            file_okay=False,
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port of TensorBoard.", show_default="6006, or the next free one"),
    ] = None,
    serve: Annotated[
        bool, typer.Option("--serve/--no-serve", help="Start TensorBoard; without it, end when the jobs have ended.")
    ] = True,
    as_json: JsonFlag = False,
) -> None:
    """Write the metrics of jobs as TensorBoard event files and look at them.

    Running jobs are followed live. Ctrl-C ends TensorBoard and leaves the jobs running.
    """
    context = context_of(ctx)
    if importlib.util.find_spec("tensorboard") is None:
        raise CliError("TensorBoard is not installed here", fix="Install naoctl[tensorboard].")
    with ExitStack() as stack:
        folder = output or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="naoctl-tensorboard-")))
        client = stack.enter_context(context.client())
        found = [find_job(client, job) for job in jobs or ["last"]]
        writers = [
            threading.Thread(target=_write_reporting, args=(context, job, folder / folder_name(job)), daemon=True)
            for job in found
        ]
        for writer in writers:
            writer.start()
        if not serve:
            for writer in writers:
                writer.join()
            if as_json:
                context.json({"path": str(folder)})
            else:
                context.say("Event files", str(folder))
            return
        options = ["--logdir", str(folder), "--host", "127.0.0.1", *(["--port", str(port)] if port is not None else [])]
        program = subprocess.Popen([sys.executable, "-P", "-m", "tensorboard.main", *options, "--reload_interval", "2"])
        stack.callback(program.wait)
        stack.callback(program.terminate)
        try:
            program.wait()
        except KeyboardInterrupt:
            return


def _write_reporting(context: Context, job: dict[str, Any], folder: Path) -> None:
    try:
        with context.client() as client:
            write_events(client, job, folder)
    except CliError as error:
        context.note(f"{job['id']}: {error}")


def write_events(client: Client, job: dict[str, Any], folder: Path) -> None:
    """Write the metrics of a job to an event file in ``folder`` until it ends or is paused."""
    began = parse_time(job.get("started_at") or job.get("created_at"))
    began_s = began.timestamp() if began else 0.0
    last = -1
    with _open_events(folder) as (add, restart):
        for update in follow(client, job, only=("metrics", "state")):
            if update.kind != "metrics":
                continue
            row = update.data
            step, wall_s = int(row["step"]), began_s + float(row.get("time_s", 0.0))
            # a later attempt replaces what came after its checkpoint; the first row, what an earlier run left there
            if step <= last or last < 0:
                restart(wall_s, step)
            last = step
            add(wall_s, step, {name: value for name, value in row.items() if name not in ("step", "attempt")})


@contextmanager
def _open_events(folder: Path) -> Iterator[tuple[Any, Any]]:
    """Yield functions that write metrics, and that discard those from a step on."""
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.summary.writer.event_file_writer import EventFileWriter

    writer = EventFileWriter(str(folder), flush_secs=1)

    def add(wall_s: float, step: int, values: dict[str, float]) -> None:
        items = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        writer.add_event(Event(wall_time=wall_s, step=step, summary=Summary(value=items)))

    def restart(wall_s: float, step: int) -> None:
        writer.add_event(Event(wall_time=wall_s, step=step, session_log=SessionLog(status=SessionLog.START)))

    try:
        yield add, restart
    finally:
        writer.close()


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("tensorboard")(tensorboard)
