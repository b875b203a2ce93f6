"""Symmetric policies: networks whose mirrored input gives the mirrored output.

Robot and task are symmetric: the mirror image of a good action is a good action in the mirrored state. A network with
this symmetry has half as much to learn, see Abdolhosseini et al., "On Learning Symmetric Locomotion" (2019). Here its
weights are tied, so that the symmetry is exact: hidden units come in pairs, each of which sees the mirror image of the
other's input.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from naosprint.mirror import Mirror

if TYPE_CHECKING:
    from stable_baselines3.common.policies import ActorCriticPolicy


@dataclass(frozen=True)
class Symmetry:
    """What mirroring does to the vectors of symmetric networks.

    Attributes:
        actor: mirrors of the actor's inputs and of each of its layers' outputs.
        critic: the same for the critic, whose value does not change.
    """

    actor: tuple[Mirror, ...]
    critic: tuple[Mirror, ...]


def tie_weights(policy: ActorCriticPolicy, observations: Mirror, actions: Mirror) -> Symmetry:
    """Make actor and critic symmetric, now and after every gradient step.

    The weights are replaced by their means with their own mirror images, scaled so that units keep their norms, and
    hooks do the same to the gradients. Mirrored weights then get mirrored gradients, bit for bit, and an optimizer that
    treats all weights alike, as Adam does, keeps them mirrored.

    Returns:
        The mirrors of both networks, for gradients that PyTorch does not compute.

    Raises:
        ValueError: if a hidden layer has an odd number of units.
    """
    value = Mirror(np.zeros(1, dtype=np.int64), np.ones(1))
    found = []
    for body, head, outputs in (
        (policy.mlp_extractor.policy_net, policy.action_net, actions),
        (policy.mlp_extractor.value_net, policy.value_net, value),
    ):
        mirrors = [observations]
        layers = [layer for layer in (*body, head) if isinstance(layer, nn.Linear)]
        for layer in layers:
            mirrors.append(outputs if layer is layers[-1] else Mirror.of_pairs(layer.out_features))
            _tie(layer.weight, mirrors[-1], mirrors[-2])
            _tie(layer.bias, mirrors[-1], None)
        found.append(tuple(mirrors))
    _tie(policy.log_std, Mirror(actions.index, np.abs(actions.sign)), None)
    return Symmetry(*found)


def _tie(parameter: Tensor, rows: Mirror, columns: Mirror | None) -> None:
    row_index = torch.from_numpy(rows.index)
    signs = torch.from_numpy(rows.sign).to(torch.float32)
    if columns is not None:
        column_index = torch.from_numpy(columns.index)
        signs = signs[:, None] * torch.from_numpy(columns.sign).to(torch.float32)

    def symmetric(array: Tensor) -> Tensor:
        mirrored = array[row_index]
        if columns is not None:
            mirrored = mirrored[:, column_index]
        return 0.5 * (array + signs * mirrored)

    with torch.no_grad():
        if columns is None:
            parameter.copy_(symmetric(parameter))
        else:
            norms = parameter.norm(dim=1, keepdim=True)
            parameter.copy_(symmetric(parameter))
            # an output that is its own mirror image with a negative sign may see nothing symmetric at first
            factors = norms / parameter.norm(dim=1, keepdim=True).clamp_min(1e-12)
            # one factor for both units of a pair, to the last bit
            parameter.mul_(0.5 * (factors + factors[row_index]))
    parameter.register_hook(symmetric)  # type: ignore[no-untyped-call]
