"""Adam in C++, with the bits of ``torch.optim.Adam(..., fused=True)`` and ``torch.nn.utils.clip_grad_norm_``.

Called for a dozen small arrays between two minibatches, these functions of PyTorch took a tenth of an update.
``torch.optim`` also loads PyTorch's compiler: 1.4 s and 70 MB in every process.
"""

from __future__ import annotations

from operator import is_not
from typing import TYPE_CHECKING

import torch

from naosprint.rl import _kernel

if TYPE_CHECKING:
    from collections.abc import Iterable

    from torch import Tensor


class Adam:
    """Adam (Kingma and Ba, 2015).

    Args:
        parameters: what to optimize, in single precision; those without a gradient stay as they are.
        lr: learning rate.
        eps: term that keeps the denominator from zero.

    Attributes:
        lr: learning rate of the next step.
        state: ``step``, ``exp_avg`` and ``exp_avg_sq`` of each parameter that has had a gradient.
    """

    def __init__(self, parameters: Iterable[Tensor], lr: float, *, eps: float = 1e-8) -> None:
        self._parameters = list(parameters)
        self._eps = eps
        self.lr = lr
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        self._tensors: list[Tensor] = []
        self._kernel = _kernel.Adam([])

    def step(self, max_norm: float | None = None) -> None:
        """Change the parameters by their gradients.

        Args:
            max_norm: norm of all gradients together to which larger ones are scaled down first.
        """
        tensors: list[Tensor] = []
        for parameter in self._parameters:
            if parameter.grad is None:
                continue
            slots = self.state.get(parameter)
            if slots is None:
                slots = self.state[parameter] = {
                    "step": torch.zeros((), dtype=torch.float32),
                    "exp_avg": torch.zeros_like(parameter, requires_grad=False),
                    "exp_avg_sq": torch.zeros_like(parameter, requires_grad=False),
                }
            tensors += (parameter, parameter.grad, slots["exp_avg"], slots["exp_avg_sq"], slots["step"])
        # the compiled kernel writes the gradients of every minibatch to the same arrays
        if len(tensors) != len(self._tensors) or any(map(is_not, tensors, self._tensors)):
            self._tensors = tensors
            arrays = [tensor.detach().numpy() for tensor in tensors]
            self._kernel = _kernel.Adam(list(zip(*(arrays[k::5] for k in range(5)), strict=True)))
        if max_norm is not None:
            self._kernel.clip(max_norm)
        self._kernel.step(self.lr, self._eps)
