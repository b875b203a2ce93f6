"""Use of the dashboard in a real browser, with the real service and a real job."""

from __future__ import annotations

import hashlib
import io
import re
import time
from typing import TYPE_CHECKING, Any

import naopolicies
import pytest
import typer
from naoctl.cli import build_app as naoctl_app
from naojobs.database import notify
from naojobs.models import Log
from naospec import flat
from PIL import Image, ImageChops
from selenium.webdriver.common.keys import Keys

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import httpx
    from conftest import Browser, Stack

TINY: dict[str, Any] = {
    "task.name": "sprint2",
    "algorithm.n_envs": 2,
    "algorithm.n_steps": 32,
    "algorithm.batch_size": 64,
    "algorithm.n_epochs": 1,
    # so much noise that robots fall soon and there are episodes to report
    "algorithm.initial_log_std": 1.0,
    "algorithm.hidden_sizes": [8],
    "runtime.simulator_threads": 1,
    "runtime.learner_threads": 1,
}
"""A very short training: two robots, the smallest network."""
ENDLESS = 10_000_000


def submit(client: httpx.Client, name: str, *, steps: int = 256, tags: tuple[str, ...] = (), **spec: Any) -> str:
    body = {"name": name, "tags": tags, "spec": flat.nest({**TINY, "total_steps": steps, **spec}), "evaluation": None}
    answer = client.post("/jobs", json=body)
    assert answer.status_code == 201, answer.text
    job_id: str = answer.json()["id"]
    return job_id


def park(client: httpx.Client, name: str, **more: Any) -> str:
    """Submit a job that no worker of the tests takes: none runs servers."""
    return submit(client, name, steps=ENDLESS, simulator="server", **more)


def wait_for(client: httpx.Client, job_id: str, *states: str, timeout_s: float = 240) -> dict[str, Any]:
    deadline = time.monotonic() + timeout_s
    while (job := client.get(f"/jobs/{job_id}").json())["state"] not in states:
        assert time.monotonic() < deadline, f"{job_id} is {job['state']}, not {' or '.join(states)}: {job['error']}"
        time.sleep(0.1)
    found: dict[str, Any] = job
    return found


def number(value: float, digits: int = 2) -> str:
    """Return a number as the page shows it."""
    text = f"{value:,.{digits}f}"
    return text.replace("-", "" if float(text.replace(",", "")) == 0 else "\N{MINUS SIGN}")


def flattened(value: Any, path: str = "") -> dict[str, Any]:
    """Return a specification by path with dots."""
    if not isinstance(value, dict):
        return {path: value}
    found: dict[str, Any] = {}
    for key, item in value.items():
        found |= flattened(item, f"{path}.{key}" if path else key)
    return found


def painted(browser: Browser, selector: str) -> int:
    """Return how many pixels of a canvas are not blank."""
    browser.allowed.append("willReadFrequently")  # that is about reading the canvas here
    count: int = browser.js(
        """
        const c = document.querySelector(arguments[0]);
        if (!c || !c.width) return 0;
        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        let n = 0;
        for (let i = 3; i < d.length; i += 4) if (d[i]) n += 1;
        return n;
        """,
        selector,
    )
    return count


def moment(browser: Browser, frame: int) -> Image.Image:
    """Move a replay to one of its frames and return the content of its canvas."""
    browser.set(".replay-bar input[type=range]", str(frame))
    return shot(browser)


def shot(browser: Browser) -> Image.Image:
    """Return what the canvas of a replay shows once it has drawn."""
    browser.module("return new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))")
    return Image.open(io.BytesIO(browser.find(".stage canvas").screenshot_as_png)).convert("RGB")


def choose(browser: Browser, selector: str, value: str) -> None:
    """Choose an entry of a select by its value."""
    browser.js(
        "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('change'))",
        browser.find(selector),
        value,
    )


def choose_text(browser: Browser, selector: str, text: str) -> None:
    """Choose an entry of a select by its text."""
    browser.js(
        "const [s, text] = arguments; s.value = [...s.options].find((o) => o.text === text).value;"
        "s.dispatchEvent(new Event('change'))",
        browser.find(selector),
        text,
    )


@pytest.fixture(scope="module")
def pair(stack: Stack) -> tuple[str, list[dict[str, Any]]]:
    """A token and a group of two jobs, of seeds 0 and 1, that are trained and evaluated."""
    token = stack.make_token("finisher", "submit")
    with stack.client(token) as client:
        job = {
            "name": "first-steps",
            "tags": ["demo"],
            "spec": flat.nest({**TINY, "total_steps": 2048, "checkpoint_interval_steps": 512, "algorithm.n_envs": 8}),
            "evaluation": {"episodes": 12, "trajectories": 8, "bootstrap_resamples": 100},
        }
        answer = client.post("/groups", json={"job": job, "seeds": [0, 1]})
        assert answer.status_code == 201, answer.text
        jobs = [wait_for(client, job["id"], "succeeded", "failed") for job in answer.json()["jobs"]]
    for job in jobs:
        assert job["state"] == "succeeded", job["error"]
    return token, jobs


@pytest.fixture(scope="module")
def finished(pair: tuple[str, list[dict[str, Any]]]) -> tuple[str, dict[str, Any]]:
    """A token and a job that is trained and evaluated."""
    token, jobs = pair
    return token, jobs[0]


def test_sign_in_says_what_is_wrong_and_keeps_the_place(browser: Browser, client: httpx.Client, token: str) -> None:
    job_id = park(client, "waiting")
    browser.allowed.append("401")
    browser.open(f"/jobs/{job_id}/log")
    browser.find("button[type=submit]").click()
    browser.shows("Paste a token first")
    browser.find("#token").send_keys("nao_wrong")
    browser.find("button[type=submit]").click()
    browser.shows("This token is not valid")
    browser.find("#token").clear()
    browser.find("#token").send_keys(token, Keys.ENTER)
    assert browser.find(".log")
    assert browser.text("h1") == "waiting"
    browser.find("button[aria-label='Sign out']").click()
    assert browser.find("#token").get_attribute("value") == ""
    assert browser.js("return [sessionStorage.length, localStorage.getItem('naosprint.token')]") == [0, None]


def test_a_token_in_the_address_signs_in_and_leaves_the_address(browser: Browser, token: str) -> None:
    browser.open(f"/?token={token}")
    browser.shows("No jobs yet")
    assert token not in browser.driver.current_url


def test_a_token_in_the_address_replaces_another_one_only_on_request(
    browser: Browser, stack: Stack, token: str
) -> None:
    other = stack.make_token("somebody-else", "read")
    browser.sign_in(token)
    stored = "return sessionStorage.getItem('naosprint.token') ?? localStorage.getItem('naosprint.token')"
    before = browser.js(stored)
    assert before == token
    for value, expected in (("no", token), ("yes", other)):
        browser.js(f"location.hash = '#/?token={other}'")
        browser.find(f"dialog button[value={value}]").click()
        browser.until(lambda: not browser.js("return document.querySelector('dialog')"))
        assert browser.js(stored) == expected
        assert other not in browser.driver.current_url


