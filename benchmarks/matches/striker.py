"""How often a lone striker scores: the example player on a real rcssservermj, from random places.

    python benchmarks/matches/striker.py --starts 50

In each start the ball rests within 8 m of the opponents' goal, at least a meter inside the field, and the robot stands
within 8 m of the ball, facing anywhere, straight and without speed as the monitor places it. It scores if the ball is
in the goal within 20 s of play. The player uses its own perceptions only; there is no goalkeeper. A fall costs only
time. Prints a line for each start, then the share of goals with its 95 % interval (Wilson).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from drill import BALL_M, Drill
from naosprint.matches.teams import Team, find_team
from naosprint.programs import integer, run_program
from naosprint.tasks.statistics import wilson
from numpy.typing import NDArray

NEAR_M, WITHIN_S = 8.0, 20.0
FIELD_M = (27.5, 18.0)
"""Half length and half width of the field."""

MARGIN_M, APART_M = 1.0, 0.6
"""Distance of ball and robot from the lines, and of the robot from the ball, at least."""

STARTS_A_SERVER, LYING_M, SETTLE_S = 12, 0.4, 1.0


@dataclass(frozen=True)
class Start:
    """Places of ball and robot.

    Attributes:
        ball: (2,) m.
        robot: (2,) m.
        yaw_deg: direction in which the robot faces.
    """

    ball: NDArray[np.float64]
    robot: NDArray[np.float64]
    yaw_deg: float


def draw(random: np.random.Generator) -> Start:
    """Draw a start."""

    def place(center: NDArray[np.float64], nearest_m: float) -> NDArray[np.float64]:
        while True:  # uniform in the disk, and on the field
            offset = random.uniform(-NEAR_M, NEAR_M, 2)
            found = center + offset
            if nearest_m < np.hypot(*offset) < NEAR_M and (np.abs(found) < np.array(FIELD_M) - MARGIN_M).all():
                return found

    ball = place(np.array([FIELD_M[0], 0.0]), 0.0)
    return Start(ball, place(ball, APART_M), random.uniform(-180.0, 180.0))


class Shooting(Drill):
    """A server with one player, who shoots on the right goal.

    Args:
        team: the team.
    """

    def __init__(self, team: Team) -> None:
        super().__init__(team, "striker", 1, 1)

    def play(self, start: Start) -> tuple[float | None, int]:
        """Return the seconds of play until the ball was in the goal, None if it was not, and the number of falls."""
        self._wait(SETTLE_S)  # after a goal the player takes its place at the kick-off
        self._play_on()
        ball, robot = start.ball, start.robot
        self._move(*robot.tolist(), start.yaw_deg)
        self._monitor.send(f"(ball (pos {ball[0]:.3f} {ball[1]:.3f} {BALL_M})(vel 0 0 0))")
        self._wait(0.2)
        began, goals, falls, lay = self._frame.time_s, self._frame.score[0], 0, False
        while self._frame.time_s < began + WITHIN_S:
            self._advance()
            if self._frame.score[0] > goals:
                return self._frame.time_s - began, falls
            lies = self._torso_m() < LYING_M
            falls, lay = falls + (lies and not lay), lies
        return None, falls


def main() -> int:
    """Read the options, play, and print what happened."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=integer(), default=50, help="number of starts")
    parser.add_argument("--seed", type=integer(0), default=0, help="seed of the starts")
    parser.add_argument("--team", default="example", help="a team's folder, or example with or without skills")
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    times: list[float | None] = []
    with tempfile.TemporaryDirectory() as scratch:
        team = find_team(options.team, Path(scratch))
        while len(times) < options.starts:
            shooting = Shooting(team)
            try:
                for _ in range(min(STARTS_A_SERVER, options.starts - len(times))):
                    start = draw(random)
                    scored_s, falls = shooting.play(start)
                    times.append(scored_s)
                    print(
                        f"{len(times):3d}  ball {start.ball[0]:5.1f} {start.ball[1]:5.1f} m, "
                        f"{np.hypot(*(start.robot - start.ball)):3.1f} m away: "
                        f"{'no goal' if scored_s is None else f'goal after {scored_s:4.1f} s'}"
                        f"{f', {falls} falls' if falls else ''}",
                        flush=True,
                    )
            finally:
                shooting.close()
    goals = [each for each in times if each is not None]
    low, high = wilson(len(goals), len(times), 0.95)
    print(
        f"{len(goals)} goals in {len(times)} starts, {len(goals) / len(times):.0%} ({low:.0%} to {high:.0%})"
        + (f", after {np.median(goals):.1f} s in the median" if goals else "")
    )
    return 0


if __name__ == "__main__":
    run_program(main)
