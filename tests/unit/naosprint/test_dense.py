"""Networks by oneDNN's kernels compute what torch computes, and so do their gradients."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from naosprint import dense
from naosprint.dense import dense_layers, run_network
from torch import nn


def network(*sizes: int) -> nn.Sequential:
    torch.manual_seed(0)
    modules: list[nn.Module] = []
    for before, after in pairwise(sizes):
        modules += [nn.Linear(before, after), nn.Tanh()]
    return nn.Sequential(*modules[:-1])


def outputs_and_gradients(outputs: torch.Tensor, net: nn.Sequential) -> list[torch.Tensor]:
    gradients = torch.autograd.grad(outputs.square().sum(), list(net.parameters()))
    return [outputs.detach(), *gradients]


@pytest.mark.parametrize("rows", [1, 7, 128, 2048])
@pytest.mark.parametrize("sizes", [(89, 64, 64, 20), (89, 64, 64, 1), (89, 20), (5, 3, 2)])
@pytest.mark.parametrize("implementation", ["chosen", "plain"])
def test_a_network_and_its_gradients_are_those_of_torch(
    rows: int, sizes: tuple[int, ...], implementation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if implementation == "plain":
        monkeypatch.setattr(dense, "_run_layer", dense._plain)
    net = network(*sizes)
    inputs = torch.randn(rows, sizes[0])
    ours = outputs_and_gradients(run_network(dense_layers(net), inputs), net)
    torchs = outputs_and_gradients(net(inputs), net)
    for mine, known in zip(ours, torchs, strict=True):
        torch.testing.assert_close(mine, known, rtol=1e-4, atol=1e-4 * float(known.abs().max()))


def test_the_inputs_get_their_gradient_too() -> None:
    net = network(6, 4, 2)
    inputs = torch.randn(9, 6, requires_grad=True)
    (ours,) = torch.autograd.grad(run_network(dense_layers(net), inputs).sum(), inputs)
    (known,) = torch.autograd.grad(net(inputs).sum(), inputs)
    torch.testing.assert_close(ours, known)


@pytest.mark.parametrize(
    "modules",
    [(nn.Linear(3, 2), nn.ReLU(), nn.Linear(2, 1)), (nn.Linear(3, 2), nn.Tanh()), (nn.Linear(3, 2), nn.Linear(2, 1))],
)
def test_other_networks_are_refused(modules: tuple[nn.Module, ...]) -> None:
    with pytest.raises(ValueError, match="linear layers with tanh between them"):
        dense_layers(modules)
