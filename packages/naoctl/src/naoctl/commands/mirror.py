"""``naoctl mirror``: copies of jobs in MLflow or Weights & Biases."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from naoctl.context import Context, JsonFlag, complete_job, context_of, find_job
from naoctl.errors import CliError, ExitCode
from naoctl.mirrors import DownloadMirror, mirror_jobs
from naoctl.mlflow_mirror import MlflowMirror
from naoctl.render import print_json_line
from naoctl.wandb_mirror import WandbMirror

Jobs = Annotated[
    list[str] | None,
    typer.Argument(metavar="[JOB...]", help="Jobs by id or name.", show_default="all", autocompletion=complete_job),
]
Artifacts = Annotated[
    bool,
    typer.Option("--artifacts/--no-artifacts", help="Copy checkpoints, reports, films and registered policies, too."),
]

mirror = typer.Typer(no_args_is_help=True, help="Copy jobs to MLflow or Weights & Biases while they train.")


@mirror.command()
def mlflow(
    ctx: typer.Context,
    jobs: Jobs = None,
    uri: Annotated[
        str, typer.Option("--tracking-uri", metavar="URI", envvar="MLFLOW_TRACKING_URI", help="Tracking server.")
    ] = "http://127.0.0.1:5000",
    experiment: Annotated[
        str, typer.Option("--experiment", metavar="NAME", envvar="MLFLOW_EXPERIMENT_NAME", help="Experiment.")
    ] = "naosprint",
    artifacts: Artifacts = True,
    as_json: JsonFlag = False,
) -> None:
    """Copy jobs to MLflow: settings, metrics, results, policy, report and film; and registered policies.

    Without JOB, all jobs until Ctrl-C: past ones that are missing, then those that run.
    """
    _require("mlflow")
    _copy(context_of(ctx), jobs, partial(MlflowMirror, uri, experiment), artifacts=artifacts, as_json=as_json)


@mirror.command()
def wandb(
    ctx: typer.Context,
    jobs: Jobs = None,
    project: Annotated[
        str, typer.Option("--project", metavar="NAME", envvar="WANDB_PROJECT", help="Project.")
    ] = "naosprint",
    entity: Annotated[
        str | None, typer.Option("--entity", metavar="NAME", envvar="WANDB_ENTITY", help="User or team.")
    ] = None,
    folder: Annotated[
        Path, typer.Option("--folder", metavar="FOLDER", envvar="WANDB_DIR", help="Where runs are kept.")
    ] = Path("wandb-naosprint"),
    offline: Annotated[
        bool,
        typer.Option("--offline", help="Only write to the folder; `wandb sync` uploads it."),
    ] = False,
    artifacts: Artifacts = True,
    as_json: JsonFlag = False,
) -> None:
    """Copy jobs to Weights & Biases: settings, metrics, results, policy, report and film; and registered policies.

    Without JOB, all jobs until Ctrl-C: past ones that are missing, then those that run.
    """
    _require("wandb")
    offline = offline or os.environ.get("WANDB_MODE") == "offline"
    _copy(
        context_of(ctx),
        jobs,
        lambda: WandbMirror(project, entity, folder, offline=offline),
        artifacts=artifacts,
        as_json=as_json,
    )


def _require(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise CliError(f"{package} is not installed here", fix=f"Install naoctl[{package}].")


def _copy(
    context: Context,
    jobs: list[str] | None,
    connect: Callable[[], DownloadMirror],
    *,
    artifacts: bool,
    as_json: bool,
) -> None:
    def note(text: str) -> None:
        if as_json:
            print_json_line(context.out, {"kind": "note", "data": text})
        else:
            context.note(text)

    with context.client() as client:
        chosen = [find_job(client, job)["id"] for job in jobs or ()]
        try:
            mirror_jobs(client, connect, chosen, artifacts=artifacts, note=note)
        except KeyboardInterrupt:
            raise CliError(
                "Stopped copying; the jobs continue",
                fix="The same command continues where it stopped.",
                code=ExitCode.INTERRUPTED,
            ) from None


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.add_typer(mirror, name="mirror")
