"""Delivery of messages to webhooks: signed JSON by POST, or an alert for people."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import TypeVar

import anyio
from naojobs import tokens, webhooks
from naojobs.database import Sessions
from naojobs.webhooks import Message
from sqlalchemy.exc import SQLAlchemyError
from standardwebhooks import Webhook as Signer

from naosprint_api import __version__, alerts
from naosprint_api.outbound import Network, RefusedAddressError, Sender

DEADLINE_S = 10.0
"""Seconds that one attempt may take."""
FORGET_S = 300.0
"""Seconds between two deletions of old messages."""
THREADS = 2
"""Threads for the database, so that deliveries do not delay requests."""

Result = TypeVar("Result")

_log = logging.getLogger(__name__)


class Deliverer:
    """Sender of due messages; any number of processes may have one."""

    def __init__(self, sessions: Sessions, *, networks: Sequence[Network], poll_s: float) -> None:
        """Look for due messages every `poll_s` seconds; `networks` of private addresses are allowed."""
        self._sessions = sessions
        self._networks = networks
        self._sender = Sender(networks, deadline_s=DEADLINE_S, lookups=webhooks.MOST_OF_OWNER)
        self._poll_s = poll_s
        self._limiter = anyio.CapacityLimiter(THREADS)
        self._alert_limiter = anyio.CapacityLimiter(webhooks.MOST_ALERTS)
        self._task: asyncio.Task[None] | None = None
        self._sending: dict[asyncio.Task[None], Message] = {}

    def start(self) -> None:
        """Start to deliver."""
        self._task = asyncio.create_task(self._run(), name="deliveries")

    async def stop(self) -> None:
        """Stop; messages that are being sent are sent again later."""
        for task in (*([] if self._task is None else [self._task]), *self._sending):
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def send_due(self) -> int:
        """Begin to send due messages beside those on their way and return their number."""
        if len(self._sending) >= webhooks.MOST_SENDING + webhooks.MOST_ALERTS:
            return 0
        sending = tuple(self._sending.values())
        messages = await self._in_thread(partial(webhooks.take_due, self._sessions, sending))
        for message in messages:
            task = asyncio.create_task(self._attempt(message))
            self._sending[task] = message
            task.add_done_callback(self._sending.pop)
        return len(messages)

    async def wait(self, seconds: float | None = None) -> None:
        """Wait until a message has been sent or has failed, at most `seconds`."""
        if self._sending:
            await asyncio.wait(self._sending, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        elif seconds is not None:
            await asyncio.sleep(seconds)

    @property
    def idle(self) -> bool:
        """Whether no message is on its way."""
        return not self._sending

    async def _run(self) -> None:
        forgotten_at = time.monotonic()
        while True:
            try:
                await self.send_due()
                if time.monotonic() - forgotten_at > FORGET_S:
                    forgotten_at = time.monotonic()
                    await self._in_thread(partial(webhooks.forget, self._sessions))
                    await self._in_thread(partial(tokens.forget, self._sessions))
            except SQLAlchemyError as error:
                _log.warning("messages to webhooks wait for the database: %s", error)
            except Exception:
                _log.exception("delivering messages to webhooks failed")
            await self.wait(self._poll_s)

    async def _attempt(self, message: Message) -> None:
        """Send a message and record the result; if that fails, it is sent again once its time is over."""
        try:
            await self._send(message)
        except SQLAlchemyError as error:
            _log.warning("the result of message %s is lost: %s", message.id, error)
        except Exception:
            _log.exception("sending message %s failed", message.id)

    async def _send(self, message: Message) -> None:
        status, error = None, None
        try:
            if webhooks.is_alert(message.url):
                error = await self._alert(message)
            else:
                status = await self._post(message)
        except TimeoutError:
            error = f"no answer within {DEADLINE_S:g} s"
        except RefusedAddressError as refused:
            error = str(refused)
        except Exception as failure:  # of the connection, TLS or the protocol
            error = f"{type(failure).__name__}: {failure}"[:500]
        if status is not None and not 200 <= status < 300:
            hint = "; redirects are not followed" if 300 <= status < 400 else ""
            error = f"the receiver answered {status}{hint}"
        if error is not None:
            _log.info(
                "message %s to webhook %s, attempt %d: %s", message.id, message.webhook_id, message.attempt, error
            )
        gone = status == HTTPStatus.GONE
        await self._in_thread(partial(webhooks.settle, self._sessions, message, error, gone=gone))

    async def _alert(self, message: Message) -> str | None:
        call = partial(alerts.send, message.url, message.body, self._networks)
        return await anyio.to_thread.run_sync(call, limiter=self._alert_limiter)

    async def _post(self, message: Message) -> int:
        headers = {
            "Content-Type": "application/json",
            "User-Agent": f"naosprint/{__version__}",
            "webhook-id": message.id,
            "webhook-timestamp": str(int(message.taken_at.timestamp())),
            "webhook-signature": Signer(message.secret).sign(message.id, message.taken_at, message.body),
        }
        return await self._sender.post(message.owner, message.url, headers, message.body.encode())

    async def _in_thread(self, call: Callable[[], Result]) -> Result:
        return await anyio.to_thread.run_sync(call, limiter=self._limiter)
