"""What the bodies of several subjects share: names, pages, files."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

from naospec import formats
from pydantic import AfterValidator, AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from naosprint_api.patterns import ID, TAG

Tag = Annotated[str, StringConstraints(pattern=TAG)]


def _current(spec: dict[str, Any]) -> dict[str, Any]:
    """Return a stored training specification as this version accepts it; one that it cannot read stays as it is."""
    try:
        return formats.current(formats.Kind.TRAINING, spec)
    except formats.FormatError:
        return spec


TrainingDocument = Annotated[dict[str, Any], BeforeValidator(_current)]

Id = Annotated[str, StringConstraints(pattern=ID)]


def _in_utc(moment: datetime) -> datetime:
    if not EARLIEST <= moment < LATEST:
        raise ValueError(f"expected a time from the year {EARLIEST.year} to the year {LATEST.year - 1}")
    return moment.astimezone(UTC)


EARLIEST, LATEST = datetime(2000, 1, 1, tzinfo=UTC), datetime(9000, 1, 1, tzinfo=UTC)
"""Bounds of the times that clients give: all within them exist in every time zone and in the database."""
Moment = Annotated[AwareDatetime, AfterValidator(_in_utc)]
"""Time with its zone."""


EvaluationState = Literal["queued", "starting", "running", "succeeded", "failed", "cancelled"]


class RequestBody(BaseModel):
    """Base of what clients send: a field that it does not have is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RowView(BaseModel):
    """Base of what is made from the attributes of a database row."""

    model_config = ConfigDict(from_attributes=True)


class WorkCreate(RequestBody):
    """What all work is submitted with; an `Idempotency-Key` is a header."""

    tags: list[Tag] = Field(
        default_factory=list,
        max_length=20,
        description="Tags: letters, digits and ._:/=- (at most 50 characters each).",
    )
    priority: int = Field(5, ge=0, le=9, description="0 to 9; work with a higher priority starts first.")
    not_before: Moment | None = Field(
        None, description="Earliest start, with its time zone; left out: as soon as a worker is free."
    )
    max_attempts: int = Field(3, ge=1, le=10, description="Attempts that may be lost before it fails.")


Item = TypeVar("Item", bound=BaseModel)


class Page(BaseModel, Generic[Item]):
    """Part of a list."""

    items: list[Item]
    next_cursor: str | None = Field(description="Give it as `cursor` to get the next page; null on the last.")

    @classmethod
    def of(cls, items: list[Item], limit: int) -> Self:
        """Return the first `limit` items; one more says that there is a next page, which the last one's id finds."""
        last: Any = items[limit - 1] if len(items) > limit else None
        return cls(items=items[:limit], next_cursor=last and last.id)


class FilePublic(BaseModel):
    """File of an artifact."""

    name: str
    size: int = Field(description="Bytes.")
    sha256: str
    url: str = Field(description="Where to download it, below the API's root.")
