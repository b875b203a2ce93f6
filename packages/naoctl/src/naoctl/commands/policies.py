"""``naoctl policies``: list policies; evaluate, replay and export them on this machine."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import naopolicies
import typer
from naospec import plugins
from naospec.metrics import format_value

from naoctl.commands import registry
from naoctl.commands.artifacts import ExportFormats, ExportName, export_flags, fetch_artifacts, run_naosprint
from naoctl.commands.registry import POLICY_HELP
from naoctl.context import Context, JsonFlag, context_of
from naoctl.descriptions import UNNAMED, metric_of, section_name
from naoctl.errors import CliError, ExitCode
from naoctl.evaluations import headline
from naoctl.policies import known_policy
from naoctl.render import MISSING, listing, pairs

app = typer.Typer(
    help="List, register, compare, evaluate, replay and export policies.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Name = Annotated[
    str, typer.Argument(metavar="POLICY", help=POLICY_HELP, autocompletion=lambda: list(naopolicies.names()))
]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FOLDER", help="Output folder (default: named after the policy)."),
]


@app.command("list")
def list_policies(ctx: typer.Context, as_json: JsonFlag = False) -> None:
    """List the bundled policies, and the registered ones if the service answers."""
    context = context_of(ctx)
    try:
        with context.client() as client:
            cards = client.every("/policies")
    except CliError as error:
        context.note(f"Bundled policies only: {error.message}.")
        cards = [naopolicies.card(name) for name in naopolicies.names()]
    if as_json:
        context.json(cards)
        return
    # a table for tasks with the same results: with all in one, most cells would be empty
    tables: dict[tuple[str, ...], list[Any]] = {}
    for card in cards:
        tables.setdefault(tuple(card["headline"]), []).append(card)
    for shown, alike in tables.items():
        titles = {result["name"]: result["title"] for card in alike for result in _headline(card)}
        table = listing(
            "Name", "Aliases", "Robot", "Task", *(titles[name] for name in shown if name in titles), "Trained"
        )
        for card in alike:
            texts = {result["name"]: format_value(metric_of(result), result["value"]) for result in _headline(card)}
            table.add_row(
                card.get("reference", card["name"]),
                ", ".join(card.get("aliases", ())) or MISSING,
                card["robot"],
                card["task"],
                *(texts.get(name, MISSING) for name in shown if name in titles),
                steps_text(card),
            )
        context.out.print(table)
    if not cards:
        context.out.print("No policies are bundled with this version.")


def steps_text(card: Mapping[str, Any]) -> str:
    """Return the steps of a policy's training."""
    return f"{card['steps'] / 1e6:,.0f} M steps" if card["steps"] >= 1e6 else f"{card['steps']:,} steps"


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
    with local_policy(context, name) as folder:
        if name in naopolicies.names():
            summary = evaluate(name, episodes=episodes, seed=seed, simulator=simulator)
        else:
            words = ("--episodes", str(episodes), "--seed", str(seed), "--simulator", simulator)
            summary = json.loads(run_naosprint("evaluate", "--json", str(folder), *words))
    if as_json:
        context.json(summary)
    else:
        context.out.print(pairs([("Policy", name), *headline(summary).items()]))


@app.command("replay")
def replay_policy(ctx: typer.Context, name: Name, output: Output = None, as_json: JsonFlag = False) -> None:
    """Run one episode of a policy and film it."""
    _write("replay", ctx, name, output or Path(f"{_plain(name)}-run"), as_json=as_json)


@app.command("export")
def export_policy(
    ctx: typer.Context,
    name: Name,
    output: Output = None,
    formats: ExportFormats = None,
    export_name: ExportName = None,
    as_json: JsonFlag = False,
) -> None:
    """Export a policy for NumPy, as ONNX, as a C header, and as a skill for team code."""
    flags = export_flags(formats, export_name)
    _write("export", ctx, name, output or Path(f"{_plain(name)}-export"), *flags, as_json=as_json)


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
    summary: dict[str, Any] = json.loads(run_naosprint("evaluate", "--json", name, *words))
    return summary


def _plain(name: str) -> str:
    return name.replace("@", "-")


def _write(word: str, ctx: typer.Context, name: str, folder: Path, *flags: str, as_json: bool) -> None:
    context = context_of(ctx)
    with local_policy(context, name) as source:
        files = run_naosprint(word, str(source), str(folder), *flags).split("\n")[:-1]
    if as_json:
        context.json({"path": str(folder), "files": files})
        return
    for file in files:
        context.out.print(file, markup=False, soft_wrap=True)


@contextmanager
def local_policy(context: Context, name: str) -> Iterator[Path]:
    """Yield the folder of a policy's checkpoint: a bundled one's, or a copy from the service for as long as this lasts.

    Raises:
        CliError: if there is no such policy.
    """
    if name in naopolicies.names():
        yield naopolicies.folder(name)
        return
    with context.client() as client, tempfile.TemporaryDirectory(prefix="naoctl-") as scratch:
        try:
            policy = known_policy(client, name)
        except CliError as error:
            if error.code not in (ExitCode.NOT_FOUND, ExitCode.UNREACHABLE, ExitCode.DENIED):
                raise
            known = ", ".join(naopolicies.names()) or "none"
            raise CliError(
                f"There is no policy {name!r}: choose one of {known}, or a registered one ({error.message})",
                fix=f"For a checkpoint of your own: {Path(sys.executable).name} -m naosprint evaluate FOLDER.",
                code=ExitCode.NOT_FOUND,
            ) from None
        folder = Path(scratch) / "checkpoint"
        fetch_artifacts(context, client, [("checkpoint", folder, {"id": name, "files": policy["files"]})])
        yield folder


registry.register(app)  # once: an application may be built again


def register(parent: typer.Typer) -> None:
    """Add the commands."""
    parent.add_typer(app, name="policies")
