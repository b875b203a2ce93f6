"""Results of a match, computed from the logs of its games alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from naosim.fields import RCSSSERVERMJ as FIELD

from naosprint.matches.log import LEFT
from naosprint.matches.stream import PLAY_MODES
from naosprint.tasks.statistics import bootstrap_mean, wilson

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from naosprint.matches.log import GameLog

FRAME_S = 0.04
_PLAY_ON = PLAY_MODES.index("PlayOn")
_LYING_M, _STANDING_M = 0.35, 0.5
"""Height of the torso below which a robot lies, and above which it stands again."""
_NEAR_M = 1.0
"""Distance from the ball within which the nearest robot has it."""
_REACH_M, _KICK_MPS, _KICK_FRAMES, _KICK_PAUSE_S = 0.9, 1.5, 5, 1.0
"""A kick: the ball becomes faster by 1.5 m/s within 5 frames while a robot is within 0.9 m; at most one a second."""
_STRIDE, _JUMP_M = 5, 0.8
"""Distance run is measured every 5 frames; what is farther than 0.8 m in them is a relocation by the referee."""
_CONFIDENCE, _RESAMPLES = 0.95, 10_000


@dataclass(frozen=True)
class TeamResult:
    """Result of one team in one game.

    Attributes:
        goals: goals.
        possession: share of the time of play in which one of its robots was the last to have the ball.
        attacking: share of the time of play in which the ball was in the opponents' half.
        falls: falls on the field.
        lying_s: seconds that its robots lay on the field, all together.
        run_m: metres that its robots moved, all together.
        kicks: kicks.
        good_kicks: kicks after which the next robot to have the ball was of the team again, or a goal followed.
        lost_players: players that crashed, hung or never came.
        cpu_ms: processor time of an agent a cycle, milliseconds, mean over the players.
    """

    goals: int
    possession: float
    attacking: float
    falls: int
    lying_s: float
    run_m: float
    kicks: int
    good_kicks: int
    lost_players: int
    cpu_ms: float


def game_results(log: GameLog) -> tuple[TeamResult, TeamResult]:
    """Return the results of both teams."""
    team_of = np.array([team for team, _ in log.robots])
    playing = log.mode == _PLAY_ON
    on_field = log.present & (np.abs(log.torso_m[..., 1]) <= FIELD.width_m / 2 + 0.1)
    holder, who = _holders(log, team_of, on_field)
    side = np.array(log.sides)[log.half]
    forward = np.where(side == LEFT, 1.0, -1.0)  # direction of team 0's attack
    kicks = _kicks(log, who, playing)
    time = max(1, int(playing.sum()))
    known = playing & (holder >= 0)
    found = []
    for team in range(2):
        own = np.flatnonzero(team_of == team)
        falls, lying = _falls(log, on_field, own)
        attack = forward if team == 0 else -forward
        struck = [(k, robot) for k, robot in kicks if team_of[robot] == team]
        found.append(
            TeamResult(
                goals=log.goals[team],
                possession=float((holder[known] == team).mean()) if known.any() else 0.0,
                attacking=float((playing & (log.ball_m[:, 0] * attack > 0)).sum() / time),
                falls=falls,
                lying_s=lying,
                run_m=_distance(log, on_field, own),
                kicks=len(struck),
                good_kicks=sum(_is_good(log, holder, k, team) for k, _ in struck),
                lost_players=len({each["number"] for each in _lost(log) if each["team"] == team}),
                cpu_ms=_cpu_ms(log, team),
            )
        )
    return found[0], found[1]


def _lost(log: GameLog) -> list[dict[str, Any]]:
    return [each for half in log.notes.get("halves", []) for each in half["lost"]]


def _cpu_ms(log: GameLog, team: int) -> float:
    halves = log.notes.get("halves", [])
    used = [each["s"] for half in halves for each in half["cpu_s"] if each["team"] == team]
    cycles = sum(half["cycles"] for half in halves) / max(1, len(halves))
    return 1000.0 * float(np.mean(used)) / cycles if used and cycles else 0.0


def _holders(log: GameLog, team_of: NDArray[Any], on_field: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return (T,) the team whose robot was the last to have the ball in the half, and the nearest; -1 for none."""
    apart = np.hypot(*np.moveaxis(log.torso_m[..., :2] - log.ball_m[:, None, :2], -1, 0))
    apart = np.where(on_field, apart, np.inf)
    nearest = apart.argmin(axis=1)
    distance = apart[np.arange(len(apart)), nearest]
    holder = np.where(distance <= _NEAR_M, team_of[nearest], -1)
    changes = np.maximum.accumulate(np.where(holder >= 0, np.arange(len(holder)), -1))
    holder = np.where(changes >= np.searchsorted(log.half, log.half), holder[changes], -1)
    return holder, np.where(distance <= _REACH_M, nearest, -1)


