"""Left-right symmetry of vectors of named numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from naosprint.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Mirror:
    """Exchange of left and right in a vector: ``mirrored = sign * vector[..., index]``.

    Attributes:
        index: (D,) position that each number comes from.
        sign: (D,) 1 or -1.
    """

    index: IntArray
    sign: FloatArray

    @classmethod
    def of_names(cls, names: Sequence[str], partners: Sequence[str], signs: Sequence[float]) -> Mirror:
        """Build a mirror from each number's name, the name of its mirror image, and the sign that it gets.

        Raises:
            ValueError: if a partner is not among the names.
        """
        position = {name: i for i, name in enumerate(names)}
        for name, partner in zip(names, partners, strict=True):
            if partner not in position:
                raise ValueError(f"{name}: its mirror image {partner} is not among the {len(names)} names")
        return cls(
            np.array([position[partner] for partner in partners], dtype=np.int64), np.array(signs, dtype=np.float64)
        )

    @classmethod
    def of_pairs(cls, width: int) -> Mirror:
        """Build the mirror of a hidden layer: unit i of the first half and of the second are a pair.

        Raises:
            ValueError: if the width is odd.
        """
        if width % 2:
            raise ValueError(f"hidden_sizes: a symmetric policy needs layers of even width, got {width}")
        return cls(np.roll(np.arange(width), width // 2), np.ones(width))

    def apply(self, vectors: FloatArray) -> FloatArray:
        """Return the mirror image of (..., D) numbers."""
        return np.asarray(vectors[..., self.index] * self.sign)
