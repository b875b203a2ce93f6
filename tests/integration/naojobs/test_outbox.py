"""Messages to webhooks are kept by when they were written, whatever the clocks of hosts show."""

from __future__ import annotations

import pytest
from naojobs import webhooks
from naojobs.database import Sessions
from naojobs.ids import new_id
from naojobs.models import Delivery
from naojobs.webhooks import MessageType
from sqlalchemy import select


def test_a_host_whose_clock_is_set_forward_drops_no_newer_message(
    sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ids may be those of a later time: these messages stayed the newest, and no later one was ever sent."""
    monkeypatch.setattr(webhooks, "MOST_KEPT", 3)
    webhooks.create_webhook(sessions, owner="alice", url="https://example.com", events=[MessageType.JOB_ENDED])
    for century, numbers in (("1", range(3)), ("0", range(3, 6))):
        with monkeypatch.context() as host:
            host.setattr(webhooks, "new_id", lambda kind, century=century: new_id(kind).replace("_0", f"_{century}"))
            for number in numbers:
                with sessions.begin() as session:
                    webhooks.publish(session, "alice", MessageType.JOB_ENDED, {"number": number})
    assert webhooks.forget(sessions) == 3
    with sessions() as session:
        assert sorted(data["number"] for data in session.scalars(select(Delivery.data))) == [3, 4, 5]
