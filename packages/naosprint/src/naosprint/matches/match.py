"""A match: several games of two teams, who swap the side on which they begin."""

from __future__ import annotations

import json
import threading
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING

from naospec.files import read_json, replacing, write_whole

from naosprint.matches.game import play_game
from naosprint.matches.log import GameLog
from naosprint.matches.teams import find_team

if TYPE_CHECKING:
    from collections.abc import Callable

    from naosprint.matches.game import GameSettings, Moment
    from naosprint.matches.teams import Team


_NOTE, _MAX_NOTE_BYTES = "match.json", 100_000


class MatchStoppedError(Exception):
    """A match that was stopped on request."""


def log_name(game: int) -> str:
    """Return the name of a game's log; games are counted from 1."""
    return f"game-{game:03}.npz"


def find_teams(names: tuple[str, str], scratch: Path) -> tuple[Team, Team]:
    """Return the teams that a user names; what has to be written for them goes to ``scratch``."""
    return (find_team(names[0], scratch / "a"), find_team(names[1], scratch / "b"))


def own_folder(folder: Path, teams: tuple[Team, Team], settings: GameSettings) -> int:
    """Note in a folder for logs what is played there; return how many games are over.

    Raises:
        ValueError: if the games there are of other teams, of other versions of them, or have other settings.
    """
    limits = settings.limits
    match = {
        "first team": teams[0].digest(),
        "second team": teams[1].digest(),
        "players": settings.players,
        "seconds": settings.half_s,
        "limits of agents": [limits.cpu_s, limits.memory_mb],
    }
    folder.mkdir(parents=True, exist_ok=True)
    note, over = folder / _NOTE, len(list(folder.glob("game-*.npz")))
    if over:
        known = read_json(note, _MAX_NOTE_BYTES) if note.exists() else {}
        differing = [name for name, value in match.items() if not isinstance(known, dict) or known.get(name) != value]
        if differing:
            what = ", ".join(differing) if known else "which one, is not known"
            raise ValueError(
                f"{folder}: has {over} games of another match ({what}); name another folder with --output, or remove it"
            )
    write_whole(note, json.dumps(match, indent=2) + "\n")
    return over


def play_match(
    teams: tuple[Team, Team],
    names: tuple[str, str],
    games: int,
    settings: GameSettings,
    folder: Path,
    *,
    parallel: int = 1,
    stop: Callable[[], bool] = lambda: False,
    watch: Callable[[int, Moment], None] = lambda _game, _moment: None,
    process: Callable[[int, GameLog], None] = lambda _game, _log: None,
    played: Callable[[int, GameLog], None] = lambda _game, _log: None,
    enough: Callable[[list[GameLog]], bool] = lambda _logs: False,
) -> list[GameLog]:
    """Play games and write a log of each to ``folder``; return the logs in order.

    A game whose log is there already is not played again. Team 0 begins on the left in the games with odd numbers.

    Args:
        teams: both teams.
        names: their names for people; two teams of the same name get a number.
        games: number of games.
        settings: of each game.
        folder: for the logs; created if need be.
        parallel: games at a time.
        stop: whether to end; asked about once a second.
        watch: called with the number of a running game and what it looks like, about once a second.
        process: called with number and log of each game that was played, in a thread of its own, before it counts.
        played: called one at a time with number and log of each game that is over.
        enough: called with the logs of the first games, without a gap, whenever there is one more; if it returns true,
            they are all that is returned, and no other game is played to its end.

    Raises:
        naosprint.matches.game.MatchError: if a game cannot be played; others are stopped, or count if they are over.
        MatchStoppedError: if ``stop`` returned true.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shown = names if names[0] != names[1] else (f"{names[0]} 1", f"{names[1]} 2")
    ended, decided, lock = threading.Event(), threading.Event(), threading.Lock()
    logs: dict[int, GameLog] = {}
    first: list[GameLog] = []

    def play(game: int) -> GameLog:
        path = folder / log_name(game)
        fresh = not path.exists()
        if fresh:
            if stop():
                raise MatchStoppedError
            side, known = (game - 1) % 2, bool(logs)
            log = play_game(teams, shown, side, settings, known=known, on_moment=lambda moment: look(game, moment))
            with replacing(path) as file:
                log.save(file)
        log = GameLog.load(path)  # with the digits of the file, so that a report has the same numbers
        if fresh:
            process(game, log)
        with lock:
            if decided.is_set():
                raise MatchStoppedError
            played(game, log)
            logs[game] = log
            while len(first) + 1 in logs:
                first.append(logs[len(first) + 1])
                if enough(list(first)):
                    decided.set()
                    ended.set()
                    break
        return log

    def look(game: int, moment: Moment) -> None:
        if ended.is_set() or stop():
            raise MatchStoppedError
        watch(game, moment)

    with ThreadPoolExecutor(parallel, thread_name_prefix="game") as pool:
        futures = [pool.submit(play, game) for game in range(1, games + 1)]
        finished, _ = wait(futures, return_when=FIRST_EXCEPTION)
        ended.set()
        for future in futures:
            future.cancel()
        errors = [error for future in finished if not future.cancelled() and (error := future.exception()) is not None]
        # the reason, not what it stopped
        error = min(errors, key=lambda error: isinstance(error, MatchStoppedError), default=None)
        if error is not None and not (decided.is_set() and isinstance(error, MatchStoppedError)):
            raise error
    return first
