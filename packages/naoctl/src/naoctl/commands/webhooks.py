"""``naoctl webhook``: create, list and delete webhooks, and show their deliveries."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated
from urllib.parse import quote

import typer
from rich.table import Table

from naoctl.client import ApiError
from naoctl.context import JsonFlag, context_of, stdin_is_terminal
from naoctl.errors import CliError, ExitCode, plain
from naoctl.render import MISSING, ago, cell

app = typer.Typer(
    help="Create, list and delete webhooks: addresses that receive messages about your jobs, by e-mail and chat, too.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Reference = Annotated[str, typer.Argument(metavar="ID", help="The webhook's id, as `naoctl webhook list` shows it.")]


@contextmanager
def _path_of(webhook: str) -> Iterator[str]:
    """Yield the path of a webhook; if there is none, raise an error that names the list."""
    try:
        yield f"/webhooks/{quote(webhook, safe='')}"
    except ApiError as error:
        if error.status not in (404, 422):
            raise
        raise CliError(
            f"There is no webhook {plain(webhook)}",
            fix="`naoctl webhook list` shows your webhooks.",
            code=ExitCode.NOT_FOUND,
        ) from None


@app.command("create")
def create_webhook(
    ctx: typer.Context,
    url: Annotated[
        str,
        typer.Argument(
            metavar="URL",
            help="Where messages are sent: http or https for signed JSON; mailtos://, slack://, discord://, tgram://, "
            "ntfys:// and others of apprise for alerts; `-` reads it from standard input.",
        ),
    ],
    event: Annotated[
        list[str] | None,
        typer.Option(
            "--event",
            "-e",
            metavar="TYPE",
            help="job.ended, job.stalled, evaluation.finished, match.ended or study.finished; may be repeated.",
            show_default="all",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Create a webhook, or alerts by e-mail or chat. The secret of a webhook's signatures is shown once."""
    context = context_of(ctx)
    if url == "-":
        url = (
            typer.prompt("Address", hide_input=True, err=True) if stdin_is_terminal() else sys.stdin.readline().strip()
        )
    with context.client() as client:
        made = client.post("/webhooks", {"url": url, **({"events": event} if event else {})})
    if as_json:
        context.json(made)
        return
    if made["secret"]:
        context.out.print(made["secret"], markup=False, soft_wrap=True)
        what = f"Secret of webhook {made['id']}; it cannot be shown again."
    else:
        context.out.print(made["id"], markup=False)
        what = f"Alerts go to {plain(made['url'])}."
    context.note(
        f"{what} Messages: {', '.join(made['events'])}. `naoctl webhook deliveries {made['id']}` shows what was sent."
    )


@app.command("list")
def list_webhooks(ctx: typer.Context, as_json: JsonFlag = False) -> None:
    """List webhooks without their secrets."""
    context = context_of(ctx)
    with context.client() as client:
        found = client.every("/webhooks")
    if as_json:
        context.json(found)
        return
    table = Table("ID", "Address", "Messages", "Created", "State", box=None, pad_edge=False, header_style="bold")
    for item in found:
        state = "disabled: its receiver or its token is gone" if item["disabled_at"] else "active"
        table.add_row(item["id"], cell(item["url"]), ", ".join(item["events"]), ago(item["created_at"]), state)
    context.out.print(table if found else "No webhooks yet. Create one with `naoctl webhook create URL`.")


@app.command("deliveries")
def list_deliveries(
    ctx: typer.Context,
    webhook: Reference,
    limit: Annotated[int, typer.Option("--limit", "-l", min=1, max=1000, help="Most messages to show.")] = 20,
    as_json: JsonFlag = False,
) -> None:
    """List the messages to a webhook, the newest first, with the last error of each."""
    context = context_of(ctx)
    with context.client() as client, _path_of(webhook) as path:
        found = list(client.pages(f"{path}/deliveries", limit=limit))
    if as_json:
        context.json(found)
        return
    table = Table("Message", "Type", "Created", "State", "Last error", box=None, pad_edge=False, header_style="bold")
    for item in found:
        if item["delivered_at"]:
            state = f"delivered {ago(item['delivered_at'])}"
        else:
            state = f"attempt {item['attempts'] + 1} follows" if item["next_at"] else "given up"
        table.add_row(item["id"], item["type"], ago(item["created_at"]), state, cell(item["error"] or MISSING))
    context.out.print(table if found else "No messages yet.")


@app.command("delete")
def delete_webhook(ctx: typer.Context, webhook: Reference, as_json: JsonFlag = False) -> None:
    """Delete a webhook and its messages, also those that are not delivered yet."""
    context = context_of(ctx)
    with context.client() as client, _path_of(webhook) as path:
        client.request("DELETE", path)
    if as_json:
        context.json({"deleted": webhook})
    else:
        context.out.print(f"Deleted {webhook}", markup=False)


def register(application: typer.Typer) -> None:
    """Add the commands."""
    application.add_typer(app, name="webhook")
