"""Fields of settings: weights, fractions, and the ends of ranges, from which numbers are drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

from naospec import TaskSettings
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from naosprint.terms import Number

if TYPE_CHECKING:
    from naosprint.arrays import FloatArray

Share = TypeVar("Share", "FloatArray", Number)

Ranges = tuple[tuple[str, str], ...]
"""Lower and upper end of each of some ranges."""


def weight(default: float, title: str, description: str, **extra: Any) -> Any:
    """Return the field of a weight of the reward; ``extra`` goes to the schema."""
    return Field(
        default=default, ge=0.0, le=1000.0, title=title, description=description, json_schema_extra=extra or None
    )


def fraction(default: float, title: str, description: str, **extra: Any) -> Any:
    """Return the field of a part of a whole, from 0 to 1; ``extra`` goes to the schema."""
    return Field(default=default, ge=0.0, le=1.0, title=title, description=description, json_schema_extra=extra or None)


class RangeSettings(TaskSettings):
    """Settings of which some are the ends of a range."""

    ranges: ClassVar[Ranges] = ()
    """Settings that are the ends of ranges, which a class adds to those of its bases."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for low, high in (names for each in type(self).__mro__ for names in vars(each).get("ranges", ())):
            least, most = getattr(self, low), getattr(self, high)
            if most is not None and least > most:
                raise PydanticCustomError(
                    "range",
                    "{low}: {least} is above {high}, {most}; exchange them",
                    {"low": low, "least": least, "high": high, "most": most},
                )
        return self


def between(low: float | Share, high: float, share: Share) -> Share:
    """Return numbers from ``low`` to ``high`` by (k,) shares of the way, from 0 to 1."""
    return low + (high - low) * share
