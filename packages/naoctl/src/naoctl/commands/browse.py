"""``naoctl open``: the dashboard in the browser, signed in."""

from __future__ import annotations

import webbrowser
from html import escape
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import typer
from naospec.files import write_whole

from naoctl.config import PRIVATE, Target, config_path
from naoctl.context import JsonFlag, complete_job, completions, context_of, find_job

PAGES = ("jobs", "studies", "policies", "workers", "submit")
"""Pages of the dashboard that have a name of their own here."""


def _complete(incomplete: str) -> list[str]:
    return [*completions(PAGES, incomplete), *complete_job(incomplete)]


def open_dashboard(
    ctx: typer.Context,
    what: Annotated[
        str,
        typer.Argument(
            metavar="JOB|PAGE",
            help="A job's id, its name or `last`, or one of the pages jobs, studies, policies, workers, submit.",
            autocompletion=_complete,
        ),
    ] = "jobs",
    print_only: Annotated[bool, typer.Option("--print", help="Print the address, open nothing.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Open the dashboard, or the page of a job, in the browser.

    You are signed in with the token of this command line. The browser reads it from a file that only you can read,
    because other users see the arguments of programs. The printed address has no token.
    """
    context = context_of(ctx)
    target = context.target()
    if what in PAGES:
        path = "/" if what == "jobs" else f"/{what}"
    else:
        with context.client() as client:
            path = job_path(find_job(client, what)["id"])
    url = address(target, path)
    opened = not print_only and not as_json and webbrowser.open(sign_in_page(target, path).as_uri())
    if as_json:
        context.json({"url": url})
    else:
        context.out.print(url, markup=False, soft_wrap=True)
    if not opened and not print_only and not as_json:
        context.note("There is no browser here; open this address in one.")


def job_path(job_id: str) -> str:
    """Return the path of a job's page within the dashboard."""
    return f"/jobs/{job_id}"


def address(target: Target, path: str) -> str:
    """Return the address of a page of the dashboard."""
    return f"{target.url}/#{path}"


def sign_in_page(target: Target, path: str) -> Path:
    """Write a page for this user's browser that leads to a page of the dashboard with the token; return its path."""
    page = config_path().with_name("sign-in.html")
    page.parent.mkdir(parents=True, exist_ok=True)
    url = address(target, path) + (f"?token={quote(target.token, safe='')}" if target.token else "")
    write_whole(page, f'<meta http-equiv="refresh" content="0; url={escape(url)}">\n', mode=PRIVATE)
    return page


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("open")(open_dashboard)