def test_empty_pages_say_what_to_do(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    browser.shows("Submit one and watch a robot learn to run")
    browser.open("/compare")
    browser.shows("Nothing to compare yet")
    browser.open("/league")
    browser.shows("No matches yet")
    browser.open("/nowhere")
    browser.shows("There is no such page")
    browser.allowed.append("404")
    browser.open("/jobs/job_00000000000000000000000000")
    browser.shows("Not found")
    browser.open("/workers")
    browser.shows("Alive")


def test_submit_from_the_form_and_watch_it_learn(browser: Browser, token: str, client: httpx.Client) -> None:
    browser.sign_in(token)
    browser.find("main .button.primary").click()
    browser.find("[name='spec.total_steps']")
    for details in browser.all("details"):
        browser.js("arguments[0].open = true", details)
    choose_text(browser, "[name='spec.task.name']", "sprint2")
    for name, value in TINY.items():
        if name != "task.name":
            browser.set(f"[name='spec.{name}']", ", ".join(map(str, value)) if isinstance(value, list) else str(value))
    browser.set("[name='spec.total_steps']", "0.5k")
    browser.set("[name='evaluation.episodes']", "4")
    browser.set("[name='evaluation.bootstrap_resamples']", "100")
    browser.set("[name='name']", "from the form")
    browser.set("[name='tags']", "form, e2e")
    browser.shows("8 of 64 steps", "aside")
    browser.find("aside button[type=submit]").click()
    browser.shows("from the form", "h1")
    job = client.get("/jobs").json()["items"][0]
    assert job["id"] in browser.driver.current_url
    assert job["tags"] == ["form", "e2e"]
    assert {path: value for path, value in flattened(job["spec"]).items() if path in TINY} == TINY
    assert job["spec"]["total_steps"] == 500
    assert job["evaluation"]["episodes"] == 4
    # Nothing is reloaded from here on: everything else comes over the stream.
    browser.shows("Succeeded", ".page-head", timeout_s=240)
    browser.shows("512of 512", ".stats")
    browser.until(lambda: painted(browser, "[data-chart=reward] canvas") > 500, message="no curve was drawn")
    browser.find("[data-tab=log]").click()
    lines = [line["message"] for line in client.get(f"/jobs/{job['id']}/logs").json()["items"]]
    browser.until(lambda: browser.all(".log") and [e.text for e in browser.all(".log .msg")] == lines)
    browser.find("[data-tab=history]").click()
    events = [event["kind"] for event in client.get(f"/jobs/{job['id']}/events").json()["items"]]
    assert {"queued", "running", "succeeded"} <= set(events)
    browser.until(lambda: [e.get_attribute("data-kind") for e in browser.all(".timeline li")] == events[::-1])
    browser.find("[data-tab=evaluation]").click()
    browser.shows("All results", timeout_s=240)


def test_a_task_of_another_package_is_everywhere(browser: Browser, token: str, client: httpx.Client) -> None:
    """Its parameter in the form, its metrics in the list, charts, evaluation and replay: no page contains its name."""
    browser.sign_in(token)
    browser.open("/submit")
    browser.find("[name='spec.task.name']")
    assert not browser.all("[name='spec.task.gait_period_s']")
    choose_text(browser, "[name='spec.task.name']", "run-backwards")
    browser.shows("Run backwards as far as possible", "[data-field='spec.task.name']")
    browser.set("[name='spec.task.gait_period_s']", "0.5")
    assert "gait_period_s" in browser.js("return document.querySelector('aside pre').textContent")
    spec = {**TINY, "task.name": "run-backwards", "task.gait_period_s": 0.5, "total_steps": 1024}
    body = {"name": "backwards", "spec": flat.nest(spec), "evaluation": {"episodes": 4, "bootstrap_resamples": 100}}
    job_id = client.post("/jobs", json=body).json()["id"]
    wait_for(client, job_id, "succeeded")
    browser.open("/")
    browser.shows("Distance backwards", "thead")
    browser.open(f"/jobs/{job_id}")
    browser.shows("Distance backwards", ".stats")
    browser.until(lambda: painted(browser, "[data-chart=backward_m] canvas") > 200, message="no curve was drawn")
    browser.open(f"/jobs/{job_id}/evaluation")
    browser.shows("Speed backwards", ".stack .stats")
    browser.shows("Paths of 4 episodes")
    browser.open(f"/compare?jobs={job_id}")
    browser.shows("Distance backwards m", "thead")
    browser.open(f"/submit?from={job_id}")
    assert browser.find("[name='spec.task.gait_period_s']").get_attribute("value") == "0.5"


def test_the_form_names_the_field_that_is_wrong(browser: Browser, token: str, client: httpx.Client) -> None:
    browser.sign_in(token)
    browser.open("/submit")
    browser.set("[name='spec.total_steps']", "many")
    browser.find("aside button[type=submit]").click()
    browser.shows("Not a number", "[data-field='spec.total_steps']")
    assert browser.js("return document.activeElement.name") == "spec.total_steps"
    browser.set("[name='spec.total_steps']", "0")
    browser.find("aside button[type=submit]").click()
    browser.shows("at least 1", "[data-field='spec.total_steps']")
    browser.set("[name='spec.total_steps']", "1M")
    browser.set("[name='tags']", "not/ok?")
    browser.js("for (const d of document.querySelectorAll('details')) d.open = true")
    browser.set("[name='spec.algorithm.batch_size']", "4095")
    browser.allowed.append("422")
    browser.find("aside button[type=submit]").click()
    browser.shows("The service refused this job")
    browser.until(lambda: browser.all("[data-field] [aria-invalid]"))
    browser.set("[name='tags']", "ok")
    browser.find("aside button[type=submit]").click()
    browser.shows("does not divide", "[data-field='spec.algorithm.batch_size']")
    assert client.get("/jobs").json()["items"] == []


def test_the_form_offers_what_robot_and_simulator_can_do(browser: Browser, token: str, client: httpx.Client) -> None:
    browser.sign_in(token)
    browser.open("/submit")
    browser.find("[name='spec.total_steps']")
    browser.js("for (const d of document.querySelectorAll('details')) d.open = true")

    def choose(section: str, name: str) -> None:
        choose_text(browser, f"[name='spec.{section}.name']", name)

    def offered(*names: str) -> list[bool]:
        fields = (f"[data-field='spec.{name}']" for name in names)
        return [browser.js("return !document.querySelector(arguments[0]).hidden", field) for field in fields]

    settings = ("task.push_mps", "task.torque_penalty", "task.hop_penalty", "algorithm.imitation_steps")
    assert offered(*settings, "task.sensor_noise") == [False] * 4 + [True]
    choose("robot", "t1")
    assert offered(*settings) == [True, True, True, False]
    browser.set("[name='spec.task.push_mps']", "0.5")
    choose("simulator", "server")
    assert offered(*settings) == [False, True, True, False]
    choose("simulator", "embedded")
    choose("task", "velocity")
    browser.set("[name='spec.algorithm.teacher']", "t1-run-steady")
    assert offered("algorithm.imitation_steps") == [True], "a teacher demonstrates, too"
    browser.set("[name='spec.algorithm.teacher']", "")
    assert offered("algorithm.imitation_steps") == [False]
    choose("task", "getup")
    assert offered(*settings) == [True] * 4
    choose("robot", "nao-0")
    assert browser.js("return document.querySelector(\"[name='spec.task.name']\").selectedOptions[0].text") != "getup"
    browser.set("[name='spec.total_steps']", "512")
    browser.find("aside button[type=submit]").click()
    browser.until(lambda: client.get("/jobs").json()["items"])
    (job,) = client.get("/jobs").json()["items"]
    assert job["spec"]["task"].get("push_mps", 0.0) == 0.0, "what was hidden is not sent"


def test_presets_fill_the_form_and_keep_what_was_chosen(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    browser.open("/submit")
    browser.find("[name='spec.seed']")
    browser.js("for (const d of document.querySelectorAll('details')) d.open = true")

    def value(name: str) -> str:
        return browser.find(f"[name='spec.algorithm.{name}']").get_attribute("value") or ""

    browser.set("[name='spec.algorithm.clip_range']", "0.15")
    click = "document.querySelector(arguments[0]).click()"  # the page's head may lie over a field that was scrolled to
    browser.js(click, "input[value=paper]")
    assert (value("n_envs"), value("n_steps"), value("batch_size"), value("clip_range")) == (
        "19",
        "4096",
        "1216",
        "0.15",
    )
    browser.js(click, "[data-field='spec.algorithm.clip_range'] .reset")
    assert value("clip_range") == "0.1"
    browser.js(click, "input[value=fast]")
    assert (value("n_envs"), value("clip_range")) == ("128", "0.2")


def test_several_seeds_make_a_group_to_compare(browser: Browser, token: str, client: httpx.Client) -> None:
    browser.sign_in(token)
    browser.open("/submit")
    browser.find("[name='spec.seed']")
    browser.js("for (const d of document.querySelectorAll('details')) d.open = true")
    choose_text(browser, "[name='spec.simulator.name']", "server")  # which no worker of the tests has
    browser.set("[name='spec.seed']", "0-2")
    browser.js("document.querySelector('#evaluate').click()")
    button = browser.find("aside button[type=submit]")
    assert button.text == "Submit 3 jobs"
    button.click()
    browser.shows("(3)", ".legend")
    jobs = client.get("/jobs").json()["items"]
    assert sorted(job["spec"]["seed"] for job in jobs) == [0, 1, 2]
    assert len({job["group_id"] for job in jobs}) == 1
    assert all(job["evaluation"] is None for job in jobs)
    assert [e.text for e in browser.all("tbody .state")] == ["0 %"] * 3
    # A job that changes changes here, too; what had the focus keeps it.
    browser.find(f"a[href='#/jobs/{jobs[0]['id']}']").send_keys("")
    client.post(f"/jobs/{jobs[0]['id']}/cancel")
    browser.shows("Cancelled", f"tr[data-job={jobs[0]['id']}]")
    assert browser.js("return document.activeElement.getAttribute('href')") == f"#/jobs/{jobs[0]['id']}"


def test_a_comparison_lays_curves_and_evaluations_over_each_other(
    browser: Browser, stack: Stack, pair: tuple[str, list[dict[str, Any]]]
) -> None:
    token, jobs = pair
    with stack.client(token) as client:
        summaries = [client.get(f"/jobs/{job['id']}/evaluations").json()["items"][0]["summary"] for job in jobs]
    column = "All episodes"
    tables = [{c["title"]: c["results"] for c in summary["tables"][0]["columns"]} for summary in summaries]
    means = [[result["value"] for result in table[column]] for table in tables]
    intervals = [[result["interval"] for result in table[column]] for table in tables]
    browser.sign_in(token)
    browser.open(f"/compare?jobs={','.join(job['id'] for job in jobs)}")
    browser.until(lambda: painted(browser, "[data-chart=reward] canvas") > 500, message="no curve was drawn")
    browser.find(f"[data-part=evaluations] button[data-value$='{column}']").click()
    band = "[data-part=evaluations] svg.figure path[opacity='0.16']"
    browser.until(lambda: len(browser.all(band)) == 2, message="not one band for each job")

    def numbers() -> list[list[str]]:
        rows = browser.all("[data-part=evaluations] tbody tr")
        return [[cell.text for cell in row.find_elements("css selector", "td")] for row in rows]

    def shown(mean: float, half: float) -> str:
        return f"{number(mean)}\n± {number(half)}"

    # Of one job: the mean of its episodes with its interval.
    for job, (mean, interval) in enumerate(zip(means, intervals, strict=True)):
        for line, cell in enumerate(numbers()[job]):
            if mean[line] is None:
                assert cell == "\N{EN DASH}"
            elif interval[line] is not None:
                low, high = interval[line]
                assert cell == shown(mean[line], (high - low) / 2)
    # Of a group: the mean of the jobs, with the deviation between them.
    choose(browser, "select[aria-label='Group by']", "settings")
    browser.shows("(2)", ".legend")
    browser.until(lambda: len(browser.all(band)) == 1, message="not one band for the group")
    (row,) = numbers()
    for line, (a, b) in enumerate(zip(*means, strict=True)):
        if a is not None and b is not None:
            assert row[line] == shown((a + b) / 2, abs(a - b) / 2**0.5)
    browser.until(lambda: painted(browser, "[data-chart=reward] canvas") > 500, message="no band was drawn")


def test_a_comparison_of_different_robots_folds_what_differs(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    specs = ({"robot": "nao-0", "task": "sprint1"}, {"robot": "t1", "task": "velocity"})
    made = [client.post("/jobs", json={"spec": spec, "evaluation": None}).json()["id"] for spec in specs]
    for job in made:
        client.post(f"/jobs/{job}/cancel")
    browser.sign_in(token)
    browser.open(f"/compare?jobs={','.join(made)}")
    browser.shows("settings differ", "[data-part=settings]")
    page = browser.js("return document.querySelector('main').textContent")
    assert "null" not in page and "undefined" not in page
    browser.js("document.querySelector('[data-part=settings]').open = true")
    browser.shows("simulator.action_delay", "[data-part=settings]")
    browser.open(f"/jobs/{made[0]}/nothing")
    browser.shows("has no part “nothing”")
    browser.shows("Ran for", ".stats")


def test_pause_resume_and_cancel(browser: Browser, token: str, client: httpx.Client) -> None:
    job_id = submit(client, "long-run", steps=ENDLESS)
    wait_for(client, job_id, "running")
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    browser.find("[data-action=pause]").click()
    browser.shows("Paused", ".page-head", timeout_s=240)
    browser.find("[data-action=resume]").click()
    browser.shows("Running", ".page-head", timeout_s=240)
    browser.find("[data-action=cancel]").click()
    browser.find("dialog button[value=no]").click()
    assert client.get(f"/jobs/{job_id}").json()["cancel_requested"] is False
    browser.find("[data-action=cancel]").click()
    browser.find("dialog button[value=yes]").click()
    browser.shows("Cancelled", ".page-head", timeout_s=240)
    assert client.get(f"/jobs/{job_id}").json()["state"] == "cancelled"
    assert browser.find("[data-action=retry]")
    browser.find("[data-action=delete]").click()
    browser.find("dialog button[value=yes]").click()
    browser.shows("No jobs yet")
    assert client.get(f"/jobs/{job_id}").status_code == 404


def test_the_newest_checkpoint_of_a_running_job_can_be_watched(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    browser.allowed += ["GPU stall", "software WebGL"]
    browser.sign_in(token)
    job_id = submit(client, "still-running", steps=ENDLESS, checkpoint_interval_steps=2048)
    browser.open(f"/jobs/{job_id}/replay")
    record = "button[data-action=record]"
    browser.shows("There is no checkpoint to watch yet")
    assert not browser.find(record).is_enabled()
    # The first checkpoint comes over the stream.
    browser.until(lambda: browser.find(record).is_enabled(), timeout_s=240, message="no checkpoint came")
    browser.find(record).click()
    browser.find(".stage canvas", timeout_s=240)
    (evaluation,) = client.get(f"/jobs/{job_id}/evaluations").json()["items"]
    assert evaluation["state"] == "succeeded"
    assert client.get(f"/jobs/{job_id}").json()["state"] == "running"
    step = next(
        checkpoint["step"]
        for checkpoint in client.get(f"/jobs/{job_id}/checkpoints").json()["items"]
        if checkpoint["id"] == evaluation["checkpoint_id"]
    )
    assert f"Step {step:,}" in browser.text("select[aria-label='Which recording']")
    browser.until(lambda: not browser.text(".replay-time").startswith("0.00"), message="the replay does not run")
    client.post(f"/jobs/{job_id}/cancel")
    wait_for(client, job_id, "cancelled")


def test_reading_goes_on_while_figures_come_in(browser: Browser, token: str, client: httpx.Client) -> None:
    """Focus, open details and scroll position are kept when a job changes."""
    job_id = submit(client, "reader", steps=ENDLESS, checkpoint_interval_steps=2048, tags=("kept",))
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}/checkpoints")
    row = browser.find("tr[data-checkpoint]", timeout_s=240)
    first = row.get_attribute("data-checkpoint")
    row.find_element("css selector", "summary").click()
    browser.js("document.querySelector('.page-head + * .tag, .tag').focus()")
    count = len(browser.all("tr[data-checkpoint]"))
    browser.until(lambda: len(browser.all("tr[data-checkpoint]")) > count, timeout_s=240, message="no checkpoint came")
    opened = browser.find(f"tr[data-checkpoint={first}] details")
    assert opened.get_attribute("open") is not None
    assert browser.js("return document.activeElement.textContent") == "kept"
    client.post(f"/jobs/{job_id}/cancel")
    wait_for(client, job_id, "cancelled")
    browser.shows("Cancelled", ".page-head")
    assert browser.js("return document.activeElement.textContent") == "kept"


def test_the_list_is_live_and_filters(browser: Browser, token: str, client: httpx.Client) -> None:
    browser.sign_in(token)
    browser.shows("No jobs yet")
    first = park(client, "alpha", tags=("red",))
    browser.find(f"tr[data-job={first}]")
    second = park(client, "beta <img src=x onerror=alert(1)>", tags=("blue",))
    browser.shows("beta <img src=x onerror=alert(1)>", "tbody")
    for job_id in (first, second):
        browser.find(f"tr[data-job={job_id}] [data-state=queued]")
        client.post(f"/jobs/{job_id}/cancel")
        browser.find(f"tr[data-job={job_id}] [data-state=cancelled]")
    order = [row.get_attribute("data-job") for row in browser.all("tbody tr")]
    assert order == [second, first]
    browser.find(f"tr[data-job={first}] .tag").click()
    browser.until(lambda: len(browser.all("tbody tr")) == 1)
    browser.find(".filters button[aria-label*='Stop filtering']").click()
    browser.until(lambda: len(browser.all("tbody tr")) == 2)
    browser.find("input[type=search]").send_keys("alph")
    browser.until(lambda: [r.get_attribute("data-job") for r in browser.all("tbody tr")] == [first])
    browser.find("input[type=search]").send_keys("xyz")
    browser.shows("No matching jobs")
    client.delete(f"/jobs/{second}")
    browser.open("/")
    browser.until(lambda: [r.get_attribute("data-job") for r in browser.all("tbody tr")] == [first])
    client.delete(f"/jobs/{first}")
    browser.shows("No jobs yet")


def test_any_setting_is_a_column_and_sorts(browser: Browser, token: str, client: httpx.Client) -> None:
    for seed in (31, 7):
        spec = {"task": "sprint2", "total_steps": 64, "seed": seed, "robot": "t1"}
        body = {"name": f"column {seed}", "spec": spec, "not_before": "2099-01-01T00:00:00Z"}
        client.post("/jobs", json=body).raise_for_status()
    browser.sign_in(token)
    browser.open("/?q=t1")
    browser.until(lambda: len(browser.all("tr[data-job]")) == 2, message="only those of the robot")
    browser.js("document.querySelector('details.menu').open = true")
    for name, problem in (("no such setting", True), ("seed", False)):
        browser.find("#column-name").clear()
        browser.find("#column-name").send_keys(name)
        browser.find(".menu-list button[type=submit]").click()
        assert browser.js("return Boolean(document.querySelector('#column-name:user-invalid'))") == problem
    browser.js("document.querySelector('details.menu').open = false")
    browser.find("button[data-sort='own:seed']").click()
    browser.until(lambda: [cell.text for cell in browser.all("td[data-own=seed]")] == ["7", "31"])
    browser.js("location.reload()")
    browser.until(lambda: [cell.text for cell in browser.all("td[data-own=seed]")] == ["7", "31"])
    for job in client.get("/jobs", params={"q": "column"}).json()["items"]:
        client.post(f"/jobs/{job['id']}/cancel").raise_for_status()


def test_everything_works_with_the_keyboard_alone(browser: Browser, token: str, client: httpx.Client) -> None:
    ids = [park(client, f"job-{i}") for i in range(3)]
    browser.sign_in(token)
    browser.until(lambda: len(browser.all("tbody tr")) == 3)
    press: Callable[..., None] = lambda *keys: browser.driver.switch_to.active_element.send_keys(*keys)  # noqa: E731
    press("j")
    press("j")
    assert browser.js("return document.activeElement.closest('tr').dataset.job") == ids[1]
    press("x")
    press("k")
    press("x")
    assert "2 selected" in browser.text(".select-bar")
    press(Keys.ENTER)
    browser.shows("job-2", "h1")
    press("g")
    press("c")
    browser.shows("Nothing to compare yet")
    press("?")
    browser.shows("All jobs", "dialog")
    press(Keys.ESCAPE)
    browser.until(lambda: not browser.all("dialog"))
    press("n")
    browser.find("[name='spec.task.name']")
    press("g")
    press("j")
    browser.until(lambda: len(browser.all("tbody tr")) == 3)
    press("/")
    assert browser.js("return document.activeElement.type") == "search"
    press(Keys.ESCAPE)
    before = browser.js("return getComputedStyle(document.body).backgroundColor")
    press("t")
    press("t")
    assert browser.js("return getComputedStyle(document.body).backgroundColor") != before
    # Every control is reached by Tab and shows where the focus is.
    browser.open("/")
    browser.until(lambda: len(browser.all("tbody tr")) == 3)
    reached = set()
    for _ in range(70):
        press(Keys.TAB)
        reached.add(browser.js("const a = document.activeElement; return a.textContent || a.ariaLabel || a.type"))
        assert browser.js(
            "const a = document.activeElement;"
            "return a === document.body || getComputedStyle(a).outlineStyle !== 'none' || a.type === 'checkbox'"
        )
    assert {"Jobs", "Compare", "Workers", "Policies", "New job", "All", "Failed", "job-0"} <= reached


def test_checkpoints_download_as_they_were_stored(
    browser: Browser, stack: Stack, finished: tuple[str, dict[str, Any]]
) -> None:
    token, job = finished
    browser.driver.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(browser.downloads)}
    )
    browser.sign_in(token)
    browser.open(f"/jobs/{job['id']}/checkpoints")
    with stack.client(token) as client:
        newest = client.get(f"/jobs/{job['id']}/checkpoints").json()["items"][0]
    row = browser.find(f"tr[data-checkpoint={newest['id']}]")
    row.find_element("css selector", "summary").click()
    for file in newest["files"]:
        browser.find(f"tr[data-checkpoint={newest['id']}] button[aria-label='Download {file['name']}']").click()
        path = browser.downloads / file["name"].rsplit("/", 1)[-1]
        browser.until(lambda path=path, size=file["size"]: path.exists() and path.stat().st_size == size)
        assert hashlib.sha256(path.read_bytes()).hexdigest() == file["sha256"]
    row.find_element("xpath", ".//button[contains(., 'Download') and not(@aria-label)]").click()
    tar = browser.downloads / f"{job['name']}-{newest['step']}.tar"
    browser.until(lambda: tar.exists() and tar.stat().st_size > newest["size"])


def test_the_evaluation_shows_the_service_s_numbers(
    browser: Browser, stack: Stack, finished: tuple[str, dict[str, Any]]
) -> None:
    token, job = finished
    with stack.client(token) as client:
        evaluation = client.get(f"/jobs/{job['id']}/evaluations").json()["items"][0]
    results = {result["title"]: result for result in evaluation["summary"]["results"]}
    browser.sign_in(token)
    browser.open(f"/jobs/{job['id']}/evaluation")
    lines = browser.text(".stack .stats").splitlines()
    said = {lines[i]: lines[i + 1 : i + 3] for i in range(0, len(lines), 3)}
    by_name = {result["name"]: result["title"] for result in results.values()}
    assert list(said) == [by_name[name] for name in evaluation["summary"]["headline"]]
    falls, deviation = results["Falls"], results["Deviation"]
    low, high = falls["interval"]
    assert said["Falls"] == [f"{falls['value'] * 100:.1f}%", f"{low * 100:.1f} to {high * 100:.1f}"]
    assert said["Deviation"] == [f"{number(deviation['value'])}°", f"sd {number(deviation['sd'])}°"]
    browser.js("for (const d of document.querySelectorAll('details')) d.open = true")
    assert len(browser.all("[data-part=results] tbody tr")) == len(results)
    assert [e.get_attribute("data-table") for e in browser.all("[data-table]")] == [
        table["name"] for table in evaluation["summary"]["tables"]
    ]
    browser.shows("Paths of 8 episodes")
    browser.until(lambda: len(browser.all("svg g[data-episode]")) == 8, message="not all paths are drawn")
    browser.until(lambda: len(browser.all("svg[aria-label^='Ground contact'] rect")) > 2, message="no contact is drawn")
    choose(browser, "select[aria-label=Episode]", "3")
    browser.until(lambda: browser.all("svg g[data-episode='3'] path[stroke-width='2.25']"))
    browser.until(lambda: painted(browser, "[data-chart='Torso height'] canvas") > 200)


def test_a_finished_job_shows_its_evaluation_in_list_and_tiles(
    browser: Browser, stack: Stack, finished: tuple[str, dict[str, Any]]
) -> None:
    token, job = finished
    with stack.client(token) as client:
        result = client.get(f"/jobs/{job['id']}").json()["result"]
    values = {item["name"]: item for item in result["results"]}
    browser.sign_in(token)
    cells = f"tr[data-job='{job['id']}'] td[data-label='Distance']"
    browser.until(lambda: browser.text(cells).startswith(number(values["distance_m"]["value"])))
    assert "training" not in browser.text(cells)
    assert browser.find(cells).get_attribute("title") == "Evaluation of 12 episodes"
    browser.open(f"/jobs/{job['id']}")
    browser.shows("12 episodes", ".stats")
    assert number(values["distance_m"]["value"]) in browser.text(".stats")
    assert "in training" not in browser.text(".stats")
    browser.open(f"/jobs/{job['id']}/evaluation")
    browser.shows("All results")
    browser.js("for (const d of document.querySelectorAll('details')) d.open = true")
    score = values.get("run_challenge_score") or {"value": None}
    with stack.client(token) as client:
        (evaluation,) = client.get(f"/jobs/{job['id']}/evaluations").json()["items"]
    explained = [r["description"] for r in evaluation["summary"]["results"] if r["value"] == 0 and r["description"]]
    assert explained or score["value"]
    for description in explained:
        browser.shows(description, "[data-part=results]")


def test_a_job_that_no_worker_can_run_says_why(browser: Browser, token: str, client: httpx.Client) -> None:
    job_id = park(client, "impossible")
    reason = client.get(f"/jobs/{job_id}").json()["waiting_reason"]
    assert "server" in reason
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}")
    browser.shows(reason[1:], "[data-part=waiting]")
    client.post(f"/jobs/{job_id}/cancel")
    browser.until(lambda: not browser.all("[data-part=waiting]"), message="the reason stays after the job has ended")


