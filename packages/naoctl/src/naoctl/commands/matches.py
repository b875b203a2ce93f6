"""``naoctl match``, ``naoctl team`` and ``naoctl league``: play matches, upload teams, rank them."""

from __future__ import annotations

import io
import tarfile
import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import typer
from naospec.match_results import table as results_table
from naospec.teams import MAX_HALF_S, MAX_PLAYERS, TEAM_FILE

from naoctl.client import Client
from naoctl.commands.submit import KeyOption, NotBeforeOption, PriorityOption, TagOption, common_fields, hand_in
from naoctl.context import Context, JsonFlag, context_of, find_listed
from naoctl.errors import CliError, InvalidInput, plain
from naoctl.follow import ENDED, result_of
from naoctl.help import WholeSummaries
from naoctl.render import MISSING, ago, cell, listing, pairs, size, state_text, waiting_text
from naoctl.transfer import RemoteFile, fetch

_POLL_S = 2.0
_SETTINGS = {"help_option_names": ["-h", "--help"]}


class Filmed(StrEnum):
    """What is filmed of a game."""

    OFF = "off"
    GOALS = "goals"
    ALL = "all"


class _Group(WholeSummaries):
    """Group in which two teams may follow without a command: ``naoctl match A B``."""

    default = "play"

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        return super().resolve_command(ctx, args if args[0] in self.commands else [self.default, *args])


app = typer.Typer(
    cls=_Group,
    help="Let two teams play: naoctl match A B. List, show, cancel, retry and delete matches.",
    no_args_is_help=True,
    context_settings=_SETTINGS,
)
teams = typer.Typer(
    help="Upload, list and delete teams: folders with team.json.", no_args_is_help=True, context_settings=_SETTINGS
)

Reference = Annotated[str, typer.Argument(metavar="MATCH", help="A match's id, the end of it, or `last`.")]
OwnerOption = Annotated[
    str | None, typer.Option("--owner", metavar="USER", help="Whose; others' need scope admin.", show_default="you")
]


