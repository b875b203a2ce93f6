"""Wake-up messages never block their sender."""

from __future__ import annotations

import socket
import time

from naojobs.notifications import Notifier, make_celery


def test_a_broker_that_is_down_is_given_up_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    notifier = Notifier(make_celery(f"redis://127.0.0.1:{port}/0"))
    started = time.monotonic()
    assert "refused" in (notifier.wake_up("job_x", "embedded") or "")
    assert not notifier.reachable()
    assert time.monotonic() - started < 3
    notifier.close()
