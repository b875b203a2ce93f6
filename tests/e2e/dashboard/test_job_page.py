"""One job's page: what can be changed, shared, chosen and read there."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from naojobs.database import notify
from naojobs.ids import new_id
from naojobs.models import Checkpoint, Evaluation, Log, MetricsRecord

if TYPE_CHECKING:
    import httpx
    from conftest import Browser, Stack

WAITING: dict[str, Any] = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}


@pytest.fixture
def job_id(client: httpx.Client) -> str:
    """A job that waits: no worker of the tests runs servers."""
    found: str = client.post("/jobs", json={"name": "page", **WAITING}).json()["id"]
    return found


def test_name_tags_and_notes_are_edited(browser: Browser, token: str, client: httpx.Client, job_id: str) -> None:
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    browser.find("[data-action=edit]").click()
    browser.set("#edit-name", "renamed <b>")
    browser.set("#edit-tags", "one, two")
    browser.set("#edit-notes", "Slips\non the left foot.")
    browser.find("dialog button[type=submit]").click()
    browser.shows("renamed <b>", "h1")
    browser.shows("Slips\non the left foot.", "[data-part=notes]")
    job = client.get(f"/jobs/{job_id}").json()
    assert (job["name"], job["tags"], job["notes"]) == ("renamed <b>", ["one", "two"], "Slips\non the left foot.")
    browser.allowed.append("422")
    browser.find("[data-action=edit]").click()
    browser.set("#edit-tags", "not/ok?")
    browser.find("dialog button[type=submit]").click()
    browser.shows("expected a letter or digit", "dialog")


def test_a_link_shows_the_job_and_offers_no_change(
    browser: Browser, token: str, client: httpx.Client, job_id: str
) -> None:
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    browser.find("[data-action=share]").click()
    browser.find("[data-action=make-link]").click()
    link = browser.find("dialog input[readonly]").get_attribute("value")
    assert link is not None
    assert job_id in link
    browser.driver.get("about:blank")
    browser.driver.get(f"{browser.base}/")
    browser.js("sessionStorage.clear()")
    browser.driver.get("about:blank")
    browser.driver.get(link)
    browser.shows("page", "h1")
    assert "token" not in browser.driver.current_url
    assert not browser.all("[data-action=cancel], [data-action=edit], [data-action=share], a[href='#/submit']")
    client.delete(f"/jobs/{job_id}/share")
    browser.allowed.append("401")
    browser.open("/")
    browser.shows("no longer valid")


def test_an_evaluation_that_waits_shows_the_present_reason(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job_id: str
) -> None:
    key = f"jobs/{job_id}/checkpoints/000000000001-1"
    with stack.sessions.begin() as session:
        session.add(Checkpoint(id=new_id("ckpt"), job_id=job_id, attempt=1, step=1, key=key, manifest={"files": []}))
    evaluation = client.post(f"/jobs/{job_id}/evaluations", json={}).raise_for_status().json()["id"]
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}/evaluation/{evaluation}")
    browser.shows("no worker has simulator 'server'", ".card.empty")
    with stack.sessions.begin() as session:
        session.get_one(Evaluation, evaluation).simulator = "elsewhere"
    browser.shows("no worker has simulator 'elsewhere'", ".card.empty")


def test_curves_have_axes_a_choice_and_saved_views(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job_id: str
) -> None:
    with stack.sessions.begin() as session:
        for i in range(1, 60):
            values = {"reward": 10.0 ** (i % 4), "episode_steps": 5.0, "time_s": float(i)}
            session.add(MetricsRecord(job_id=job_id, attempt=1, step=i * 1000, time_s=float(i), values=values))
        notify(session, job_id)
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    chart = "[data-chart=reward]"
    browser.find(f"{chart} canvas")
    linear = browser.find(f"{chart} canvas").screenshot_as_png
    browser.find("input[name=log]").click()
    browser.until(lambda: browser.find(f"{chart} canvas").screenshot_as_png != linear, message="the scale is linear")
    browser.find("button[data-x=clock]").click()
    assert browser.find("button[data-x=clock]").get_attribute("aria-pressed") == "true"
    browser.find(".menu:has(.chart-list) summary").click()
    other = browser.find(".chart-list input[type=checkbox]:not([name='show:reward'])").get_attribute("name") or ""
    hidden = other.removeprefix("show:")
    browser.find(f"[name='{other}']").click()
    browser.until(lambda: not browser.driver.find_element("css selector", f"[data-chart={hidden}]").is_displayed())
    before = browser.find(f"{chart} canvas").screenshot_as_png
    browser.js(
        "arguments[0].value = '20000'; arguments[0].dispatchEvent(new Event('change'))",
        browser.find("[name='max:reward']"),
    )
    browser.until(lambda: browser.find(f"{chart} canvas").screenshot_as_png != before, message="the range is unchanged")
    browser.js("for (const d of document.querySelectorAll('.menu')) d.open = true")
    browser.set("[aria-label='Name of the view']", "mine")
    browser.js("document.querySelector('[data-action=save-view]').click()")
    browser.open(f"/jobs/{job_id}")
    browser.find(f"{chart} canvas")
    assert browser.find(f"[data-chart={hidden}]")
    browser.js(
        "const s = document.querySelector(arguments[0]); s.value = 'mine'; s.dispatchEvent(new Event('change'))",
        "[aria-label='Saved view']",
    )
    browser.until(lambda: not browser.driver.find_element("css selector", f"[data-chart={hidden}]").is_displayed())
    assert browser.find("input[name=log]").is_selected()
    assert browser.find("button[data-x=clock]").get_attribute("aria-pressed") == "true"


def test_a_dark_page_is_printed_dark_on_white(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job_id: str
) -> None:
    with stack.sessions.begin() as session:
        for i in (1, 2):
            values = {"reward": 10.0 * i, "time_s": float(i)}
            session.add(MetricsRecord(job_id=job_id, attempt=1, step=i * 1000, time_s=float(i), values=values))
        notify(session, job_id)
    browser.sign_in(token)
    browser.theme("dark")
    browser.open(f"/jobs/{job_id}")
    dark = browser.find("[data-chart=reward] canvas").screenshot_as_png
    browser.js(
        "addEventListener('beforeprint', () => { "
        "window.printed = [document.documentElement.dataset.theme, getComputedStyle(document.body).color]; });"
        "addEventListener('beforeprint', async () => { await null; await null; "
        "window.drawn = document.querySelector('[data-chart=reward] canvas').toDataURL(); });"
        "window.before = document.querySelector('[data-chart=reward] canvas').toDataURL();"
    )
    browser.driver.execute_cdp_cmd("Page.printToPDF", {})
    assert browser.js("return window.printed") == ["light", "rgb(21, 26, 33)"]
    assert browser.js("return window.drawn !== window.before"), "the chart has the colours of the dark theme"
    browser.until(
        lambda: browser.find("[data-chart=reward] canvas").screenshot_as_png == dark, message="the chart stays light"
    )
    assert browser.js("return document.documentElement.dataset.theme") == "dark"
    assert browser.js("return localStorage['naosprint.theme']") == "dark"


def open_long_log(browser: Browser, stack: Stack, token: str, job_id: str) -> None:
    """Give a job 1,500 lines of its log, and open its tab, which shows the last 1,000."""
    with stack.sessions.begin() as session:
        session.add_all(Log(job_id=job_id, attempt=1, level="info", message=f"line {i}") for i in range(1500))
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}/log")
    browser.shows("line 1499", ".log")


def test_earlier_lines_of_the_log_come_in_pages(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job_id: str
) -> None:
    open_long_log(browser, stack, token, job_id)
    assert len(browser.all(".log .msg")) == 1000
    browser.js("document.querySelector('.log').scrollTop = 0")
    browser.find("[data-action=earlier]").click()
    browser.until(lambda: len(browser.all(".log .msg")) == 1500, message="not all lines came")
    lines = browser.js("return [...document.querySelectorAll('.log .msg')].map((e) => e.textContent)")
    assert lines == [f"line {i}" for i in range(1500)]
    assert not browser.all("[data-action=earlier]")
    assert browser.js("return document.querySelector('.log').scrollTop") > 0, "what was in view has moved away"


def test_time_in_the_queue_and_in_pauses_does_not_count(browser: Browser) -> None:
    browser.driver.get(f"{browser.base}/")
    kinds = ["queued", "claimed", "running", "pause_requested", "paused", "queued", "claimed", "running", "succeeded"]
    minutes = [0, 10, 11, 20, 21, 50, 60, 61, 80]
    events = [
        {"kind": kind, "at": f"2026-01-01T{minute // 60:02}:{minute % 60:02}:00Z", "data": {}}
        for kind, minute in zip(kinds, minutes, strict=True)
    ]
    job = {"started_at": events[1]["at"], "finished_at": events[-1]["at"]}
    worked = browser.module("return (await import('/ui/js/jobs.js')).worked(...args)", job, events)
    assert worked == (21 - 10 + 80 - 60) * 60


def test_wall_clock_of_metrics_has_the_gaps_of_pauses(browser: Browser) -> None:
    browser.driver.get(f"{browser.base}/")
    events = [
        {"kind": "started", "at": "2026-01-01T00:00:00Z", "data": {"step": 0}},
        {"kind": "resumed", "at": "2026-01-01T01:00:00Z", "data": {"step": 200}},
    ]
    clock = browser.module(
        """
        const { Columns } = await import('/ui/js/columns.js');
        const { wallClock } = await import('/ui/js/curves.js');
        const m = new Columns();
        m.load({ step: [100, 200, 300], time_s: [10, 20, 32] });
        return wallClock(m, args[0]);
        """,
        events,
    )
    start = 1_767_225_600
    assert clock == [start + 10, start + 20, start + 3600 + 12]


def test_pages_that_were_left_hold_no_connections(browser: Browser, token: str, job_id: str) -> None:
    browser.sign_in(token)
    for _ in range(8):  # a browser opens six connections to one origin, and keeps the pages of its Back button
        browser.open(f"/jobs/{job_id}")
        browser.shows("page", "h1", timeout_s=30)
        browser.shows("Live", ".top")


def test_a_page_that_is_returned_to_is_live_again(
    browser: Browser, token: str, client: httpx.Client, job_id: str
) -> None:
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    browser.shows("Live", ".top")
    browser.js("window.kept = true")
    browser.driver.get("about:blank")
    client.post(f"/jobs/{job_id}/cancel").raise_for_status()
    browser.driver.back()
    assert browser.js("return window.kept"), "the browser has loaded the page again instead of keeping it"
    browser.find("[data-state=cancelled]")


def test_an_ended_job_is_read_again_when_its_page_gets_the_focus(
    browser: Browser, token: str, client: httpx.Client, job_id: str
) -> None:
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    browser.shows("Live", ".top")
    client.post(f"/jobs/{job_id}/cancel").raise_for_status()
    browser.find("[data-state=cancelled]")
    browser.until(lambda: "Live" not in browser.text(".top"), message="the stream of an ended job stays open")
    client.post(f"/jobs/{job_id}/retry").raise_for_status()
    browser.js("dispatchEvent(new Event('focus'))")
    browser.find("[data-state=queued]")
    client.post(f"/jobs/{job_id}/cancel").raise_for_status()
    browser.find("[data-state=cancelled]")
    browser.until(lambda: "Live" not in browser.text(".top"))
    client.delete(f"/jobs/{job_id}").raise_for_status()
    browser.allowed.append("404")
    browser.find("[data-action=retry]").click()  # refused: there is no such job any more
    browser.shows("Jobs", "h1")


def test_a_name_without_spaces_stays_beside_the_buttons(browser: Browser, token: str, client: httpx.Client) -> None:
    job_id = client.post("/jobs", json={"name": "x" * 100, **WAITING}).json()["id"]
    browser.sign_in(token)
    for width in (390, 1280):
        browser.size(width, 900)
        browser.open(f"/jobs/{job_id}")
        browser.find("h1")
        assert browser.js("return document.documentElement.scrollWidth") <= width
        title, buttons = (browser.find(selector).rect for selector in ("h1", ".page-head > :last-child"))
        beside = title["x"] + title["width"] <= buttons["x"]
        assert beside or title["y"] + title["height"] <= buttons["y"], f"the name lies under the buttons at {width} px"


def test_a_job_with_a_start_time_waits_for_no_worker(browser: Browser, token: str, client: httpx.Client) -> None:
    body = {"name": "night", **WAITING, "spec": {"total_steps": 8192}, "not_before": "2100-01-01T00:00:00Z"}
    job_id = client.post("/jobs", json=body).json()["id"]
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    browser.shows("Waiting for its time. It is to start at 2100-01-01", "[data-part=waiting]")
    assert "for a worker" not in browser.text("main")


def test_earlier_lines_that_are_asked_for_twice_come_once(
    browser: Browser, stack: Stack, token: str, job_id: str
) -> None:
    open_long_log(browser, stack, token, job_id)
    browser.js(
        "const real = fetch; window.held = [];"
        "const release = new Promise((resolve) => { window.release = resolve; });"
        "window.fetch = (...request) => {"
        "  if (!String(request[0]).includes('before=')) return real(...request);"
        "  const answer = release.then(() => real(...request)); window.held.push(answer); return answer; };"
        "document.querySelector('.log').scrollTop = 0;"
    )
    browser.find("[data-action=earlier]").click()
    browser.set("input[type=search]", "line")  # a filter draws the lines with their button again
    browser.find("[data-action=earlier]").click()
    assert browser.js("return window.held.length") == 2
    browser.module("release(); await Promise.all(window.held); await new Promise((done) => setTimeout(done));")
    browser.until(lambda: len(browser.all(".log .msg")) >= 1500)
    browser.module("await new Promise((done) => setTimeout(done));")
    assert len(browser.all(".log .msg")) == 1500


def test_an_ended_job_that_has_run_again_meanwhile_shows_what_it_recorded(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, job_id: str
) -> None:
    client.post(f"/jobs/{job_id}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}/log")
    browser.find("[data-state=cancelled]")
    client.post(f"/jobs/{job_id}/retry").raise_for_status()
    with stack.sessions.begin() as session:
        session.add(Log(job_id=job_id, attempt=2, level="info", message="a line of the retry"))
    client.post(f"/jobs/{job_id}/cancel").raise_for_status()
    browser.js("dispatchEvent(new Event('focus'))")
    browser.shows("a line of the retry", ".log", 20)
