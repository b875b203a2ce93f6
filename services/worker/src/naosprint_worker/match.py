"""Child process of one attempt at a match.

Run as ``python -m naosprint_worker.match --workdir FOLDER`` by a worker, with the assignment in that folder. Every game
that is over is stored at once, and is not played again by a later attempt.
"""

from __future__ import annotations

import contextlib
import sys
import tarfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import naopolicies
from naojobs import matches, outcomes
from naojobs.leases import MatchClaim
from naojobs.matches import StoredGame
from naojobs.states import WorkState
from naojobs.store import StoreManifest, game_key, new_nonce
from naojobs.teams import ARCHIVE, MatchTeam
from naosprint.matches.film import film_name, goal_frames, write_game_film
from naosprint.matches.game import GameSettings, MatchError, Moment, TeamFailedError, TooSlowError
from naosprint.matches.log import GameLog
from naosprint.matches.match import MatchStoppedError, log_name, play_match
from naosprint.matches.results import match_results
from naosprint.matches.sequential import Gate, Verdict
from naosprint.matches.teams import Team, read_team, write_example
from naosprint.threads import quiet_openmp

from naosprint_worker.assignment import read_assignment
from naosprint_worker.child_process import EVALUATOR_OOM_SCORE, Services, run_child
from naosprint_worker.database import DATABASE_ERRORS
from naosprint_worker.outcome import Outcome, TrainerExitCode
from naosprint_worker.spool import link_or_copy


def work(services: Services) -> Outcome:
    """Run the assignment in the working folder."""
    claim = read_assignment(MatchClaim, services.workdir)
    try:
        _Match(services, claim).play()
    except MatchStoppedError:
        return Outcome(TrainerExitCode.STOPPED, "stopped", "stopped on request")
    except TeamFailedError as error:
        return Outcome(TrainerExitCode.PERMANENT, "team", str(error))
    except TooSlowError as error:
        return Outcome(TrainerExitCode.PERMANENT, "slow", str(error))
    except MatchError as error:
        return Outcome(TrainerExitCode.TRANSIENT, "system", str(error))
    return Outcome(TrainerExitCode.FINISHED, "finished", "the match finished")


