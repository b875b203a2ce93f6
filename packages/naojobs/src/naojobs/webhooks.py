"""Webhooks: their registration, and the outbox of messages to them.

A message is written in the transaction of the change that it reports, one row for each webhook that wants it. A
sender schedules the next attempt before it sends (`take_due`) and records the result afterwards (`settle`): if it
dies in between, the message is sent again. So each message is delivered at least once. Owners take turns, and so do
the webhooks of one owner; after a failure nothing is sent to the webhook for a while, then one message. Times come
from the database's clock.
"""

from __future__ import annotations

import base64
import json
import secrets
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Any
from urllib.parse import urlsplit

from sqlalchemy import case, delete, func, literal, or_, select, true, tuple_, update
from sqlalchemy.orm import Session

from naojobs import tokens
from naojobs.database import Sessions, is_due
from naojobs.errors import NotFoundError
from naojobs.ids import new_id
from naojobs.models import Delivery, Token, Webhook
from naojobs.quotas import NO_LIMITS, Limits, Quota, require_room

FIRST_DELAY_S, LONGEST_DELAY_S = 5.0, 3600.0
"""Seconds until the second attempt, doubled with each further one up to the longest."""
GIVE_UP_AFTER, LEAST_ATTEMPTS = timedelta(days=3), 5
"""Age and number of attempts at which a message that could not be delivered is given up: the service may have been off
for some of the time.
"""
KEEP = timedelta(days=14)
"""Age at which messages are deleted that are delivered or given up."""
TAKEN_S = 60.0
"""Seconds for which a sender has a message to itself; an attempt has to take less."""
MOST_SENDING, MOST_OF_OWNER, MOST_TO_WEBHOOK = 64, 16, 8
"""Messages that one process sends at a time: in all, of one owner and to one webhook."""
MOST_ALERTS, MOST_ALERTS_OF_OWNER = 8, 2
"""Alerts that one sender sends at a time besides, in all and of one owner; each alert takes a process of its own."""
MOST_KEPT = 10_000
"""Messages that `forget` keeps for one webhook; older ones are deleted, delivered or not."""


class MessageType(StrEnum):
    """Type of a message."""

    JOB_ENDED = "job.ended"
    """A job has succeeded, failed or been cancelled."""
    JOB_STALLED = "job.stalled"
    """A running job has made no step for a while."""
    EVALUATION_FINISHED = "evaluation.finished"
    """An evaluation has succeeded, failed or been cancelled."""
    MATCH_ENDED = "match.ended"
    """A match has succeeded, failed or been cancelled."""
    STUDY_FINISHED = "study.finished"
    """A study has finished, failed or been cancelled."""


@dataclass(frozen=True, slots=True)
class Message:
    """Attempt to deliver a message."""

    id: str
    attempt: int
    """Number of this attempt, from 1."""
    owner: str
    webhook_id: str
    url: str
    secret: str
    body: str
    """JSON, the same in every attempt."""
    taken_at: datetime
    """When the attempt began."""


def is_alert(url: str) -> bool:
    """Return whether a webhook's address is one of an alert rather than one that gets signed messages."""
    return urlsplit(url).scheme not in ("http", "https")


def check_room(sessions: Sessions, owner: str, limits: Limits) -> None:
    """Raise QuotaError if `owner` has as many webhooks as `limits` allow."""
    with sessions.begin() as session:
        require_room(session, owner, limits, Quota.WEBHOOKS)


def create_webhook(
    sessions: Sessions,
    *,
    owner: str,
    url: str,
    events: Iterable[MessageType],
    token_id: str | None = None,
    signed: bool = True,
    limits: Limits = NO_LIMITS,
) -> Webhook:
    """Register a webhook and return it, with a new secret if its messages are `signed`, or an empty one.

    One made with the token `token_id` ends with it. Raises ConflictError if that token is not valid any more, and
    QuotaError if `owner` has as many webhooks as `limits` allow.
    """
    secret = "whsec_" + base64.b64encode(secrets.token_bytes(32)).decode() if signed else ""
    webhook = Webhook(
        id=new_id("hook"),
        owner=owner,
        token_id=token_id,
        url=url,
        events=sorted({str(event) for event in events}),
        secret=secret,
    )
    with sessions.begin() as session:
        if token_id is not None:
            tokens.hold(session, token_id)
        require_room(session, owner, limits, Quota.WEBHOOKS)
        session.add(webhook)
        session.flush()
        session.refresh(webhook)
    return webhook


def get_webhook(sessions: Sessions, webhook_id: str) -> Webhook:
    """Return a webhook. Raises NotFoundError."""
    with sessions.begin() as session:
        webhook = session.get(Webhook, webhook_id)
    if webhook is None:
        raise NotFoundError(f"no webhook {webhook_id}")
    return webhook


