"""Children of matches, without servers: what a match has when an attempt at it was cut off, or cannot play."""

from __future__ import annotations

import errno
import subprocess
import sys
from functools import partial

import pytest
from naojobs import matches, outcomes
from naojobs.leases import MatchClaim
from naojobs.matches import MatchRequest, StoredGame
from naojobs.models import Match
from naojobs.states import WorkState
from naojobs.store import game_key, new_nonce
from naojobs.teams import Film, upload_team
from naosim.launchers import LABELS_VARIABLE
from naosim.mujoco.program import PROGRAM_VARIABLE
from naosprint.matches.game import GameSettings
from naosprint.matches.log import GameLog
from naosprint.matches.match import log_name
from naosprint_worker import match
from naosprint_worker.assignment import write_assignment
from naosprint_worker.child_process import Services, StopRequest
from naosprint_worker.orphans import attempt_is_over
from naosprint_worker.outcome import Outcome, TrainerExitCode
from naosprint_worker.progress import Progress

from tests.integration.attempts import claim_work
from tests.unit.naojobs.test_team_archives import TEAM, packed
from tests.unit.naosprint.matches.test_results import game

from .conftest import Postgres, Service


def claim_match(service: Service, match_id: str) -> MatchClaim:
    claim = claim_work(service.sessions, Match, match_id, "worker")
    assert claim is not None
    return claim


def submit_match(service: Service, film: Film = "off") -> str:
    team = packed(("team.json", TEAM))
    upload_team(service.sessions, service.store, owner="tester", name="standing", data=team)
    request = MatchRequest(("standing", "standing"), 2, 1, 10.0, film=film)
    return matches.submit_match(service.sessions, request, owner="tester")[0].id


def over() -> GameLog:
    """Return a game that is over, in which the second team has lost a player."""
    log = game()
    lost = [{"team": 1, "number": 1, "clock_s": 3.0, "reason": "it ended"}]
    log.notes["halves"] = [{"lost": lost, "cpu_s": [], "cycles": 1}]
    return log


def without_links(*_: object, **__: object) -> None:
    raise PermissionError(errno.EPERM, "no links on this disk")


def attempt(service: Service, claim: MatchClaim, *played: int, stop: StopRequest | None = None) -> Outcome:
    """Run the child of an attempt in whose folder the logs of some games are already."""
    workdir = service.folder / "work" / str(claim.lease.attempt)
    (workdir / "logs").mkdir(parents=True)
    for number in played:
        over().save(workdir / "logs" / log_name(number))
    write_assignment(claim, workdir)
    settings = service.settings.model_copy(update={"worker_games": 1})
    services = (settings, service.sessions, service.store, workdir, stop or StopRequest(), Progress(workdir))
    return match.work(Services(*services))


