"""Export of a policy for use without this package.

policy.npz     weights, standardization, and the robot's tables: all that an agent needs besides NumPy
policy.onnx    the network from raw observations to actions, standardization included
policy.json    inputs and outputs by name and unit
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from naosprint.export.arrays import policy_arrays
from naosprint.export.description import describe
from naosprint.export.graph import build_onnx
from naosprint.rl.policy import load_policy

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["build_onnx", "describe", "export_policy", "policy_arrays"]


def export_policy(checkpoint: Path, directory: Path) -> tuple[Path, Path, Path]:
    """Write the policy of a checkpoint to ``directory`` as ``policy.npz``, ``policy.onnx`` and ``policy.json``.

    Returns:
        The paths of the three files, which are replaced if they exist.

    Raises:
        CheckpointError: if the checkpoint is damaged.
        OSError: if onnx is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise OSError("policy.onnx needs onnx: pip install naosprint[export]") from error
    policy, manifest = load_policy(checkpoint)
    directory.mkdir(parents=True, exist_ok=True)
    arrays, network, text = directory / "policy.npz", directory / "policy.onnx", directory / "policy.json"
    np.savez(arrays, allow_pickle=False, **policy_arrays(policy, manifest))
    onnx.save(build_onnx(policy), network)
    text.write_text(json.dumps(describe(policy, manifest), indent=2, allow_nan=False) + "\n")
    return arrays, network, text
