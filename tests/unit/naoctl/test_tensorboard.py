"""`naoctl tensorboard` writes event files that TensorBoard reads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from naoctl.client import Client
from naoctl.commands.tensorboard import write_events

pytest.importorskip("tensorboard")


def test_metrics_become_an_event_file(
    server: Any,
    client: Client,
    job: Callable[..., dict[str, Any]],
    event: Callable[..., str],
    tmp_path: Path,
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    running = job()

    def stream(request: Any) -> None:
        rows = [(100, 1, 1.0), (200, 1, 2.0), (300, 1, 9.0), (200, 2, 2.5), (300, 2, 3.0)]
        messages = [
            event("metrics", {"step": step, "attempt": attempt, "time_s": step / 100, "reward": reward}, "1")
            for step, attempt, reward in rows
        ]
        request.stream(*messages, event("state", job(state="succeeded"), "2"))

    server.on("GET", f"/jobs/{running['id']}/stream")(stream)
    write_events(client, running, tmp_path)
    found = EventAccumulator(str(tmp_path)).Reload()
    assert found.Tags()["scalars"] == ["time_s", "reward"]
    points = [(point.step, point.value) for point in found.Scalars("reward")]
    assert points == [(100, 1.0), (200, 2.5), (300, 3.0)], "a later attempt replaces the steps after its checkpoint"
    assert found.Scalars("reward")[0].wall_time == pytest.approx(1767323046 + 1)
