"""``naoctl policies``: evaluate, replay and export bundled policies on this machine, without the service."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import naopolicies
import typer
from naospec import plugins
from naosprint.tasks.metrics import format_value

from naoctl.commands.artifacts import ExportFormats, format_flags, run_naosprint
from naoctl.context import JsonFlag, context_of
from naoctl.descriptions import UNNAMED, metric_of, section_name
from naoctl.errors import CliError, ExitCode
from naoctl.evaluations import headline
from naoctl.render import MISSING, listing, pairs

app = typer.Typer(
    help="List, evaluate, replay and export the bundled policies.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Name = Annotated[
    str, typer.Argument(metavar="NAME", help="A bundled policy.", autocompletion=lambda: list(naopolicies.names()))
]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FOLDER", help="Output folder (default: named after the policy)."),
]


@app.command("list")
def list_policies(ctx: typer.Context, as_json: JsonFlag = False) -> None:
    """List the bundled policies."""
    context = context_of(ctx)
    cards = [naopolicies.card(name) for name in naopolicies.names()]
    if as_json:
        context.json(cards)
        return
    shown = {result["name"]: result["title"] for card in cards for result in _headline(card)}
    columns = ("Name", "Robot", "Task", *shown.values(), "Trained")
    table = listing(*columns)
    for card in cards:
        texts = {result["name"]: format_value(metric_of(result), result["value"]) for result in _headline(card)}
        table.add_row(
            card["name"],
            card["robot"],
            card["task"],
            *(texts.get(name, MISSING) for name in shown),
            f"{card['steps'] / 1e6:,.0f} M steps",
        )
    context.out.print(table if cards else "No policies are bundled with this version.")


def _headline(card: Mapping[str, Any]) -> list[dict[str, Any]]:
    results = {result["name"]: result for result in card["results"]}
    return [results[name] for name in card["headline"] if name in results]


@app.command("evaluate")
def evaluate_policy(
    ctx: typer.Context,
    name: Name,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to run.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the starts.")] = 0,
    simulator: Annotated[
        str, typer.Option(metavar="NAME", help=f"One of {', '.join(plugins.names(plugins.SIMULATORS))}.")
    ] = "embedded",
    as_json: JsonFlag = False,
) -> None:
    """Evaluate a policy again, on this machine."""
    context = context_of(ctx)
    _known(name)
    summary = evaluate(name, episodes=episodes, seed=seed, simulator=simulator)
    if as_json:
        context.json(summary)
    else:
        context.out.print(pairs([("Policy", name), *headline(summary).items()]))


@app.command("replay")
def replay_policy(ctx: typer.Context, name: Name, output: Output = None, as_json: JsonFlag = False) -> None:
    """Run one episode of a policy and film it."""
    _write("replay", ctx, name, output or Path(f"{name}-run"), as_json=as_json)


@app.command("export")
def export_policy(
    ctx: typer.Context,
    name: Name,
    output: Output = None,
    formats: ExportFormats = None,
    as_json: JsonFlag = False,
) -> None:
    """Export a policy for NumPy, as ONNX and as a C header."""
    _write("export", ctx, name, output or Path(f"{name}-export"), *format_flags(formats), as_json=as_json)


def evaluate(name: str, *, episodes: int, seed: int = 0, simulator: str = "embedded") -> dict[str, Any]:
    """Evaluate a bundled policy as on its card; return the results.

    Raises:
        CliError: if naosprint is not installed here or fails.
    """
    task = section_name(naopolicies.card(name)["evaluation"], "task")
    words = (
        *(("--task", task) if task != UNNAMED else ()),
        "--episodes",
        str(episodes),
        "--seed",
        str(seed),
        "--simulator",
        simulator,
    )
    summary: dict[str, Any] = json.loads(run_naosprint("evaluate", name, *words))
    return summary


def _write(word: str, ctx: typer.Context, name: str, folder: Path, *flags: str, as_json: bool) -> None:
    context = context_of(ctx)
    _known(name)
    files = run_naosprint(word, name, str(folder), *flags).split("\n")[:-1]
    if as_json:
        context.json({"path": str(folder), "files": files})
        return
    for file in files:
        context.out.print(file, markup=False, soft_wrap=True)


def _known(name: str) -> None:
    """Raise CliError unless a bundled policy has this name."""
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
