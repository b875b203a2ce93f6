"""Compiled forward pass of networks, with the same bits on every processor.

Every output is one sum in single precision, of the bias and the products in the order of the inputs, each rounded. What
a row gives does not depend on the instruction set, on the other rows, or on the number of threads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import nn

    from naosprint.arrays import Float32Array


class Forward:
    """A network of linear layers with tanh between them.

    Args:
        layers: weights (out, in) and bias (out,) of each layer. The arrays are kept; when their contents have changed,
            call :meth:`pack`.
        kernel: instruction set, ``avx512``, ``avx2`` or ``generic``; by default the fastest supported one.
        threads: address of a simulator's threads; see ``naosim.simulator.NativeHandle``.
    """

    def __init__(
        self, layers: Sequence[tuple[Float32Array, Float32Array]], kernel: str = "", *, threads: int = 0
    ) -> None:
        from naosprint.rl import _kernel

        self._network = _kernel.Forward(list(layers), kernel)
        self._outputs = len(layers[-1][1])
        self._threads = threads

    @classmethod
    def of(cls, layers: Sequence[nn.Linear], threads: int) -> Forward:
        """Return a network of torch's layers, whose weights it shares."""
        return cls([(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers], threads=threads)

    def pack(self) -> None:
        """Read the weights again."""
        self._network.pack()

    def __call__(
        self, inputs: Float32Array, added: Float32Array | None = None, out: Float32Array | None = None
    ) -> Float32Array:
        """Return the (n, outputs) outputs for (n, inputs) inputs.

        Args:
            inputs: (n, inputs), C-contiguous.
            added: (n, outputs) numbers to add to the outputs.
            out: (n, outputs) array to write into; a new one by default.

        Raises:
            ValueError: if a shape is wrong.
        """
        if out is None:
            out = np.empty((len(inputs), self._outputs), np.float32)
        self._network.run(inputs, out, added, self._threads)
        return out
