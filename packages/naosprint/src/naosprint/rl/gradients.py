"""Gradients of PPO's losses by a compiled kernel, in place of those of :class:`naosprint.rl.ppo.Losses`.

Both compute the same; the last digits differ. The kernel (packages/naosprint/cpp) passes a minibatch through a network
in tiles that stay in the processor's cache, forward and backward. It applies to layers of any number and width.

Symmetric networks (:mod:`naosprint.rl.symmetry`) take half the work there. In sums and differences of mirrored numbers
their layers are block diagonal: sums depend on sums and differences on differences, see Cohen and Welling, "Group
Equivariant Convolutional Networks" (2016). Only tanh needs the numbers themselves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from naosprint.rl import _kernel
from naosprint.rl.networks import linear_layers

if TYPE_CHECKING:
    from stable_baselines3.common.policies import ActorCriticPolicy
    from torch import Tensor

    from naosprint.arrays import Float32Array
    from naosprint.mirror import Mirror
    from naosprint.rl.settings import PPOSettings
    from naosprint.rl.symmetry import Symmetry

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class Samples:
    """The N samples of a rollout.

    Attributes:
        observations: (N, D) normalized observations.
        actions: (N, A) actions as drawn.
        log_probs: (N,) logarithms of their probability densities when they were drawn.
        advantages: (N,) estimated advantages.
        returns: (N,) estimated returns.
    """

    observations: Tensor
    actions: Tensor
    log_probs: Tensor
    advantages: Tensor
    returns: Tensor


class KernelGradients:
    """Gradients by the compiled kernel.

    Args:
        policy: the networks.
        settings: PPO's settings.
        symmetry: mirrors of the networks if their weights are tied.
        kernel: instruction set, ``avx512``, ``avx2`` or ``generic``; by default the fastest supported one.
        seen: number of observations that the actor sees, the first ones; by default all.
        concurrent: whether actor and critic are computed on a thread each.
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        settings: PPOSettings,
        symmetry: Symmetry | None = None,
        kernel: str = "",
        seen: int | None = None,
        concurrent: bool = False,
    ) -> None:
        self._settings = settings
        self._concurrent = concurrent
        self._log_std = policy.log_std
        self._gradients: dict[Tensor, Tensor] = {
            parameter: torch.zeros_like(parameter, requires_grad=False) for parameter in policy.parameters()
        }
        # the mirrored spread of each joint, whose gradients are averaged
        self._pairs = None if symmetry is None else torch.from_numpy(symmetry.actor[-1].index)
        self._halves: Float32Array | None = None

        def network(layers: tuple[torch.nn.Linear, ...], mirrors: tuple[Mirror, ...]) -> _kernel.Gradients:
            return _kernel.Gradients(
                [
                    (
                        layer.weight.detach().numpy(),
                        layer.bias.detach().numpy(),
                        self._gradients[layer.weight].numpy(),
                        self._gradients[layer.bias].numpy(),
                    )
                    for layer in layers
                ],
                [(mirror.index, mirror.sign) for mirror in mirrors],
                kernel,
            )

        actor = linear_layers((*policy.mlp_extractor.policy_net, policy.action_net))
        critic = linear_layers((*policy.mlp_extractor.value_net, policy.value_net))
        self._unseen = self._gradients[actor[0].weight][:, seen or actor[0].in_features :]
        written = [parameter for layer in (*actor, *critic) for parameter in (layer.weight, layer.bias)]
        if policy.log_std.requires_grad:
            written.append(policy.log_std)
        self._written = [(parameter, self._gradients[parameter]) for parameter in written]
        self._actor = network(actor, () if symmetry is None else symmetry.actor)
        self._critic = network(critic, () if symmetry is None else symmetry.critic)

    def prepare(self, samples: Samples) -> Samples:
        """Return the samples, with observations as sums and differences if the networks are symmetric."""
        if self._pairs is None:
            return samples
        observations = samples.observations.numpy()
        if self._halves is None or self._halves.shape != observations.shape:
            self._halves = np.empty_like(observations)
        self._actor.split(observations, self._halves)
        return replace(samples, observations=torch.from_numpy(self._halves))

    def both(self, samples: Samples, chosen: Tensor) -> tuple[float, float, float, float, float]:
        """Compute the gradients of both networks; see :meth:`naosprint.rl.ppo.Losses.both`."""
        settings, log_std = self._settings, self._log_std
        spread = self._gradients[log_std] if log_std.requires_grad else None
        policy_loss, clipped, kl, value_loss = self._actor.both(
            self._critic,
            log_std.detach().numpy(),
            None if spread is None else spread.numpy(),
            samples.observations.numpy(),
            samples.actions.numpy(),
            samples.log_probs.numpy(),
            samples.advantages.numpy(),
            samples.returns.numpy(),
            chosen.numpy(),
            settings.advantage_normalization == "minibatch",
            settings.clip_range,
            settings.value_coefficient,
            self._concurrent,
        )
        if spread is not None:
            spread -= settings.entropy_coefficient
            if self._pairs is not None:
                spread.copy_(0.5 * (spread + spread[self._pairs]))
        self._hand_over()
        return policy_loss, value_loss, float(gaussian_entropy(log_std.detach())), clipped, kl

    def imitation(self, samples: Samples, chosen: Tensor) -> tuple[float, float]:
        """Compute the gradients of both networks in imitation; see :meth:`naosprint.rl.ppo.Losses.imitation`."""
        distance, value_loss = self._actor.imitation(
            self._critic,
            samples.observations.numpy(),
            samples.actions.numpy(),
            samples.returns.numpy(),
            chosen.numpy(),
            self._settings.value_coefficient,
            self._concurrent,
        )
        self._hand_over()
        self._log_std.grad = None
        return distance, value_loss

    def _hand_over(self) -> None:
        """Give the parameters the gradients that the kernel has written, and will overwrite next time."""
        self._unseen.zero_()
        for parameter, gradient in self._written:
            parameter.grad = gradient


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Return the entropy of a Gaussian whose spread does not depend on the state."""
    return log_std.sum() + log_std.numel() * (0.5 + _HALF_LOG_TWO_PI)