def test_the_replay_plays_a_recorded_episode(
    browser: Browser, stack: Stack, finished: tuple[str, dict[str, Any]]
) -> None:
    token, job = finished
    with stack.client(token) as client:
        files = client.get(f"/jobs/{job['id']}/evaluations").json()["items"][0]["files"]
        replay = client.get(next(file["url"] for file in files if file["name"] == "replay.json")).json()
    browser.allowed += ["GPU stall", "software WebGL"]
    browser.sign_in(token)
    browser.open(f"/jobs/{job['id']}/replay")
    browser.find(".stage canvas")
    last = replay["frames"] - 1
    first, end = moment(browser, 0), moment(browser, last)
    assert len(first.getcolors(1 << 24) or []) > 200, "the canvas is blank"
    # The start line's amber is visible on the turf with any depth resolution of the renderer.
    amber = sum(n for n, (r, g, b) in first.getcolors(1 << 24) or [] if r > 130 and 60 < g < r - 25 and b < 70)
    assert amber > 500, f"the start line is not seen: {amber} pixels of its colour"
    assert ImageChops.difference(first, end).getbbox(), "the first frame looks like the last"
    assert not ImageChops.difference(first, moment(browser, 0)).getbbox(), "the same frame looks different"
    assert browser.text(".replay-time") == f"0.00 / {last * replay['dt_s']:.2f} s"
    browser.find(".segments button[data-value=side]").click()
    assert ImageChops.difference(first, shot(browser)).getbbox(), "the camera did not move"
    browser.find("[data-action=play]").click()
    browser.until(lambda: not browser.text(".replay-time").startswith("0.00"), message="the replay does not run")
    browser.find(".stage").send_keys(Keys.SPACE)
    browser.find(".stage").send_keys(Keys.HOME, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert browser.text(".replay-time").startswith("0.04")
    shown = browser.text(".stats.flat")
    assert f"{replay['position_m'][2][2]:.3f} m" in shown


def test_the_bundled_policies_are_listed_with_their_results(browser: Browser, token: str, client: httpx.Client) -> None:
    cards = client.get("/policies").json()["items"]
    assert [card["name"] for card in cards] == list(naopolicies.names())
    browser.allowed += ["GPU stall", "software WebGL"]
    browser.sign_in(token)
    browser.find("#top nav a[href='#/policies']").send_keys(Keys.ENTER)
    browser.until(lambda: browser.all("[data-policy]"), message="no policy is shown")
    found = sorted(str(e.get_attribute("data-policy")) for e in browser.all("[data-policy]"))
    assert found == sorted(card["name"] for card in cards)
    assert [e.text for e in browser.all(".policies thead th")] == [
        "Robot",
        "Sprint",
        "Follow a velocity",
        "Kick",
        "Stand up",
        "Dribble",
        "Keep goal",
    ]
    assert browser.text("#top nav a[aria-current=page]") == "Policies"
    for card in cards:
        shown = browser.text(f"[data-policy={card['name']}]")
        results = {result["name"]: result for result in card["results"]}
        main = [results[name] for name in card["headline"][:2]]
        for words in (
            card["sentence"],
            *(result["title"] for result in main),
            *(number(result["value"], result["digits"]) for result in main if result["unit"] != "%"),
        ):
            assert words in shown, (card["name"], words)

    def names() -> list[str]:
        return [str(e.get_attribute("data-policy")) for e in browser.all("[data-policy]")]

    browser.set("input[aria-label='Search policies']", "pushed slippery")
    pushed = {card["name"] for card in cards if {"pushed", "slippery"} <= set(re.findall("[a-z]+", card["sentence"]))}
    assert {"k1-run", "t1-run-firm"} <= pushed < {card["name"] for card in cards}
    browser.until(lambda: set(names()) == pushed)
    browser.find("[data-filter=robot]").send_keys("Booster K1")
    browser.until(lambda: names() == ["k1-run"])
    browser.open("/policies?robot=t1&skill=Kick")
    browser.until(lambda: names() == ["t1-kick", "t1-kick-firm"], message="the address does not filter")
    browser.open("/policies")
    browser.find("button[aria-label='Watch t1-kick']").click()
    browser.find("dialog .stage canvas")
    browser.driver.switch_to.active_element.send_keys(Keys.ESCAPE)
    browser.until(lambda: not browser.all("dialog"), message="the film stays open")
    # By keyboard alone to the page of the first, and back.
    browser.js("document.querySelector('[data-policy] a').focus()")
    browser.driver.switch_to.active_element.send_keys(Keys.ENTER)
    browser.shows("t1-sprint", "h1")
    browser.driver.switch_to.active_element.send_keys("g")
    browser.driver.switch_to.active_element.send_keys("p")
    browser.shows("Policies", "h1")


def test_a_bundled_policy_runs_and_is_described(browser: Browser, token: str, client: httpx.Client) -> None:
    policy = client.get("/policies/sprint").json()
    replay = client.get("/policies/sprint/replay").json()
    browser.allowed += ["GPU stall", "software WebGL"]
    browser.sign_in(token)
    browser.open("/policies/sprint")
    browser.find(".stage canvas")
    browser.find("[data-action=play]").click()
    last = replay["frames"] - 1
    first, end = moment(browser, 0), moment(browser, last)
    assert len(first.getcolors(1 << 24) or []) > 200, "the canvas is blank"
    assert ImageChops.difference(first, end).getbbox(), "the first frame looks like the last"
    assert not ImageChops.difference(first, moment(browser, 0)).getbbox(), "the same frame looks different"
    assert browser.text(".replay-time") == f"0.00 / {last * replay['dt_s']:.2f} s"

    def cells(part: str) -> dict[str, list[str]]:
        rows = browser.all(f"[data-part={part}] tbody tr")
        texts = [[cell.text for cell in row.find_elements("css selector", "th, td")] for row in rows]
        return {text[0]: text[1:] for text in texts}

    said = cells("results")
    assert [title.splitlines()[0] for title in said] == [result["title"] for result in policy["results"]]
    speed = next(result for result in policy["results"] if result["name"] == "speed_mps")
    assert said[speed["title"]] == [
        f"{number(speed['value'])} m/s",
        " to ".join(map(number, speed["interval"])),
        *(number(speed[key]) for key in ("sd", "low", "high")),
        f"{speed['episodes']:,}",
    ]
    for one in policy["lineage"]:
        assert f"{one['steps']:,}" in cells("lineage")[one["job"]]
    # Every setting of the specification, named as the form names it once the service has answered.
    browser.until(lambda: browser.all(".spec-columns .unit"), message="the form's names and units are not shown")
    assert len(browser.all(".spec-columns .pair")) == len(flattened(policy["spec"])) + len(
        flattened(policy["evaluation"])
    )
    # The commands on the page are those of naoctl.
    commands = dict(typer.main.get_command(naoctl_app()).commands["policies"].commands)  # type: ignore[attr-defined]
    typed = [e.text.split() for e in browser.all("main li code") if e.text.startswith("naoctl policies")]
    assert {words[2] for words in typed} == {"evaluate", "replay", "export"} <= set(commands)
    browser.until(lambda: painted(browser, "[data-chart=speed_mps] canvas") > 200, message="no curve was drawn")


def test_policies_say_what_is_wrong(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    browser.allowed += ["404", "ERR_BLOCKED_BY_CLIENT"]
    browser.open("/policies/sprnt")
    browser.shows("bundled policies are k1-getup")
    browser.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["*/policies"]})
    try:
        browser.open("/policies")
        browser.shows("The service does not answer")
    finally:
        browser.driver.execute_cdp_cmd("Network.setBlockedURLs", {"urls": []})
    browser.find("main button.primary").click()
    browser.until(lambda: browser.all("[data-policy=sprint]"))


