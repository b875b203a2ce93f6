"""Know what the robot's left-right symmetry does to observations, actions and networks.

The robot and its task look the same in a mirror: what is a good action in a state is, with the sides exchanged, a good
action in the mirrored state. A network that respects this has half as much to learn, see Abdolhosseini et al., "On
Learning Symmetric Locomotion" (2019). Here its weights are tied, so that it respects it exactly: hidden units come in
pairs of which each sees the mirror image of what the other sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stable_baselines3.common.policies import ActorCriticPolicy
    from torch import Tensor

    from naosprint.arrays import FloatArray, IntArray

# The torso's frame has x to the right, y to the front, z up. Vectors turn round along x. Angular velocities, which are
# axial, turn round along y and z, and so does the yaw, which is an angle about z.
_TURNED = frozenset(
    {"yaw", "com_x", "gyro_y", "gyro_z", "accel_x"}
    | {f"{side}_foot_{kind}_x" for side in ("left", "right") for kind in ("origin", "force")}
)


@dataclass(frozen=True)
class Mirror:
    """Exchange left and right in a vector of named numbers: ``mirrored = sign * vector[..., place]``.

    Attributes:
        place: (D,) where each number comes from.
        sign: (D,) 1 or -1.
    """

    place: IntArray
    sign: FloatArray

    @classmethod
    def of_names(cls, names: Sequence[str]) -> Mirror:
        """Build the mirror of observations, or of actions, from their names.

        Joints keep their sign, because policies see both sides in a mirrored convention.

        Raises:
            ValueError: if the partner of a name is missing.
        """
        position = {name: i for i, name in enumerate(names)}
        place, sign = [], []
        for name in names:
            partner = _other_side(name)
            if partner not in position:
                raise ValueError(f"{name}: its mirror image {partner} is not among the {len(names)} names")
            place.append(position[partner])
            sign.append(-1.0 if name.removesuffix("_rate") in _TURNED else 1.0)
        return cls(np.array(place, dtype=np.int64), np.array(sign))

    @classmethod
    def of_pairs(cls, width: int) -> Mirror:
        """Build the mirror of a hidden layer: unit i of the first half and of the second are a pair.

        Raises:
            ValueError: if the width is odd.
        """
        if width % 2:
            raise ValueError(f"hidden_sizes: a symmetric policy needs layers of even width, not {width}")
        return cls(np.roll(np.arange(width), width // 2), np.ones(width))

    def apply(self, vectors: FloatArray) -> FloatArray:
        """Return the mirror image of (..., D) numbers."""
        return np.asarray(vectors[..., self.place] * self.sign)


def _other_side(name: str) -> str:
    if len(name) > 3 and name[0] in "lr" and name[1:3] in ("aj", "lj"):
        return ("r" if name[0] == "l" else "l") + name[1:]
    if name.startswith("left_"):
        return "right_" + name.removeprefix("left_")
    if name.startswith("right_"):
        return "left_" + name.removeprefix("right_")
    return name


def tie_weights(policy: ActorCriticPolicy, observations: Mirror, actions: Mirror) -> None:
    """Make actor and critic symmetric, now and under every gradient step to come.

    The weights are replaced by their means with their own mirror images, scaled so that units keep their norms, and
    hooks do the same to the gradients. Mirrored weights then get mirrored gradients, bit for bit, and an optimiser that
    treats all weights alike, as Adam does, keeps them mirrored.

    Raises:
        ValueError: if a hidden layer has an odd number of units.
    """
    from torch import nn

    value = Mirror(np.zeros(1, dtype=np.int64), np.ones(1))
    for body, head, outputs in (
        (policy.mlp_extractor.policy_net, policy.action_net, actions),
        (policy.mlp_extractor.value_net, policy.value_net, value),
    ):
        seen = observations
        layers = [layer for layer in (*body, head) if isinstance(layer, nn.Linear)]
        for layer in layers:
            out = outputs if layer is layers[-1] else Mirror.of_pairs(layer.out_features)
            _tie(layer.weight, out, seen)
            _tie(layer.bias, out, None)
            seen = out
    _tie(policy.log_std, Mirror(actions.place, np.abs(actions.sign)), None)


def _tie(parameter: Tensor, rows: Mirror, columns: Mirror | None) -> None:
    import torch

    row_place = torch.from_numpy(rows.place)
    signs = torch.from_numpy(rows.sign).to(torch.float32)
    if columns is not None:
        column_place = torch.from_numpy(columns.place)
        signs = signs[:, None] * torch.from_numpy(columns.sign).to(torch.float32)

    def symmetric(array: Tensor) -> Tensor:
        mirrored = array[row_place]
        if columns is not None:
            mirrored = mirrored[:, column_place]
        return 0.5 * (array + signs * mirrored)

    with torch.no_grad():
        if columns is None:
            parameter.copy_(symmetric(parameter))
        else:
            norms = parameter.norm(dim=1, keepdim=True)
            parameter.copy_(symmetric(parameter))
            factors = norms / parameter.norm(dim=1, keepdim=True)
            # one factor for both units of a pair, to the last bit
            parameter.mul_(0.5 * (factors + factors[row_place]))
    parameter.register_hook(symmetric)  # type: ignore[no-untyped-call]
