"""Webhooks: register, list, delete, look up deliveries."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Path
from naojobs import webhooks
from naojobs.errors import InvalidError, NotFoundError
from naojobs.ids import PATTERN
from naojobs.models import Webhook
from naojobs.tokens import Principal
from pydantic import HttpUrl

from naosprint_api import alerts
from naosprint_api.dependencies import CountedRoute, Cursor, PageLimit, ServiceDep, Submitter
from naosprint_api.outbound import Network, is_refused_literal
from naosprint_api.problems import ProblemError, responses
from naosprint_api.schemas.webhooks import (
    DeliveryPage,
    DeliveryPublic,
    WebhookCreate,
    WebhookMade,
    WebhookPage,
    WebhookPublic,
)
from naosprint_api.service import Service

router = APIRouter(tags=["webhooks"], route_class=CountedRoute)

_log = logging.getLogger(__name__)

WebhookId = Annotated[str, Path(pattern=PATTERN, description="Id of the webhook.")]


def _visible(service: Service, principal: Principal, webhook_id: str) -> Webhook:
    webhook = webhooks.get_webhook(service.reads, webhook_id)
    if not principal.is_admin and webhook.owner != principal.owner:
        raise NotFoundError(f"no webhook {webhook_id}")
    return webhook


def _refusal(url: str, networks: Sequence[Network]) -> str | None:
    """Return why nothing may be sent to an address, or none."""
    if not webhooks.is_alert(url):
        return alerts.NOT_PUBLIC if is_refused_literal(str(HttpUrl(url).host), networks) else None
    try:
        alerts.check_hosts(url, networks)
    except ValueError as error:
        return str(error)
    try:
        return alerts.try_address(url)
    except alerts.BusyError as busy:
        raise ProblemError(429, str(busy), headers={"Retry-After": "3"}) from None


@router.post("/webhooks", status_code=201, responses=responses(401, 403, 413, 422, 429, 503))
def make_webhook(body: WebhookCreate, principal: Submitter, service: ServiceDep) -> WebhookMade:
    """Register an address that receives messages about one's own jobs, evaluations, matches and studies.

    An address of http or https gets signed JSON; the secret that verifies the signatures is only in this answer. Any
    other one gets alerts, text for people; no answer shows it again. A webhook ends with the token that made it.
    """
    settings = service.settings
    is_alert = webhooks.is_alert(body.url)
    webhooks.check_room(service.sessions, principal.owner, settings.limits)  # before a process is started for it
    if (refused := _refusal(body.url, settings.api_webhook_networks)) is not None:
        raise InvalidError(refused, "url")
    webhook = webhooks.create_webhook(
        service.sessions,
        owner=principal.owner,
        token_id=principal.token_id,
        url=body.url,
        signed=not is_alert,
        events=body.events,
        limits=settings.limits,
    )
    _log.info("%s (%s) made webhook %s", principal.owner, principal.token_id, webhook.id)
    return WebhookMade.model_validate(webhook)


@router.get("/webhooks", responses=responses(401, 403, 422, 429, 503))
def show_webhooks(
    principal: Submitter, service: ServiceDep, limit: PageLimit = 50, cursor: Cursor = None
) -> WebhookPage:
    """List one's own webhooks, or all with scope admin, oldest first, without their secrets."""
    owner = None if principal.is_admin else principal.owner
    rows = webhooks.list_webhooks(service.reads, owner, limit=limit + 1, after=cursor)
    return WebhookPage.of([WebhookPublic.model_validate(webhook) for webhook in rows], limit)


@router.get("/webhooks/{webhook_id}/deliveries", responses=responses(401, 403, 404, 422, 429, 503))
def show_deliveries(
    webhook_id: WebhookId,
    principal: Submitter,
    service: ServiceDep,
    limit: PageLimit = 50,
    cursor: Cursor = None,
) -> DeliveryPage:
    """List the messages to a webhook, newest first, with the error of the last attempt."""
    _visible(service, principal, webhook_id)
    rows = webhooks.list_deliveries(service.reads, webhook_id, limit=limit + 1, before=cursor)
    return DeliveryPage.of([DeliveryPublic.model_validate(delivery) for delivery in rows], limit)


@router.delete("/webhooks/{webhook_id}", status_code=204, responses=responses(401, 403, 404, 422, 429, 503))
def delete_webhook(webhook_id: WebhookId, principal: Submitter, service: ServiceDep) -> None:
    """Delete a webhook and its messages, also those that are not delivered yet."""
    _visible(service, principal, webhook_id)
    webhooks.delete_webhook(service.sessions, webhook_id)
    _log.info("%s (%s) deleted webhook %s", principal.owner, principal.token_id, webhook_id)