def test_a_checkpoint_becomes_a_policy_that_is_compared_and_promoted(
    browser: Browser, stack: Stack, finished: tuple[str, dict[str, Any]]
) -> None:
    token, job = finished
    browser.sign_in(token)
    browser.open(f"/jobs/{job['id']}/checkpoints")
    browser.until(lambda: len(browser.all("tr[data-checkpoint]")) > 1, message="there are not two checkpoints")
    for place, aliases in ((0, "best"), (-1, "")):
        row = browser.all("tr[data-checkpoint]")[place]
        next(b for b in row.find_elements("css selector", "button") if b.text == "Register").click()
        browser.set("#policy-name", "runner")
        if aliases:
            browser.set("#policy-aliases", aliases)
        browser.find("dialog button[type=submit]").click()
        browser.until(lambda: not browser.all("dialog.modal"), message="the dialog stays open")
    with stack.client(token) as client:
        assert [card["aliases"] for card in client.get("/policies/runner/versions").json()["items"]] == [[], ["best"]]
        browser.open("/policies")
        browser.shows("runner@2", "[data-policy=runner]")
        for name in ("runner", "sprint"):
            box = browser.find(f"[data-policy={name}] input[type=checkbox]")
            browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", box)
            box.click()
        browser.find("a[href*='policies-compared']").click()
        browser.shows("runner@2", "[data-part=comparison] thead")
        browser.shows("Started from", "[data-part=comparison]")
        browser.open("/policies/runner")
        browser.find("[data-version='2'] button").click()
        browser.find("dialog button[type=submit]").click()
        browser.shows("best", "[data-version='2']")
        assert client.get("/policies/runner@best").json()["version"] == 2
        assert client.delete("/policies/runner").status_code == 204


