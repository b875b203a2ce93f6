"""Results and logs of games that are made up here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from naospec.match_results import table
from naosprint.matches.log import GameLog
from naosprint.matches.results import game_results, match_results
from naosprint.matches.stream import PLAY_MODES

PLAY_ON, THROW_IN = PLAY_MODES.index("PlayOn"), PLAY_MODES.index("KickIn_Left")


def game(n: int = 500, teams: tuple[str, str] = ("ours", "theirs"), goals: tuple[int, int] = (0, 0)) -> GameLog:
    """Return a game of one robot a team, which stand 10 m from the ball, in two halves."""
    torso = np.zeros((n, 2, 3), np.float32)
    torso[..., 2] = 0.6
    torso[:, 0, 0], torso[:, 1, 0] = -10.0, 10.0
    score = np.zeros((n, 2), np.uint8)
    score[-1] = goals
    return GameLog(
        teams=teams,
        robots=[(0, 1), (1, 1)],
        sides=[0, 1],
        half=np.repeat(np.arange(2, dtype=np.uint8), n // 2),
        clock_s=np.tile(np.arange(n // 2, dtype=np.float32) * 0.04, 2),
        mode=np.full(n, PLAY_ON, np.uint8),
        score=score,
        ball_m=np.tile(np.array([0.0, 0.0, 0.11], np.float32), (n, 1)),
        torso_m=torso,
        quaternion=np.tile(np.array([1.0, 0, 0, 0], np.float32), (n, 2, 1)),
        joints_rad=np.zeros((n, 2, 23), np.float32),
        present=np.ones((n, 2), bool),
    )


def test_a_kick_to_a_teammate_keeps_the_ball_and_one_to_the_opponent_does_not() -> None:
    found = []
    for receiver in (0, 1):
        log = game()
        log.ball_m[50:100, 0] = np.linspace(0.0, 4.0, 50)  # 2 m/s
        log.ball_m[100:, 0] = 4.0
        log.torso_m[:60, 0, 0] = -0.5
        log.torso_m[60:, receiver, 0] = 4.3
        ours, theirs = game_results(log)
        assert (ours.kicks, theirs.kicks) == (1, 0)
        found.append(ours.good_kicks)
    assert found == [1, 0]


def test_a_ball_that_the_referee_moves_is_not_kicked() -> None:
    log = game()
    log.torso_m[:, 0, 0] = -0.5
    log.ball_m[100:, 0] = 20.0
    assert game_results(log)[0].kicks == 0


def test_falls_count_on_the_field_only_and_time_on_the_ground_is_theirs() -> None:
    log = game()
    log.torso_m[100:150, 0, 2] = 0.1
    log.torso_m[200:225, 1, 2] = 0.1
    log.torso_m[200:225, 1, 1] = 21.0
    ours, theirs = game_results(log)
    assert (ours.falls, theirs.falls) == (1, 0)
    assert ours.lying_s == pytest.approx(2.0)
    assert theirs.lying_s == 0.0


def test_the_side_is_that_of_the_half() -> None:
    log = game()
    log.ball_m[:, 0] = 5.0  # at +x all the time: the other's half, then the own
    ours, theirs = game_results(log)
    assert ours.attacking == pytest.approx(0.5)
    assert theirs.attacking == pytest.approx(0.5)
    log.mode[250:] = THROW_IN
    ours, theirs = game_results(log)
    assert (ours.attacking, theirs.attacking) == (1.0, 0.0)


def test_distance_is_without_relocations() -> None:
    log = game()
    log.torso_m[:250, 0, 0] = np.linspace(-10.0, -5.0, 250)
    log.torso_m[250:, 0, 0] = -20.0
    assert game_results(log)[0].run_m == pytest.approx(5.0, abs=0.2)


def test_a_match_has_intervals_and_its_table_fits_a_terminal() -> None:
    results = match_results([game(goals=(2, 0)), game(goals=(1, 1)), game(goals=(3, 1)), game(goals=(0, 1))])
    assert (results["wins"], results["draws"], results["losses"]) == (2, 1, 1)
    assert results["goal_difference"] == pytest.approx(0.75)
    low, high = results["goal_difference_interval"]
    assert low < 0.75 < high
    assert max(map(len, table(results).splitlines())) <= 80
    with pytest.raises(ValueError, match="different teams"):
        match_results([game(), game(teams=("a", "b"))])


def test_goals_of_a_single_game_have_no_interval() -> None:
    results = match_results([game(goals=(2, 0))])
    assert results["goals_interval"] == [None, None] and results["goal_difference_interval"] is None
    lines = table(results).splitlines()
    assert lines[1].split() == ["goals", "2.00", "0.00"]
    assert lines[-1] == "goal difference +2.00, 95 % interval of the win rate"


def test_who_had_the_ball_at_half_time_does_not_have_it_in_the_second_half() -> None:
    log = game()
    log.torso_m[200:250, 0, 0] = -0.5
    log.torso_m[400:, 1, 0] = 0.5
    ours, theirs = game_results(log)
    assert (ours.possession, theirs.possession) == (pytest.approx(1 / 3), pytest.approx(2 / 3))


def test_a_log_read_again_gives_the_same_results(tmp_path: Path) -> None:
    log = game(goals=(1, 0))
    rng = np.random.default_rng(0)
    log.ball_m[:, :2] = np.cumsum(rng.normal(0.0, 0.03, (500, 2)), axis=0)
    log.torso_m[:, 0, :2] = log.ball_m[:, :2] - 0.3
    log.notes = {"halves": [{"lost": [{"team": 1, "number": 1}], "cpu_s": [], "cycles": 1}]}
    log.save(tmp_path / "game-001.npz")
    once = GameLog.load(tmp_path / "game-001.npz")
    once.save(tmp_path / "game-002.npz")
    again = GameLog.load(tmp_path / "game-002.npz")
    assert match_results([once]) == match_results([again])
    assert match_results([once])["per_game"][0][1]["lost_players"] == 1
    assert once.goals == (1, 0)


@pytest.mark.parametrize("content", [b"", b"PK", b"not a log"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "game-001.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"."):
        GameLog.load(path)
