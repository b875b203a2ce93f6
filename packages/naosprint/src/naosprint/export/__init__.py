"""Export a policy for those who run it elsewhere.

policy.npz     weights, standardisation, and the robot's tables: all that an agent needs besides NumPy
policy.onnx    the network from raw observations to actions, standardisation included
policy.json    what goes in and comes out, by name and unit

"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from naosim.robots import nao_model

from naosprint.actuation import CYCLE_S, GAIN, Actuation
from naosprint.policy import load_policy
from naosprint.starts import DROP_M, RUNNING_YAW_DEG, SETTLING_CYCLES

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from naosim.robots.nao_model import RobotModel
    from onnx import ModelProto

    from naosprint.arrays import AnyArray
    from naosprint.checkpoint import Manifest
    from naosprint.policy import Policy

FORMAT = 2
"""Version of the exported files."""

OPSET = 17
"""Operator set of the ONNX file; every runtime since 2022 knows it."""

_IR_VERSION = 8


def export_policy(checkpoint: Path, directory: Path) -> tuple[Path, Path, Path]:
    """Write the policy of a checkpoint to ``directory`` as ``policy.npz``, ``policy.onnx`` and ``policy.json``.

    Returns:
        The paths of the three files, which are replaced if they exist.

    Raises:
        CheckpointError: if the checkpoint is damaged.
        OSError: onnx is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise OSError("policy.onnx needs onnx: pip install naosprint[export]") from error
    policy, manifest = load_policy(checkpoint)
    directory.mkdir(parents=True, exist_ok=True)
    arrays, network, text = directory / "policy.npz", directory / "policy.onnx", directory / "policy.json"
    np.savez(arrays, allow_pickle=False, **_arrays(policy, manifest))
    onnx.save(build_onnx(policy), network)
    text.write_text(json.dumps(_description(policy, manifest), indent=2, allow_nan=False) + "\n")
    return arrays, network, text