def test_lineage_leads_from_a_checkpoint_to_the_job_that_continues_it(
    browser: Browser, stack: Stack, finished: tuple[str, dict[str, Any]]
) -> None:
    token, job = finished
    browser.sign_in(token)
    browser.open(f"/jobs/{job['id']}/checkpoints")
    browser.find("a[href*='parent=']").click()
    browser.shows("Starts from a trained policy")
    browser.set("[name='spec.total_steps']", "512")
    browser.set("[name='name']", "second-steps")
    browser.find("aside button[type=submit]").click()
    browser.shows("second-steps", "h1")
    browser.find("[data-tab=history]").click()
    browser.shows("first-steps", ".tree")
    browser.shows("second-steps", ".tree .tree")
    with stack.client(token) as client:
        child = client.get("/jobs", params={"parent": job["id"]}).json()["items"][0]
        assert child["parent_checkpoint_id"]
        client.post(f"/jobs/{child['id']}/cancel")


def test_a_lost_connection_is_told_and_mends_itself(
    browser: Browser, stack: Stack, token: str, client: httpx.Client
) -> None:
    browser.sign_in(token)
    browser.find(".link-state[data-state=live]")
    browser.allowed += [
        "ERR_CONNECTION_REFUSED",
        "ERR_EMPTY_RESPONSE",
        "ERR_INCOMPLETE_CHUNKED_ENCODING",
        "ERR_CONNECTION_RESET",
    ]
    stack.stop_api()
    try:
        browser.find(".link-state[data-state=offline]")
        browser.js("location.hash = '#/workers'")
        browser.shows("The service does not answer")
    finally:
        stack.start_api()
    browser.find("main button.primary").click()
    browser.shows("Alive")
    browser.open("/")
    browser.find(".link-state[data-state=live]")
    stack.stop_api()
    browser.find(".link-state[data-state=offline]")
    stack.start_api()
    browser.find(".link-state[data-state=live]")
    job_id = park(client, "after the outage")
    browser.find(f"tr[data-job={job_id}]")