class _Match:
    """The games of a match, and what is recorded of them."""

    def __init__(self, services: Services, claim: MatchClaim) -> None:
        self._services, self._claim = services, claim
        self._logs: dict[int, GameLog] = {}
        self._folder = services.workdir / "logs"
        self._gate = Gate()
        self._running: set[int] = set()
        """Numbers of the games that run; the first of them is shown."""

    def play(self) -> None:
        """Play what is not over yet and record every game."""
        services, claim, spec = self._services, self._claim, self._claim.spec
        with services.stop.interruptible():
            for number, log in claim.games.items():
                folder = services.workdir / "game"
                services.fetch(log.key, folder, StoreManifest.model_validate(log.manifest))
                self._folder.mkdir(exist_ok=True)
                path = (folder / log_name(number)).replace(self._folder / log_name(number))
                self._logs[number] = GameLog.load(path)  # at once: each result is that of all games that are over
            first, second = (self._team(team, f"team-{'ab'[side]}") for side, team in enumerate(spec.teams))
        self._database(
            lambda: outcomes.transition(services.sessions, claim.lease, WorkState.RUNNING, message="running")
        )
        at_a_time = min(spec.games, services.settings.games_at_a_time)
        if at_a_time > 1:
            self._note("info", f"{at_a_time} games at a time")
        play_match(
            (first, second),
            (spec.teams[0].name, spec.teams[1].name),
            spec.games,
            GameSettings(players=spec.players, half_s=spec.half_s),
            self._folder,
            parallel=at_a_time,
            stop=services.step,
            watch=self._watch,
            process=self._film,
            played=self._record,
            enough=lambda logs: spec.gate and self._verdict(logs) is not Verdict.OPEN,
        )

    def _team(self, team: MatchTeam, name: str) -> Team:
        """Return a team after fetching its policies, or its archive."""
        services, claim = self._services, self._claim
        folder = services.workdir / name
        if team.team_id is not None:
            archive = claim.archives[team.team_id]
            services.fetch(archive.key, services.workdir / f"{name}.d", StoreManifest.model_validate(archive.manifest))
            with tarfile.open(services.workdir / f"{name}.d" / ARCHIVE) as file:
                file.extractall(folder, filter="data")
            return read_team(folder)
        checkpoints: dict[str, Path] = {}
        for skill, policy in team.policies.items():
            if (stored := claim.checkpoints.get(policy)) is None:
                checkpoints[skill] = naopolicies.folder(policy)
                continue
            checkpoints[skill] = services.workdir / policy
            services.fetch(stored.key, checkpoints[skill], StoreManifest.model_validate(stored.manifest))
        return write_example(folder, checkpoints)

    def _watch(self, game: int, moment: Moment) -> None:
        """Show where robots and ball of the first running game are; a moment that cannot be written is left out."""
        if game not in self._running:
            self._running.add(game)
            self._note("info", f"game {game} has kicked off")
        if game != min(self._running):
            return
        with contextlib.suppress(*DATABASE_ERRORS):
            matches.record_moment(self._services.sessions, self._claim.lease, {"game": game, **asdict(moment)})

    def _film(self, number: int, log: GameLog) -> None:
        """Film a game, if that is requested and possible before a stop."""
        self._running.discard(number)
        wanted = self._claim.spec.film
        frames = goal_frames(log) if wanted == "goals" else None
        if wanted == "off" or frames == []:
            return
        path = self._game_folder(number) / film_name(number)
        try:
            write_game_film(log, path, frames=frames, stop=self._stop)
        except OSError as error:
            path.unlink(missing_ok=True)
            self._note("warning", f"game {number} has no film: {error}")
        except MatchStoppedError:  # the game counts: played again, it would end in another way
            self._note("warning", f"game {number} has no film: the match was stopped meanwhile")

    def _stop(self) -> None:
        """Raise MatchStoppedError if the match was asked to stop."""
        if self._services.step():
            raise MatchStoppedError

    def _game_folder(self, number: int) -> Path:
        """Return the folder of what is stored of a game."""
        folder = self._services.workdir / f"game-{number}"
        folder.mkdir(exist_ok=True)
        return folder

    def _record(self, number: int, log: GameLog) -> None:
        """Store a game that is over with the results so far."""
        self._logs[number] = log
        if number in self._claim.games:
            return
        services, lease = self._services, self._claim.lease
        folder = self._game_folder(number)
        link_or_copy(str(self._folder / log_name(number)), str(folder / log_name(number)))
        key = game_key(lease.id, number, lease.attempt, new_nonce())
        manifest = services.put(key, folder, what="a game")
        lost = [{"half": half, **each} for half, notes in enumerate(log.notes["halves"]) for each in notes["lost"]]
        game = StoredGame(number, log.goals, lost, key, manifest)
        lines = [("info", f"game {number} ended {log.goals[0]}:{log.goals[1]}")]
        for each in lost:
            who = f"{log.teams[each['team']]}, player {each['number']}"
            when = f"game {number}, half {each['half'] + 1}, {each['clock_s']:.0f} s"
            lines.append(("warning", f"{when}: lost {who}: {each['reason']}"))
        self._database(lambda: matches.record_game(services.sessions, lease, game, self._summary(), lines))

    def _summary(self) -> dict[str, Any]:
        logs = [log for _, log in sorted(self._logs.items())]
        results = match_results(logs)
        if self._claim.spec.gate:
            verdict = self._verdict(logs)
            results |= {
                "verdict": str(verdict),
                "decided": verdict is not Verdict.OPEN,
                "holds": verdict is Verdict.HOLDS,
            }
        return results

    def _verdict(self, logs: list[GameLog]) -> Verdict:
        return self._gate.verdict(log.goals[0] - log.goals[1] for log in logs)

    def _note(self, level: str, text: str) -> None:
        """Add a line to the match's log; one that cannot be written is left out."""
        with contextlib.suppress(*DATABASE_ERRORS):
            matches.append_lines(self._services.sessions, self._claim.lease, [(level, text)])

    def _database(self, call: Callable[[], object]) -> None:
        self._services.database(call, "recording the match")


if __name__ == "__main__":
    quiet_openmp()
    sys.exit(run_child(work, oom_score=EVALUATOR_OOM_SCORE))