def build_onnx(policy: Policy) -> ModelProto:
    """Build the ONNX graph of a policy.

    Its input ``observations`` is (N, D) float32, raw; its output ``actions`` (N, A) float32 in [-1, 1].
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    constants: dict[str, AnyArray] = {
        "mean": policy.mean.astype(np.float32),
        "scale": policy.scale.astype(np.float32),
        "low": np.array(-1.0, dtype=np.float32),
        "high": np.array(1.0, dtype=np.float32),
    }
    nodes = [
        helper.make_node("Sub", ["observations", "mean"], ["centred"]),
        helper.make_node("Mul", ["centred", "scale"], ["scaled"]),
    ]
    hidden = "scaled"
    if np.isfinite(policy.clip):
        constants["clip_low"] = np.array(-policy.clip, dtype=np.float32)
        constants["clip_high"] = np.array(policy.clip, dtype=np.float32)
        nodes.append(helper.make_node("Clip", [hidden, "clip_low", "clip_high"], ["standardised"]))
        hidden = "standardised"
    for i, (weights, bias) in enumerate(policy.layers):
        constants[f"weights_{i}"], constants[f"bias_{i}"] = weights, bias
        last = i == len(policy.layers) - 1
        name = "mean_actions" if last else f"linear_{i}"
        nodes.append(helper.make_node("Gemm", [hidden, f"weights_{i}", f"bias_{i}"], [name], transB=1))
        hidden = name
        if not last:
            nodes.append(helper.make_node("Tanh", [name], [f"tanh_{i}"]))
            hidden = f"tanh_{i}"
    nodes.append(helper.make_node("Clip", [hidden, "low", "high"], ["actions"]))
    width, n_actions = len(policy.mean), len(policy.log_std)
    graph = helper.make_graph(
        nodes,
        "sprint_policy",
        [helper.make_tensor_value_info("observations", TensorProto.FLOAT, ["N", width])],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["N", n_actions])],
        [numpy_helper.from_array(np.ascontiguousarray(array), name) for name, array in constants.items()],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="naosprint", ir_version=_IR_VERSION
    )
    checker.check_model(model, full_check=True)
    return model


def _arrays(policy: Policy, manifest: Manifest) -> dict[str, AnyArray]:
    model = nao_model.model(manifest.spec.robot_type)
    actuation = Actuation(model)
    task = manifest.spec.task_definition
    arrays: dict[str, AnyArray] = {
        "format": np.array(FORMAT),
        "robot_type": np.array(model.robot_type),
        "mean": policy.mean,
        "scale": policy.scale,
        "clip": np.array(policy.clip),
        "layers": np.array(len(policy.layers)),
        "observation_names": np.array(manifest.observations),
        "action_names": np.array(manifest.actions),
        "joint_names": np.array(model.joint_names),
        "effector_names": np.array([joint.effector for joint in model.joints]),
        **_views(manifest.observations, actuation),
        "max_speed": actuation.max_speed,
        "start_pose_rad": actuation.start_pose(),
        "start": np.array([task.start_x_m, task.start_y_m, model.standing_height + DROP_M, RUNNING_YAW_DEG]),
        "settling_cycles": np.array(SETTLING_CYCLES),
        "gain": np.array(GAIN),
        "cycle_s": np.array(CYCLE_S),
        **_kinematics(model),
    }
    for i, (weights, bias) in enumerate(policy.layers):
        arrays[f"weights_{i}"], arrays[f"bias_{i}"] = weights, bias
    return arrays


def _views(observations: Sequence[str], actuation: Actuation) -> dict[str, AnyArray]:
    """Return what turns joint angles into observations, observations into their order, and actions into targets."""
    joints = np.arange(actuation.n_actions)
    view = np.zeros((actuation.n_actions, len(actuation.max_speed)))
    view[joints, actuation.index] = actuation.sign
    reach = (actuation.high_rad - actuation.low_rad) / 2.0
    features = [name for name in observations if f"{name}_rate" in observations]
    both = [*features, *(f"{name}_rate" for name in features)]
    return {
        "joint_view": view,
        "middle_rad": (actuation.low_rad + reach) @ view,
        "reach_rad": view.T * reach,
        "feature_order": np.array([both.index(name) for name in observations if name in both]),
    }


def _kinematics(model: RobotModel) -> dict[str, AnyArray]:
    """Return what the centre of mass follows from.

    ``chain`` has a row per joint, parents first: which joint turns which body against which other, the joint's place
    in the frames of both (``offset`` in the parent's, ``anchor`` in the body's), metres, and its axis.
    """
    place, offsets = model.body_index, np.array([body.offset for body in model.bodies])
    numbers, vectors = ("joint", "body", "parent"), ("offset", "anchor", "axis")
    kinds = [*((name, "i8") for name in numbers), *((name, "f8", 3) for name in vectors)]
    rows = []
    for k, joint in sorted(enumerate(model.joints), key=lambda item: place[item[1].body]):
        body, parent, anchor = place[joint.body], place[joint.parent], np.array(joint.anchor, dtype=np.float64)
        rows.append((k, body, parent, offsets[body] - offsets[parent] + anchor, anchor, joint.axis))
    return {"body_mass": np.array([body.mass for body in model.bodies]), "chain": np.array(rows, dtype=kinds)}


def _description(policy: Policy, manifest: Manifest) -> dict[str, Any]:
    actuation = Actuation(nao_model.model(manifest.spec.robot_type))
    low, high = np.degrees(actuation.low_rad).round(6), np.degrees(actuation.high_rad).round(6)
    return {
        "format": FORMAT,
        "checkpoint": {"step": manifest.steps, "spec_sha256": manifest.spec_sha256},
        "spec": manifest.spec.model_dump(mode="json"),
        "observations": list(manifest.observations),
        "actions": [
            {"joint": name, "minus_one_deg": float(a), "plus_one_deg": float(b), "sign": float(s)}
            for name, a, b, s in zip(manifest.actions, low, high, actuation.sign, strict=True)
        ],
        "controller": {"gain_per_s": GAIN, "cycle_s": CYCLE_S},
        "network": {
            "input": ["N", len(policy.mean)],
            "output": ["N", len(policy.log_std)],
            "hidden": [len(bias) for _, bias in policy.layers[:-1]],
            "activation": "tanh",
        },
    }
