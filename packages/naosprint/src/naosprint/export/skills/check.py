"""Compare this folder's policy with recorded values: observations, actions and target angles of one episode.

python check.py

The exit code is 0 if all of them agree. Only NumPy is needed.
"""

import sys
from pathlib import Path

import numpy as np
from runner import Runner

FOLDER = Path(__file__).parent
TOLERANCE = 1e-5


def main():
    """Feed what the robot perceived in the recorded episode to the policy, cycle by cycle."""
    vectors = np.load(FOLDER / "parity.npz")
    inputs = [str(name) for name in vectors["inputs"]]
    runner = Runner(FOLDER / "policy.npz")
    runner.begin(**{str(name): vectors[f"begin_{name}"] for name in vectors["begin"]})
    worst = dict.fromkeys(("observations", "actions", "targets_rad"), 0.0)
    count = len(vectors["observations"])
    for step in range(count):
        seen = runner.observe(**{name: vectors[name][step] for name in inputs})
        targets = runner.act(seen)
        for name, found in zip(worst, (seen, runner.action, targets)):
            worst[name] = max(worst[name], float(np.abs(found - vectors[name][step]).max()))
    print(f"{count} cycles; largest differences: " + ", ".join(f"{name} {value:.1e}" for name, value in worst.items()))
    return 0 if all(value <= TOLERANCE for value in worst.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
