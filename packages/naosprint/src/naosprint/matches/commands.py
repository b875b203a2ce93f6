"""Commands ``match`` and ``team`` of the command line."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies
from naospec.match_results import table
from naospec.teams import EXAMPLE, skills_of

from naosprint.matches.agents import Limits
from naosprint.matches.game import GameSettings
from naosprint.matches.log import GameLog
from naosprint.matches.match import MatchStoppedError, find_teams, log_name, own_folder, play_match
from naosprint.matches.results import match_results
from naosprint.matches.sequential import Gate, Verdict
from naosprint.matches.teams import write_example

if TYPE_CHECKING:
    from collections.abc import Callable

REPORT, FILM = "report", "film"
_TEAM_HELP = "'example', 'example:walk=POLICY,kick=POLICY,keep=POLICY,getup=POLICY', or a folder with team.json"


def play(options: argparse.Namespace, stop_on_signals: Callable[[], Callable[[], bool]]) -> int:
    """Play a match; report on logs if the first word is ``report``, film one if it is ``film``."""
    first, *others = options.teams
    if first == REPORT:
        return _report([Path(each) for each in others], as_json=options.json)
    if first == FILM:
        return _film([Path(each) for each in others], options.output or Path("match.mp4"), goals=options.goals)
    if len(others) != 1:
        raise ValueError("match: name two teams, 'report' and logs of games, or 'film' and a log")
    if options.games < 1 or options.parallel < 1:
        raise ValueError("--games, --parallel: must be at least 1")
    settings = GameSettings(
        players=options.players,
        half_s=options.seconds,
        limits=Limits(cpu_s=options.cpu_seconds, memory_mb=options.memory_mb),
    )
    names, gate, output = (first, others[0]), Gate(), options.output or Path("match")
    stop = stop_on_signals()

    def played(game: int, log: GameLog) -> None:
        sys.stderr.write(f"game {game}: {log.teams[0]} {log.goals[0]}:{log.goals[1]} {log.teams[1]}\n")
        for half, notes in enumerate(log.notes.get("halves", []), start=1):
            for lost in notes["lost"]:
                who = f"{log.teams[lost['team']]}, player {lost['number']}"
                sys.stderr.write(f"  half {half}, {lost['clock_s']:.0f} s: lost {who}: {lost['reason']}\n")

    with tempfile.TemporaryDirectory(prefix="naosprint-match-") as scratch:
        teams = find_teams(names, Path(scratch))
        shown = (_shown(first), _shown(others[0]))
        if (over := own_folder(output, teams, settings)) > 0:
            sys.stderr.write(f"{output}: {over} games are over already; they count, and are not played again\n")
        try:
            logs = play_match(
                teams,
                shown,
                options.games,
                settings,
                output,
                parallel=options.parallel,
                stop=stop,
                played=played,
                enough=lambda logs: options.gate and gate.verdict(_differences(logs)) is not Verdict.OPEN,
            )
        except MatchStoppedError:
            sys.stderr.write(f"stopped; the games that are over are in {output}\n")
            return 1
    _print(logs, as_json=options.json)
    if not options.gate:
        return 0
    verdict = gate.verdict(_differences(logs))
    sys.stderr.write(f"{shown[0]} {verdict} against {shown[1]}, after {len(logs)} of at most {options.games} games\n")
    return 0 if verdict is Verdict.HOLDS else 1


def _differences(logs: list[GameLog]) -> list[int]:
    return [log.goals[0] - log.goals[1] for log in logs]


def team(options: argparse.Namespace) -> int:
    """Write the example team to a folder."""
    if options.folder.exists() and any(options.folder.iterdir()):
        raise ValueError(f"{options.folder}: is not empty; name a new folder")
    if options.team.partition(":")[0] != EXAMPLE:
        raise ValueError(f"--team: expected {EXAMPLE!r} with or without policies of its skills, not {options.team!r}")
    references = skills_of(options.team)
    write_example(options.folder, {skill: naopolicies.resolve(each) for skill, each in references.items()})
    for path in sorted(options.folder.iterdir()):
        sys.stdout.write(f"{path}\n")
    return 0


def _report(paths: list[Path], *, as_json: bool) -> int:
    found: list[Path] = []
    for path in paths:
        found += sorted(path.glob("game-*.npz")) if path.is_dir() else [_existing(path)]
    if not found:
        raise ValueError(f"match report: name logs of games ({log_name(1)}), or a folder with them")
    _print([GameLog.load(path) for path in found], as_json=as_json)
    return 0


def _existing(path: Path) -> Path:
    """Return the file of a log. Raises ValueError if there is none."""
    if not path.is_file():
        raise ValueError(f"{path}: there is no such log; `naosprint match` writes {log_name(1)} into its folder")
    return path


def _film(paths: list[Path], output: Path, *, goals: bool) -> int:
    from naosprint.matches.film import goal_frames, write_game_film

    if len(paths) != 1:
        raise ValueError(f"match film: name one log of a game ({log_name(1)})")
    output.parent.mkdir(parents=True, exist_ok=True)
    log = GameLog.load(_existing(paths[0]))
    frames = goal_frames(log) if goals else None
    if frames == []:
        raise ValueError(f"{paths[0]}: no goal was scored; leave out --goals to film the whole game")
    write_game_film(log, output, frames=frames)
    sys.stdout.write(f"{output}\n")
    return 0


def _print(logs: list[GameLog], *, as_json: bool) -> None:
    results = match_results(logs)
    sys.stdout.write((json.dumps(results, indent=2) if as_json else table(results)) + "\n")


def _shown(name: str) -> str:
    """Return a team's name for people: of a folder its last part."""
    return Path(name).resolve().name if Path(name).is_dir() else name


