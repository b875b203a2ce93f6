"""Webhooks and their deliveries."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from naojobs.webhooks import MessageType, is_alert
from pydantic import AfterValidator, Field, HttpUrl, StringConstraints, ValidationError

from naosprint_api import alerts
from naosprint_api.schemas.common import Page, RequestBody, RowView


def _address(text: str) -> str:
    if is_alert(text):
        alerts.check_address(text)
        return text
    try:
        url = HttpUrl(text)
    except ValidationError as error:
        raise ValueError(error.errors()[0]["msg"]) from None
    if url.username or url.password:
        raise ValueError("expected an address without user and password; the signature identifies the sender")
    return str(url)


class WebhookCreate(RequestBody):
    """Webhook to register."""

    url: Annotated[str, StringConstraints(min_length=1, max_length=2083), AfterValidator(_address)] = Field(
        description="Where messages are sent: by POST to http or https, without redirects; or as text for people "
        "through a service, at an address of apprise such as mailtos://, slack://, discord://, tgram:// or ntfys://.",
        json_schema_extra={"format": "uri"},
    )
    events: list[MessageType] = Field(
        default_factory=lambda: list(MessageType),
        min_length=1,
        max_length=len(MessageType),
        description="Types of messages to receive; left out: all.",
    )


class WebhookPublic(RowView):
    """Webhook without its secret."""

    id: str
    owner: str
    url: Annotated[str, AfterValidator(alerts.shown_address)] = Field(
        description="Its address; of one that gets alerts only the service and host, since the rest is secret."
    )
    events: list[MessageType]
    disabled_at: datetime | None = Field(
        description="When its receiver answered 410 Gone, or the token that made it was found revoked or expired; "
        "nothing is sent after it. Null if neither."
    )
    created_at: datetime


class WebhookPage(Page[WebhookPublic]):
    """Page of webhooks, oldest first."""


class WebhookMade(WebhookPublic):
    """New webhook with its secret."""

    secret: str = Field(
        description="Key of the Standard Webhooks signatures. It is shown only here. Empty for alerts: they have none."
    )


class DeliveryPublic(RowView):
    """Message to a webhook."""

    id: str = Field(description="The header webhook-id, the same in every attempt.")
    type: MessageType
    data: dict[str, Any]
    attempts: int
    next_at: datetime | None = Field(description="When the next attempt is due; null once it is delivered or given up.")
    delivered_at: datetime | None
    error: str | None = Field(description="Why the last attempt failed; null if it did not.")
    created_at: datetime


class DeliveryPage(Page[DeliveryPublic]):
    """Page of messages to a webhook, newest first."""
