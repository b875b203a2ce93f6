"""Speed of matches, and what limits it: the example team against itself on one real server.

    python benchmarks/matches/run.py --players 1 3 7 --seconds 20

Prints a line for each number of players: seconds of play per second, and the processor time of a cycle (20 ms of play)
of the server, of all agents and of the program that records the match. Server and agents wait for each other, so that
a game cannot be faster than all three allow on one processor, or than the server alone on several.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
from naosprint.matches.game import GameSettings, Moment, play_game
from naosprint.matches.teams import find_team
from naosprint.programs import above_zero, integer, run_program

CYCLES_S = 50.0


@dataclass(frozen=True)
class Sample:
    """State of a game at one moment.

    Attributes:
        played_s: seconds of play.
        time_s: wall-clock time.
        used_s: processor time of each process by its number, with what it is: server, agents or recorder.
    """

    played_s: float
    time_s: float
    used_s: dict[int, tuple[str, float]]

    @classmethod
    def now(cls, played_s: float) -> Sample:
        """Return the state now."""
        used_s = {}
        for process in [psutil.Process(), *psutil.Process().children(recursive=True)]:
            try:
                kind = "server" if "rcsssmj" in " ".join(process.cmdline()) else "agents"
                used_s[process.pid] = (kind, sum(process.cpu_times()[:2]))
            except psutil.Error:
                continue  # it has ended
        used_s[os.getpid()] = ("recorder", used_s[os.getpid()][1])
        return cls(played_s, time.monotonic(), used_s)

    def since(self, first: Sample, kind: str) -> float:
        """Return the processor time of the processes of a kind since an earlier sample, seconds."""
        return sum(
            used_s - first.used_s[pid][1]
            for pid, (what, used_s) in self.used_s.items()
            if what == kind and pid in first.used_s
        )


def main() -> int:
    """Read the options, play, and print a line for each number of players."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--players", type=integer(), nargs="+", default=[1, 3, 7], help="players of each team")
    parser.add_argument("--seconds", type=above_zero, default=20.0, help="play time of a half")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        team = find_team("example", Path(scratch))
        for players in options.players:
            samples: list[Sample] = []

            def note(moment: Moment, samples: list[Sample] = samples) -> None:
                # the first half from the kick-off on; a sample reads the state of all processes, which takes a while
                if (
                    moment.half == 0
                    and moment.share > 0.0
                    and (not samples or time.monotonic() - samples[-1].time_s > 3.0)
                ):
                    samples.append(Sample.now(2.0 * options.seconds * moment.share))

            play_game((team, team), ("a", "b"), 0, GameSettings(players, options.seconds), on_moment=note)
            if len(samples) < 2:
                sys.exit(f"{players} v {players}: too short to measure; play more --seconds")
            first, last = samples[0], samples[-1]
            played_s = last.played_s - first.played_s
            cycles = CYCLES_S * played_s
            server, agents, recorder = (
                1000.0 * last.since(first, kind) / cycles for kind in ("server", "agents", "recorder")
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
    run_program(main)