@app.command("play")
def play(
    ctx: typer.Context,
    first: Annotated[
        str, typer.Argument(metavar="A", help="A team: example, example:walk=POLICY,kick=POLICY, or an uploaded one.")
    ],
    second: Annotated[str, typer.Argument(metavar="B", help="The other team.")],
    games: Annotated[int, typer.Option(min=1, max=1000, help="Games; sides are swapped from game to game.")] = 20,
    players: Annotated[int, typer.Option(min=1, max=MAX_PLAYERS, help="Players of each team.")] = 3,
    seconds: Annotated[float, typer.Option(min=1, max=MAX_HALF_S, help="Play time of a half.")] = float(MAX_HALF_S),
    gate: Annotated[
        bool, typer.Option("--gate", help="Stop as soon as a test has decided whether A does not lose.")
    ] = False,
    film: Annotated[
        Filmed, typer.Option(help="What to film of each game: nothing, what led to goals, or all of it.")
    ] = Filmed.GOALS,
    tag: TagOption = None,
    priority: PriorityOption = None,
    not_before: NotBeforeOption = None,
    key: KeyOption = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for the end and print the results.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Play a match of two teams."""
    context = context_of(ctx)
    body = {
        "teams": [first, second],
        **{"games": games, "players": players, "half_s": seconds, "gate": gate},
        "film": film.value,
        **common_fields(context, tag, priority, not_before),
    }
    with context.client() as client:
        match = hand_in(client, "/matches", body, key)
        if wait:
            _follow(context, client, match["id"], quiet=as_json)
            match = client.get(f"/matches/{match['id']}")
    if as_json:
        context.json(match)
    elif wait:
        _print_results(context, match)
    else:
        a, b = map(plain, match["teams"])
        context.out.print(f"Submitted {match['id']}: {a} - {b}, {games} games", markup=False)
        context.note(f"Look at it with: naoctl match show {match['id']}")
    if wait:
        raise typer.Exit(result_of(match))


def _follow(context: Context, client: Client, match_id: str, *, quiet: bool) -> None:
    """Wait until a match has ended; note why it waits for a worker, and each game that is over."""
    seen, noted = 0, None
    while True:
        match = client.get(f"/matches/{match_id}")
        if match["waiting_reason"] not in (None, noted):
            noted = match["waiting_reason"]
            context.note(f"Waiting: {waiting_text(match)}")
        for game in match["finished"][seen:] if not quiet else ():
            context.note(f"game {game['number']}: {game['goals'][0]}:{game['goals'][1]}")
        seen = len(match["finished"])
        if match["state"] in ENDED:
            return
        time.sleep(_POLL_S)


def find_match(client: Client, reference: str) -> dict[str, Any]:
    """Return a match with its games by what a user typed. Raises CliError."""
    return find_listed(client, "/matches", "match", reference)


@app.command("list")
def list_matches(
    ctx: typer.Context,
    limit: Annotated[int, typer.Option("--limit", "-l", min=1, max=1000, help="Most matches to show.")] = 20,
    as_json: JsonFlag = False,
) -> None:
    """List matches, the newest first."""
    context = context_of(ctx)
    with context.client() as client:
        found = list(client.pages("/matches", limit=limit))
    if as_json:
        context.json(found)
        return
    table = listing("ID", "Teams", "State", "Games", "Won", "Drawn", "Lost", "Submitted")
    for match in found:
        table.add_row(
            match["id"][-6:],
            cell(" - ".join(match["teams"])),
            state_text(match["state"]),
            f"{match['played']}/{match['games']}",
            *(str(match[name]) for name in ("wins", "draws", "losses")),
            ago(match["created_at"]),
        )
    context.out.print(table if found else "No matches yet. Play one with `naoctl match A B`.")


@app.command("show")
def show_match(ctx: typer.Context, match: Reference = "last", as_json: JsonFlag = False) -> None:
    """Show a match: its state and its games."""
    context = context_of(ctx)
    with context.client() as client:
        found = find_match(client, match)
    if as_json:
        context.json(found)
        return
    minutes = f"2 x {found['half_s']:g} s, {found['players']} players"
    rows: list[tuple[str, Any]] = [
        ("Match", cell(found["id"])),
        ("Teams", cell(" - ".join(found["teams"]))),
        ("State", state_text(found["state"])),
        ("Games", f"{found['played']} of {found['games']} are over, each {minutes}"),
        (
            "Result",
            f"{found['wins']} won, {found['draws']} drawn, {found['losses']} lost by {plain(found['teams'][0])}",
        ),
    ]
    rows += [("Waiting", waiting_text(found))] if found["waiting_reason"] else []
    rows += [(title, cell(found[title.lower()])) for title in ("Worker", "Error") if found[title.lower()]]
    context.out.print(pairs(rows))
    table = listing("Game", "Goals", "Log", "Film", "Lost players")
    for game in found["finished"]:
        lost = ", ".join(f"{'AB'[each['team']]}{each['number']} ({each['reason'][:40]})" for each in game["lost"])
        goals = f"{game['goals'][0]}:{game['goals'][1]}"
        film = size(game["film"]["size"]) if game["film"] else MISSING
        table.add_row(str(game["number"]), goals, size(game["log"]["size"]), film, cell(lost or MISSING))
    if found["finished"]:
        context.out.print(table)


@app.command("report")
def report_match(
    ctx: typer.Context,
    match: Reference = "last",
    logs: Annotated[
        Path | None, typer.Option("--logs", metavar="FOLDER", help="Download the logs of the games there, too.")
    ] = None,
    films: Annotated[
        Path | None, typer.Option("--films", metavar="FOLDER", help="Download the films of the games there, too.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Print the results of a match: goals, possession, falls, kicks and more, with intervals."""
    context = context_of(ctx)
    with context.client() as client:
        found = find_match(client, match)
        for folder, kind in ((logs, "log"), (films, "film")):
            if folder is None:
                continue
            folder.mkdir(parents=True, exist_ok=True)
            for game in found["finished"]:
                if game[kind]:
                    fetch(client, RemoteFile(**game[kind]), folder)
    if as_json:
        context.json(found["summary"])
    else:
        _print_results(context, found)


def _print_results(context: Context, match: dict[str, Any]) -> None:
    if match["summary"] is None:
        raise CliError(
            f"No game of {match['id']} is over; it is {match['state']}"
            + (f": {plain(match['error'])}" if match["error"] else ""),
            fix="`naoctl match show` shows why it waits or failed.",
        )
    context.out.print(plain(results_table(match["summary"]), keep="\n"), markup=False, soft_wrap=True)
    if "verdict" in match["summary"]:
        first, second = map(plain, match["teams"])
        context.note(f"{first} {match['summary']['verdict']} against {second}")


@app.command("logs")
def show_log(ctx: typer.Context, match: Reference = "last", as_json: JsonFlag = False) -> None:
    """Print the history of a match and the lines of its log, oldest first."""
    context = context_of(ctx)
    with context.client() as client:
        path = f"/matches/{find_match(client, match)['id']}/events"
        found: list[dict[str, Any]] = []
        while page := client.get(path, limit=200, after=found[-1]["id"] if found else None)["items"]:
            found += page
    if as_json:
        context.json(found)
        return
    table = listing("At", "Attempt", "Kind", "Message")
    for event in found:
        table.add_row(ago(event["at"]), str(event["attempt"]), cell(event["kind"]), cell(event["message"]))
    context.out.print(table)


def _act(ctx: typer.Context, match: str, action: str, *, as_json: bool) -> None:
    context = context_of(ctx)
    with context.client() as client:
        found = client.post(f"/matches/{find_match(client, match)['id']}/{action}")
    if as_json:
        context.json(found)
        return
    state = "is asked to stop" if found["cancel_requested"] else found["state"]
    context.out.print(f"{found['id']}: {state}", markup=False)


@app.command("cancel")
def cancel_match(ctx: typer.Context, match: Reference, as_json: JsonFlag = False) -> None:
    """Cancel a match; the games that are over stay."""
    _act(ctx, match, "cancel", as_json=as_json)


@app.command("retry")
def retry_match(ctx: typer.Context, match: Reference, as_json: JsonFlag = False) -> None:
    """Queue a failed or cancelled match again; games that are over are not played again."""
    _act(ctx, match, "retry", as_json=as_json)


@app.command("delete")
def delete_match(ctx: typer.Context, match: Reference, as_json: JsonFlag = False) -> None:
    """Delete a match that has ended, with its logs."""
    context = context_of(ctx)
    with context.client() as client:
        found = find_match(client, match)
        client.request("DELETE", f"/matches/{found['id']}")
    if as_json:
        context.json({"deleted": found["id"]})
    else:
        context.out.print(f"Deleted {found['id']}", markup=False)


def league(ctx: typer.Context, owner: OwnerOption = None, as_json: JsonFlag = False) -> None:
    """Rank teams by Elo over all games of all matches."""
    context = context_of(ctx)
    with context.client() as client:
        found = client.get("/league", owner=owner)
    if as_json:
        context.json(found)
        return
    table = listing("", "Team", "Elo", "Won", "Drawn", "Lost", "Goals")
    for place, team in enumerate(found, start=1):
        numbers = [str(team[name]) for name in ("wins", "draws", "losses")]
        goals = f"{team['goals'][0]}:{team['goals'][1]}"
        table.add_row(str(place), cell(team["name"]), f"{team['rating']:.0f}", *numbers, goals)
    context.out.print(
        table
        if found
        else "No games yet; those of a team against itself do not count. Play a match with `naoctl match A B`."
    )


@teams.command("upload")
def upload_team(
    ctx: typer.Context,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with team.json.")],
    name: Annotated[str | None, typer.Option("--name", "-n", help="Name.", show_default="the folder's")] = None,
    owner: OwnerOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Upload a team, whose command then runs on workers; this needs scope admin."""
    if not (folder / TEAM_FILE).is_file():
        raise InvalidInput(f"{folder} has no {TEAM_FILE}", fix="docs/how-to/match.md shows one.")
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.add(folder, arcname=".", filter=_plain_member)
    context = context_of(ctx)
    path = f"/teams/{quote(name or folder.resolve().name, safe='')}"
    with context.client() as client:
        found = client.request("PUT", path, archive=buffer.getvalue(), params={"owner": owner})
    if as_json:
        context.json(found)
    else:
        context.out.print(f"Uploaded {plain(found['name'])}: {size(found['size'])}", markup=False)


def _plain_member(member: tarfile.TarInfo) -> tarfile.TarInfo | None:
    """Leave out caches, and who owns a file here."""
    if member.name.split("/")[-1] in ("__pycache__", ".git", ".venv"):
        return None
    member.uid = member.gid = 0
    member.uname = member.gname = ""
    return member


@teams.command("list")
def list_teams(ctx: typer.Context, owner: OwnerOption = None, as_json: JsonFlag = False) -> None:
    """List uploaded teams."""
    context = context_of(ctx)
    with context.client() as client:
        found = client.every("/teams", owner=owner)
    if as_json:
        context.json(found)
        return
    table = listing("Name", "Owner", "Size", "Uploaded")
    for team in found:
        table.add_row(cell(team["name"]), cell(team["owner"]), size(team["size"]), ago(team["created_at"]))
    context.out.print(table if found else "No teams yet. Upload one with `naoctl team upload FOLDER`.")


@teams.command("delete")
def delete_team(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(metavar="TEAM", help="Name of the team.")],
    owner: OwnerOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Delete an uploaded team; its matches stay."""
    context = context_of(ctx)
    with context.client() as client:
        client.request("DELETE", f"/teams/{quote(name, safe='')}", params={"owner": owner})
    if as_json:
        context.json({"deleted": name})
    else:
        context.out.print(f"Deleted {plain(name)}", markup=False)


def register(application: typer.Typer) -> None:
    """Add the commands."""
    application.add_typer(app, name="match")
    application.add_typer(teams, name="team")
    application.command("league")(league)