def list_webhooks(
    sessions: Sessions, owner: str | None = None, *, limit: int, after: str | None = None
) -> list[Webhook]:
    """Return up to `limit` webhooks, or those of an owner, after the webhook `after` if it is given, oldest first."""
    wanted = [] if owner is None else [Webhook.owner == owner]
    if after is not None:
        wanted.append(Webhook.id > after)
    with sessions.begin() as session:
        return list(session.scalars(select(Webhook).where(*wanted).order_by(Webhook.id).limit(limit)))


def delete_webhook(sessions: Sessions, webhook_id: str) -> None:
    """Delete a webhook with its messages. Raises NotFoundError."""
    with sessions.begin() as session:
        if session.scalar(delete(Webhook).where(Webhook.id == webhook_id).returning(Webhook.id)) is None:
            raise NotFoundError(f"no webhook {webhook_id}")


def list_deliveries(sessions: Sessions, webhook_id: str, *, limit: int, before: str | None = None) -> list[Delivery]:
    """Return the messages to a webhook, newest first, only those older than message `before` if it is given."""
    wanted = [Delivery.webhook_id == webhook_id, *([] if before is None else [Delivery.id < before])]
    with sessions.begin() as session:
        return list(session.scalars(select(Delivery).where(*wanted).order_by(Delivery.id.desc()).limit(limit)))


# --- outbox -----------------------------------------------------------------------------------------------------------


def publish(session: Session, owner: str, kind: MessageType, data: Mapping[str, Any]) -> None:
    """Write a message to each webhook of `owner` that wants this type, within the caller's transaction."""
    wanted = (Webhook.owner == owner, Webhook.events.contains([str(kind)]), Webhook.disabled_at.is_(None))
    # The lock keeps a webhook from being deleted until the message is committed: the change itself must not fail.
    locked = select(Webhook.id).where(*wanted).order_by(Webhook.id).with_for_update(key_share=True, read=True)
    session.add_all(
        Delivery(id=new_id("msg"), webhook_id=webhook_id, type=str(kind), data=dict(data))
        for webhook_id in session.scalars(locked)
    )


def take_due(sessions: Sessions, sending: Collection[Message] = ()) -> list[Message]:
    """Return messages whose next attempt is due, for the caller to send beside those that it is `sending`.

    Together they are at most `MOST_SENDING` and `MOST_ALERTS`, of each owner and to each webhook no more than one
    process sends at a time, and one to a webhook whose last attempt failed. Several processes may call it at once: each
    gets other messages. Webhooks whose tokens were revoked or have expired are disabled first.
    """
    due = is_due(Delivery.next_at, LONGEST_DELAY_S)
    open_ = or_(Webhook.not_before.is_(None), is_due(Webhook.not_before, LONGEST_DELAY_S))
    alert = func.lower(Webhook.url).regexp_match("^https?:").is_(False)
    turn = func.row_number().over(partition_by=Delivery.webhook_id, order_by=(Delivery.next_at, Delivery.id))
    of_webhook = (
        select(
            Delivery.id,
            Delivery.next_at,
            alert.label("alert"),
            func.concat(alert, Webhook.owner).label("lane"),  # an owner's alerts, or what else is sent to it
            (turn + _count(Webhook.id, [message.webhook_id for message in sending])).label("turn"),
            case((Webhook.failures > 0, 1), else_=MOST_TO_WEBHOOK).label("most"),
        )
        .join(Webhook)
        .where(due, open_, Delivery.id.not_in([message.id for message in sending]))
        .subquery()
    )
    columns = of_webhook.c
    under_way = [(is_alert(message.url), message.owner) for message in sending]
    lanes = [f"{'t' if alert else 'f'}{owner}" for alert, owner in under_way]
    turn = func.row_number().over(partition_by=columns.lane, order_by=(columns.turn, columns.next_at))
    of_owner = (
        select(columns.id, columns.next_at, columns.alert, (turn + _count(columns.lane, lanes)).label("turn"))
        .where(columns.turn <= columns.most)
        .subquery()
    )
    columns = of_owner.c
    place = func.row_number().over(partition_by=columns.alert, order_by=(columns.turn, columns.next_at))
    alerts = sum(alert for alert, _ in under_way)
    in_all = (
        select(
            columns.id,
            (place + case((columns.alert, alerts), else_=len(sending) - alerts)).label("place"),
            case((columns.alert, MOST_ALERTS), else_=MOST_SENDING).label("most"),
        )
        .where(columns.turn <= case((columns.alert, MOST_ALERTS_OF_OWNER), else_=MOST_OF_OWNER))
        .subquery()
    )
    first = select(in_all.c.id).where(in_all.c.place <= in_all.c.most)
    ended = select(Webhook.id).join(Token).where(Webhook.disabled_at.is_(None), ~Token.is_valid()).order_by(Webhook.id)
    with sessions.begin() as session:
        for webhook_id in session.scalars(ended).all():
            _disable(session, webhook_id, "the token that made the webhook was revoked or has expired")
        rows = session.execute(
            select(Delivery, Webhook, func.now())
            .join(Webhook)
            .where(Delivery.id.in_(first), due)
            .with_for_update(of=Delivery, skip_locked=True)
        ).all()
        messages = []
        for delivery, webhook, now in rows:
            delivery.attempts += 1
            delivery.next_at = func.now() + timedelta(seconds=TAKEN_S)
            body = {
                "type": delivery.type,
                "timestamp": delivery.created_at.astimezone(UTC).isoformat().replace("+00:00", "Z"),
                "data": delivery.data,
            }
            messages.append(
                Message(
                    delivery.id,
                    delivery.attempts,
                    webhook.owner,
                    webhook.id,
                    webhook.url,
                    webhook.secret,
                    json.dumps(body),
                    now,
                )
            )
    return messages


