"""The API against its own OpenAPI document, with generated requests.

`make fuzz` sends more: FUZZ_EXAMPLES of each kind to each operation, from FUZZ_SEED on.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import Unsatisfiable
from hypothesis.strategies import SearchStrategy
from naojobs.leases import Lease
from schemathesis import Case, GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from sqlalchemy.orm import Session, sessionmaker

from tests.integration.writes import append_metrics, request_evaluation

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "4"))
FUZZ_SEED = int(os.environ.get("FUZZ_SEED", "0"))

CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.fixture(scope="module")
def caller(start_api: Callable[..., Any], make_token: Callable[..., str]) -> Iterator[httpx.Client]:
    """An admin without limits on rate and jobs."""
    api = start_api(api_rate_per_s=1e6, api_rate_burst=1_000_000, api_max_open_jobs=1_000_000)
    headers = {"Authorization": f"Bearer {make_token('fuzz', 'admin')}"}
    with httpx.Client(base_url=api.url, headers=headers, timeout=30) as client:
        yield client


@pytest.fixture
def known(
    run_job: Callable[..., Lease], save_checkpoint: Callable[..., str], sessions: sessionmaker[Session]
) -> dict[str, str]:
    """Path parameters of existing objects."""
    lease = run_job()
    checkpoint = save_checkpoint(lease, 1, {"a.json": b"{}"})
    evaluation = request_evaluation(sessions, lease.job_id)
    append_metrics(sessions, lease, [{"step": 1, "reward": 1.0}])
    return {"job_id": lease.job_id, "checkpoint_id": checkpoint, "evaluation_id": evaluation.id, "name": "a.json"}


def test_no_request_breaks_the_service_or_its_document(caller: httpx.Client, known: dict[str, str]) -> None:
    schema = schemathesis.openapi.from_dict(caller.get("/openapi.json").json())
    tried = 0
    for result in schema.get_all_operations():
        operation = result.ok()
        assert operation is not None
        if operation.path.endswith("/stream"):
            continue  # a stream does not end
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):
            for ids in (known, {}):
                fixed = {name: value for name, value in ids.items() if f"{{{name}}}" in operation.path}
                if ids and not fixed:
                    continue
                strategy = operation.as_strategy(generation_mode=mode, path_parameters=fixed or None)
                tried += attempt_all(caller, strategy)
    assert tried > 20 * EXAMPLES


def attempt_all(caller: httpx.Client, strategy: SearchStrategy[Case]) -> int:
    """Send requests of a strategy and check the responses; return their number."""
    tried = 0

    @seed(FUZZ_SEED)
    @settings(
        max_examples=EXAMPLES,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=strategy)
    def attempt(case: Case) -> None:
        nonlocal tried
        tried += 1
        response = case.call(base_url=str(caller.base_url), headers={"Authorization": caller.headers["authorization"]})
        case.validate_response(response, checks=CHECKS)

    with suppress(Unsatisfiable):  # an operation without parameters cannot be called wrongly
        attempt()
    return tried
