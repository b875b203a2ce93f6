"""Lists have pages: a limit, a maximum, and a cursor that leads through all items without a gap or a repetition."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest
from naojobs import registry
from naojobs.capabilities import Capabilities
from naojobs.leases import Lease
from naojobs.tokens import Scope, create_token
from naosprint_api.app import create_app
from naosprint_api.service import Service
from naosprint_api.settings import ApiSettings
from sqlalchemy.orm import Session, sessionmaker

CATALOG = {"/tasks", "/algorithms", "/robots", "/simulators", "/presets", "/recipes", "/league", "/usage"}
"""What is installed with the service, not what users make; and a ranking and a sum by owner, each one whole."""
COUNT = 5


@pytest.fixture(scope="module")
def filled(sessions: sessionmaker[Session]) -> None:
    """Tokens and workers."""
    for number in range(COUNT):
        create_token(sessions, name=str(number), owner="pages", scopes=[Scope.READ])
        registry.beat(
            sessions,
            f"host-{number}:1:a",
            host="host",
            pid=number,
            capabilities=Capabilities({}, [], [], ["ppo"]),
            version="1",
        )


@pytest.mark.parametrize("kind", ["tokens", "workers", "checkpoints", "evaluations", "policies", "versions"])
def test_pages_lead_through_all_items(
    filled: None,
    admin: httpx.Client,
    run_job: Callable[..., Lease],
    save_checkpoint: Callable[..., str],
    kind: str,
) -> None:
    path = f"/{kind}"
    if kind not in ("tokens", "workers"):
        lease = run_job(owner="pages")
        made = [save_checkpoint(lease, step, {"policy.npz": b"x"}) for step in range(100, 100 + COUNT)]
        if kind in ("checkpoints", "evaluations"):
            path = f"/jobs/{lease.job_id}/{kind}"
        elif kind == "versions":
            path = "/policies/paged/versions"
        for number, checkpoint in enumerate(made):
            if kind == "evaluations":
                body = {"checkpoint_id": checkpoint, "spec": {"episodes": 1}}
                assert admin.post(path, json=body).status_code == 202
            elif kind != "checkpoints":
                name = "paged" if kind == "versions" else f"paged-{number}"
                body = {"job_id": lease.job_id, "checkpoint_id": checkpoint}
                assert admin.post(f"/policies/{name}/versions", json=body).status_code == 201
    whole = admin.get(path, params={"limit": 200}).json()
    assert len(whole["items"]) >= COUNT
    assert whole["next_cursor"] is None
    found: list[dict[str, Any]] = []
    cursor = None
    while True:
        page = admin.get(path, params={"limit": 2, **({"cursor": cursor} if cursor else {})}).json()
        assert 1 <= len(page["items"]) <= 2
        found += page["items"]
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert found == whole["items"]
    for wrong in ({"limit": 0}, {"limit": 201}, {"cursor": "\x00"}):
        assert admin.get(path, params=wrong).status_code == 422


def test_every_list_has_pages(service_environment: dict[str, str]) -> None:
    settings = {name.removeprefix("NAOSPRINT_").lower(): value for name, value in service_environment.items()}
    document = create_app(Service.build(ApiSettings(**settings))).openapi()
    lists = set()
    for path, methods in document["paths"].items():
        schema = methods.get("get", {}).get("responses", {}).get("200", {}).get("content", {})
        schema = schema.get("application/json", {}).get("schema", {})
        if schema.get("type") == "array":
            lists.add(path)
        name = schema.get("$ref", "").rsplit("/", 1)[-1]
        if name.endswith("Page"):
            limits = [item["schema"] for item in methods["get"]["parameters"] if item["name"] == "limit"]
            names = {item["name"] for item in methods["get"]["parameters"]}
            assert limits and limits[0]["maximum"] <= 1000, path
            assert names & {"cursor", "after"}, path
    assert lists == CATALOG
