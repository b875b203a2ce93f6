"""Context of every command: consoles, the service's address, and ways to print."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from naoctl.client import Client
from naoctl.config import Target, resolve_target
from naoctl.errors import CliError, ExitCode, InvalidInput
from naoctl.render import SHORT_ID, make_console, print_json

JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_INERT_WORD = re.compile(r"[A-Za-z0-9][A-Za-z0-9_./@+-]*")
NEWEST = "last"
"""Reference to the newest job; no job can have this name."""
DataDir = Annotated[
    Path | None,
    typer.Option("--data-dir", metavar="FOLDER", help="Folder of the one-machine stack.", envvar="NAOCTL_DATA_DIR"),
]


@dataclass
class Context:
    """Consoles and address of the service of one run of the program."""

    url: str | None = None
    out: Console = field(default_factory=make_console)
    err: Console = field(default_factory=lambda: make_console(stderr=True))

    def target(self) -> Target:
        """Return the service's address and token."""
        return resolve_target(self.url)

    @contextmanager
    def client(self) -> Iterator[Client]:
        """Open a client of the service and close it afterwards."""
        with Client(self.target()) as client:
            yield client

    def json(self, value: Any) -> None:
        """Print a result as JSON."""
        print_json(self.out, value)

    def say(self, title: str, text: str) -> None:
        """Print a title and a text on one line."""
        self.out.print(f"[bold]{title:<12}[/bold]", end="")
        self.out.print(text, markup=False, soft_wrap=True)

    def note(self, text: str) -> None:
        """Print a note to standard error."""
        self.err.print(text, markup=False, soft_wrap=True, style="bright_black")


def context_of(command: typer.Context) -> Context:
    """Return the context of a command."""
    found = command.obj
    assert isinstance(found, Context)
    return found


def find_job(client: Client, reference: str) -> dict[str, Any]:
    """Return a job by its id, the beginning or the last six characters of its id, its name, or ``last`` for the newest.

    Raises:
        CliError: if there is no such job, or more than one.
    """
    text = reference.strip()
    if not text:
        raise InvalidInput("JOB is empty", fix="Use a job's id or name; `naoctl list` shows them.")
    if text == NEWEST:
        newest = list(client.pages("/jobs", limit=1))
        if not newest:
            raise CliError("There is no job yet", fix="Submit one with `naoctl submit`.", code=ExitCode.NOT_FOUND)
        return newest[0]
    if _is_id(text):
        found: dict[str, Any] = client.get(f"/jobs/{text}")
        return found
    named, begun = [], []
    for job in client.pages("/jobs", limit=500, q=text):
        if job["name"] == text:
            named.append(job)
        elif job["id"].startswith(text) or (len(text) >= SHORT_ID and job["id"].endswith(text)):
            begun.append(job)
    matches = named or begun
    if not matches:
        raise CliError(f"There is no job {text!r}", fix="`naoctl list` shows all jobs.", code=ExitCode.NOT_FOUND)
    if len(matches) > 1:
        ids = ", ".join(job["id"] for job in matches[:4]) + (", …" if len(matches) > 4 else "")
        raise CliError(
            f"{text!r} matches {len(matches)} jobs", fix=f"Give one of their ids: {ids}", code=ExitCode.USAGE
        )
    return matches[0]


def find_checkpoint(client: Client, job: dict[str, Any], wanted: str | None) -> dict[str, Any]:
    """Return the checkpoint of a job with an id or step; the newest if none is given.

    Raises:
        CliError: if there is none.
    """
    points: list[dict[str, Any]] = sorted(
        client.every(f"/jobs/{job['id']}/checkpoints"), key=lambda p: (p["step"], p["attempt"])
    )
    if not points:
        raise CliError(
            f"Job {job['id']} has no checkpoint yet",
            fix="Wait for its first, or for its end.",
            code=ExitCode.NOT_FOUND,
        )
    if wanted is None:
        return points[-1]
    for point in points[::-1]:
        if wanted in (point["id"], str(point["step"])):
            return point
    steps = ", ".join(str(point["step"]) for point in points[-5:])
    raise CliError(
        f"Job {job['id']} has no checkpoint {wanted!r}",
        fix=f"Its newest are at steps {steps}.",
        code=ExitCode.NOT_FOUND,
    )


def find_listed(client: Client, path: str, kind: str, reference: str) -> dict[str, Any]:
    """Return a study or a match with its details, by its id, the end of it, its name, or ``last`` for the newest.

    Args:
        client: connection to the service.
        path: list of the service, such as ``/studies``.
        kind: noun, which is also the beginning of ids and the command whose ``list`` shows all.
        reference: what the user typed.

    Raises:
        CliError: if there is none.
    """
    found: dict[str, Any]
    if len(reference) == len(kind) + 27 and reference.startswith(f"{kind}_"):
        found = client.get(f"{path}/{reference}")
        return found
    for item in client.pages(path, limit=1000):
        ends = len(reference) >= SHORT_ID and item["id"].endswith(reference)
        if reference == NEWEST or ends or item.get("name") == reference:
            found = client.get(f"{path}/{item['id']}")
            return found
    raise CliError(f"There is no {kind} {reference!r}", fix=f"`naoctl {kind} list` shows all.", code=ExitCode.NOT_FOUND)


def _is_id(text: str) -> bool:
    return len(text) == 30 and text.startswith("job_") and text[4:].isalnum()


def completions(words: Iterable[str], incomplete: str) -> list[str]:
    """Return the words that begin with ``incomplete`` and that no shell interprets.

    Shells evaluate what a completion returns: zsh while it completes, bash when the line is run.
    """
    return [word for word in dict.fromkeys(words) if word.startswith(incomplete) and _INERT_WORD.fullmatch(word)]


def complete_job(incomplete: str) -> list[str]:
    """Return names and ids of jobs for shell completion: names first; nothing if the service does not answer.

    Of a job whose name a shell would interpret it is the id alone.
    """
    try:
        with Client(resolve_target()) as client:
            jobs = list(client.pages("/jobs", limit=100, q=incomplete or None))
    except CliError:
        jobs = []
    return completions([*(job["name"] for job in jobs), NEWEST, *(job["id"] for job in jobs)], incomplete)


def stdin_is_terminal() -> bool:
    """Return whether a question can be answered on standard input."""
    return os.isatty(0)


Register = Callable[[typer.Typer], None]
