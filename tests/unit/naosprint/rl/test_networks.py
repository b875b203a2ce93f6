"""Networks by oneDNN's kernels compute what torch computes, and so do their gradients."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
import torch
from naosprint.rl import networks
from naosprint.rl.networks import linear_layers, run_network
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


ONEDNN = pytest.mark.skipif(not torch.backends.mkldnn.is_available(), reason="this torch has no oneDNN")


@ONEDNN
@pytest.mark.parametrize("fused", [False, True])
def test_the_fused_kernels_run_where_they_may(fused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without them every training would take twice as long, unnoticed."""
    calls: list[int] = []
    operator = networks._fused

    def counted(*arguments: Any) -> torch.Tensor:
        calls.append(len(calls))
        return operator(*arguments)

    monkeypatch.setattr(networks, "_fused", counted)
    net = network(89, 64, 20)
    inputs = torch.randn(128, 89)
    outputs_and_gradients(run_network(linear_layers(net), inputs, fused=fused), net)
    with torch.no_grad():
        run_network(linear_layers(net), inputs, fused=fused)
    # two layers forward, their weights and one layer's inputs backward; then forward alone
    assert len(calls) == (7 if fused else 0)


@pytest.mark.parametrize("rows", [1, 7, 128, 2048])
@pytest.mark.parametrize("sizes", [(89, 64, 64, 20), (89, 128, 128, 1), (89, 20), (5, 3, 2)])
def test_a_network_and_its_gradients_are_those_of_torch(rows: int, sizes: tuple[int, ...]) -> None:
    net = network(*sizes)
    inputs = torch.randn(rows, sizes[0])
    ours = outputs_and_gradients(run_network(linear_layers(net), inputs), net)
    torchs = outputs_and_gradients(net(inputs), net)
    for mine, known in zip(ours, torchs, strict=True):
        torch.testing.assert_close(mine, known, rtol=1e-4, atol=1e-4 * float(known.abs().max()))


def missing(*_: object) -> torch.Tensor:
    raise AttributeError("no such operator")


def wrong(inputs: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, squash: bool) -> torch.Tensor:
    # a kernel that forgets the bias
    outputs = inputs @ weight.t()
    return torch.tanh(outputs) if squash else outputs


@pytest.mark.parametrize("operator", [missing, wrong])
def test_an_operator_that_is_missing_or_wrong_is_not_used(operator: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "_fused", operator)
    assert not networks._fused_works()
    # plain torch does not need it
    net = network(6, 4, 2)
    inputs = torch.randn(9, 6)
    monkeypatch.setattr(networks, "FUSED", False)
    torch.testing.assert_close(run_network(linear_layers(net), inputs), net(inputs))


def test_the_inputs_get_their_gradient_too() -> None:
    net = network(6, 4, 2)
    inputs = torch.randn(9, 6, requires_grad=True)
    (ours,) = torch.autograd.grad(run_network(linear_layers(net), inputs).sum(), inputs)
    (known,) = torch.autograd.grad(net(inputs).sum(), inputs)
    torch.testing.assert_close(ours, known)


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
