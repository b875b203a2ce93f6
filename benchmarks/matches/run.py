"""Speed of matches, and what limits it: the example team against itself on one real server.

    python benchmarks/matches/run.py --players 1 3 7 --seconds 20

Prints a line for each number of players: seconds of play per second, and the processor time of a cycle (20 ms of play)
of the server, of all agents and of the program that records the match. Server and agents wait for each other, so that
a game cannot be faster than all three allow on one processor, or than the server alone on several.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
from naosprint.matches.game import GameSettings, Moment, play_game
from naosprint.matches.teams import find_team

CYCLES_S = 50.0


@dataclass(frozen=True)
class Sample:
    """State of a game at one moment.

    Attributes:
        played_s: seconds of play.
        time_s: wall-clock time.
        server_s, agents_s, recorder_s: processor time of the server, of all agents and of this program.
    """

    played_s: float
    time_s: float
    server_s: float
    agents_s: float
    recorder_s: float


def sample(played_s: float) -> Sample:
    """Return the state now."""
    server_s = agents_s = 0.0
    for process in psutil.Process().children(recursive=True):
        try:
            used = sum(process.cpu_times()[:2])
            if "rcsssmj" in " ".join(process.cmdline()):
                server_s += used
            else:
                agents_s += used
        except psutil.Error:
            continue  # it has ended
    return Sample(played_s, time.monotonic(), server_s, agents_s, sum(psutil.Process().cpu_times()[:2]))


def main() -> int:
    """Read the options, play, and print a line for each number of players."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--players", type=int, nargs="+", default=[1, 3, 7], help="players of each team")
    parser.add_argument("--seconds", type=float, default=20.0, help="play time of a half")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        team = find_team("example", Path(scratch))
        for players in options.players:
            samples: list[Sample] = []

            def note(moment: Moment, samples: list[Sample] = samples) -> None:
                # the first half from the kick-off on; a sample reads the state of all processes, which takes a while
                if 0.0 < moment.share <= 0.5 and (not samples or moment.share > 0.4):
                    samples.append(sample(2.0 * options.seconds * moment.share))

            play_game((team, team), ("a", "b"), 0, GameSettings(players, options.seconds), on_moment=note)
            first, last = samples[0], samples[-1]
            played_s = last.played_s - first.played_s
            cycles = CYCLES_S * played_s
            server, agents, recorder = (
                1000.0 * (getattr(last, name) - getattr(first, name)) / cycles
                for name in ("server_s", "agents_s", "recorder_s")
            )
            print(
                f"{players} v {players}: {played_s / (last.time_s - first.time_s):.2f} s of match per second; "
                f"CPU of a cycle: server {server:.1f} ms, agents {agents:.1f} ms ({agents / players / 2:.2f} each), "
                f"recorder {recorder:.1f} ms; at most {20.0 / (server + agents + recorder):.1f} s per second on one "
                f"processor, {20.0 / server:.1f} on several"
            )
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
