"""Results of a match in words, as `naosprint.matches.results.match_results` returns them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

_ROWS = (
    ("goals", "goals", "{:.2f}"),
    ("possession", "possession", "{:.0%}"),
    ("attacking", "ball in the other's half", "{:.0%}"),
    ("falls", "falls", "{:.1f}"),
    ("lying_s", "on the ground, s", "{:.1f}"),
    ("run_m", "distance run, m", "{:.0f}"),
    ("kicks", "kicks", "{:.1f}"),
    ("good_kicks", "kicks that kept the ball", "{:.1f}"),
    ("lost_players", "lost players", "{:.1f}"),
    ("cpu_ms", "agent, CPU ms a cycle", "{:.2f}"),
)
"""Name, words and format of what a table has a row for; means over the games."""


def rows(results: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return what is measured and its mean of both teams, in words."""
    found = []
    for name, words, form in _ROWS:
        values = [form.format(means[name]) for means in results["means"]]
        if name == "goals":
            values = [
                value + _ends(interval, ".2f")
                for value, interval in zip(values, results["goals_interval"], strict=True)
            ]
        found.append((words, values[0], values[1]))
    return found


def _ends(interval: Sequence[float] | None, form: str) -> str:
    """Return an interval to follow its value; empty without one, as of a single game's goals."""
    return f" [{interval[0]:{form}}, {interval[1]:{form}}]" if interval else ""


def sums(results: dict[str, Any]) -> list[str]:
    """Return wins and goal difference in two sentences."""
    count, difference = results["games"], _ends(results["goal_difference_interval"], "+.2f")
    level = " a game, 95 % intervals" if difference else ", 95 % interval of the win rate"
    return [
        f"{count} {'game' if count == 1 else 'games'}: {results['wins']} won, {results['draws']} drawn, "
        f"{results['losses']} lost; win rate {results['win_rate']:.2f}{_ends(results['win_rate_interval'], '.2f')}",
        f"goal difference {results['goal_difference']:+.2f}{difference}{level}",
    ]


def table(results: dict[str, Any]) -> str:
    """Return the results of a match as lines of at most 80 columns."""
    names = [name if len(name) <= 18 else name[:17] + "…" for name in results["teams"]]
    lines = [f"{words:26}{first:>20}{second:>20}" for words, first, second in (("", *names), *rows(results))]
    return "\n".join([*lines, *sums(results)])