def _kicks(log: GameLog, who: NDArray[Any], playing: NDArray[Any]) -> list[tuple[int, int]]:
    """Return frame and robot of each kick."""
    speed = np.zeros(len(who))
    speed[1:] = np.hypot(*np.diff(log.ball_m[:, :2], axis=0).T) / FRAME_S
    speed[1:][np.diff(log.half) != 0] = 0.0
    found, last = [], -math.inf
    for k in range(_KICK_FRAMES, len(who) - 1):
        before = k - _KICK_FRAMES
        faster = min(speed[k], speed[k + 1]) - speed[before]
        if who[before] < 0 or not playing[k] or log.half[before] != log.half[k] or faster < _KICK_MPS:
            continue
        if speed[k] < 15.0 and k - last > _KICK_PAUSE_S / FRAME_S:  # a faster ball was put elsewhere by the referee
            found.append((k, int(who[before])))
            last = k
    return found


def _is_good(log: GameLog, holder: NDArray[Any], k: int, team: int) -> bool:
    """Return whether the team has the ball next, more than a metre on, or scores before that."""
    way = np.hypot(*(log.ball_m[k:, :2] - log.ball_m[k, :2]).T)
    same = log.half[k:] == log.half[k]
    scored = np.flatnonzero(same & (log.score[k:, team] > log.score[k, team]))
    apart = np.hypot(*np.moveaxis(log.torso_m[k:, :, :2] - log.ball_m[k:, None, :2], -1, 0))
    near = np.where(log.present[k:], apart, np.inf).min(axis=1) <= _NEAR_M
    again = np.flatnonzero(same & near & (way > 1.0))
    if len(scored) and (not len(again) or scored[0] <= again[0] + 1):
        return True
    stopped = np.flatnonzero(same & (log.mode[k:] != _PLAY_ON))
    if not len(again) or (len(stopped) and stopped[0] < again[0]):
        return False
    return bool(holder[k + again[0]] == team)


def _falls(log: GameLog, on_field: NDArray[Any], own: NDArray[Any]) -> tuple[int, float]:
    falls, lying = 0, 0
    for robot in own:
        down = False
        for height, here in zip(log.torso_m[:, robot, 2], on_field[:, robot], strict=True):
            if not here:
                down = False
            elif not down and height < _LYING_M:
                down, falls = True, falls + 1
            elif down and height > _STANDING_M:
                down = False
            lying += down
    return falls, lying * FRAME_S


def _distance(log: GameLog, on_field: NDArray[Any], own: NDArray[Any]) -> float:
    places, half, here = log.torso_m[::_STRIDE, own, :2], log.half[::_STRIDE], on_field[::_STRIDE, own]
    moved = np.hypot(*np.moveaxis(np.diff(places, axis=0), -1, 0))
    counts = here[1:] & here[:-1] & (np.diff(half) == 0)[:, None] & (moved < _JUMP_M)
    return float(moved[counts].sum())


# --- over the games of a match ----------------------------------------------------------------------------------------


def match_results(logs: Sequence[GameLog]) -> dict[str, Any]:
    """Return the results of a match as JSON has them: a list of games, and sums with 95 % intervals.

    Goals and goal difference of a single game have no interval.

    Raises:
        ValueError: if the logs are of different teams, or there is none.
    """
    if not logs:
        raise ValueError("no log of a game")
    teams = logs[0].teams
    if any(log.teams != teams for log in logs):
        raise ValueError(f"logs of different teams: {', '.join(sorted({' - '.join(log.teams) for log in logs}))}")
    games = [game_results(log) for log in logs]
    difference = np.array([a.goals - b.goals for a, b in games], float)
    n, wins, losses = len(games), int((difference > 0).sum()), int((difference < 0).sum())
    rng = np.random.default_rng(0)
    names = [field.name for field in fields(TeamResult)]
    means = [
        {name: float(np.mean([getattr(game[team], name) for game in games])) for name in names} for team in range(2)
    ]
    intervals = [_interval([game[team].goals for game in games], rng) for team in range(2)]
    return {
        "teams": list(teams),
        "games": n,
        "wins": wins,
        "draws": n - wins - losses,
        "losses": losses,
        "win_rate": wins / n,
        "win_rate_interval": list(wilson(wins, n, _CONFIDENCE)),
        "goal_difference": float(difference.mean()),
        "goal_difference_interval": _interval(difference, rng),
        "goals_interval": intervals,
        "means": means,
        "per_game": [[vars(team) for team in game] for game in games],
    }


def _interval(values: ArrayLike, rng: np.random.Generator) -> list[float] | None:
    """Return the interval of the mean of a value a game; None of a single one, which resampled only repeats itself."""
    values = np.asarray(values, float)
    if len(values) < 2:
        return None
    return list(bootstrap_mean(values, confidence=_CONFIDENCE, resamples=_RESAMPLES, rng=rng))
