"""The list of jobs as a working tool: sign-in in several tabs, order, columns, bulk actions, a thousand rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from naojobs.ids import new_id
from naojobs.models import Job
from sqlalchemy import delete, insert

if TYPE_CHECKING:
    import httpx
    from conftest import Browser, Stack

WAITING: dict[str, Any] = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}
"""A job that no worker of the tests takes: none runs servers."""


def park(client: httpx.Client, name: str, tags: tuple[str, ...] = ()) -> str:
    """Submit a job that waits; return its id."""
    job_id: str = client.post("/jobs", json={"name": name, "tags": tags, **WAITING}).json()["id"]
    return job_id


def listed(browser: Browser) -> list[str]:
    """Return the names of the jobs in the order of their rows."""
    return [element.text for element in browser.all("tbody tr[data-job] .name > a")]


def test_sign_in_extends_to_a_new_tab_and_sign_out_to_all(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    driver = browser.driver
    first = driver.current_window_handle
    driver.switch_to.new_window("tab")
    try:
        browser.open("/workers")
        browser.shows("Alive")
        assert browser.js("return localStorage.getItem('naosprint.token')") is None, (
            "it is kept by no storage of all tabs"
        )
        browser.find("button[aria-label='Sign out']").click()
        browser.find("#token")
    finally:
        driver.close()
        driver.switch_to.window(first)
    browser.find("#token")


def test_the_list_sorts_hides_columns_and_finds_tags(browser: Browser, token: str, client: httpx.Client) -> None:
    for name, tags in (("beta", ("left",)), ("alpha", ("right-foot",)), ("gamma", ())):
        park(client, name, tags=tags)
    browser.sign_in(token)
    browser.until(lambda: listed(browser) == ["gamma", "alpha", "beta"], message="not the newest first")
    browser.find("button[data-sort=name]").click()
    browser.until(lambda: listed(browser) == ["alpha", "beta", "gamma"], message="not sorted by name")
    assert browser.find("th:has([data-sort=name])").get_attribute("aria-sort") == "ascending"
    browser.find("button[data-sort=name]").click()
    browser.until(lambda: listed(browser) == ["gamma", "beta", "alpha"], message="not in reverse")
    assert "sort=-name" in browser.driver.current_url
    browser.find(".menu summary").click()
    browser.find(".menu input[name=owner]").click()
    browser.until(lambda: not any(e.is_displayed() for e in browser.all("td.owner, [data-sort=owner]")))
    browser.open("/")
    browser.until(lambda: len(listed(browser)) == 3)
    assert not any(e.is_displayed() for e in browser.all("td.owner")), "the choice of columns was forgotten"
    browser.find("input[type=search]").send_keys("right-f")
    browser.until(lambda: listed(browser) == ["alpha"], message="a tag is not found")


def test_the_list_filters_groups_and_keeps_views(browser: Browser, token: str, client: httpx.Client) -> None:
    def add(name: str, task: str, robot: str) -> None:
        spec = {**WAITING["spec"], "task": task, "robot": robot}
        assert client.post("/jobs", json={"name": name, "spec": spec, "evaluation": None}).status_code == 201

    def pick(name: str, value: str) -> None:
        script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('change'))"
        browser.js(script, browser.find(f"[data-filter={name}]"), value)

    for name, task, robot in (("one", "sprint1", "t1"), ("two", "sprint1", "nao-2"), ("three", "sprint2", "t1")):
        add(name, task, robot)
    group = {"job": {"name": "swept", **WAITING}, "seeds": [0, 1]}
    group_id = client.post("/groups", json=group).json()["id"]
    browser.sign_in(token)
    browser.until(lambda: len(listed(browser)) == 5)
    pick("robot", "t1")
    browser.until(lambda: listed(browser) == ["three", "one"], message="not filtered by robot")
    pick("task", "sprint1")
    browser.until(lambda: listed(browser) == ["one"], message="not filtered by robot and task")
    add("four", "sprint1", "t1")
    add("five", "sprint1", "nao-2")
    browser.until(lambda: listed(browser) == ["four", "one"], message="a new job that fits is not shown alone")
    browser.find(".menu:last-child summary").click()
    another = "localStorage.setItem('naosprint.jobs.views', JSON.stringify({Zero: {address: '', own: [], hidden: []}}))"
    browser.js(another)  # as another tab does
    browser.find("#view-name").send_keys("T1 sprints")
    browser.find(".menu:last-child button[type=submit]").click()
    browser.open("/?by=group")
    browser.until(lambda: len(listed(browser)) == 7)
    headings = [element.text for element in browser.all("tr.group")]
    assert headings[0] == "Single jobs 5"
    assert headings[1].endswith(" 2")
    assert listed(browser)[-2:] == ["swept-seed-1", "swept-seed-0"]
    browser.open(f"/?group={group_id}")
    browser.until(lambda: listed(browser) == ["swept-seed-1", "swept-seed-0"], message="not filtered by sweep")
    browser.find(".menu:last-child summary").click()
    browser.find(".menu:last-child .grow").click()
    browser.until(lambda: listed(browser) == ["four", "one"], message="the saved view does not open")
    browser.find(".menu:last-child summary").click()
    browser.find("[aria-label='Delete view T1 sprints']").click()
    browser.open("/")
    browser.until(lambda: len(listed(browser)) == 7)
    kept = [element.get_attribute("aria-label") for element in browser.all("[aria-label^='Delete view']")]
    assert kept == ["Delete view Zero"]


def test_any_jobs_are_plotted_by_settings_and_results(browser: Browser, token: str, client: httpx.Client) -> None:
    for number, rate in enumerate((1e-4, 1e-3, 1e-2)):
        job = {**WAITING, "spec": {**WAITING["spec"], "algorithm": {"learning_rate": rate}, "seed": number}}
        assert client.post("/jobs", json={"name": f"rate-{number}", "tags": ["rates"], **job}).status_code == 201
    park(client, "other")
    browser.sign_in(token)
    browser.open("/?tag=rates&plot=scatter&y=seed")
    browser.until(lambda: len(browser.all("[data-part=plots] circle")) == 3, message="not a mark for each job")
    texts = [e.text for e in browser.all("[data-part=plots] svg text")]
    assert {"learning_rate", "seed", "0.001", "0.01"} <= set(texts)
    assert browser.js("return document.querySelector('[data-part=plots] a title').textContent").startswith("rate-")
    browser.find("[data-part=plots] select[aria-label='Color by']").send_keys("seed")
    browser.until(lambda: len(browser.all("[data-part=plots] .legend span")) == 3, message="no legend")
    next(e for e in browser.all("[data-part=plots] .segments button") if e.text.startswith("Parallel")).click()
    browser.until(lambda: len(browser.all("[data-part=plots] path.plot-mark")) == 3, message="not a line for each job")
    assert "plot=parallel" in browser.driver.current_url and "color=seed" in browser.driver.current_url
    browser.find("[data-part=plots] select[aria-label='Add an axis']").send_keys("seed")
    browser.until(lambda: "axes=" in browser.driver.current_url, message="the address has no axes")
    assert browser.all("button[aria-label='Remove axis seed']")
    ids = ",".join(job["id"] for job in client.get("/jobs").json()["items"])
    browser.open(f"/compare?jobs={ids}")
    browser.until(lambda: len(browser.all("[data-part=plots] circle")) == 4, message="no plot of the compared jobs")


def test_the_basic_form_asks_for_what_most_jobs_need(browser: Browser, token: str, client: httpx.Client) -> None:
    browser.sign_in(token)
    browser.js("localStorage.removeItem('naosprint.form')")
    browser.open("/submit")
    browser.find("[name='spec.total_steps']")
    shown = {e.get_attribute("data-field") for e in browser.all(".field[data-field]") if e.is_displayed()}
    assert shown == {"spec.task.name", "spec.robot.name", "spec.total_steps", "spec.seed", "name", "tags"}
    browser.find("[data-level=advanced]").click()
    browser.find("[name='spec.task.reward_scale']")
    browser.set("[name='spec.task.reward_scale']", "many")
    browser.find("[data-level=basic]").click()
    browser.find("aside button[type=submit]").click()
    browser.find("[name='spec.task.reward_scale'][aria-invalid=true]")
    browser.set("[name='spec.task.reward_scale']", "50")
    browser.set("[name='spec.total_steps']", "512")
    browser.find("[data-level=basic]").click()
    browser.find("aside button[type=submit]").click()
    browser.until(lambda: client.get("/jobs").json()["items"])
    (job,) = client.get("/jobs").json()["items"]
    assert job["spec"]["task"]["reward_scale"] == 50


def test_jobs_are_cancelled_and_deleted_together(browser: Browser, token: str, client: httpx.Client) -> None:
    jobs = [park(client, f"bulk-{i}") for i in range(3)]
    client.post(f"/jobs/{jobs[2]}/pause")
    browser.sign_in(token)
    browser.open("/?state=paused")
    browser.until(lambda: listed(browser) == ["bulk-2"], message="the filter does not show the paused job alone")
    browser.open("/")
    browser.until(lambda: len(listed(browser)) == 3)
    browser.find("thead input[type=checkbox]").click()
    client.post(f"/jobs/{jobs[0]}/cancel")
    browser.until(lambda: browser.text("[data-bulk=cancel]") == "Cancel 2", message="an ended job is still counted")
    assert browser.text("[data-bulk=delete]") == "Delete 1"
    browser.find("[data-bulk=cancel]").click()
    browser.find("dialog button[value=yes]").click()
    browser.until(lambda: {j["state"] for j in client.get("/jobs").json()["items"]} == {"cancelled"})
    browser.until(lambda: len(browser.all("tbody [data-state=cancelled]")) == 3)
    browser.find("thead input[type=checkbox]").click()
    browser.find(f"tr[data-job={jobs[0]}] .check input").click()
    assert browser.text("[data-bulk=delete]") == "Delete 2"
    browser.find("[data-bulk=delete]").click()
    browser.find("dialog button[value=yes]").click()
    browser.until(lambda: listed(browser) == ["bulk-0"], message="the others are still listed")
    assert [job["id"] for job in client.get("/jobs").json()["items"]] == [jobs[0]]


SCROLL = """
const times = [];
for (let step = 0; step < 120; step++) {
  await new Promise((resolve) => requestAnimationFrame(resolve));
  const began = performance.now();
  scrollBy(0, 240);
  dispatchEvent(new Event("scroll"));
  await new Promise((resolve) => requestAnimationFrame(resolve));
  document.body.getBoundingClientRect();
  const spent = performance.getEntriesByName("jobs.draw").at(-1)?.duration ?? 0;
  performance.clearMeasures("jobs.draw");
  times.push(spent);
}
return times;
"""
"""Scroll through the list as a wheel does, and return the milliseconds of script, style and layout of each step."""


def test_a_thousand_jobs_stay_light(browser: Browser, token: str, client: httpx.Client) -> None:
    for part in range(10):
        body = {"job": {"name": f"part-{part}", **WAITING}, "seeds": list(range(100))}
        assert client.post("/groups", json=body, timeout=120).status_code == 201
    browser.sign_in(token)
    browser.find("tbody tr[data-job]")
    browser.shows("1,000", ".page-head")
    rows = "return document.querySelectorAll('tbody tr[data-job]').length"
    assert browser.js(rows) < 60
    height = browser.js("return document.documentElement.scrollHeight")
    assert height > 1000 * 40, "the scroll bar does not stand for all jobs"
    times = sorted(browser.module(SCROLL))
    print(f"a step of scrolling takes {times[60]:.1f} ms in the median, {times[114]:.1f} ms in 95 of 100")  # noqa: T201
    assert 0 < times[60] < 16.7, "fewer than 60 frames a second"
    assert browser.js(rows) < 60
    browser.js("scrollTo(0, document.documentElement.scrollHeight)")
    browser.shows("part-0-seed-0", "tbody:nth-of-type(2)")
    assert browser.js("return document.documentElement.scrollWidth <= innerWidth")


def test_a_list_without_the_oldest_jobs_says_so(
    browser: Browser, stack: Stack, token: str, client: httpx.Client
) -> None:
    job = park(client, "first")
    with stack.sessions.begin() as session:
        row = {column.name: getattr(session.get_one(Job, job), column.name) for column in Job.__table__.columns}
        session.execute(insert(Job), [{**row, "id": new_id("job"), "name": f"copy-{i}"} for i in range(5000)])
    try:
        browser.sign_in(token)
        browser.shows("The newest 5,000. Filters list older ones.", ".page-head", 60)
        browser.find("input[type=search]").send_keys("first")
        browser.until(lambda: listed(browser) == ["first"], message="a filter does not list older jobs")
        assert browser.text(".page-head [role=status]") == "1"
    finally:
        with stack.sessions.begin() as session:
            session.execute(delete(Job).where(Job.name.startswith("copy-")))


def test_a_reader_is_offered_no_new_jobs(browser: Browser, stack: Stack) -> None:
    browser.sign_in(stack.make_token("reader-of-nothing", "read"))
    browser.shows("No jobs yet")
    assert not browser.all("a[href^='#/submit']")


def test_a_search_is_undone_by_the_back_button(browser: Browser, token: str, client: httpx.Client) -> None:
    park(client, "alpha")
    browser.sign_in(token)
    browser.until(lambda: listed(browser) == ["alpha"])
    next(e for e in browser.all(".segments button") if e.text == "Active").click()
    browser.find("input[type=search]").send_keys("beta")
    browser.shows("No matching jobs")
    browser.driver.back()
    browser.until(lambda: listed(browser) == ["alpha"])
    assert browser.find("input[type=search]").get_attribute("value") == ""


def test_the_policies_show_what_their_address_says(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    browser.open("/policies?q=kick&robot=t1")
    robots = "[data-filter=robot]"
    browser.until(lambda: browser.all("[data-policy]") and browser.find(robots).get_attribute("value") == "t1")
    few = len(browser.all("[data-policy]"))
    browser.find("#top nav a[href='#/policies']").click()
    browser.until(lambda: len(browser.all("[data-policy]")) > few, 20, "the filter of the last address still applies")
    assert browser.find(robots).get_attribute("value") == ""
    assert browser.find("input[type=search]").get_attribute("value") == ""


def test_a_search_of_policies_is_typed_while_they_load(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    browser.shows("Jobs", "h1")
    browser.js(
        "const real = fetch; const held = new Promise((resolve) => { window.release = resolve; });"
        "window.fetch = async (url, ...rest) => {"
        "  const answer = await real(url, ...rest);"
        "  if (String(url).includes('/policies')) await held;"
        "  return answer; };"
        "location.hash = '#/policies';"
    )
    search = "input[aria-label='Search policies']"
    browser.find(search).send_keys("kick")
    browser.until(lambda: "q=kick" in browser.driver.current_url)
    browser.js("release()")
    browser.until(lambda: browser.all("[data-policy]"))
    assert browser.find(search).get_attribute("value") == "kick"
    assert browser.js("return document.activeElement.type") == "search", "the focus has left the field"
