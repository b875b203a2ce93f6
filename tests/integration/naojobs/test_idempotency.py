"""A key makes one thing, also when a request is sent again while the first one is processed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from naojobs import matches, outcomes, policies, studies, submission
from naojobs.database import Sessions
from naojobs.errors import ConflictError, QuotaError
from naojobs.matches import MatchRequest
from naojobs.models import Job
from naojobs.policies import Registration
from naojobs.quotas import Quota
from naojobs.states import WorkState
from naojobs.studies import StudyRequest
from naojobs.submission import EvaluationRequest, JobRequest
from naospec.search import SearchSpec

from tests.integration.attempts import claim_work
from tests.integration.writes import record_checkpoint

CALLERS = 6
SEARCH = {"space": {"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-3}}}

Send = Callable[[str | None, str], tuple[Any, bool]]
"""Send a request with a key and with a text in it; return what it made and whether that is new."""


@pytest.fixture
def send(sessions: Sessions, request: pytest.FixtureRequest) -> Send:
    """Return a function that sends requests of a kind for an owner who has room for one."""
    kind: str = request.param
    owner = f"owner-of-{kind}"
    quota = {"evaluation": Quota.EVALUATIONS, "version": Quota.VERSIONS, "study": Quota.STUDIES}.get(kind, Quota.JOBS)
    one: Mapping[Quota, int] = {quota: 1}
    if kind in ("evaluation", "version"):
        job, _ = submission.submit(sessions, JobRequest(), owner=owner)
        claim = claim_work(sessions, Job, job.id, "w")
        assert claim is not None
        outcomes.begin(sessions, claim.lease, step=0)
        outcomes.transition(sessions, claim.lease, WorkState.RUNNING)
        record_checkpoint(sessions, claim.lease, step=10, key=f"jobs/{job.id}/10", manifest={"files": []})

    def send(key: str | None, text: str) -> tuple[Any, bool]:
        options: Any = {"idempotency_key": key, "limits": one}
        if kind == "evaluation":
            return submission.submit_evaluation(sessions, job.id, EvaluationRequest(tags=[text]), **options)
        if kind == "version":
            return policies.register(sessions, "quick", Registration(job.id, notes=text), **options)
        if kind == "study":
            search = SearchSpec.model_validate(SEARCH)
            return studies.submit_study(sessions, StudyRequest(JobRequest(), search, text), owner=owner, **options)
        if kind == "match":
            match = MatchRequest(teams=("example", "example"), games=1, players=1, half_s=1.0, tags=[text])
            return matches.submit_match(sessions, match, owner=owner, **options)
        return submission.submit(sessions, JobRequest(name=text), owner=owner, **options)

    return send


@pytest.mark.parametrize("send", ["job", "study", "match", "evaluation", "version"], indirect=True)
def test_a_key_makes_one_thing_in_a_race_for_the_last_place(send: Send) -> None:
    """A repeated request needs no room: none of them is refused."""
    gate = threading.Barrier(CALLERS)

    def race(_: int) -> tuple[Any, bool]:
        gate.wait()
        return send("night", "a")

    with ThreadPoolExecutor(CALLERS) as pool:
        answers = list(pool.map(race, range(CALLERS)))
    made = {getattr(row, "id", None) or (row.policy_id, row.number) for row, _ in answers}
    assert (len(made), sum(new for _, new in answers)) == (1, 1)
    row = answers[0][0]
    with pytest.raises(ConflictError, match=f"which made {getattr(row, 'id', 'version 1')}; use a new key") as caught:
        send("night", "b")
    assert caught.value.field == "Idempotency-Key"
    with pytest.raises((QuotaError, ConflictError), match=r"has 1 .* of 1 that are allowed|is this checkpoint already"):
        send(None, "b")


def test_another_owners_key_is_another_key(sessions: Sessions) -> None:
    made = [submission.submit(sessions, JobRequest(), owner=owner, idempotency_key="k") for owner in ("alice", "bob")]
    assert all(new for _, new in made)