def test_the_log_follows_its_end_and_filters(browser: Browser, stack: Stack, token: str, client: httpx.Client) -> None:
    job_id = park(client, "talker")

    def say(*messages: str, level: str = "info") -> None:
        with stack.sessions.begin() as session:
            session.add_all(Log(job_id=job_id, attempt=1, level=level, message=message) for message in messages)
            notify(session, job_id)

    say(*(f"line {i}" for i in range(1500)))
    browser.sign_in(token)
    browser.open(f"/jobs/{job_id}/log")
    browser.shows("line 1499", ".log")
    assert browser.text(".log .mark") == "Show earlier lines"
    say("<b>not bold</b>", level="warning")
    browser.shows("<b>not bold</b>", ".log")
    at_end = "const b = document.querySelector('.log'); return b.scrollHeight - b.scrollTop - b.clientHeight < 4"
    browser.until(lambda: browser.js(at_end), message="the log did not follow its end")
    browser.js("document.querySelector('.log').scrollTop = 0")
    browser.until(lambda: browser.all(".card-head button:not([hidden])"))
    say("while reading above")
    browser.until(lambda: "while reading above" in browser.js("return document.querySelector('.log').textContent"))
    assert browser.js("return document.querySelector('.log').scrollTop") == 0
    choose(browser, ".card-head select", "30")
    browser.until(lambda: [e.text for e in browser.all(".log .msg")] == ["<b>not bold</b>"])


