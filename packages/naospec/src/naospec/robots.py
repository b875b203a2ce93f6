"""The few robot facts that a specification is checked against."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

STANDING_HEIGHT_M: Mapping[int, float] = MappingProxyType(
    {0: 0.385, 1: 0.42164, 2: 0.385, 3: 0.440736848, 4: 0.385},
)
"""Torso height above the soles with all joints at zero, metres, by robot type.

Type 0: foot centre 0.375 m below the torso plus half a foot, 0.01 m. Types 1 and 3 lengthen thigh and shank.
"""
