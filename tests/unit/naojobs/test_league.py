"""Tests of the ratings of teams."""

from __future__ import annotations

import itertools
import math
import random
from collections import defaultdict

import pytest
from naojobs.league import Results, Standing, standings, strengths


def game(first: str, second: str, own: int, against: int) -> Results:
    """Return the result of one game."""
    names = (first.upper(), second.upper())
    return Results((first, second), names, own > against, own == against, own < against, (own, against))


def summed(games: list[Results]) -> list[Results]:
    """Return the games by pair of teams, as the database counts them."""
    pairs: defaultdict[tuple[tuple[str, str], tuple[str, str]], list[Results]] = defaultdict(list)
    for each in games:
        pairs[each.identities, each.names].append(each)
    return [
        Results(
            *pair,
            *(sum(getattr(each, name) for each in found) for name in ("wins", "draws", "losses")),
            (sum(each.goals[0] for each in found), sum(each.goals[1] for each in found)),
        )
        for pair, found in pairs.items()
    ]


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


@pytest.mark.parametrize("seed", range(5))
def test_pairs_of_teams_have_the_ratings_of_their_games(seed: int) -> None:
    """As if each game were counted and fitted by itself; teams play on both sides, some of them against themselves."""
    chance = random.Random(seed)
    teams = [f"{chance.randrange(100)}-{i}" for i in range(chance.randint(2, 12))]
    skill = {team: chance.gauss(1.5, 1.0) for team in teams}
    games = []
    for _ in range(150):
        pair = chance.choices(teams, k=2)
        own, against = (max(0, round(chance.gauss(skill[team], 1.0))) for team in pair)
        games.append(game(pair[0], pair[1], own, against))
    table = standings(summed(games))
    assert table == standings(games)

    strength = dict.fromkeys(
        sorted({team for each in games if len(set(each.identities)) == 2 for team in each.identities}), 0.0
    )
    points = dict.fromkeys(strength, 0.5)
    opponents: dict[str, list[str]] = {team: [] for team in strength}
    for each in games:
        for team, other, won in zip(each.identities, each.identities[::-1], (each.wins, each.losses), strict=True):
            if team != other:
                points[team] += won + 0.5 * each.draws
                opponents[team].append(other)
    change = 1.0
    for _ in range(2_000):
        if change < 1e-7:
            break
        change = 0.0
        for team, own in strength.items():
            chances = [1.0 / (1.0 + math.exp(-own))]
            chances += [1.0 / (1.0 + math.exp(strength[other] - own)) for other in opponents[team]]
            step = (points[team] - sum(chances)) / sum(p * (1.0 - p) for p in chances)
            strength[team] = own + max(-1.0, min(1.0, step))
            change = max(change, abs(strength[team] - own))
    for row in table:
        assert row.rating == pytest.approx(1500.0 + 400.0 / math.log(10.0) * strength[row.identity], abs=1e-9)
        assert row.wins + row.draws + row.losses == len(opponents[row.identity])


def test_ratings_predict_the_shares_of_many_games() -> None:
    """With games drawn from known strengths, the ratings differ as the strengths do, within the noise of the draws."""
    chance = random.Random(1)
    truth = {"a": 0.8, "b": 0.0, "c": -0.5, "d": -1.2}
    games: list[Results] = []
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
