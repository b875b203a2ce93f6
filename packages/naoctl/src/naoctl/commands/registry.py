"""Commands for registered policies: ``register``, ``show``, ``compare``, ``promote``, ``require`` and their like."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import typer

from naoctl.commands.artifacts import Conditions, condition_values
from naoctl.commands.jobs import add_settings, settings_of
from naoctl.commands.submit import hand_in
from naoctl.context import JsonFlag, complete_job, context_of, find_checkpoint, find_job, stdin_is_terminal
from naoctl.errors import InvalidInput
from naoctl.evaluations import headline, result_text
from naoctl.policies import known_policy, policy_path
from naoctl.render import MISSING, ago, cell, duration, listing, pairs

POLICY_HELP = "A bundled or registered policy: NAME, NAME@VERSION or NAME@ALIAS."
Policy = Annotated[str, typer.Argument(metavar="POLICY", help=POLICY_HELP)]
_BOUND = re.compile(r"([a-z][a-z0-9_]*)(<=|>=|=)(now|-?\d+(?:\.\d+)?)")
DIGEST_DIGITS = 12
"""Leading digits of a digest that displays show."""


def register_policy(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the policy; a new one if you have none of it.")],
    job: Annotated[
        str, typer.Argument(metavar="JOB", help="A job's id, its name, or `last`.", autocompletion=complete_job)
    ] = "last",
    checkpoint: Annotated[
        str | None,
        typer.Option("--checkpoint", "-c", metavar="ID|STEP", help="Checkpoint to register (default: the newest)."),
    ] = None,
    alias: Annotated[
        list[str] | None,
        typer.Option("--alias", "-a", metavar="ALIAS", help="Alias of the new version, such as best; repeatable."),
    ] = None,
    notes: Annotated[str, typer.Option(metavar="TEXT", help="Text about the version.")] = "",
    key: Annotated[
        str | None,
        typer.Option("--idempotency-key", metavar="KEY", help="A second request with the same key adds no version."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Register a checkpoint of a job as the next version of a policy; it is kept for as long as the version exists."""
    context = context_of(ctx)
    with context.client() as client:
        found = find_job(client, job)
        body: dict[str, Any] = {"job_id": found["id"], "aliases": alias or [], "notes": notes}
        if checkpoint is not None:
            body["checkpoint_id"] = find_checkpoint(client, found, checkpoint)["id"]
        card = hand_in(client, f"{policy_path(name)}/versions", body, key)
    if as_json:
        context.json(card)
    else:
        context.out.print(f"Registered {card['reference']}: step {card['lineage'][-1]['steps']:,} of {found['id']}")


def show_policy(ctx: typer.Context, policy: Policy, as_json: JsonFlag = False) -> None:
    """Show a policy: its results and its lineage."""
    context = context_of(ctx)
    with context.client() as client:
        card = known_policy(client, policy)
    if as_json:
        context.json(card)
        return
    rows: list[tuple[str, Any]] = [
        ("Policy", card["reference"]),
        ("Aliases", ", ".join(card["aliases"]) or MISSING),
        ("Owner", card["owner"] or "bundled, read-only"),
        ("Robot, task", f"{card['robot']}, {card['task']}"),
        ("Trained", f"{card['steps']:,} steps in {duration(card['training_s'])}"),
        ("Checkpoint", card["checkpoint_id"] or MISSING),
        ("Spec SHA-256", card["spec_sha256"]),
        ("Started from", card["parent_policy"] or "random weights, or a job that is not registered"),
    ]
    if card["created_at"]:
        rows.append(("Registered", ago(card["created_at"])))
    rows += [(f"{alias} requires", "; ".join(texts)) for alias, texts in _requirements(card).items()]
    if card["notes"]:
        rows.append(("Notes", cell(card["notes"])))
    rows.append(("Episodes", f"{card['episodes']:,}" if card["episodes"] else "not evaluated yet"))
    rows += headline(card).items()
    rows += _ranges(card).items()
    context.out.print(pairs(rows))
    table = listing("Job", "Task", "Preset", "Steps", "Spec", "From")
    for part in card["lineage"]:
        digest = (part.get("spec_sha256") or MISSING)[:DIGEST_DIGITS]
        table.add_row(
            cell(part["job"]),
            part["task"],
            part["preset"],
            f"{part['steps']:,}",
            digest,
            part.get("parent_policy") or MISSING,
        )
    context.out.print(table)