@pytest.fixture(scope="module")
def study(stack: Stack, finished: tuple[str, dict[str, Any]]) -> str:
    """The id of a finished study of the same owner, with two objectives and enough trials for the importance."""
    with stack.client(finished[0]) as client:
        job = {"spec": flat.nest({**TINY, "total_steps": 512, "algorithm.n_envs": 8}), "evaluation": None}
        space = {
            "learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True},
            "hidden_sizes": {"type": "choice", "choices": [[4], [8]]},
        }
        search = {
            "space": space,
            "objectives": [{"metric": "distance_m"}, {"metric": "fall_rate"}],
            "trials": 6,
            "parallel": 2,
        }
        answer = client.post("/studies", json={"job": job, "search": search, "name": "two-objectives"})
        assert answer.status_code == 201, answer.text
        study_id: str = answer.json()["id"]
        deadline = time.monotonic() + 240
        while (found := client.get(f"/studies/{study_id}").json())["state"] == "running":
            assert time.monotonic() < deadline, found
            time.sleep(0.2)
    assert found["state"] == "finished", found["error"]
    return study_id


def test_a_study_shows_trials_curves_importance_and_front(
    browser: Browser, finished: tuple[str, dict[str, Any]], study: str
) -> None:
    browser.sign_in(finished[0])
    browser.open("/studies")
    browser.find(f"a[href='#/studies/{study}']").click()
    browser.shows("two-objectives", "h1")
    for part in ("curves", "coordinates", "front", "importance", "trials"):
        browser.find(f"[data-part={part}]")
    assert len(browser.all("[data-part=trials] tbody tr")) == 6
    assert len(browser.all("[data-part=coordinates] svg path")) == 6
    assert len(browser.all("[data-part=front] circle")) == 6
    assert browser.all("[data-part=trials] .tag"), "no trial is marked as best"


def test_a_checkpoint_is_filmed_and_the_report_opens(
    browser: Browser, stack: Stack, finished: tuple[str, dict[str, Any]]
) -> None:
    """A worker draws it; the tab opens it without a reload."""
    token, job = finished
    with stack.client(token) as client:
        checkpoint = client.get(f"/jobs/{job['id']}/checkpoints").json()["items"][0]["id"]
        browser.sign_in(token)
        browser.open(f"/jobs/{job['id']}/checkpoints")
        browser.find(f"tr[data-checkpoint='{checkpoint}'] button[title^='Run a few']").click()
        browser.shows("will be filmed", "#toasts")
        browser.open(f"/jobs/{job['id']}/report")
        browser.find("iframe.report", 400)
        (asked,) = [each for each in client.get(f"/jobs/{job['id']}/evaluations").json()["items"] if each["report"]]
    assert (asked["checkpoint_id"], asked["spec"]["episodes"]) == (checkpoint, 5)
    assert {"report.html", "run.mp4", "replay.json"} <= {file["name"] for file in asked["files"]}
    assert "Film" in [e.text for e in browser.all(".card-head button")]
    assert browser.find("button[data-action=report]").is_enabled()


