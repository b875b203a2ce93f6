"""The compiled forward pass: sums in the order of the inputs, the same bits everywhere."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from naosprint.arrays import Float32Array
from naosprint.rl import _kernel
from naosprint.rl.forward import Forward

Layers = list[tuple[Float32Array, Float32Array]]


def drawn(*sizes: int) -> Layers:
    rng = np.random.default_rng(3)
    return [
        (rng.standard_normal((out, into), dtype=np.float32) / 4, rng.standard_normal(out, dtype=np.float32))
        for into, out in pairwise(sizes)
    ]


def tanh(x: Float32Array) -> Float32Array:
    """Return the kernel's approximation, one rounded operation after the other."""
    x = np.clip(x, np.float32(-7.90531110763549805), np.float32(7.90531110763549805))
    z = x * x
    p, q = np.float32(-2.76076847742355e-16), np.float32(1.19825839466702e-06)
    above = (2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08)
    for number in (*above, 1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03):
        p = z * p + np.float32(number)
    for number in (1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03):
        q = z * q + np.float32(number)
    return x * p / q


def reference(layers: Layers, inputs: Float32Array) -> Float32Array:
    values = inputs
    for number, (weight, bias) in enumerate(layers):
        sums = np.repeat(bias[None], len(values), axis=0)
        for k in range(weight.shape[1]):
            sums = sums + values[:, k : k + 1] * weight[:, k]
        values = sums if number == len(layers) - 1 else tanh(sums)
    return values


@pytest.mark.parametrize("kernel", _kernel.kernels())
@pytest.mark.parametrize(
    ("sizes", "rows"), [((89, 128, 128, 20), 37), ((13, 7, 3), 1), ((5, 18), 130), ((3, 33, 1), 16)]
)
def test_every_kernel_has_the_bits_of_single_operations(kernel: str, sizes: tuple[int, ...], rows: int) -> None:
    layers = drawn(*sizes)
    inputs = 2.0 * np.random.default_rng(4).standard_normal((rows, sizes[0]), dtype=np.float32)
    network = Forward(layers, kernel)
    expected = reference(layers, inputs)
    np.testing.assert_array_equal(network(inputs), expected)
    np.testing.assert_array_equal(network(inputs, added=expected), expected + expected)


def test_tanh_is_that_of_double_precision() -> None:
    inputs = np.concatenate([np.linspace(-12, 12, 40_001), np.geomspace(1e-30, 1, 1000)]).astype(np.float32)[:, None]
    one = np.ones((1, 1), np.float32), np.zeros(1, np.float32)
    np.testing.assert_allclose(Forward([one, one])(inputs), np.tanh(inputs.astype(np.float64)), rtol=6e-7, atol=0)
    assert np.isnan(Forward([one, one])(np.full((1, 1), np.nan, np.float32)))


def test_changed_weights_are_packed_on_request() -> None:
    layers = drawn(4, 6, 2)
    network, inputs = Forward(layers), np.ones((3, 4), np.float32)
    before = network(inputs)
    layers[0][0][:] *= 2.0
    np.testing.assert_array_equal(network(inputs), before)
    network.pack()
    np.testing.assert_array_equal(network(inputs), reference(layers, inputs))


def test_wrong_shapes_are_named() -> None:
    network = Forward(drawn(4, 6, 2))
    with pytest.raises(ValueError, match="inputs: wrong shape"):
        network(np.ones((3, 5), np.float32))
    with pytest.raises(ValueError, match="outputs: wrong shape"):
        network(np.ones((3, 4), np.float32), out=np.ones((2, 2), np.float32))
    with pytest.raises(ValueError, match="added: wrong shape"):
        network(np.ones((3, 4), np.float32), added=np.ones((3, 1), np.float32))
    with pytest.raises(ValueError, match="widths do not match"):
        Forward([*drawn(4, 6), *drawn(5, 2)])
