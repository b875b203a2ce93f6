"""Tanh networks of stable-baselines3, and their outputs by PyTorch."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch
from torch import nn

if TYPE_CHECKING:
    from collections.abc import Iterable

    from stable_baselines3.common.policies import ActorCriticPolicy

    from naosprint.arrays import Float32Array


def actor_of(policy: ActorCriticPolicy) -> nn.Sequential:
    """Return the network from observations to mean actions, which shares the policy's weights."""
    return nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)


def critic_of(policy: ActorCriticPolicy) -> nn.Sequential:
    """Return the network from observations to values, which shares the policy's weights."""
    return nn.Sequential(*policy.mlp_extractor.value_net, policy.value_net)


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


class TorchForward:
    """A network's outputs by PyTorch, as :class:`naosprint.rl.forward.Forward` gives them.

    Args:
        network: the network.
    """

    def __init__(self, network: nn.Sequential) -> None:
        self._network = network

    def pack(self) -> None:
        """Do nothing: the weights are used as they are."""

    def __call__(
        self, inputs: Float32Array, added: Float32Array | None = None, out: Float32Array | None = None
    ) -> Float32Array:
        """Return the (n, outputs) outputs for (n, inputs) inputs; see :meth:`Forward.__call__`."""
        with torch.no_grad():
            values: Float32Array = self._network(torch.from_numpy(inputs)).numpy()
        if added is not None:
            values = values + added
        if out is None:
            return values
        out[:] = values
        return out
