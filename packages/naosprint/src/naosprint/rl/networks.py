"""Tanh networks on the processor, by oneDNN's kernels.

Torch multiplies matrices of 32-bit floats by MKL and computes tanh one vector at a time. oneDNN, which torch includes
for its compiler, does both in one pass and, on AVX-512 machines that are not Intel's, in a third of the time. The
operator is internal to torch; where it is missing or gives wrong results, plain torch is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import torch
from torch import nn

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from stable_baselines3.common.policies import ActorCriticPolicy
    from torch import Tensor

    from naosprint.arrays import Float32Array

FEW_ROWS = 64
"""oneDNN's operator takes at least 20 microseconds a call; with fewer rows than these plain torch is faster."""


def linear_layers(modules: Iterable[nn.Module]) -> tuple[nn.Linear, ...]:
    """Return the linear layers of networks in which tanh follows each but the last.

    Raises:
        ValueError: if anything but tanh stands between them.
    """
    chain = list(modules)
    layers = tuple(module for module in chain[::2] if isinstance(module, nn.Linear))
    if len(chain) != 2 * len(layers) - 1 or not all(isinstance(module, nn.Tanh) for module in chain[1::2]):
        raise ValueError(f"expected linear layers with tanh between them, got {chain}")
    return layers


def blind(policy: ActorCriticPolicy, seen: int) -> None:
    """Give the actor weight 0 for all but the first ``seen`` observations, now and after every gradient step."""
    first = cast("nn.Linear", policy.mlp_extractor.policy_net[0]).weight
    if seen == first.shape[1]:
        return
    mask = torch.zeros(first.shape[1])
    mask[:seen] = 1.0
    with torch.no_grad():
        first.mul_(mask)
    first.register_hook(lambda gradient: gradient * mask)  # type: ignore[no-untyped-call]


def run_network(layers: Sequence[nn.Linear], inputs: Tensor, *, fused: bool = True) -> Tensor:
    """Return the (n, outputs) outputs of a network for (n, inputs) inputs; gradients flow through it.

    Args:
        layers: the network's linear layers, tanh between them.
        inputs: (n, inputs).
        fused: whether oneDNN may compute it; what it computes differs from plain torch in the last bits.
    """
    values = inputs
    last = len(layers) - 1
    run_layer = _plain if not (fused and FUSED) else _Dense.apply if torch.is_grad_enabled() else _fused
    for i, layer in enumerate(layers):
        values = cast("Any", run_layer)(values, layer.weight, layer.bias, i < last)
    return values


class TorchForward:
    """A network's outputs by torch, as :class:`naosprint.rl.forward.Forward` gives them.

    Args:
        layers: the network's linear layers, tanh between them.
        fused: whether oneDNN may compute it.
    """

    def __init__(self, layers: Sequence[nn.Linear], *, fused: bool = True) -> None:
        self._layers, self._fused = layers, fused

    def pack(self) -> None:
        """Do nothing: the layers are used as they are."""

    def __call__(
        self, inputs: Float32Array, added: Float32Array | None = None, out: Float32Array | None = None
    ) -> Float32Array:
        """Return the (n, outputs) outputs for (n, inputs) inputs; see :meth:`Forward.__call__`."""
        with torch.no_grad():
            outputs = run_network(self._layers, torch.from_numpy(inputs), fused=self._fused)
            if added is not None:
                outputs = outputs + torch.from_numpy(added)
            values: Float32Array = outputs.numpy()
            if out is None:
                return values
            out[:] = values
            return out


class _Dense(torch.autograd.Function):
    """Linear layer with or without tanh, forward and backward by oneDNN."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, squash: bool) -> Tensor:
        outputs = _fused(inputs, weight, bias, squash)
        ctx.save_for_backward(inputs, weight, outputs if squash else None)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None]:
        inputs, weight, outputs = ctx.saved_tensors
        gradient = gradients[0] if outputs is None else torch.ops.aten.tanh_backward(gradients[0], outputs)
        into_inputs = _fused(gradient, weight.t(), None, False) if ctx.needs_input_grad[0] else None
        return into_inputs, _fused(gradient.t(), inputs.t(), None, False), gradient.sum(0), None


def _fused(inputs: Tensor, weight: Tensor, bias: Tensor | None, squash: bool) -> Tensor:
    operator = torch.ops.mkldnn._linear_pointwise
    return cast("Tensor", operator(inputs, weight, bias, "tanh" if squash else "none", [], ""))


def _plain(inputs: Tensor, weight: Tensor, bias: Tensor, squash: bool) -> Tensor:
    outputs = nn.functional.linear(inputs, weight, bias)
    return torch.tanh(outputs) if squash else outputs


def _fused_works() -> bool:
    """Try the operator on a layer whose outputs and gradients are known."""
    inputs = torch.linspace(-1.0, 1.0, 8).reshape(4, 2)
    weight = torch.tensor([[0.5, -1.0], [0.25, 2.0], [1.0, 0.0]])
    bias = torch.tensor([0.1, -0.2, 0.3])
    try:
        fused = [_fused(inputs, weight, bias, squash) for squash in (True, False)]
        turned = _fused(fused[1].t(), inputs.t(), None, False)
    except (AttributeError, RuntimeError):
        return False
    plain = [_plain(inputs, weight, bias, squash) for squash in (True, False)]
    pairs = ((fused[0], plain[0]), (fused[1], plain[1]), (turned, plain[1].t() @ inputs))
    return all(torch.allclose(ours, known, atol=1e-6) for ours, known in pairs)


FUSED = _fused_works()
"""Whether oneDNN's operator is used."""