def _count(column: Any, values: Collection[str]) -> Any:
    """Return how often the value of `column` is among `values`."""
    return case(dict(Counter(values)), value=column, else_=0) if values else literal(0)


def settle(sessions: Sessions, message: Message, error: str | None, *, gone: bool = False) -> None:
    """Record the result of an attempt: delivered, or why not and when the next one is due.

    After a failure, all messages to the webhook wait, longer with each that follows; messages that were on their way
    at the same time count as one. With `gone` the receiver wants no more messages: its webhook is disabled. An attempt
    that lasted so long that another one has begun changes nothing.
    """
    same = (Delivery.id == message.id, Delivery.attempts == message.attempt)
    delay_s = min(FIRST_DELAY_S * 2 ** min(message.attempt - 1, 30), LONGEST_DELAY_S)
    webhook = Webhook.id == message.webhook_id
    age = func.now() - Delivery.created_at
    early = or_(age < GIVE_UP_AFTER, Delivery.attempts < LEAST_ATTEMPTS)
    retry = case((early, func.now() + timedelta(seconds=delay_s)))
    with sessions.begin() as session:
        if gone:
            _disable(session, message.webhook_id, error)
        elif error is None:
            backoff = update(Webhook).where(webhook, Webhook.failures > 0).values(failures=0, not_before=None)
            session.execute(backoff)
        else:
            pause_s = func.least(FIRST_DELAY_S * func.power(2, func.least(Webhook.failures, 30)), LONGEST_DELAY_S)
            backoff = update(Webhook).values(
                failures=Webhook.failures + 1, not_before=func.now() + pause_s * timedelta(seconds=1)
            )
            open_ = or_(Webhook.not_before.is_(None), is_due(Webhook.not_before, LONGEST_DELAY_S))
            session.execute(backoff.where(webhook, open_).execution_options(synchronize_session=False))
        values = {
            "error": error,
            "delivered_at": func.now() if error is None else None,
            "next_at": None if error is None or gone else retry,
        }
        session.execute(update(Delivery).where(*same).values(values).execution_options(synchronize_session=False))


def _disable(session: Session, webhook_id: str, why: str | None) -> None:
    """Disable a webhook and give up its messages."""
    # The webhook's lock comes before those of several messages: two attempts may end in this way at once.
    webhook = session.scalar(select(Webhook).where(Webhook.id == webhook_id).with_for_update(key_share=True))
    if webhook is None or webhook.disabled_at is not None:
        return
    webhook.disabled_at = func.now()
    waiting = (Delivery.webhook_id == webhook_id, Delivery.next_at.is_not(None))
    session.execute(update(Delivery).where(*waiting).values(next_at=None, error=why))


def forget(sessions: Sessions) -> int:
    """Delete old messages that are delivered or given up, and those beyond the newest `MOST_KEPT`; return how many."""
    old = (Delivery.next_at.is_(None), Delivery.created_at < func.now() - KEEP)
    age = (Delivery.created_at, Delivery.id)  # ids alone follow the clocks of hosts
    of_webhook = select(*age).where(Delivery.webhook_id == Webhook.id).order_by(*(column.desc() for column in age))
    last = of_webhook.offset(MOST_KEPT).limit(1).correlate(Webhook).lateral("last")
    full = select(Webhook.id.label("webhook"), *last.c).join(last, true()).subquery()
    extra = (Delivery.webhook_id == full.c.webhook, tuple_(*age) <= tuple_(full.c.created_at, full.c.id))
    with sessions.begin() as session:
        return sum(
            len(session.scalars(delete(Delivery).where(*which).returning(Delivery.id)).all()) for which in (old, extra)
        )
