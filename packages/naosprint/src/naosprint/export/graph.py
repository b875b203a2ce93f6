"""``policy.onnx``: the network as an ONNX graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from onnx import ModelProto

    from naosprint.arrays import AnyArray
    from naosprint.rl.policy import NetworkPolicy

OPSET = 17
"""Operator set of the ONNX file; every runtime since 2022 supports it."""

_IR_VERSION = 8


def build_onnx(policy: NetworkPolicy) -> ModelProto:
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
        nodes.append(helper.make_node("Clip", [hidden, "clip_low", "clip_high"], ["standardized"]))
        hidden = "standardized"
    for i, (weights, bias) in enumerate(policy.layers):
        constants[f"weights_{i}"], constants[f"bias_{i}"] = weights, bias
        function = policy.activations[i]
        name = "mean_actions" if function == "linear" else f"linear_{i}"
        nodes.append(helper.make_node("Gemm", [hidden, f"weights_{i}", f"bias_{i}"], [name], transB=1))
        hidden = name
        if function != "linear":
            hidden = f"{function}_{i}"
            nodes.append(helper.make_node({"tanh": "Tanh", "relu": "Relu"}[function], [name], [hidden]))
    nodes.append(helper.make_node("Clip", [hidden, "low", "high"], ["actions"]))
    width, n_actions = len(policy.mean), policy.n_actions
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observations", TensorProto.FLOAT, ["N", width])],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["N", n_actions])],
        [numpy_helper.from_array(np.ascontiguousarray(array), name) for name, array in constants.items()],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="naosprint", ir_version=_IR_VERSION
    )
    checker.check_model(model, full_check=True)
    return model
