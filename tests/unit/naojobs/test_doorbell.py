"""What sender and receiver of a message agree on."""

from __future__ import annotations

import socket
import time

from naojobs.doorbell import Doorbell, make_celery


def test_a_message_is_never_delivered_while_its_job_may_live() -> None:
    options = make_celery("redis://h").conf.broker_transport_options
    assert options["visibility_timeout"] > 86_400


def test_a_broker_that_is_down_is_given_up_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    doorbell = Doorbell(make_celery(f"redis://127.0.0.1:{port}/0"))
    started = time.monotonic()
    assert "refused" in (doorbell.ring_job("job_x", "embedded") or "")
    assert "refused" in (doorbell.ring_evaluation("eval_x", "embedded") or "")
    assert not doorbell.reachable()
    assert time.monotonic() - started < 3
    doorbell.close()