def test_a_study_is_started_and_cancelled_in_the_browser(browser: Browser, token: str, client: httpx.Client) -> None:
    browser.allowed += ["422"]
    browser.sign_in(token)
    browser.open("/studies")
    browser.find("a[href='#/submit?study=1']").click()
    browser.shows("New study", "h1")
    browser.set("#f-spec-total-steps" if browser.all("#f-spec-total-steps") else "#f-spec-total_steps", "100M")
    values = "input[aria-label='Values of the setting']"
    browser.set(values, "5..1")
    browser.find("form button[type=submit]").click()
    browser.shows("Write a lower and a higher number", "[data-part=space]")
    browser.set(values, "1e-4..20:log")
    browser.find("form button[type=submit]").click()
    browser.shows("learning_rate", "[data-part=space]")  # the service names the setting whose values it refuses
    browser.set(values, "1e-4..1e-2:log")
    browser.set("#f-search-trials", "3")
    browser.set("#f-name", "from-the-form")
    browser.find("form button[type=submit]").click()
    browser.shows("from-the-form", "h1")
    (study,) = client.get("/studies", params={"q": "from-the-form"}).json()["items"]
    space = {"algorithm.learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True, "step": None}}
    assert (study["spec"]["space"], study["spec"]["trials"]) == (space, 3)
    assert [goal["metric"] for goal in study["spec"]["objectives"]] == ["top_speed_mps"]
    next(e for e in browser.all(".page-head button") if e.text == "Cancel").click()
    browser.find("dialog button[value=yes]").click()
    browser.until(lambda: client.get(f"/studies/{study['id']}").json()["state"] == "cancelled")


PAGES = (
    "/",
    "/submit",
    "/submit?study=1",
    "/studies",
    "study",
    "/league",
    "/workers",
    "/policies",
    "/policies/sprint",
    "job",
    "job/log",
    "job/history",
    "job/checkpoints",
    "job/evaluation",
    "job/replay",
    "job/report",
    "job/spec",
    "compare",
    "group",
    "/compare?empty",
    "/?state=failed",
    "/nowhere",
)


# An evaluation's button grows with its age.
OLDER = """
for (const age of document.querySelectorAll("[data-evaluation] .muted")) age.textContent = "59 min ago";
"""
WIDE = """
return [...document.body.querySelectorAll("*")]
  .filter((element) => element.getBoundingClientRect().right > arguments[0] && !element.closest(".scroll-x"))
  .map((element) => element.outerHTML.slice(0, 160));
"""


@pytest.mark.parametrize(
    ("width", "theme"), [(1440, "light"), (1440, "dark"), (768, "light"), (360, "light"), (360, "dark")]
)
def test_every_page_in_both_themes_and_widths(
    browser: Browser, finished: tuple[str, dict[str, Any]], study: str, pictures: Path, theme: str, width: int
) -> None:
    token, job = finished
    browser.allowed += ["GPU stall", "software WebGL"]
    browser.size(width, 900 if width > 600 else 740)
    axe = (pictures.__class__(__file__).parent / "vendor" / "axe-core-4.14.1" / "axe.min.js").read_text()
    found: dict[str, list[str]] = {}

    def look(page: str) -> None:
        overflow = browser.js("return document.documentElement.scrollWidth") - width
        assert overflow <= 0, f"{page} is {overflow} px wider than the view of {width} px: {browser.js(WIDE, width)}"
        name = re.sub(r"[^a-z]+", "-", page).strip("-") or "jobs"
        browser.picture(pictures / f"{name}-{width}-{theme}.png")
        browser.js(axe)
        result = browser.module("return await axe.run(document, { resultTypes: ['violations'] })")
        if result["violations"]:
            found[page] = [f"{v['id']}: {v['nodes'][0]['html'][:160]}" for v in result["violations"]]

    browser.open()
    browser.theme(theme)
    browser.find("#token")
    look("sign-in")
    browser.sign_in(token)
    for page in PAGES:
        place = {
            "compare": f"/compare?jobs={job['id']}",
            "group": f"/compare?group={job['group_id']}",
            "study": f"/studies/{study}",
        }.get(page, page.replace("job", f"/jobs/{job['id']}", 1))
        browser.open(place)
        browser.find("h1")
        browser.until(lambda: not browser.all(".loading"), message=f"{page} never finished loading")
        assert not browser.all(".sign-in, .empty[role=alert]"), f"{page} shows no content"
        browser.js(OLDER)
        look(page)
    assert found == {}


def test_tables_scroll_inside_their_box_on_a_phone(
    browser: Browser, finished: tuple[str, dict[str, Any]], study: str
) -> None:
    token, job = finished
    browser.size(390, 844)
    browser.sign_in(token)
    for place in (
        f"/jobs/{job['id']}/checkpoints",
        f"/compare?group={job['group_id']}",
        "/workers",
        f"/studies/{study}",
    ):
        browser.open(place)
        browser.find(".scroll-x table")
        browser.until(lambda: not browser.all(".loading"))
        boxes = browser.js(
            """
            return [...document.querySelectorAll(".scroll-x")].filter((box) => box.clientWidth).map((box) => {
              box.scrollLeft = 10_000;
              const [inner, outer] = [box.firstElementChild, box].map((e) => e.getBoundingClientRect());
              return { wider: inner.width - outer.width, end: inner.right - outer.right, outer: outer.right };
            });
            """
        )
        assert any(box["wider"] > 1 for box in boxes), f"no table of {place} is wider than a phone"
        assert all(box["outer"] <= 390 for box in boxes), f"{place}: {boxes}"
        assert all(abs(box["end"]) < 1 for box in boxes if box["wider"] > 1), (
            f"{place} does not scroll to its end: {boxes}"
        )
        assert browser.js("return document.documentElement.scrollWidth") <= 390, place


def test_ids_and_names_are_shown_without_ligatures(browser: Browser, token: str, client: httpx.Client) -> None:
    """Inter shows `64x64` with a multiplication sign and `->` as an arrow, unless ligatures are off."""
    job_id = park(client, "64x64->0x10")
    browser.sign_in(token)
    for place, selectors in (
        ("/", [f"tr[data-job={job_id}] a"]),
        (f"/jobs/{job_id}", ["h1", ".crumbs .mono"]),
        (f"/compare?jobs={job_id}", [".compare-name a"]),
    ):
        browser.open(place)
        for selector in selectors:
            variant = browser.js("return getComputedStyle(arguments[0]).fontVariantLigatures", browser.find(selector))
            assert variant == "none", f"{place} {selector}"


def test_the_first_view_is_small_and_safe(browser: Browser, stack: Stack, token: str, client: httpx.Client) -> None:
    page = client.get("/")
    policy = page.headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "unsafe" not in policy
    browser.driver.execute_cdp_cmd("Network.clearBrowserCache", {})
    browser.received()
    browser.sign_in(token)
    browser.shows("No jobs yet")
    sent = browser.received()
    static = {url: size for url, size in sent.items() if "/ui/" in url or url == f"{stack.url}/"}
    assert len(static) > 8
    assert not [url for url in static if "three" in url]
    size = sum(static.values())
    print(f"the first view takes {size:,} bytes in {len(static)} answers")  # noqa: T201
    assert size > 50_000, "the browser had it already"
    assert size < 300_000, f"the first view takes {size} bytes: {static}"
