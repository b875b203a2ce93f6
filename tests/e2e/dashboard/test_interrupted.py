"""What is being done in a page while an answer is lost, a token ends, the page is left or another tab is faster."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import pytest
from naojobs.database import notify
from naojobs.models import Job, Log, MetricsRecord, Token, generation
from naospec import recipes
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select
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


HOLD_POSTS = """
    const real = fetch;
    const held = new Promise((resolve) => { window.release = resolve; });
    window.fetch = async (...request) => {
        const answer = await real(...request);
        if (request[1]?.method === "POST") await held;
        return answer;
    };
"""
SEND_TWICE = """
    const real = fetch;
    window.keys = [];
    window.fetch = (...request) => {
        if (request[1]?.method !== "POST") return real(...request);
        keys.push(request[1].headers["Idempotency-Key"]);
        return keys.length === 1 ? Promise.reject(Error()) : real(...request);
    };
"""


@pytest.fixture
def job(client: httpx.Client) -> str:
    """A job that no worker of the tests takes: none runs servers."""
    found: str = client.post("/jobs", json={"name": "model", "tags": ["first"], **WAITING}).json()["id"]
    return found


def end_tokens(browser: Browser, stack: Stack, owner: str, token: str) -> None:
    """Revoke all tokens of an owner, of which the API has kept this one for a moment."""
    with stack.sessions.begin() as session:
        session.execute(update(Token).where(Token.owner == owner).values(revoked_at=func.now()))
    with stack.client(token) as client:
        browser.until(lambda: client.get("/whoami").status_code == 401)


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
    end_tokens(browser, stack, owner, token)
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
    end_tokens(browser, stack, "somebody", ended)
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


def test_what_is_chosen_in_a_comparison_is_in_its_address(
    browser: Browser, token: str, client: httpx.Client, job: str
) -> None:
    another = client.post("/jobs", json={"name": "another", **WAITING}).json()["id"]

    def chosen() -> tuple[str | None, ...]:
        return (
            browser.find("select[aria-label='Group by']").get_attribute("value"),
            browser.find(".segments button[aria-pressed=true]").text,
            browser.find("input[aria-label='Smoothing']").get_attribute("value"),
        )

    browser.sign_in(token)
    browser.open(f"/compare?jobs={job}")
    browser.find("select[aria-label='Group by']").send_keys("Robot")
    browser.shows("Line: mean.")
    next(e for e in browser.all(".segments button") if e.text == "Training time").click()
    browser.find("input[aria-label='Smoothing']").send_keys(Keys.HOME)
    browser.driver.refresh()
    browser.shows("Line: mean.")
    assert chosen() == ("robot", "Training time", "0")
    browser.find("input[aria-label='Add a job']").send_keys(another, Keys.ENTER)
    browser.find(f"tr[data-job='{another}']")
    assert chosen() == ("robot", "Training time", "0")


def test_a_page_that_was_left_opens_no_other_page(browser: Browser, token: str, client: httpx.Client, job: str) -> None:
    browser.sign_in(token)
    browser.open("/submit")
    browser.js(HOLD_POSTS)
    browser.find("form button.primary").click()
    browser.js("location.hash = '#/studies'")
    browser.shows("Studies", "h1")
    browser.js("release()")
    browser.shows("submitted.", "#toasts")
    assert browser.driver.current_url.endswith("#/studies")
    made = {row["id"] for row in client.get("/jobs").json()["items"]} - {job}
    assert len(made) == 1
    client.post(f"/jobs/{made.pop()}/cancel").raise_for_status()


def change(stack: Stack, job: str, **values: Any) -> None:
    """Set columns of a job as a worker does."""
    with stack.sessions.begin() as session:
        row = session.get_one(Job, job)
        for name, value in values.items():
            setattr(row, name, value)
        row.updated_at = func.now()
        notify(session, job)


@pytest.mark.parametrize("place", ["list", "page"])
def test_an_answer_that_comes_late_does_not_replace_a_newer_state(
    browser: Browser, stack: Stack, token: str, job: str, place: str
) -> None:
    # of this generation, so that no worker takes it for one of a database that was restored
    lease = {"lease_owner": "worker", "lease_generation": generation(), "attempt": 1}
    expires_at = datetime(2100, 1, 1, tzinfo=UTC)
    change(stack, job, state="running", started_at=func.now(), lease_expires_at=expires_at, **lease)
    browser.sign_in(token)
    browser.open("/" if place == "list" else f"/jobs/{job}")
    browser.shows("Live", ".top")
    shown = f"tr[data-job='{job}'] [data-state]" if place == "list" else ".page-head [data-state]"

    def state() -> str | None:
        return browser.find(shown).get_attribute("data-state")

    browser.until(lambda: state() == "running", 20)
    browser.js(HOLD_POSTS)
    browser.find("[data-action=pause]").click()
    browser.until(lambda: state() == "pausing", 20)
    change(stack, job, state="paused", lease_owner=None, lease_generation=None, lease_expires_at=None)
    browser.until(lambda: state() == "paused", 20)
    browser.module(
        "release(); await new Promise((done) => setTimeout(done)); await new Promise(requestAnimationFrame);"
    )
    assert state() == "paused"


def test_a_page_that_was_opened_in_an_outage_opens_when_the_service_is_back(
    browser: Browser, stack: Stack, token: str
) -> None:
    browser.allowed.append("ERR_")
    browser.sign_in(token)
    browser.open("/studies")
    browser.shows("No studies yet")
    stack.stop_api()
    try:
        browser.js("location.hash = '#/league'")
        browser.shows("does not answer")
        browser.find("main button.primary").click()
        browser.shows("does not answer")
        assert browser.driver.title.endswith("naosprint"), "the dashboard is gone"
    finally:
        stack.start_api()
    browser.shows("No matches yet", timeout_s=30)


def test_evaluations_are_followed_after_an_answer_is_lost(
    browser: Browser, token: str, client: httpx.Client, job: str
) -> None:
    client.post(f"/jobs/{job}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/jobs/{job}/evaluation")
    browser.shows("Not evaluated yet")
    browser.js(
        "const real = fetch; let asked = 0; window.fetch = async (url, ...options) => {"
        "  if (!String(url).includes('/evaluations')) return real(url, ...options);"
        "  asked += 1;"
        "  if (asked === 2) throw Error();"
        "  const items = [{ id: 'e', state: asked < 3 ? 'running' : 'failed', spec: { episodes: 5 }, files: [] }];"
        "  return new Response(JSON.stringify({ items, next_cursor: null })); };"
        "dispatchEvent(new Event('focus'));"
    )
    browser.shows("The results appear here", timeout_s=20)
    browser.shows("This evaluation failed.", timeout_s=20)


def test_an_evaluation_that_was_made_is_not_reported_as_failed(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    made = browser.module(
        "const { requestEvaluation } = await import('/ui/js/evaluation.js');"
        "const store = { path: 'jobs/none', read: () => Promise.reject(Error()) };"
        'const real = fetch; window.fetch = async () => new Response(\'{"id": "made"}\');'
        "const made = await requestEvaluation(store, document.createElement('button'), {}, 'done');"
        "window.fetch = real; return made?.id;"
    )
    assert made == "made", "the list of evaluations could not be read, and a second one would be requested"


def test_the_focus_stays_near_a_button_that_is_gone(browser: Browser, token: str, client: httpx.Client) -> None:
    for number in range(3):
        client.post("/jobs", json={"name": f"job {number}", **WAITING}).raise_for_status()
    browser.sign_in(token)
    browser.until(lambda: len(browser.all("tr[data-job]")) == 3)

    def press(*keys: str) -> None:
        ActionChains(browser.driver).send_keys(*keys).perform()

    def focused() -> str:
        return str(browser.js("return document.activeElement.textContent"))

    browser.js("document.querySelector(\"[aria-label='Cancel job 1']\").focus()")
    press(Keys.ENTER)
    browser.until(lambda: focused() == "job 1", 20, "the focus is lost in the list")
    press("j")
    browser.until(lambda: focused() == "job 0", 20)
    press(Keys.ENTER)
    browser.find(".page-head [data-action=pause]")
    browser.js("document.querySelector('.page-head [data-action=pause]').focus()")
    press(Keys.ENTER)
    browser.find(".page-head [data-action=resume]")
    browser.until(lambda: focused() == "job 0", 20, "the focus is lost on the page")
    browser.js("const menu = document.querySelector('.menu'); menu.open = true; menu.querySelector('summary').focus()")
    press(Keys.ESCAPE)
    assert not browser.js("return document.querySelector('.menu').open")


def test_what_is_submitted_again_keeps_its_order_and_the_task_of_its_evaluation(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    body = {
        "spec": {"robot": "t1", "task": "velocity", "total_steps": 1_000_000},
        "priority": 8,
        "max_attempts": 7,
        "evaluation": {"episodes": 77, "task": {"name": "getup"}},
        "not_before": "2100-01-01T00:00:00Z",
    }
    made = client.post("/jobs", json=body).raise_for_status().json()
    browser.sign_in(token)
    browser.open(f"/submit?from={made['id']}")
    browser.until(lambda: browser.all("pre.code"))
    sent = json.loads(browser.js("return document.querySelector('pre.code').textContent"))
    assert (sent["priority"], sent["max_attempts"], sent["evaluation"]) == (8, 7, body["evaluation"])


def test_a_job_whose_parent_has_been_deleted_is_not_submitted_again_unnoticed(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    body = {"spec": {"total_steps": 1_000_000}, "not_before": "2100-01-01T00:00:00Z"}
    parent = client.post("/jobs", json=body).raise_for_status().json()["id"]
    child = client.post("/jobs", json={**body, "parent_job_id": parent}).raise_for_status().json()["id"]
    for job in (child, parent):
        client.post(f"/jobs/{job}/cancel").raise_for_status()
    client.delete(f"/jobs/{parent}").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/submit?from={child}")
    browser.shows("it would start from random weights")
    Select(browser.find("#recipe")).select_by_value("sprint-hour")
    browser.until(lambda: "random weights" not in browser.find("main").text)


def test_a_recipe_of_a_job_to_start_from_has_only_the_stages_after_it(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    body = {"spec": {"total_steps": 1_000_000}, "not_before": "2100-01-01T00:00:00Z"}
    parent = client.post("/jobs", json=body).raise_for_status().json()["id"]
    browser.sign_in(token)
    browser.open(f"/submit?parent={parent}")
    browser.until(lambda: browser.all("#recipe"))
    Select(browser.find("#recipe")).select_by_value("t1-sprint-robust")
    sent = json.loads(browser.js("return document.querySelector('pre.code').textContent"))
    assert len(sent["spec"]["stages"]) == len(recipes.job("t1-sprint-robust", parent)["spec"]["stages"])
    assert sent["parent_job_id"] == parent


def test_studies_versions_and_evaluations_are_sent_again_with_their_key(
    browser: Browser, token: str, client: httpx.Client, job: str
) -> None:
    browser.sign_in(token)
    browser.open("/submit?study=1")
    browser.set("[aria-label='Values of the setting']", "1e-4..1e-3")
    browser.js(SEND_TWICE)
    browser.find("form button.primary").click()
    browser.shows("does not answer")
    browser.find("form button.primary").click()
    browser.until(lambda: "/studies/" in browser.driver.current_url)
    study = browser.driver.current_url.rsplit("/", 1)[1]
    client.post(f"/studies/{study}/cancel").raise_for_status()
    keys = browser.js("return keys")
    assert keys[0], "a study has no key"
    assert keys[0] == keys[1]
    assert len(client.get("/studies").json()["items"]) == 1
    browser.allowed += ["404", "422"]  # neither checkpoint exists
    browser.driver.refresh()
    browser.js(SEND_TWICE)
    browser.module(
        "const { registerCheckpoint } = await import('/ui/js/views/job-edit.js');"
        "registerCheckpoint({ id: args[0] }, { id: 'checkpoint_none', step: 1 });"
        "document.querySelector('#policy-name').value = 'twice';",
        job,
    )
    for count in (1, 2):
        browser.js("document.querySelector('dialog form').requestSubmit()")
        browser.until(lambda count=count: browser.js("return keys.length") == count)
        browser.until(lambda: browser.text("dialog .problem"))
    version = browser.js("return keys")
    assert version[0], "a version has no key"
    assert version[0] == version[1]
    browser.driver.refresh()
    browser.js(SEND_TWICE)
    evaluation = browser.module(
        "const { requestEvaluation } = await import('/ui/js/evaluation.js');"
        "const store = { path: `jobs/${args[0]}`, read: async () => {} };"
        "for (let i = 0; i < 2; i++) await requestEvaluation(store, document.createElement('button'),"
        " { checkpoint_id: 'ckpt_none' }, 'done');"
        "return keys;",
        job,
    )
    assert evaluation[0], "an evaluation has no key"
    assert evaluation[0] == evaluation[1]


def test_empty_charts_of_a_training_with_metrics_do_not_say_that_it_had_none(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job: str
) -> None:
    with stack.sessions.begin() as session:
        session.add(MetricsRecord(job_id=job, attempt=1, step=1000, time_s=1.0, values={"reward": 1.0}))
    client.post(f"/jobs/{job}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/jobs/{job}")
    browser.shows("The training has no such values.")
    assert "before its first update" not in browser.text("main")


def test_a_comparison_shows_no_answer_older_than_the_stream(
    browser: Browser, token: str, client: httpx.Client, job: str
) -> None:
    browser.sign_in(token)
    browser.open(f"/compare?jobs={job}")
    browser.shows("Live", ".top")
    browser.js("dispatchEvent(new Event('pagehide'))")
    browser.hold(f"/jobs/{job}$")
    browser.js("dispatchEvent(new Event('pageshow'))")
    browser.until(lambda: browser.js("return window.answered"))
    client.post(f"/jobs/{job}/cancel").raise_for_status()
    browser.find("tr[data-job] [data-state=cancelled]")
    browser.module("release(); await new Promise((done) => setTimeout(done));")
    browser.theme("dark")  # the table is drawn again
    assert browser.find("tr[data-job] [data-state]").get_attribute("data-state") == "cancelled"


def test_a_job_that_ends_while_its_page_loads_is_shown_whole(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job: str
) -> None:
    browser.sign_in(token)
    browser.find(f"tr[data-job='{job}']")
    browser.hold(f"/jobs/{job}$", "request")
    browser.js("location.hash = arguments[0]", f"#/jobs/{job}/log")
    browser.until(lambda: browser.js("return window.asked"))
    browser.module("await Promise.all(window.others)")
    with stack.sessions.begin() as session:
        session.add(Log(job_id=job, attempt=1, level="info", message="the last line"))
    client.post(f"/jobs/{job}/cancel").raise_for_status()
    browser.js("release()")
    browser.find(".page-head [data-state=cancelled]")
    browser.shows("the last line", ".log", 20)


def test_a_list_that_comes_late_has_the_jobs_that_came_and_went_meanwhile(
    browser: Browser, token: str, client: httpx.Client, job: str
) -> None:
    client.post(f"/jobs/{job}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.shows("Live", ".top")
    browser.find(f"tr[data-job='{job}'] [data-state=cancelled]")
    browser.hold("/jobs[?]")
    browser.js("location.hash = '#/?q=m'")
    browser.until(lambda: browser.js("return window.answered"))
    client.delete(f"/jobs/{job}").raise_for_status()
    made = client.post("/jobs", json={"name": "made", **WAITING}).json()["id"]
    browser.find(f"tr[data-job='{made}']")
    browser.until(lambda: not browser.all(f"tr[data-job='{job}']"))
    browser.module(
        "release(); await new Promise((done) => setTimeout(done)); await new Promise(requestAnimationFrame);"
    )
    assert [row.get_attribute("data-job") for row in browser.all("tr[data-job]")] == [made]


def test_another_token_shows_other_jobs_at_once(browser: Browser, stack: Stack, token: str, job: str) -> None:
    other = stack.make_token("owner-of-another-job", "submit")
    with stack.client(other) as client:
        made = client.post("/jobs", json={"name": "other", **WAITING}).json()["id"]
    browser.sign_in(token)
    browser.find(f"tr[data-job='{job}']")
    browser.js("location.hash = arguments[0]", f"#/?token={other}")
    browser.find("dialog button[value=yes]").click()
    browser.find(f"tr[data-job='{made}']", 20)
    assert not browser.all(f"tr[data-job='{job}']")
