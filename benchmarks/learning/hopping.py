"""Print whether policies of a Booster robot hop on both feet: how alike left and right joints move, from 0 to 1.

    python benchmarks/learning/hopping.py t1-sprint [CHECKPOINT ...]

The number is what `hop_penalty` penalizes, as the mean of 16 robots from the 21st to the 200th step, deterministic.
Robots that hop have 0.85 or more, those that step less than 0.1.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import naopolicies
import numpy as np
from naosim.robots.booster import FAMILY
from naosprint.programs import run_program
from naosprint.rl.policy import load_policy
from naosprint.tasks.environment import open_environment
from naosprint.tasks.penalties import hopping

ROBOTS, FIRST_STEP, LAST_STEP, SEED = 16, 21, 200, 5


def main() -> None:
    """Measure each policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+", metavar="POLICY", help="bundled policy, or folder of a checkpoint")
    for name in parser.parse_args().policies:
        print(f"{name}: {how_alike(naopolicies.resolve(name)):.3f}")


def how_alike(checkpoint: Path) -> float:
    """Return the mean of the hop penalty's value, 0 to 1."""
    policy, manifest = load_policy(checkpoint)
    spec = manifest.stage_spec
    if spec.family != FAMILY:
        raise ValueError(f"{checkpoint.name}: the robot is a {spec.robot.name}, no Booster robot")
    environment = open_environment(spec, ROBOTS, threads=1, seed=SEED)
    try:
        starts = environment.task.starts(ROBOTS, SEED, spec.task.start_noise_deg)
        environment.load_starts(starts)
        environment.restart(np.arange(ROBOTS), np.arange(ROBOTS) % len(starts))
        term = hopping(environment.world, 1.0)
        found = []
        for step in range(1, LAST_STEP + 1):
            environment.step(policy.act(environment.observations, None))
            if step >= FIRST_STEP:
                found.append(term.value(slice(0, ROBOTS)).mean())
    finally:
        environment.close()
    return float(np.mean(found))


if __name__ == "__main__":
    run_program(main)
