"""Search scripted motions of getting up from front, back and right; write them where the task ``getup`` finds them.

    python tools/getup_motion.py [--robot t1] [--sides front back right] [--minutes 10] [--output FOLDER]

A motion is six keyframes and the nominal pose at the end. From front and back all are equal on both sides; from the
right side the first three move left and right apart. CMA-ES (Hansen and Ostermeier, 2001) draws 48 at a time and runs
each in MuJoCo from a start of the task and with noise on all targets, as in a training that explores; later heights, an
upright torso, weight on the feet and standing by 2.4 s count most. The motion that is kept is the mean of the
distribution that did best from all starts. ``--minutes`` is the time for each side.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import cmaes
import numpy as np
from naosim import robots
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.robots.booster import FAMILY
from naosim.simulator import Starts
from naospec.json_text import json_text
from naosprint.programs import above_zero, integer, run_program
from naosprint.tasks.getup import SIDES, STANDING_HEIGHT, STANDING_UP, lying, side_of
from naosprint.tasks.motions import Motion, motions
from naosprint.terms import source

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "packages/naosprint/src/naosprint/tasks/motion_data"
ARM, LEG = ("shoulder_pitch", "shoulder_roll", "elbow_pitch", "elbow_yaw"), ("hip_pitch", "hip_roll", "hip_yaw")
JOINTS = (*ARM, *LEG, "knee_pitch", "ankle_pitch")
ALL = (*(f"{side}_{name}" for side in ("left", "right") for name in JOINTS), "waist")
POPULATION, STARTS, STEPS, LAST = 48, 24, 175, 55
SHORTEST_S, LONGEST_S, RETURN_S = 0.1, 0.5, 0.3
FRAMES, APART = 6, 3
SIGMA, SIGMA_FOUND = 0.8, 0.25
POSE_NOISE_DEG, TARGET_NOISE_RAD = 30.0, 0.1

GUESSES: dict[str, tuple[dict[str, float], ...]] = {
    "front": (
        {"shoulder_pitch": -1.5, "elbow_yaw": -2.0, "hip_pitch": -0.2, "knee_pitch": 0.3},
        {"shoulder_pitch": -1.6, "hip_pitch": -1.2, "hip_roll": 0.4, "knee_pitch": 1.8, "ankle_pitch": -0.8},
        {"shoulder_pitch": -1.2, "hip_pitch": -1.8, "hip_roll": 0.4, "knee_pitch": 2.3, "ankle_pitch": -0.9},
        {"shoulder_pitch": -0.4, "hip_pitch": -1.7, "hip_roll": 0.2, "knee_pitch": 2.2, "ankle_pitch": -0.9},
        {"shoulder_pitch": -1.0, "hip_pitch": -1.7, "knee_pitch": 2.0, "ankle_pitch": -0.7},
        {"shoulder_pitch": -0.6, "hip_pitch": -1.0, "knee_pitch": 1.2, "ankle_pitch": -0.5},
    ),
    "back": (
        {"shoulder_pitch": 1.0, "hip_pitch": -1.0, "knee_pitch": 1.8},
        {"shoulder_pitch": 1.2, "hip_pitch": -1.7, "knee_pitch": 2.3, "ankle_pitch": -0.2},
        {"shoulder_pitch": 1.0, "hip_pitch": -1.8, "knee_pitch": 2.3, "ankle_pitch": -0.6},
        {"shoulder_pitch": -1.0, "hip_pitch": -1.8, "knee_pitch": 2.3, "ankle_pitch": -0.9},
        {"shoulder_pitch": -1.5, "hip_pitch": -1.7, "knee_pitch": 2.2, "ankle_pitch": -0.8},
        {"shoulder_pitch": -0.6, "hip_pitch": -1.0, "knee_pitch": 1.2, "ankle_pitch": -0.5},
    ),
}
"""Where the first search begins: arms to the ground, knees under the torso, squat."""

ROLL = {"left_shoulder_pitch": 1.0, "right_shoulder_pitch": -1.2, "hip_pitch": -1.0, "knee_pitch": 1.8}
"""First keyframe from the right side, towards the back; the next are those from the back."""


class Search:
    """Motions of one robot from one side.

    Args:
        robot: its name.
        side: ``front``, ``back`` or ``right``.
        known: motions found before; the search begins with the one from this side.
        seed: seed of the starts and of the search.
        threads: threads of the simulator.
    """

    def __init__(self, robot: str, side: str, known: Mapping[str, Motion], seed: int, threads: int) -> None:
        self.robot = robots.get(robot)
        if self.robot.family != FAMILY:
            raise ValueError(f"--robot: {robot} is no Booster robot")
        self._rng = np.random.default_rng(seed)
        self._simulator = MujocoSimulator(self.robot, POPULATION, BoosterEmbeddedParameters(), threads=threads)
        self._simulator.load_starts(self._starts(side))
        self._weight = 9.81 * float(sum(self._simulator.world.model.body_mass))
        named = {joint.name for joint in self.robot.joints}
        apart = tuple(name for name in ALL if name in named)  # a K1 has no waist
        self._rows = [apart if side == "right" and row < APART else JOINTS for row in range(FRAMES)]
        begins = known.get(side, known.get("back")) if side == "right" else known.get(side)
        guesses = [dict(frame) for frame in GUESSES.get(side, GUESSES["back"])]
        seconds = np.full(FRAMES, 0.5 * (SHORTEST_S + LONGEST_S))
        if begins is not None:
            guesses = [{name: angles[row] for name, angles in begins.angles_rad.items()} for row in range(FRAMES)]
            seconds = np.diff([0.0, *begins.times_s])[:FRAMES]
        if side == "right" and begins is not known.get("right"):
            guesses[0] = ROLL
        mean = [self._numbers(*each) for each in zip(self._rows, guesses, seconds, strict=True)]
        sigma = SIGMA if begins is None else SIGMA_FOUND
        self._optimizer = cmaes.CMA(np.concatenate(mean), sigma, seed=seed, population_size=POPULATION)

    def _limits(self, name: str) -> tuple[float, float, float]:
        """Return lower limit, upper limit and nominal angle of a joint, or of a pair, with the left side's signs."""
        index = next(i for i, joint in enumerate(self.robot.joints) if joint.name in (name, f"left_{name}"))
        joint, nominal = self.robot.joints[index], float(self.robot.nominal[index])
        if joint.sign < 0.0:
            return -joint.high_rad, -joint.low_rad, -nominal
        return joint.low_rad, joint.high_rad, nominal

    def _numbers(self, names: tuple[str, ...], guess: Mapping[str, float], seconds: float) -> Floats:
        """Return the numbers of the search that stand for a keyframe."""
        shares = []
        for name in names:
            low, high, nominal = self._limits(name)
            alike = name.removeprefix("left_").removeprefix("right_")
            angle = guess.get(name, guess.get(alike, guess.get(f"left_{name}", nominal)))
            shares.append((angle - low) / (high - low))
        share = np.clip([*shares, (seconds - SHORTEST_S) / (LONGEST_S - SHORTEST_S)], 0.05, 0.95)
        return np.log(share / (1.0 - share))

    def _starts(self, side: str) -> Starts:
        """Return starts as in the task that come to rest on this side."""
        rng, joints, simulator = self._rng, self.robot.joints, self._simulator
        limits = [joint.low_rad for joint in joints], [joint.high_rad for joint in joints]
        lane = (0.0, float(self.robot.data.get("lane_y_m", 0.0)))
        poses: list[Floats] = []
        orientations: list[Floats] = []
        while len(poses) < STARTS:
            offsets = np.deg2rad(rng.uniform(-1.0, 1.0, (POPULATION, len(joints))) * POSE_NOISE_DEG)
            drawn = np.clip(self.robot.nominal + offsets, *limits)
            around = SIDES[side] + rng.uniform(-0.3, 0.3, POPULATION)
            tipped = lying(around, np.pi / 2.0 + rng.uniform(-0.2, 0.2, POPULATION), np.zeros(POPULATION))
            simulator.load_starts(Starts(drawn, lane, orientations=tipped))
            simulator.start(np.arange(POPULATION), np.arange(POPULATION))
            lies_on = side_of(source(simulator.truth.torso_rotation))(slice(None))[:, 0]
            rests = lies_on == list(SIDES).index(side)
            poses += list(drawn[rests])
            orientations += list(tipped[rests])
        return Starts(np.array(poses[:STARTS]), lane, orientations=np.array(orientations[:STARTS]))

    def motion(self, numbers: Floats) -> Motion:
        """Return the motion that (D,) numbers of the search stand for."""
        shares, first = 1.0 / (1.0 + np.exp(-numbers)), 0
        times, names = [], self._rows[0]
        angles: dict[str, list[float]] = {name: [] for name in names}
        for row in self._rows:
            part = dict(zip((*row, "seconds"), shares[first : first + len(row) + 1], strict=True))
            first += len(row) + 1
            times.append(SHORTEST_S + (LONGEST_S - SHORTEST_S) * part["seconds"])
            for name in names:
                low, high, nominal = self._limits(name)
                share = part.get(name, part.get(name.removeprefix("left_").removeprefix("right_")))
                angles[name].append(nominal if share is None else low + (high - low) * share)
        for name in names:
            angles[name].append(self._limits(name)[2])
        return Motion(
            [round(float(at), 3) for at in np.cumsum([*times, RETURN_S])],
            {name: [round(float(angle), 3) for angle in column] for name, column in angles.items()},
        )

    def scores(self, motions: list[Motion], starts: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Return the (n,) scores of n motions, and the share of the last 1.1 s in which each robot stands."""
        simulator, everyone = self._simulator, slice(0, POPULATION)
        targets = np.tile(self.robot.nominal, (STEPS, POPULATION, 1))
        for row, motion in enumerate(motions):
            table = motion.targets(self.robot)[:STEPS]
            targets[: len(table), row] = table
        simulator.start(np.arange(POPULATION), starts)
        values, stands = np.zeros((STEPS, POPULATION)), np.zeros((STEPS, POPULATION))
        targets += self._rng.normal(0.0, TARGET_NOISE_RAD, targets.shape)
        for step in range(STEPS):
            simulator.step_async(targets[step], everyone)
            simulator.step_wait(everyone)
            up = simulator.truth.torso_rotation[:, 2, 2]
            height = np.clip(simulator.truth.torso_position[:, 2] / self.robot.standing_height_m, 0.0, 1.0)
            upright = 0.5 * (1.0 + up)
            on_feet = np.clip(simulator.foot_forces().sum(axis=1) / self._weight, 0.0, 1.0)
            values[step] = height**2 * (0.5 + 0.5 * upright) + 0.4 * on_feet * height + 0.1 * upright
            stands[step] = (height > STANDING_HEIGHT) & (up > STANDING_UP)
        standing = stands[-LAST:].mean(axis=0)
        found = values[-LAST:].mean(axis=0) + 0.35 * values[60:].mean(axis=0) + standing
        return np.where(simulator.lost, -1.0, found), standing

    def run(self, seconds: float) -> Motion:
        """Search for some time and return the best mean."""
        optimizer, began, generation = self._optimizer, time.monotonic(), 0
        best: tuple[float, Motion | None] = (-np.inf, None)
        while best[1] is None or time.monotonic() - began < seconds:
            drawn = [optimizer.ask() for _ in range(POPULATION)]
            start = np.full(POPULATION, self._rng.integers(STARTS))
            scores, _ = self.scores([self.motion(numbers) for numbers in drawn], start)
            optimizer.tell(list(zip(drawn, (-scores).tolist(), strict=True)))
            if generation % 10 == 0:
                mean = self.motion(optimizer.mean)
                scores, standing = self.scores([mean] * POPULATION, np.arange(POPULATION) % STARTS)
                if scores.mean() > best[0]:
                    best = float(scores.mean()), mean
                print(f"  {generation}: score {scores.mean():.2f}, stands {standing.mean():.0%} of the end", flush=True)
            generation += 1
        self._simulator.close()
        return best[1]


def main() -> None:
    """Search from each side and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="t1")
    parser.add_argument("--sides", nargs="+", choices=list(SIDES), default=list(SIDES))
    parser.add_argument("--minutes", type=above_zero, default=10.0)
    parser.add_argument("--seed", type=integer(0), default=0)
    parser.add_argument("--threads", type=integer(), default=2)
    parser.add_argument("--output", type=Path, metavar="FOLDER", default=FOLDER, help="default: the package's")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for side in options.sides:
        print(f"{options.robot}, {side}", flush=True)
        robot = robots.get(options.robot)
        search = Search(options.robot, side, motions("getup", robot), options.seed, options.threads)
        motion = search.run(60.0 * options.minutes)
        found = {name: asdict(each) for name, each in motions("getup", robot).items()} | {side: asdict(motion)}
        file = options.output / f"getup-{options.robot}.json"
        file.write_text(json_text(found), encoding="utf-8")
        print(f"wrote {file}", flush=True)


if __name__ == "__main__":
    run_program(main)
