"""Networks that the compiled code can compute."""

from __future__ import annotations

import pytest
from naosprint.rl.networks import linear_layers
from torch import nn


@pytest.mark.parametrize(
    "modules",
    [
        (nn.Linear(3, 2), nn.ReLU(), nn.Linear(2, 1)),
        (nn.Linear(3, 2), nn.Tanh()),
        (nn.Linear(3, 2), nn.Linear(2, 1)),
        (nn.Linear(3, 2), nn.Linear(2, 1), nn.Tanh()),
    ],
)
def test_other_networks_are_refused(modules: tuple[nn.Module, ...]) -> None:
    with pytest.raises(ValueError, match="linear layers with tanh between them"):
        linear_layers(modules)
