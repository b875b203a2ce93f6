"""Speed of matches: seconds of play per second, of the example team against itself on one real server.

    python benchmarks/matches/run.py --players 1 3 --seconds 20

Prints a line for each number of players: what the half took from the kick-off on, the processor time of an agent a
cycle, and how many processors all agents together were busy with.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from naosprint.matches.game import GameSettings, Moment, play_game
from naosprint.matches.results import game_results
from naosprint.matches.teams import find_team


def main() -> int:
    """Read the options, play, and print a line a number of players."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--players", type=int, nargs="+", default=[1, 3], help="players of each team")
    parser.add_argument("--seconds", type=float, default=20.0, help="play time of a half")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        team = find_team("example", Path(scratch))
        for players in options.players:
            times: list[tuple[float, float]] = []

            def note(moment: Moment, times: list[tuple[float, float]] = times) -> None:
                times.append((moment.share, time.monotonic()))

            log = play_game((team, team), ("a", "b"), 0, GameSettings(players, options.seconds), on_moment=note)
            # the first half, while the ball is in play
            half = [(share, at) for share, at in times if 0.0 < share <= 0.5]
            played = 2 * options.seconds * (half[-1][0] - half[0][0])
            took = half[-1][1] - half[0][1]
            cpu_ms = game_results(log)[0].cpu_ms
            busy = 2 * players * cpu_ms / 20.0 * played / took
            print(
                f"{players} v {players}: {played / took:.2f} s of match per second, {took / played * 20:.1f} ms a "
                f"cycle; agent {cpu_ms:.2f} ms of CPU a cycle, {busy:.2f} processors for all agents"
            )
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
