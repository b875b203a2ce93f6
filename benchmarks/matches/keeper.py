"""How often a keeper saves shots: the example player on a real rcssservermj, against balls that the monitor shoots.

    python benchmarks/matches/keeper.py --shots 100

A shot is drawn like one of the task ``block``: from 4 to 10 m before the goal, up to 45 degrees aside, with 2 to 6 m/s
and at least as fast as it has to be, to a point between the posts. The server gives the ball no spin, so it slides at
first, and is launched faster by 7/5. Before a shot the ball rests farther away in the same direction, and the keeper
takes its place by itself. A shot is saved if the ball has not come nearer for 1.5 s and the robot is on its feet. The
player uses its own perceptions only. Prints a line for each shot, then the share of saves with its 95 % interval
(Wilson). ``--empty`` places the keeper beside the field: then every shot should go in.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from drill import BALL_M, PLAY_ON, Drill
from naosprint.matches.teams import Team, find_team
from naosprint.programs import integer, run_program
from naosprint.tasks import rolling
from naosprint.tasks.block import CALM_S, BlockSettings, draw_shot
from naosprint.tasks.statistics import wilson
from numpy.typing import NDArray

GOAL_X, GOAL_HALF_M = -27.5, 1.83
SHOTS_A_SERVER = 20
AWAY_M, WAIT_S, LIMIT_S, UPRIGHT_M = 14.0, 4.0, 10.0, 0.45
STILL_M = 0.002  # way toward the goal between two frames from which a ball comes nearer


@dataclass(frozen=True)
class Shot:
    """Where a ball begins and how it moves.

    Attributes:
        angle, distance_m: its place as seen from the middle of the goal.
        speed_mps, direction: with which it rolls, counted from the field's +x axis; angles in radians.
    """

    angle: float
    distance_m: float
    speed_mps: float
    direction: float

    def place(self, distance_m: float) -> str:
        """Return the monitor's text for a place in the direction of the shot's."""
        x, y = GOAL_X + distance_m * np.cos(self.angle), distance_m * np.sin(self.angle)
        return f"(pos {x:.3f} {y:.3f} {BALL_M})"

    def launch(self) -> str:
        """Return the monitor's text that shoots."""
        speed = rolling.SLIDES * self.speed_mps
        x, y = speed * np.cos(self.direction), speed * np.sin(self.direction)
        return f"(ball {self.place(self.distance_m)}(vel {x:.3f} {y:.3f} 0))"


def _goes_in(before: NDArray[np.float64], ball: NDArray[np.float64]) -> bool:
    """Return whether a ball that was last seen at these two places crosses the line between the posts."""
    share = (GOAL_X - BALL_M - ball[0]) / min(ball[0] - before[0], -1e-3)
    return bool(abs(ball[1] + share * (ball[1] - before[1])) < GOAL_HALF_M)


class Keeping(Drill):
    """A server with one player, who keeps the left goal.

    Args:
        team: the team.
        empty: place the keeper beside the field.
    """

    def __init__(self, team: Team, *, empty: bool) -> None:
        super().__init__(team, "keeper", 1, 3)
        self._empty = empty

    def play(self, shot: Shot) -> tuple[bool, bool]:
        """Return whether the ball was kept out, and whether the robot was on its feet then."""
        self._wait(1.0)  # after a goal the player takes its place at the kick-off
        self._play_on()
        self._monitor.send(f"(ball {shot.place(AWAY_M)}(vel 0 0 0))")
        x, y = (GOAL_X - 2.0, 12.0) if self._empty else (GOAL_X + 1.0, 0.5 * shot.angle)
        self._move(x, y, np.degrees(0.5 * shot.angle))
        self._wait(WAIT_S)
        self._monitor.send(shot.launch())
        self._wait(0.1)
        began, calm_since, before, ball = self._frame.time_s, None, self._frame.ball_m, self._frame.ball_m
        while self._frame.time_s < began + LIMIT_S:
            self._advance()
            # a goal, too, is one only if somebody has touched the ball since the kick-off
            if self._frame.mode != PLAY_ON:
                return not _goes_in(before, ball), self._stands()
            before, ball = ball, self._frame.ball_m
            comes = ball[0] < before[0] - STILL_M
            calm_since = None if comes else self._frame.time_s if calm_since is None else calm_since
            if calm_since is not None and self._frame.time_s >= calm_since + CALM_S:
                break
        return True, self._stands()

    def _stands(self) -> bool:
        return self._torso_m() > UPRIGHT_M


def main() -> int:
    """Read the options, play, and print what happened."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=integer(), default=100, help="number of shots")
    parser.add_argument("--seed", type=integer(0), default=0, help="seed of the shots")
    parser.add_argument("--team", default="example", help="a team's folder, or example with or without skills")
    parser.add_argument("--empty", action="store_true", help="without a keeper, as a control")
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    slides = np.ones(options.shots, dtype=np.bool_)
    drawn = draw_shot(BlockSettings(name="block"), GOAL_HALF_M, random.uniform(size=(4, options.shots)), slides)
    shots = [Shot(*map(float, each)) for each in np.transpose(drawn)]
    results: list[bool] = []
    with tempfile.TemporaryDirectory() as scratch:
        team = find_team(options.team, Path(scratch))
        for first in range(0, len(shots), SHOTS_A_SERVER):
            keeping = Keeping(team, empty=options.empty)
            try:
                for shot in shots[first : first + SHOTS_A_SERVER]:
                    kept_out, stands = keeping.play(shot)
                    results.append(kept_out and stands)
                    print(
                        f"{len(results):3d}  {shot.speed_mps:3.1f} m/s from {shot.distance_m:4.1f} m, "
                        f"{np.degrees(shot.angle):4.0f} degrees: "
                        f"{'goal' if not kept_out else 'saved' if stands else 'kept out, fallen'}",
                        flush=True,
                    )
            finally:
                keeping.close()
    low, high = wilson(sum(results), len(results), 0.95)
    print(f"{sum(results)} saves of {len(results)} shots, {np.mean(results):.0%} ({low:.0%} to {high:.0%})")
    return 0


if __name__ == "__main__":
    run_program(main)
