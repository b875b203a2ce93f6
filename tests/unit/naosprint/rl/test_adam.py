"""Our Adam and our clipping of gradients are PyTorch's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from naosprint.rl import _kernel
from naosprint.rl.adam import Adam

SHAPES = ((128, 76), (16, 8), (21,), (3,), (1,))


def parameters() -> list[torch.nn.Parameter]:
    """Return parameters of several shapes, the same ones every time."""
    generator = torch.Generator().manual_seed(1)
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


def optimize(optimizer: Any, optimized: list[torch.nn.Parameter], max_norm: float | None, clips: bool) -> None:
    """Take 20 steps; one parameter has its first gradient at the fifth and loses it at the tenth."""
    generator = torch.Generator().manual_seed(2)
    for step in range(20):
        for parameter in optimized:
            parameter.grad = torch.randn(parameter.shape, generator=generator)
        if not 5 <= step < 10:
            optimized[-1].grad = None
        if clips:
            optimizer.step(max_norm)
            continue
        if max_norm is not None:
            torch.nn.utils.clip_grad_norm_(optimized, max_norm)
        optimizer.step()


@pytest.mark.parametrize("max_norm", [None, 0.5, 1e6])
def test_every_bit_is_that_of_torch(max_norm: float | None) -> None:
    ours, theirs = parameters(), parameters()
    adam, stock = Adam(ours, 1e-2, eps=1e-5), torch.optim.Adam(theirs, lr=1e-2, eps=1e-5, fused=True)
    optimize(adam, ours, max_norm, clips=True)
    optimize(stock, theirs, max_norm, clips=False)
    for mine, other in zip(ours, theirs, strict=True):
        assert torch.equal(mine, other)
        for slot in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(adam.state[mine][slot], stock.state[other][slot])
    assert not torch.equal(ours[-1], parameters()[-1])


def test_kernels_have_the_same_bits() -> None:
    rng, found = np.random.default_rng(3), []
    start = [rng.normal(size=(4, n)).astype(np.float32) ** 2 for n in (1000, 37, 1)]
    for kernel in _kernel.kernels():
        arrays = [each.copy() for each in start]
        steps = [np.zeros((), np.float32) for _ in arrays]
        adam = _kernel.Adam([(*each, step) for each, step in zip(arrays, steps, strict=True)], kernel)
        for _ in range(3):
            adam.clip(0.7)
            adam.step(1e-2, 1e-8)
        assert all(step == 3.0 for step in steps)
        found.append(np.concatenate(arrays, axis=1))
    for each in found:
        np.testing.assert_array_equal(each, found[0])


def test_a_gradient_that_is_not_finite_shows() -> None:
    ours = parameters()
    adam = Adam(ours, 1e-2)
    for parameter in ours:
        parameter.grad = torch.full(parameter.shape, float("nan"))
    adam.step(0.5)
    assert all(bool(torch.isnan(parameter).all()) for parameter in ours)


def test_arrays_must_match() -> None:
    one, two = np.zeros(1, np.float32), np.zeros(2, np.float32)
    with pytest.raises(ValueError, match="sizes do not match"):
        _kernel.Adam([(two, two, two, one, one)])
