"""Our Adam is PyTorch's."""

from __future__ import annotations

from typing import Any

import torch
from naosprint.rl.adam import Adam


def parameters() -> list[torch.nn.Parameter]:
    """Return parameters of several shapes, the same ones every time."""
    generator = torch.Generator().manual_seed(1)
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in ((16, 8), (16,), (1,))]


def optimize(optimizer: Any, optimized: list[torch.nn.Parameter]) -> None:
    """Take 20 steps; one parameter has its first gradient at the fifth and loses it at the tenth."""
    generator = torch.Generator().manual_seed(2)
    for step in range(20):
        for parameter in optimized:
            parameter.grad = torch.randn(parameter.shape, generator=generator)
        if not 5 <= step < 10:
            optimized[-1].grad = None
        optimizer.step()


def test_every_bit_is_that_of_torch() -> None:
    ours, theirs = parameters(), parameters()
    adam, stock = Adam(ours, 1e-2, eps=1e-5), torch.optim.Adam(theirs, lr=1e-2, eps=1e-5, fused=True)
    optimize(adam, ours)
    optimize(stock, theirs)
    for mine, other in zip(ours, theirs, strict=True):
        assert torch.equal(mine, other)
        for slot in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(adam.state[mine][slot], stock.state[other][slot])
    assert not torch.equal(ours[-1], parameters()[-1])
