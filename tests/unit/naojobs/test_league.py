"""Tests of the ratings of teams."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from naojobs.league import Standing, standings, strengths
from naojobs.teams import MatchSpec, MatchTeam

Game = tuple[MatchSpec, tuple[int, int]]


def game(first: str, second: str, *goals: int) -> Game:
    teams = (MatchTeam(name=first.upper(), identity=first), MatchTeam(name=second.upper(), identity=second))
    return MatchSpec(teams=teams, games=1, players=1, half_s=1.0), (goals[0], goals[1])


def test_results_are_counted_for_both_teams() -> None:
    games = [game("a", "b", 2, 0), game("b", "a", 1, 1), game("a", "a", 5, 0), game("c", "a", 0, 3)]
    table = {team.name: team for team in standings(games)}
    best = table["A"]
    assert (best.wins, best.draws, best.losses, best.goals) == (2, 1, 0, [6, 1])
    assert (table["B"].wins, table["B"].draws, table["B"].losses, table["B"].goals) == (0, 1, 1, [1, 3])
    assert table["C"].losses == 1
    assert standings(games)[0] == best


def test_the_order_of_games_does_not_matter() -> None:
    games = [game("a", "b", 1, 0), game("b", "c", 2, 2), game("c", "a", 0, 1), game("b", "a", 3, 0)]
    first = standings(games)
    for order in itertools.permutations(games):
        assert standings(order) == first


def test_more_wins_are_worth_more_and_stay_finite() -> None:
    one, twenty = (standings([game("a", "b", 1, 0)] * count) for count in (1, 20))
    assert [team.name for team in one] == ["A", "B"]
    assert twenty[0].rating - twenty[1].rating > one[0].rating - one[1].rating > 0.0
    assert math.isfinite(twenty[0].rating)
    assert one[0].rating - 1500.0 == pytest.approx(1500.0 - one[1].rating, abs=1e-3)


def test_ratings_predict_the_shares_of_many_games() -> None:
    """With games drawn from known strengths, the ratings differ as the strengths do, within the noise of the draws."""
    chance = random.Random(1)
    truth = {"a": 0.8, "b": 0.0, "c": -0.5, "d": -1.2}
    games: list[Game] = []
    for first, second in itertools.combinations(truth, 2):
        for _ in range(2_000):
            wins = chance.random() < 1.0 / (1.0 + math.exp(truth[second] - truth[first]))
            games.append(game(first, second, int(wins), int(not wins)))
    found: dict[str, Standing] = {team.identity: team for team in standings(games)}
    for first, second in itertools.combinations(truth, 2):
        points = 400.0 / math.log(10.0) * (truth[first] - truth[second])
        assert found[first].rating - found[second].rating == pytest.approx(points, abs=15.0)


def test_the_fit_is_a_maximum_also_of_a_long_chain() -> None:
    """At the maximum each team's score is what its strength predicts; a chain of teams is the slowest to fit."""
    names = [f"{i:02}" for i in range(40)]
    rivals: dict[str, dict[str, int]] = {name: {} for name in names}
    scores = dict.fromkeys(names, 0.0)
    for weak, strong in itertools.pairwise(names):
        rivals[weak][strong] = rivals[strong][weak] = 20
        scores[strong] += 13.0
        scores[weak] += 7.0
    found = strengths(scores, rivals)
    for name in names:
        expected = 1.0 / (1.0 + math.exp(-found[name]))
        for other, count in rivals[name].items():
            expected += count / (1.0 + math.exp(found[other] - found[name]))
        assert scores[name] + 0.5 == pytest.approx(expected, abs=1e-3)
