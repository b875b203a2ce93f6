"""Tokens over HTTP: only admins may make, list and revoke them."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import httpx
import pytest
from naojobs.database import Sessions
from naojobs.errors import ConflictError
from naojobs.tokens import Scope, create_token, get_token, revoke


def test_a_token_from_its_making_to_its_end(admin: httpx.Client, api: Any) -> None:
    answer = admin.post("/tokens", json={"owner": "carol", "name": "laptop", "scopes": ["read"], "expires_in_days": 30})
    assert answer.status_code == 201
    made = answer.json()
    assert (made["owner"], made["name"], made["scopes"], made["revoked_at"]) == ("carol", "laptop", ["read"], None)
    assert made["expires_at"] > made["created_at"]
    with httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {made['token']}"}) as carol:
        assert carol.get("/whoami").json() == {"owner": "carol", "scopes": ["read"], "job_id": None, "docs_url": ""}
        listed = admin.get("/tokens")
        assert made["token"] not in listed.text
        (shown,) = (token for token in listed.json()["items"] if token["id"] == made["id"])
        assert shown == {name: value for name, value in made.items() if name != "token"}
        assert admin.delete(f"/tokens/{made['id']}").status_code == 204
        assert carol.get("/whoami").status_code == 401
    (shown,) = (token for token in admin.get("/tokens").json()["items"] if token["id"] == made["id"])
    assert shown["revoked_at"] is not None


def test_another_process_refuses_a_revoked_token_within_a_second(
    sessions: Sessions, api: Any, soon: Callable[..., bool]
) -> None:
    """API processes share their look-ups for a second; one that did not revoke the token itself learns it then."""
    token_id, secret = create_token(sessions, name="", owner="frank", scopes=[Scope.READ])
    with httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {secret}"}) as frank:
        assert frank.get("/whoami").status_code == 200
        revoke(sessions, token_id)
        assert soon(lambda: frank.get("/whoami").status_code == 401)


def test_a_token_is_for_submitting_and_lasts_unless_told_otherwise(admin: httpx.Client) -> None:
    made = admin.post("/tokens", json={"owner": "dave"}).json()
    assert (made["scopes"], made["expires_at"]) == (["submit"], None)


@pytest.mark.parametrize("scope", ["read", "submit"])
def test_only_an_admin_may(make_client: Callable[..., httpx.Client], admin: httpx.Client, scope: str) -> None:
    mallory = make_client("mallory", scope)
    token = admin.get("/tokens").json()["items"][0]["id"]
    for body in ({"owner": "mallory", "scopes": ["admin"]}, {"owner": "alice", "scopes": ["read"]}):
        answer = mallory.post("/tokens", json=body)
        assert answer.status_code == 403
        assert f"scope {'admin' if scope == 'submit' else 'submit'}" in answer.json()["errors"][0]["message"]
    assert mallory.delete(f"/tokens/{token}").status_code == (404 if scope == "submit" else 403)
    assert token not in mallory.get("/tokens").text


def test_a_token_revokes_none_with_more_scopes(make_client: Callable[..., httpx.Client], sessions: Sessions) -> None:
    """Of its own owner; it may revoke those with the same or fewer, and itself."""
    made = {
        scope: create_token(sessions, name="", owner="nina", scopes=[Scope(scope)])[0]
        for scope in ("read", "submit", "metrics", "admin")
    }
    nina = make_client("nina", "submit")
    (own,) = (token["id"] for token in nina.get("/tokens").json()["items"] if token["id"] not in made.values())
    for scope in ("metrics", "admin"):
        answer = nina.delete(f"/tokens/{made[scope]}")
        assert (answer.status_code, scope in answer.json()["detail"]) == (403, True), answer.text
        assert get_token(sessions, made[scope]).revoked_at is None
    for token_id in (made["read"], made["submit"], own):
        assert nina.delete(f"/tokens/{token_id}").status_code == 204
    assert nina.get("/tokens").status_code == 401
    root = make_client("root", "admin")
    assert [root.delete(f"/tokens/{made[scope]}").status_code for scope in ("metrics", "admin")] == [204, 204]


def test_a_user_shares_all_own_jobs_with_a_read_token(make_client: Callable[..., httpx.Client], api: Any) -> None:
    erin = make_client("erin", "submit")
    job = erin.post("/jobs", json={"name": "shared"}).json()["id"]
    made = erin.post("/tokens", json={"owner": "erin", "scopes": ["read"], "expires_in_days": 7}).json()
    with httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {made['token']}"}) as guest:
        assert [item["id"] for item in guest.get("/jobs").json()["items"]] == [job]
        assert guest.post(f"/jobs/{job}/cancel").status_code == 403
        assert guest.post("/tokens", json={"owner": "erin", "scopes": ["read"]}).status_code == 403
        assert {token["owner"] for token in erin.get("/tokens").json()["items"]} == {"erin"}
        assert erin.delete(f"/tokens/{made['id']}").status_code == 204
        assert guest.get("/jobs").status_code == 401


def test_the_scope_metrics_reads_nothing_else(make_client: Callable[..., httpx.Client]) -> None:
    prometheus = make_client("prometheus", "metrics")
    assert "naosprint_" in prometheus.get("/metrics").text
    for path in ("/jobs", "/whoami", "/workers", "/tokens", "/jobs/stream"):
        assert prometheus.get(path).status_code == 403
    assert make_client("someone", "submit").get("/metrics").status_code == 403


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "owner"),
        ({"owner": ""}, "owner"),
        ({"owner": "a\u0000"}, "owner"),
        ({"owner": "a", "scopes": []}, "scopes"),
        ({"owner": "a", "scopes": ["root"]}, "scopes.0"),
        ({"owner": "a", "expires_in_days": 0}, "expires_in_days"),
        ({"owner": "a", "expires_in_days": 1e9}, "expires_in_days"),
        ({"owner": "a", "name": "x" * 201}, "name"),
        ({"owner": "a", "token": "nao_mine"}, "token"),
    ],
)
def test_bad_wishes_are_refused_by_field(admin: httpx.Client, body: dict[str, Any], field: str) -> None:
    answer = admin.post("/tokens", json=body)
    assert answer.status_code == 422
    assert [item["field"] for item in answer.json()["errors"]] == [field]


def test_an_unknown_token_cannot_be_revoked(admin: httpx.Client) -> None:
    assert admin.delete("/tokens/token_01m7y0bdkc59pc1szgpqz7ge55").status_code == 404
    assert admin.delete("/tokens/nao_secret").status_code == 422


def test_what_a_token_made_is_revoked_with_it(
    make_client: Callable[..., httpx.Client], sessions: Sessions, api: Any
) -> None:
    helen_id, helen_secret = create_token(sessions, name="", owner="helen", scopes=[Scope.SUBMIT])
    with httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {helen_secret}"}, timeout=20) as helen:
        job = helen.post("/jobs", json={}).json()["id"]
        child = helen.post("/tokens", json={"owner": "helen", "scopes": ["read"]}).json()
        link = helen.post(f"/jobs/{job}/share").json()["token"]
    assert child["parent_id"] == helen_id

    def statuses() -> list[int]:
        return [
            httpx.get(f"{api.url}/jobs", headers={"Authorization": f"Bearer {secret}"}).status_code
            for secret in (child["token"], link)
        ]

    assert statuses() == [200, 200]
    assert httpx.get(f"{api.url}/workers", headers={"Authorization": f"Bearer {link}"}).json()["items"] == []
    assert make_client("root", "admin").delete(f"/tokens/{helen_id}").status_code == 204
    assert statuses() == [401, 401]
    with pytest.raises(ConflictError):
        create_token(sessions, name="", owner="helen", scopes=[Scope.READ], parent_id=helen_id)


def test_what_a_token_made_expires_no_later(sessions: Sessions, api: Any) -> None:
    hour = timedelta(hours=1)
    made_id, secret = create_token(sessions, name="", owner="ivy", scopes=[Scope.SUBMIT], valid_for=hour)
    limit = get_token(sessions, made_id).expires_at
    with httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {secret}"}, timeout=20) as ivy:
        job = ivy.post("/jobs", json={}).json()["id"]
        body = {"owner": "ivy", "scopes": ["read"]}
        expiries = [
            ivy.post("/tokens", json=body).json()["expires_at"],
            ivy.post("/tokens", json=body | {"expires_in_days": 30}).json()["expires_at"],
            ivy.post(f"/jobs/{job}/share").json()["expires_at"],
        ]
        shorter = ivy.post("/tokens", json=body | {"expires_in_days": 0.01}).json()["expires_at"]
    assert limit is not None
    assert {datetime.fromisoformat(text) for text in expiries} == {limit}
    assert datetime.fromisoformat(shorter) < limit