@pytest.mark.parametrize("links", [True, False])
def test_the_results_are_those_of_all_games_in_whatever_order_they_were_recorded(
    service: Service, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    """Of two games at a time the second was over first; then the worker died, and the next one plays one at a time."""
    match_id = submit_match(service)
    lease = claim_match(service, match_id).lease
    outcomes.transition(service.sessions, lease, WorkState.RUNNING)
    folder = service.folder / "second"
    folder.mkdir()
    over().save(folder / log_name(2))
    key = game_key(match_id, 2, lease.attempt, new_nonce())
    stored = StoredGame(2, (0, 0), [], key, service.store.put_directory(key, folder))
    for _ in range(2):  # the first commit seemed to fail
        matches.record_game(service.sessions, lease, stored, {"games": 1}, [("info", "game 2 ended 0:0")])
    outcomes.lose(service.sessions, lease, "killed")

    if not links:  # of this disk
        monkeypatch.setattr("os.link", without_links)
    claim = claim_match(service, match_id)
    assert attempt(service, claim, 1).code is TrainerExitCode.FINISHED
    assert outcomes.succeed(service.sessions, claim.lease) is None
    with service.sessions() as session:
        summary = session.get_one(Match, match_id).summary
    assert summary is not None and summary["games"] == 2
    assert [each.number for each in matches.games_of(service.sessions, match_id)] == [1, 2]
    lines = [each.message for each in matches.events_of(service.sessions, match_id, limit=100, after=None)]
    assert [lines.count(f"game {number} ended 0:0") for number in (1, 2)] == [1, 1]
    assert "game 1, half 1, 3 s: lost theirs, player 1: it ended" in lines


def test_a_stop_while_a_game_is_filmed_costs_the_film_and_not_the_game(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = StopRequest()

    def play(*_: object, **__: object) -> GameLog:
        stop._event.set()  # as the signal does
        return over()

    monkeypatch.setattr("naosprint.matches.match.play_game", play)
    match_id = submit_match(service, film="all")
    claim = claim_match(service, match_id)
    assert attempt(service, claim, stop=stop).code is TrainerExitCode.STOPPED
    (game,) = matches.games_of(service.sessions, match_id)
    assert [file["name"] for file in game.manifest["files"]] == [log_name(1)]
    lines = [each.message for each in matches.events_of(service.sessions, match_id, limit=100, after=None)]
    assert "game 1 has no film: the match was stopped meanwhile" in lines


def test_a_match_that_this_worker_cannot_play_is_tried_again(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PROGRAM_VARIABLE, "launcher:http://127.0.0.1:9")
    monkeypatch.setenv(LABELS_VARIABLE, "job=none,attempt=1")
    outcome = attempt(service, claim_match(service, submit_match(service)))
    assert (outcome.code, outcome.kind, outcome.traceback) == (TrainerExitCode.TRANSIENT, "system", "")
    assert "a process of this machine" in outcome.message


def test_a_half_that_takes_all_of_its_time_is_not_played_again(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With three attempts of four hours for each half, one slow agent would keep a worker busy for days."""
    monkeypatch.setattr(match, "GameSettings", partial(GameSettings, wall_s=0.0))
    request = MatchRequest(("example", "example"), 1, 1, 10.0, film="off")
    match_id = matches.submit_match(service.sessions, request, owner="tester")[0].id
    outcome = attempt(service, claim_match(service, match_id))
    assert (outcome.code, outcome.kind) == (TrainerExitCode.PERMANENT, "slow")
    assert outcome.message.startswith("the half took more than 0 s of wall-clock time; use faster agents")


def test_a_match_whose_worker_died_is_queued_again_by_its_own_process(service: Service) -> None:
    """It reads the end of its standard input, as when the worker's end of the pipe is closed."""
    match_id = submit_match(service)
    workdir = service.folder / "work" / "1"
    workdir.mkdir(parents=True)
    write_assignment(claim_match(service, match_id), workdir)
    command = [sys.executable, "-m", "naosprint_worker.match", "--workdir", str(workdir)]
    process = subprocess.Popen(command, env=service.environment, stdin=subprocess.DEVNULL, start_new_session=True)
    assert process.wait(120) == TrainerExitCode.STOPPED
    with service.sessions() as session:
        row = session.get_one(Match, match_id)
    assert (row.state, row.failures, row.error) == (WorkState.QUEUED, 1, "worker worker died")


def test_a_match_that_finished_just_before_its_worker_died_has_succeeded(service: Service, postgres: Postgres) -> None:
    """Its process has left its report, and no worker was there to read it."""
    match_id = submit_match(service)
    claim = claim_match(service, match_id)
    outcome = attempt(service, claim, 1, 2)
    workdir = service.folder / "work" / str(claim.lease.attempt)
    assert not attempt_is_over(service.sessions, workdir)  # its process has reported nothing
    outcome.write(workdir)
    with postgres.read_only(service.engine.url.database or ""):
        assert not attempt_is_over(service.sessions, workdir)
    service.until(lambda: attempt_is_over(service.sessions, workdir), what="for a connection that can write")
    with service.sessions() as session:
        assert session.get_one(Match, match_id).state is WorkState.SUCCEEDED


def test_an_attempt_without_its_lease_or_its_assignment_is_over(service: Service) -> None:
    claim = claim_match(service, submit_match(service))
    workdir = service.folder / "work"
    workdir.mkdir()
    assert attempt_is_over(service.sessions, workdir)
    write_assignment(claim, workdir)
    assert not attempt_is_over(service.sessions, workdir)
    outcomes.lose(service.sessions, claim.lease, "lease expired")
    assert attempt_is_over(service.sessions, workdir)