def list_versions(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a policy.")],
    as_json: JsonFlag = False,
) -> None:
    """List the versions of a policy with their results."""
    context = context_of(ctx)
    with context.client() as client:
        cards = client.every(f"{policy_path(name)}/versions")
    if as_json:
        context.json(cards)
        return
    shown = dict.fromkeys(title for card in cards for title in headline(card))
    table = listing("Version", "Aliases", *shown, "Registered")
    for card in cards:
        results = headline(card)
        table.add_row(
            card["reference"],
            ", ".join(card["aliases"]) or MISSING,
            *(results.get(title, MISSING) for title in shown),
            ago(card["created_at"]),
        )
    context.out.print(table)


def compare_policies(
    ctx: typer.Context,
    policies: Annotated[list[str], typer.Argument(metavar="POLICY POLICY...", help=POLICY_HELP)],
    as_json: JsonFlag = False,
) -> None:
    """Compare policies or versions: the settings that differ, and all results."""
    context = context_of(ctx)
    if len(policies) < 2:
        raise InvalidInput("compare needs two policies or more", fix="Name another one.")
    with context.client() as client:
        cards = [known_policy(client, reference) for reference in policies]
    specs = [settings_of(card["spec"]) for card in cards]
    paths = dict.fromkeys(path for spec in specs for path in spec)
    differing = [path for path in paths if len({str(spec.get(path)) for spec in specs}) > 1]
    if as_json:
        context.json(
            [
                {**card, "spec": {path: spec[path] for path in differing if path in spec}}
                for card, spec in zip(cards, specs, strict=True)
            ]
        )
        return
    table = listing()
    table.add_column("")
    for card in cards:
        table.add_column(card["reference"], justify="right", overflow="fold")
    table.add_row("Aliases", *(", ".join(card["aliases"]) or MISSING for card in cards))
    table.add_row("Steps", *(f"{card['steps']:,}" for card in cards))
    table.add_row("Started from", *(card["parent_policy"] or MISSING for card in cards))
    add_settings(table, specs, differing)
    table.add_row("[bold]Evaluation[/bold]", *("" for _ in cards))
    table.add_row("Episodes", *(f"{card['episodes']:,}" if card["episodes"] else MISSING for card in cards))
    for title, texts in _side_by_side(_results, cards):
        table.add_row(title, *texts)
    robustness = _side_by_side(_ranges, cards)
    if robustness:
        table.add_row("[bold]Robustness[/bold]", *("" for _ in cards))
    for title, texts in robustness:
        table.add_row(title, *texts)
    context.out.print(table)


def _results(card: Mapping[str, Any]) -> dict[str, str]:
    """Return all results as texts, by title."""
    return {result["title"]: result_text(result) for result in card["results"]}


def _ranges(card: Mapping[str, Any]) -> dict[str, str]:
    """Return what a policy stands of each disturbance, by the disturbance's name."""
    found = (card.get("ranges") or {}).get("disturbances", ())
    return {each["disturbance"].capitalize(): each["text"] for each in found}


def _side_by_side(
    texts_of: Callable[[Mapping[str, Any]], dict[str, str]], cards: Sequence[Mapping[str, Any]]
) -> list[tuple[str, list[str]]]:
    """Return the texts of all cards, one list for each title."""
    by_card = [texts_of(card) for card in cards]
    titles = dict.fromkeys(title for texts in by_card for title in texts)
    return [(title, [texts.get(title, MISSING) for texts in by_card]) for title in titles]