def add_parsers(commands: Any, stop: Callable[[], Callable[[], bool]]) -> None:
    """Add the commands; ``stop`` installs the handlers of signals and returns whether one came."""
    match = commands.add_parser(
        "match",
        help="let two teams play on rcssservermj",
        description="Play games of two teams on real servers, with swapped sides, and print the results; print "
        "them again from logs: match report FOLDER; or film a game from its log: match film LOG -o match.mp4.",
    )
    match.add_argument(
        "teams",
        nargs="+",
        metavar="TEAM",
        help=f"two teams, each {_TEAM_HELP}; or 'report' and logs, or 'film' and a log",
    )
    match.add_argument("--games", type=int, default=2, help="number of games (default: 2)")
    match.add_argument("--players", type=int, default=3, help="players of each team, 1 to 7 (default: 3)")
    match.add_argument("--seconds", type=float, default=300.0, help="play time of a half (default: 300, at most 300)")
    match.add_argument("--parallel", type=int, default=1, metavar="N", help="games at a time (default: 1)")
    match.add_argument(
        "-o",
        "--output",
        type=Path,
        help="folder for the logs (default: match); of a film its file (default: match.mp4)",
    )
    match.add_argument("--goals", action="store_true", help="film only what led to goals")
    match.add_argument("--cpu-seconds", type=int, default=Limits.cpu_s, help="processor time of an agent in a half")
    match.add_argument("--memory-mb", type=int, default=Limits.memory_mb, help="memory of an agent, MiB")
    match.add_argument(
        "--gate",
        action="store_true",
        help="stop as soon as a sequential test has decided whether the first team does not lose; exit code 1 if it "
        "does, or if --games were too few",
    )
    match.add_argument("--json", action="store_true", help="print the results as JSON")
    match.set_defaults(run=lambda options: play(options, stop), written=Path.cwd())
    write = commands.add_parser(
        "team", help="write the example team", description="Write the example team to a folder, to change and play it."
    )
    write.add_argument("folder", type=Path, help="new folder")
    write.add_argument("--team", default="example", help="'example' with the policies of its skills")
    write.set_defaults(run=team)
