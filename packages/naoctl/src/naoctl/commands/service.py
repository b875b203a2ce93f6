"""Commands for the service: login, logout, token, workers, version."""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version
from typing import Annotated, Any
from urllib.parse import quote

import typer

from naoctl import __version__
from naoctl.client import ApiError, Client
from naoctl.config import Config, Target, normal_url, resolve_target
from naoctl.context import JsonFlag, context_of, stdin_is_terminal
from naoctl.errors import CliError, ExitCode, InvalidInput, plain
from naoctl.render import MISSING, SHORT_ID, ago, cell, has_passed, listing, size

PACKAGES = ("naospec", "naojobs", "naosprint", "naosim", "naosprint-api", "naosprint-worker")
WorkerId = Annotated[str, typer.Argument(metavar="ID", help="A worker's id, as `naoctl workers` shows it.")]
_BESIDE_IDS = 50
"""Characters that the other columns of the list of workers need."""
workers_app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})
token_app = typer.Typer(no_args_is_help=True, help="Create, list and revoke tokens; needs a token with scope admin.")
SCOPES = ("read", "submit", "admin")


def login(
    ctx: typer.Context,
    url: Annotated[str | None, typer.Argument(metavar="[URL]", help="Address of the service.")] = None,
    token_stdin: Annotated[bool, typer.Option("--token-stdin", help="Read the token from standard input.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Sign in to a service and store its token.

    Prompts for the token without showing it, or reads it from standard input. Only you can read the stored token.
    """
    context = context_of(ctx)
    chosen = normal_url(url) if url else resolve_target(context.url).url
    if token_stdin:
        token = sys.stdin.readline().strip()
    elif stdin_is_terminal():
        token = typer.prompt(f"Token for {chosen}", hide_input=True).strip()
    else:
        raise InvalidInput("Standard input is not a terminal", fix="Pipe the token in and add --token-stdin.")
    if not token:
        raise InvalidInput("The token is empty", fix="Paste the token that an administrator gave you.")
    with Client(Target(chosen, token)) as client:
        who = client.get("/whoami")
    path = Config.load().with_token(chosen, token).save()
    if as_json:
        context.json({"url": chosen, "config": str(path), **who})
    else:
        context.out.print(
            f"Signed in to {chosen} as {plain(who['owner'])} ({', '.join(who['scopes'])}); token stored in {path}",
            markup=False,
            soft_wrap=True,
        )


def logout(
    ctx: typer.Context,
    url: Annotated[str | None, typer.Argument(metavar="[URL]", help="Address of the service.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Delete the stored token of a service."""
    context = context_of(ctx)
    chosen = normal_url(url) if url else resolve_target(context.url).url
    config = Config.load()
    known = chosen in config.tokens
    if known:
        config.without(chosen).save()
    if as_json:
        context.json({"url": chosen, "forgotten": known})
    else:
        context.out.print(f"{'Signed out of' if known else 'No token is stored for'} {chosen}", markup=False)


@workers_app.callback(invoke_without_command=True)
def workers(ctx: typer.Context, as_json: JsonFlag = False) -> None:
    """List the workers with what they run; drain one before maintenance."""
    if ctx.invoked_subcommand:
        return
    context = context_of(ctx)
    with context.client() as client:
        found = client.every("/workers")
    if as_json:
        context.json(found)
        return
    table = listing("ID", "Queues", "Robots", "Works on", "Free disk", "Last seen", "Version")
    for worker in found:
        marks = [("drained", worker["drained_at"]), ("lost", not worker["alive"])]
        seen = " ".join([ago(worker["heartbeat_at"]), *(f"({word})" for word, holds in marks if holds)])
        table.add_row(
            cell(worker["id"]),
            cell(", ".join(worker["simulators"])),
            cell(", ".join(worker["robots"])),
            "\n".join(each[-SHORT_ID:] for each in _held(worker)) or MISSING,
            MISSING if worker["disk_free_bytes"] is None else size(worker["disk_free_bytes"]),
            seen,
            cell(worker["version"]),
            style="red" if not worker["alive"] else "yellow" if worker["drained_at"] else None,
        )
    if not found:
        context.out.print("No workers. Jobs wait until one starts; `naoctl up` starts one.")
        return
    # A narrower terminal wraps the lines: ids come first, and stay whole.
    least = max(len(worker["id"]) for worker in found) + _BESIDE_IDS
    table.width = max(context.out.width, least)
    context.out.print(table, crop=False)


@workers_app.command("drain")
def drain(
    ctx: typer.Context,
    worker: WorkerId,
    requeue: Annotated[
        bool,
        typer.Option("--requeue", help="Its trainings write a checkpoint and continue on another worker, not here."),
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Keep a worker from claiming work, for example before its machine is restarted. Needs scope admin.

    What it runs ends there first. A worker that is started again claims work.
    """
    _set_drained(ctx, worker, "drain", {"requeue": requeue}, as_json=as_json)


@workers_app.command("undrain")
def undrain(ctx: typer.Context, worker: WorkerId, as_json: JsonFlag = False) -> None:
    """Allow a drained worker to claim work again. Needs scope admin."""
    _set_drained(ctx, worker, "undrain", None, as_json=as_json)


def _set_drained(ctx: typer.Context, worker: str, verb: str, body: Any, *, as_json: bool) -> None:
    context = context_of(ctx)
    with context.client() as client:
        chosen = [each["id"] for each in client.every("/workers") if each["id"].startswith(worker)]
        worker = chosen[0] if len(chosen) == 1 else worker  # the beginning of an id is enough
        try:
            found = client.post(f"/workers/{quote(worker, safe='')}/{verb}", body)
        except ApiError as error:
            if error.status != 404:
                raise
            raise CliError(
                f"There is no worker {plain(worker)}", fix="`naoctl workers` lists them.", code=ExitCode.NOT_FOUND
            ) from None
    if as_json:
        context.json(found)
        return
    context.out.print(f"{found['id']}: {verb}ed", markup=False)
    if verb == "drain" and (held := _held(found)):
        context.note(f"It still runs {', '.join(held)}; `naoctl workers` shows when it has none.")


def _held(worker: dict[str, Any]) -> list[str]:
    """Return the ids of the jobs, evaluations and matches that a worker runs."""
    return [*worker["jobs"], *worker.get("evaluations", ()), *worker.get("matches", ())]


def usage(
    ctx: typer.Context,
    since: Annotated[str | None, typer.Option(metavar="DATE", help="First day (UTC), such as 2026-11-01.")] = None,
    until: Annotated[str | None, typer.Option(metavar="DATE", help="Last day (UTC).")] = None,
    owner: Annotated[str | None, typer.Option(help="This owner only.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Show the core hours and the hours of attempts by owner, deleted jobs included.

    A token with scope admin shows all owners.
    """
    context = context_of(ctx)
    with context.client() as client:
        found = client.get("/usage", since=since, until=until, owner=owner)
    if as_json:
        context.json(found)
        return
    table = listing("Owner")
    for heading in ("Core hours", "Hours"):
        table.add_column(heading, justify="right")
    for item in found:
        table.add_row(cell(item["owner"]), *(f"{item[name] / 3600:,.2f}" for name in ("cpu_s", "run_s")))
    context.out.print(table if found else "Nothing was used in this period.")


def version(ctx: typer.Context, as_json: JsonFlag = False) -> None:
    """Show the versions of naoctl, of the installed packages, and of the service."""
    context = context_of(ctx)
    found: dict[str, Any] = {"naoctl": __version__, "python": sys.version.split()[0]}
    for package in PACKAGES:
        try:
            found[package] = installed_version(package)
        except PackageNotFoundError:
            found[package] = None
    target = context.target()
    found["service"] = {"url": target.url, "version": None}
    try:
        with Client(target) as client:
            found["service"]["version"] = client.get("/openapi.json")["info"]["version"]
    except (CliError, KeyError, TypeError):
        pass
    if as_json:
        context.json(found)
        return
    service = found.pop("service")
    for name, value in found.items():
        context.out.print(f"{name:<18}{value or 'not installed'}", markup=False)
    context.out.print(f"{'service':<18}{service['version'] or 'no answer'} at {service['url']}", markup=False)


@token_app.command("create")
def token_create(
    ctx: typer.Context,
    owner: Annotated[str, typer.Option(help="User whose jobs the token gives access to.")],
    name: Annotated[str, typer.Option(help="Purpose of the token.")] = "",
    scope: Annotated[
        list[str] | None,
        typer.Option(
            help="read, submit or admin, each including those before; may be repeated.", show_default="submit"
        ),
    ] = None,
    days: Annotated[float | None, typer.Option(min=0.001, help="Days until it expires.", show_default="never")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Create a token. Its secret is shown once."""
    context = context_of(ctx)
    for word in scope or []:
        if word not in SCOPES:
            raise InvalidInput(f"--scope: unknown scope {word!r}", fix=f"Choose from {', '.join(SCOPES)}.")
    body = {"owner": owner, "name": name, "scopes": scope or ["submit"], "expires_in_days": days}
    with context.client() as client:
        made = client.post("/tokens", body)
    if as_json:
        context.json(made)
        return
    context.out.print(made["token"], markup=False, soft_wrap=True)
    context.note(f"Token {made['id']} of {owner}; it cannot be shown again. Its user runs `naoctl login URL`.")


@token_app.command("list")
def token_list(ctx: typer.Context, as_json: JsonFlag = False) -> None:
    """List all tokens without their secrets."""
    context = context_of(ctx)
    with context.client() as client:
        found = client.every("/tokens")
    if as_json:
        context.json(found)
        return
    table = listing("ID", "Owner", "Name", "Scopes", "Created", "Expires", "State")
    for item in found:
        table.add_row(
            item["id"],
            cell(item["owner"]),
            cell(item["name"]),
            ", ".join(item["scopes"]),
            ago(item["created_at"]),
            item["expires_at"] or "never",
            "revoked" if item["revoked_at"] else "expired" if has_passed(item["expires_at"]) else "valid",
        )
    context.out.print(table)


@token_app.command("revoke")
def token_revoke(
    ctx: typer.Context,
    token_id: Annotated[str, typer.Argument(metavar="ID", help="The token's id, as `naoctl token list` shows it.")],
    as_json: JsonFlag = False,
) -> None:
    """Revoke a token."""
    context = context_of(ctx)
    with context.client() as client:
        try:
            client.request("DELETE", f"/tokens/{quote(token_id, safe='')}")
        except ApiError as error:
            if error.status not in (404, 422):
                raise
            raise CliError(
                f"There is no token {plain(token_id)}",
                fix="`naoctl token list` shows all tokens.",
                code=ExitCode.NOT_FOUND,
            ) from None
    if as_json:
        context.json({"id": token_id, "revoked": True})
    else:
        context.out.print(f"{token_id}: revoked", markup=False)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.add_typer(workers_app, name="workers")
    for function in (login, logout, usage, version):
        app.command(function.__name__)(function)
    app.add_typer(token_app, name="token")
