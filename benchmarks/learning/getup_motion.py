"""Search scripted motions of getting up from front and back; write them where the task ``getup`` finds them.

    python benchmarks/learning/getup_motion.py [--robot t1] [--minutes 10] [--seed 0]

A motion is six keyframes, equal on both sides, and the nominal pose at the end. CMA-ES (Hansen and Ostermeier, 2001)
draws 48 at a time and runs each in MuJoCo from a lying start with random offsets; later heights, an upright torso and
weight on the feet count most. The motion that is kept is the mean of the distribution that did best from all starts.
``--minutes`` is the time for each side.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cmaes
import numpy as np
from naosim import robots
from naosim.mujoco.embedded import MujocoSimulator
from naosim.simulator import Starts
from naosprint.tasks.getup import SIDES, STANDING_HEIGHT, STANDING_UP, lying
from naosprint.tasks.motions import Motion

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "packages/naosprint/src/naosprint/tasks/motion_data"
JOINTS = ("shoulder_pitch", "shoulder_roll", "elbow_pitch", "elbow_yaw", "hip_pitch", "hip_roll", "hip_yaw")
JOINTS += ("knee_pitch", "ankle_pitch")
POPULATION, STARTS, STEPS, LAST = 48, 12, 190, 50
SHORTEST_S, LONGEST_S, RETURN_S = 0.12, 0.62, 0.35
SIGMA = 0.8
POSE_NOISE_DEG = 5.0

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
"""Where the search begins: arms to the ground, knees under the torso, squat."""


class Search:
    """Motions of one robot from one side.

    Args:
        robot: its name.
        side: ``front`` or ``back``.
        seed: seed of the starts and of the search.
    """

    def __init__(self, robot: str, side: str, seed: int) -> None:
        self.robot = robots.get(robot)
        lefts = {joint.name.removeprefix("left_"): index for index, joint in enumerate(self.robot.joints)}
        chosen = [self.robot.joints[lefts[name]] for name in JOINTS]
        self._low = np.array([joint.low_rad for joint in chosen])
        self._span = np.array([joint.high_rad for joint in chosen]) - self._low
        self._nominal = self.robot.nominal[[lefts[name] for name in JOINTS]]
        self._rng = np.random.default_rng(seed)
        self._simulator = MujocoSimulator(self.robot, POPULATION, threads=2)
        self._simulator.load_starts(self._starts(SIDES[side]))
        self._weight = 9.81 * float(sum(self._simulator.world.model.body_mass))
        guess = np.zeros((len(GUESSES[side]), len(JOINTS) + 1))
        for row, angles in zip(guess, GUESSES[side], strict=True):
            frame = self._nominal.copy()
            for name, angle in angles.items():
                frame[JOINTS.index(name)] = angle
            share = np.clip((frame - self._low) / self._span, 0.05, 0.95)
            row[:-1] = np.log(share / (1.0 - share))
        self._optimizer = cmaes.CMA(mean=guess.ravel(), sigma=SIGMA, seed=seed, population_size=POPULATION)

    def _starts(self, around: float) -> Starts:
        rng, joints = self._rng, self.robot.joints
        offsets = np.deg2rad(rng.uniform(-1.0, 1.0, (STARTS, len(joints))) * POSE_NOISE_DEG)
        poses = np.clip(
            self.robot.nominal + offsets, [joint.low_rad for joint in joints], [joint.high_rad for joint in joints]
        )
        tipped = around + rng.uniform(-0.15, 0.15, STARTS), np.pi / 2.0 + rng.uniform(-0.1, 0.1, STARTS)
        lane = (0.0, float(self.robot.data.get("lane_y_m", 0.0)))
        return Starts(poses, lane, orientations=lying(*tipped, np.zeros(STARTS)))

    def motion(self, numbers: Floats) -> Motion:
        """Return the motion that (D,) numbers of the search stand for."""
        rows = 1.0 / (1.0 + np.exp(-numbers.reshape(-1, len(JOINTS) + 1)))
        times = np.cumsum(SHORTEST_S + (LONGEST_S - SHORTEST_S) * rows[:, -1])
        frames = np.concatenate([self._low + self._span * rows[:, :-1], self._nominal[None]])
        return Motion(
            [round(float(at), 3) for at in (*times, times[-1] + RETURN_S)],
            {name: [round(float(angle), 3) for angle in frames[:, k]] for k, name in enumerate(JOINTS)},
        )

    def scores(self, motions: list[Motion], starts: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Return the (n,) scores of n motions, and the share of the last second in which each robot stands."""
        simulator, everyone = self._simulator, slice(0, POPULATION)
        targets = np.tile(self.robot.nominal, (STEPS, POPULATION, 1))
        for row, motion in enumerate(motions):
            table = motion.targets(self.robot)[:STEPS]
            targets[: len(table), row] = table
        simulator.start(np.arange(POPULATION), starts)
        values, stands = np.zeros((STEPS, POPULATION)), np.zeros((STEPS, POPULATION))
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
        while time.monotonic() - began < seconds:
            drawn = [optimizer.ask() for _ in range(POPULATION)]
            start = np.full(POPULATION, self._rng.integers(STARTS))
            scores, _ = self.scores([self.motion(numbers) for numbers in drawn], start)
            optimizer.tell(list(zip(drawn, (-scores).tolist(), strict=True)))
            if generation % 10 == 0:
                mean = self.motion(optimizer.mean)
                scores, standing = self.scores([mean] * POPULATION, np.arange(POPULATION) % STARTS)
                if scores.mean() > best[0]:
                    best = float(scores.mean()), mean
                print(f"  {generation}: score {scores.mean():.2f}, stands {standing.mean():.0%} of the last second")
            generation += 1
        self._simulator.close()
        assert best[1] is not None
        return best[1]


def main() -> None:
    """Search both sides and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="t1")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for side in SIDES:
        print(f"{options.robot}, {side}")
        motion = Search(options.robot, side, options.seed).run(60.0 * options.minutes)
        found[side] = {"times_s": motion.times_s, "angles_rad": motion.angles_rad}
    file = FOLDER / f"getup-{options.robot}.json"
    file.write_text(json.dumps(found, indent=2) + "\n")
    print(f"wrote {file.name}")


if __name__ == "__main__":
    main()
