"""The Python of docs/how-to/client.md in its order, against a real API, with a worker that records metrics."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from naojobs import outcomes
from naojobs.models import Job
from naojobs.states import WorkState
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.attempts import claim_work
from tests.integration.conftest import RunningApi
from tests.integration.writes import append_metrics

PAGE = Path(__file__).parents[3] / "docs/how-to/client.md"


def test_a_notebook_submits_follows_and_compares(
    api: RunningApi,
    make_token: Any,
    sessions: sessionmaker[Session],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("NAOCTL_URL", api.url)
    monkeypatch.setenv("NAOCTL_TOKEN", make_token("alice", "submit"))
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    submit, follow, curves, table, control = blocks
    names: dict[str, Any] = {}
    exec(submit, names)
    claim = claim_work(sessions, Job, names["job"]["id"], "worker-1")
    assert claim is not None
    outcomes.begin(sessions, claim.lease, step=0)
    outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
    append_metrics(sessions, claim.lease, [{"step": 8192, "reward": 1.5}, {"step": 16384, "reward": 2.5}])
    outcomes.transition(sessions, claim.lease, WorkState.FAILED, error="the end of the test")
    exec(follow, names)
    assert capsys.readouterr().out == "8192 1.5\n16384 2.5\n"
    exec(curves, names)
    assert names["curve"] == {8192: 1.5, 16384: 2.5}
    exec(table, names)
    (row,) = names["table"]
    assert (row["name"], row["state"], row["algorithm.learning_rate"]) == ("notebook", "failed", 0.0005)
    exec(control, names)
    assert names["client"].get(f"/jobs/{names['job']['id']}")["notes"] == "The first from a notebook."
    assert names["client"].get(f"/jobs/{names['other']['id']}")["state"] == "cancelled"
    names["client"]._http.close()
