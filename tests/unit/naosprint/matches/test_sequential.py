"""The sequential test, and matches that end with it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from naosprint.matches import match
from naosprint.matches.game import GameSettings, MatchError
from naosprint.matches.log import GameLog
from naosprint.matches.match import MatchStoppedError, log_name, play_match
from naosprint.matches.sequential import Gate, Verdict
from naosprint.matches.teams import Team

from .test_results import game


def decisions(p: float, gate: Gate, trials: int = 1000) -> tuple[float, float]:
    """Return the share of trials in which a team with probability p of a win holds, and the games that it takes."""
    rng = np.random.default_rng(0)
    held, games = 0, 0
    for _ in range(trials):
        results = [1 if win else -1 for win in rng.random(400) < p]
        verdict = gate.verdict(results)
        assert verdict is not Verdict.OPEN
        held += verdict is Verdict.HOLDS
        games += next(n for n in range(1, 400) if gate.verdict(results[:n]) is not Verdict.OPEN) if trials < 200 else 0
    return held / trials, games / trials


def test_errors_are_as_rare_as_promised() -> None:
    gate = Gate()
    assert decisions(gate.holding, gate)[0] >= 0.88
    assert decisions(gate.losing, gate)[0] <= 0.12
    assert decisions(0.7, gate)[0] >= 0.99


def test_it_stops_early() -> None:
    gate = Gate()
    assert gate.verdict([1] * 5) is Verdict.HOLDS
    assert gate.verdict([1] * 4) is Verdict.OPEN
    assert gate.verdict([-1] * 7) is Verdict.LOSES
    assert gate.verdict([0] * 100) is Verdict.OPEN
    assert decisions(0.5, gate, trials=100)[1] < 30
    assert gate.ratio([1, 0, -1]) == pytest.approx(math.log(0.5 / 0.3) + math.log(0.5 / 0.7))


@pytest.mark.parametrize("numbers", [{"losing": 0.6}, {"error": 0.5}, {"holding": 1.0}])
def test_numbers_that_make_no_test_are_refused(numbers: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="|".join(numbers)):
        Gate(**numbers)


@pytest.mark.parametrize("parallel", [1, 3])
def test_a_match_ends_when_it_is_decided(tmp_path: Path, parallel: int) -> None:
    """With logs of games that were played before, which are not played again."""
    wins = [True, False, *[True] * 8]
    for number, win in enumerate(wins, start=1):
        log = replace(game(goals=(1, 0) if win else (0, 1)), notes={})
        log.save(tmp_path / log_name(number))
    gate, team = Gate(), Team(tmp_path, ("none",))

    def decided(logs: list[GameLog]) -> bool:
        return gate.verdict([log.goals[0] - log.goals[1] for log in logs]) is not Verdict.OPEN

    logs = play_match((team, team), ("a", "b"), 10, GameSettings(), tmp_path, parallel=parallel, enough=decided)
    assert [log.goals for log in logs] == [(1, 0), (0, 1), *[(1, 0)] * 4]
    assert len(play_match((team, team), ("a", "b"), 10, GameSettings(), tmp_path, parallel=parallel)) == 10


def test_a_game_that_is_over_counts_though_another_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is being filmed meanwhile; the next attempt would play it again."""
    filmed, runs, stopped = threading.Event(), threading.Event(), threading.Event()
    kinds = iter(("over", "fails", "runs"))

    def play(*_: object, on_moment: Callable[[object], None], **__: object) -> GameLog:
        kind = next(kinds)
        if kind == "over":
            return replace(game(), notes={})
        if kind == "fails":
            assert filmed.wait(60) and runs.wait(60)
            raise MatchError("the server ended")
        runs.set()
        try:
            while True:
                on_moment(None)
        except MatchStoppedError:
            stopped.set()
            raise

    def film(_number: int, _log: GameLog) -> None:
        filmed.set()
        assert stopped.wait(60)

    monkeypatch.setattr(match, "play_game", play)
    team, played = Team(tmp_path, ("none",)), []
    with pytest.raises(MatchError, match="the server ended"):
        play_match(
            (team, team),
            ("a", "b"),
            3,
            GameSettings(),
            tmp_path,
            parallel=3,
            process=film,
            played=lambda number, _: played.append(number),
        )
    assert len(played) == 1
