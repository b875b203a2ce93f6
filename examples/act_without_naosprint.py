"""Export a policy as arrays, and compute its joint angles with NumPy alone, as a team's agent does."""

from pathlib import Path

import naopolicies
import numpy as np
from naosprint.export import export_policy

export_policy(naopolicies.folder("sprint"), Path("exported"), ["numpy"])
with np.load("exported/policy.npz") as arrays:
    policy = dict(arrays)


def targets(observations: np.ndarray) -> np.ndarray:
    """Return the joint angles in radians for the observations of one cycle."""
    z = np.clip((observations - policy["mean"]) * policy["scale"], -policy["clip"], policy["clip"])
    for i, activation in enumerate(policy["activations"]):
        z = policy[f"weights_{i}"] @ z + policy[f"bias_{i}"]
        z = np.tanh(z) if activation == "tanh" else z
    angles = policy["middle_rad"] + policy["reach_rad"] @ np.clip(z, -1.0, 1.0)
    return np.clip(angles, policy["low_rad"], policy["high_rad"])


angles = targets(np.asarray(policy["mean"]))
print(f"{len(angles)} joints; {policy['joint_names'][8]}: {np.rad2deg(angles[8]):.1f} degrees")
