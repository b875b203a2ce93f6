"""What is being done in a page while an answer is lost, a token ends, the page is left or another tab is faster."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from naojobs.models import Token
from sqlalchemy import func, update

if TYPE_CHECKING:
    import httpx
    from conftest import Browser, Stack

LOSE_ONE_POST = """
    const real = fetch;
    window.fetch = async (...request) => {
        const answer = await real(...request);
        if (request[1]?.method !== "POST") return answer;
        window.fetch = real;
        throw Error();
    };
"""
WAITING: dict[str, Any] = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}


@pytest.fixture
def job(client: httpx.Client) -> str:
    """A job that no worker of the tests takes: none runs servers."""
    found: str = client.post("/jobs", json={"name": "model", "tags": ["first"], **WAITING}).json()["id"]
    return found


def end_tokens(stack: Stack, owner: str) -> None:
    """Revoke all tokens of an owner."""
    with stack.sessions.begin() as session:
        session.execute(update(Token).where(Token.owner == owner).values(revoked_at=func.now()))


def test_what_is_submitted_again_after_a_lost_answer_is_made_once(
    browser: Browser, token: str, client: httpx.Client, job: str
) -> None:
    browser.sign_in(token)
    browser.open(f"/submit?from={job}")
    browser.set("#f-name", "")
    browser.js(LOSE_ONE_POST)
    browser.find("form button.primary").click()
    browser.shows("does not answer")
    browser.until(lambda: len(client.get("/jobs").json()["items"]) == 2)
    browser.find("form button.primary").click()
    browser.until(lambda: "/jobs/" in browser.driver.current_url)
    assert len(client.get("/jobs").json()["items"]) == 2, "the job was made twice"


def test_what_is_submitted_again_keeps_its_tags_and_the_policy_it_starts_from(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    spec = {"robot": "t1", "task": "velocity", "total_steps": 1_000_000}
    body = {
        "spec": spec,
        "tags": ["one", "two"],
        "parent_policy": "t1-run-steady",
        "not_before": "2100-01-01T00:00:00Z",
    }
    answer = client.post("/jobs", json=body)
    assert answer.status_code == 201, answer.text
    browser.sign_in(token)
    browser.open(f"/submit?from={answer.json()['id']}")
    browser.until(lambda: browser.all("pre.code"))
    sent = json.loads(browser.js("return document.querySelector('pre.code').textContent"))
    assert (sent["tags"], sent["parent_policy"]) == (["one", "two"], answer.json()["parent_policy"])
    browser.shows("Starts from a trained policy:")


def test_a_match_is_submitted_once_however_often_its_button_is_pressed(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    browser.sign_in(token)
    browser.open("/league")
    browser.find(".page-head button.primary").click()
    browser.set("#match-team-b", "example")
    browser.set("#match-games", "1")
    browser.set("#match-seconds", "2")
    browser.js(
        "const real = fetch; window.made = 0;"
        "window.fetch = (...request) => real(...request).finally(() => { made += request[1]?.method === 'POST'; });"
        "const form = document.querySelector('dialog form'); form.requestSubmit(); form.requestSubmit();"
    )
    browser.until(lambda: browser.js("return made") == 2)
    browser.until(lambda: not browser.all("dialog"))
    matches = client.get("/matches").json()["items"]
    for match in matches:
        client.post(f"/matches/{match['id']}/cancel")
    assert len(matches) == 1


def test_an_edit_changes_only_what_was_edited(browser: Browser, token: str, client: httpx.Client, job: str) -> None:
    browser.sign_in(token)
    browser.open(f"/jobs/{job}")
    browser.find("[data-action=edit]").click()
    browser.set("#edit-notes", "Written here.")
    client.patch(f"/jobs/{job}", json={"tags": ["second"], "priority": 7}).raise_for_status()
    client.post(f"/jobs/{job}/cancel").raise_for_status()  # no priority can be set any more
    browser.find("dialog [type=submit]").click()
    browser.shows("Written here.", "[data-part=notes]")
    changed = client.get(f"/jobs/{job}").json()
    assert (changed["tags"], changed["priority"], changed["notes"]) == (["second"], 7, "Written here.")


def test_a_form_outlasts_the_token_that_it_was_opened_with(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job: str, request: pytest.FixtureRequest
) -> None:
    owner = f"owner-{request.node.name[:80]}"
    browser.sign_in(token)
    browser.open(f"/submit?from={job}")
    browser.set("#f-name", "typed before")
    end_tokens(stack, owner)
    browser.allowed.append("401")
    browser.find("form button.primary").click()
    browser.shows("no longer valid", "dialog")
    fresh = stack.make_token(owner, "submit")
    browser.find("dialog #token").send_keys(fresh)
    browser.find("dialog [type=submit]").click()
    browser.until(lambda: not browser.all("dialog"))
    browser.find("form button.primary").click()
    browser.shows("typed before", "h1")
    with stack.client(fresh) as renewed:
        assert {each["name"] for each in renewed.get("/jobs").json()["items"]} == {"model", "typed before"}


def test_a_link_whose_token_ended_keeps_the_token_of_the_browser(
    browser: Browser, stack: Stack, token: str, job: str
) -> None:
    ended = stack.make_token("somebody", "read")
    end_tokens(stack, "somebody")
    browser.driver.get(f"{browser.base}/")
    browser.js("localStorage.setItem('naosprint.token', arguments[0])", token)
    browser.js("sessionStorage.setItem('naosprint.token', arguments[0])", ended)
    browser.allowed.append("401")
    browser.open("/")
    browser.shows("model")
    assert browser.js("return localStorage.getItem('naosprint.token')") == token


def test_addresses_keep_percent_signs(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    browser.open("/")
    browser.find("input[type=search]").send_keys("95%41")
    browser.until(lambda: "95%2541" in browser.driver.current_url)
    browser.open("/?q=95%2541")
    browser.shows("No matching jobs")
    assert browser.find("input[type=search]").get_attribute("value") == "95%41"
    browser.open("/%")
    browser.shows("There is nothing at /%.")


def test_a_page_that_was_left_while_loading_does_not_come_back(browser: Browser, token: str) -> None:
    browser.driver.get(f"{browser.base}/")
    browser.js("sessionStorage.setItem('naosprint.token', arguments[0])", token)
    browser.open("/league")
    browser.shows("League", "h1")
    browser.js(
        "const real = fetch; window.asked = 0;"
        "const held = new Promise((resolve) => { window.release = resolve; });"
        "window.fetch = async (url, ...options) => {"
        "  const answer = await real(url, ...options);"
        "  window.asked += String(url).includes('/presets') || String(url).includes('/recipes');"
        "  if (String(url).endsWith('/algorithms')) await held;"
        "  return answer; };"
        "location.hash = '#/submit';"
    )
    browser.until(lambda: browser.js("return window.asked") == 2)
    browser.js("location.hash = '#/workers'")
    browser.shows("Alive")
    browser.module("release(); await (await import('/ui/js/descriptions.js')).descriptions(); await 0;")
    browser.module("await new Promise((done) => setTimeout(done));")
    assert browser.text("h1") == "Workers"


def test_a_dialog_is_closed_when_its_page_is_left(browser: Browser, token: str, client: httpx.Client, job: str) -> None:
    browser.sign_in(token)
    browser.find("tbody .name a").click()
    browser.find("[data-action=edit]").click()
    browser.find("dialog")
    browser.driver.back()
    browser.until(lambda: not browser.all("dialog"), 10, "the dialog is still open")
    assert browser.text("h1") == "Jobs"


def test_the_grouping_of_a_comparison_is_in_its_address(
    browser: Browser, token: str, client: httpx.Client, job: str
) -> None:
    browser.sign_in(token)
    browser.open(f"/compare?jobs={job}")
    browser.find("select[aria-label='Group by']").send_keys("Robot")
    browser.shows("Line: mean.")
    browser.driver.refresh()
    browser.shows("Line: mean.")
    assert browser.find("select[aria-label='Group by']").get_attribute("value") == "robot"
