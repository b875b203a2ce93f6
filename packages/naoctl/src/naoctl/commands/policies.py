"""``naoctl policies``: the policies in the box, judged, shown and exported on this machine, without the service."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import naopolicies
import typer
from rich.table import Table

from naoctl.commands.artifacts import run_naosprint
from naoctl.context import JsonFlag, context_of
from naoctl.errors import CliError, ExitCode
from naoctl.judgement import headline
from naoctl.render import pairs

app = typer.Typer(
    help="Sprint policies that come with naosprint: list, judge, replay and export them.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Name = Annotated[
    str, typer.Argument(metavar="NAME", help="A shipped policy.", autocompletion=lambda: list(naopolicies.names()))
]
Output = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Where to put it; else named after the policy.")
]


@app.command("list")
def list_policies(ctx: typer.Context, as_json: JsonFlag = False) -> None:
    """List the policies in the box."""
    context = context_of(ctx)
    cards = [naopolicies.card(name) for name in naopolicies.names()]
    if as_json:
        context.json(cards)
        return
    columns = ("Name", "Robot", "Task", "Top speed", "Falls", "Deviation", "Trained")
    table = Table(*columns, box=None, pad_edge=False, header_style="bold")
    for card in cards:
        paper = card["figures"]["paper"]
        table.add_row(
            card["name"],
            f"type {card['robot_type']}",
            card["task"],
            f"{paper['top_speed_mps']:.2f} m/s",
            f"{card['figures']['falls']['rate']:.1%}",
            f"{paper['deviation_deg']['mean']:.1f}°",
            f"{card['steps'] / 1e6:,.0f} M steps",
        )
    context.out.print(table if cards else "No policies are shipped with this version.")


@app.command("evaluate")
def evaluate_policy(
    ctx: typer.Context,
    name: Name,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to run.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the starts.")] = 0,
    simulator: Annotated[str, typer.Option(help="embedded or rcssserver3d.")] = "embedded",
    as_json: JsonFlag = False,
) -> None:
    """Judge a policy anew, on this machine."""
    context = context_of(ctx)
    _known(name)
    summary = judge(name, episodes=episodes, seed=seed, simulator=simulator)
    if as_json:
        context.json(summary)
    else:
        context.out.print(pairs([("Policy", name), *headline(summary).items()]))


@app.command("replay")
def replay_policy(ctx: typer.Context, name: Name, output: Output = None, as_json: JsonFlag = False) -> None:
    """Let a policy run once, and film it."""
    _write("replay", ctx, name, output or Path(f"{name}-run"), as_json=as_json)


@app.command("export")
def export_policy(ctx: typer.Context, name: Name, output: Output = None, as_json: JsonFlag = False) -> None:
    """Write a policy for use elsewhere: ONNX, NumPy, JSON."""
    _write("export", ctx, name, output or Path(f"{name}-export"), as_json=as_json)


def judge(name: str, *, episodes: int, seed: int = 0, simulator: str = "embedded") -> dict[str, Any]:
    """Run a shipped policy over the whole field, whichever task it was trained on; return its figures.

    Raises:
        CliError: when naosprint is not installed here or fails.
    """
    task = naopolicies.card(name)["task"].replace("sprint2", "sprint1")
    words = ("--task", task, "--episodes", str(episodes), "--seed", str(seed), "--simulator", simulator)
    summary: dict[str, Any] = json.loads(run_naosprint("evaluate", name, *words))
    return summary


def _write(word: str, ctx: typer.Context, name: str, folder: Path, *, as_json: bool) -> None:
    context = context_of(ctx)
    _known(name)
    files = run_naosprint(word, name, str(folder)).split("\n")[:-1]
    if as_json:
        context.json({"path": str(folder), "files": files})
        return
    for file in files:
        context.out.print(file, markup=False, soft_wrap=True)


def _known(name: str) -> None:
    """Refuse what is no shipped policy; a checkpoint's folder is for ``python -m naosprint``."""
    try:
        naopolicies.folder(name)
    except ValueError as error:
        raise CliError(
            str(error).capitalize(),
            fix=f"For a checkpoint of your own: {Path(sys.executable).name} -m naosprint evaluate FOLDER.",
            code=ExitCode.NOT_FOUND,
        ) from None


def register(parent: typer.Typer) -> None:
    """Add the commands."""
    parent.add_typer(app, name="policies")