def promote(
    ctx: typer.Context,
    policy: Policy,
    aliases: Annotated[list[str], typer.Argument(metavar="ALIAS...", help="Aliases, such as best or match.")],
    remove: Annotated[bool, typer.Option("--remove", help="Remove the aliases instead.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Point aliases at a version: `naoctl policies promote fast@3 best`."""
    context = context_of(ctx)
    with context.client() as client:
        card = known_policy(client, policy)
        for alias in aliases:
            path = f"{policy_path(card['name'])}/aliases/{alias}"
            if remove:
                client.request("DELETE", path)
            else:
                client.request("PUT", path, json_body={"version": card["version"]})
        card = known_policy(client, card["reference"])
    if as_json:
        context.json(card)
    else:
        context.out.print(f"{card['reference']} has the aliases: {', '.join(card['aliases']) or 'none'}")


def require(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a registered policy.")],
    alias: Annotated[str, typer.Argument(metavar="ALIAS", help="Alias, such as best or match.")],
    bounds: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="BOUND...",
            help="'RESULT<=X', 'RESULT>=X', 'RESULT=now' for no worse than now, 'match=now' for no loss against it.",
        ),
    ] = None,
    conditions: Conditions = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes that the evaluation needs at least.")] = 100,
    simulator: Annotated[
        str | None, typer.Option(metavar="NAME", help="Where they have to run.", show_default="that of the training")
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Remove what the alias required before.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Set what a version needs before an alias names it: `naoctl policies require fast best 'fall_rate<=0.03'`.

    Bounds are added to those that the alias has; without any they are listed.
    """
    context = context_of(ctx)
    shared = {"conditions": condition_values(conditions), "episodes": episodes, "simulator": simulator}
    wanted = [{**_bound(text), **shared} for text in bounds or ()]
    with context.client() as client:
        card = known_policy(client, name)
        if wanted or clear:
            kept = [] if clear else card["requirements"].get(alias, [])
            body = {"requirements": [*kept, *wanted]}
            path = f"{policy_path(card['name'])}/aliases/{alias}/requirements"
            card = client.request("PUT", path, json_body=body)
    if as_json:
        context.json(card["requirements"].get(alias, []))
        return
    texts = _requirements(card).get(alias, [])
    context.out.print(f"{card['name']}@{alias} requires: {'; '.join(texts) or 'nothing'}", markup=False)


def _bound(text: str) -> dict[str, Any]:
    """Return a bound of a result as the API takes it."""
    found = _BOUND.fullmatch(text.replace(" ", ""))
    if found is None or (found[2] == "=") != (found[3] == "now"):
        raise InvalidInput(
            f"{text!r} is no bound", fix="Write for example 'fall_rate<=0.03', 'top_speed_mps>=4' or 'fall_rate=now'."
        )
    result, sign, value = found.groups()
    if value == "now":
        return {"result": result, "no_worse": True}
    return {"result": result, "most" if sign == "<=" else "least": float(value)}


def _requirements(card: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return what aliases require, in words."""
    return {
        alias: [_requirement_text(each) for each in requirements]
        for alias, requirements in card.get("requirements", {}).items()
    }


def _requirement_text(each: Mapping[str, Any]) -> str:
    """Return a requirement in words: ``fall_rate <= 0.03 in 1,000 episodes with friction_min=0.6``."""
    bounds = [f"{sign} {each[key]:g}" for sign, key in (("<=", "most"), (">=", "least")) if each[key] is not None]
    bounds += ["not worse than now"] * each["no_worse"]
    settings = " ".join(f"{name}={value}" for name, value in sorted(each["conditions"].items()))
    place = f" on {each['simulator']}" if each["simulator"] else ""
    with_settings = f" with {settings}" if settings else ""
    return f"{each['result']} {' and '.join(bounds)} in {each['episodes']:,} episodes{with_settings}{place}"


def delete_policy(
    ctx: typer.Context,
    policy: Annotated[
        str, typer.Argument(metavar="NAME[@VERSION]", help="A version, or a policy with all its versions.")
    ],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Delete a version, or a policy with all its versions; checkpoints stay with their jobs."""
    context = context_of(ctx)
    with context.client() as client:
        card = known_policy(client, policy)
        path, what = policy_path(card["name"]), f"{card['name']} with all its versions"
        if "@" in policy:
            path, what = f"{path}/versions/{card['version']}", card["reference"]
        if not yes:
            if not stdin_is_terminal():
                raise InvalidInput(
                    "Deleting needs a confirmation, and standard input is not a terminal", fix="Add --yes."
                )
            typer.confirm(f"Delete {what}?", abort=True)
        client.request("DELETE", path)
    if as_json:
        context.json({"deleted": what})
    else:
        context.out.print(f"Deleted {what}")


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for name, function in (
        ("register", register_policy),
        ("show", show_policy),
        ("versions", list_versions),
        ("compare", compare_policies),
        ("promote", promote),
        ("require", require),
        ("delete", delete_policy),
    ):
        app.command(name)(function)
