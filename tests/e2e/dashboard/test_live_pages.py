"""Pages of studies, matches and comparisons: they follow what happens elsewhere, and stay where the reader is."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import pytest
from naojobs.database import notify
from naojobs.ids import new_id
from naojobs.models import Job, Log, Match, MatchEvent, MetricsRecord, Study
from sqlalchemy import func, insert

if TYPE_CHECKING:
    import httpx
    from conftest import Browser, Stack

LATER = "2100-01-01T00:00:00Z"
FOCUS = "dispatchEvent(new Event('focus'))"
LOSE_ONE_ANSWER = "const real = fetch; window.fetch = () => { window.fetch = real; return Promise.reject(Error()); };"


def make_study(client: httpx.Client, *names: str, trials: int = 2) -> str:
    """Start a study whose trials run elsewhere, over settings with these names."""
    search = {
        "elsewhere": True,
        "space": {name: {"type": "float", "low": 0.9, "high": 0.99} for name in names},
        "objectives": [{"metric": "jump_m", "direction": "maximize"}],
        "trials": trials,
        "parallel": 1,
    }
    answer = client.post("/studies", json={"name": "followed", "job": {"spec": {}}, "search": search})
    found: str = answer.raise_for_status().json()["id"]
    return found


def report(browser: Browser, client: httpx.Client, study: str, value: float) -> None:
    """Take the next trial of a study and report its value."""
    asked = browser.until(lambda: client.post(f"/studies/{study}/ask").json().get("number", -1) + 1)
    client.post(f"/studies/{study}/trials/{asked - 1}/tell", json={"values": [value]}).raise_for_status()


def test_a_study_stays_when_a_job_of_it_is_deleted_while_it_is_read(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    job = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}
    space = {"gamma": {"type": "float", "low": 0.9, "high": 0.99}}
    body = {"name": "shrinking", "job": job, "search": {"space": space, "trials": 1, "parallel": 1}}
    study = client.post("/studies", json=body).raise_for_status().json()["id"]
    trial = browser.until(lambda: client.get("/jobs").json()["items"], 60)[0]["id"]
    browser.sign_in(token)
    browser.hold(f"/jobs/{trial}/metrics", "request")
    browser.js("location.hash = arguments[0]", f"#/studies/{study}")
    browser.until(lambda: browser.js("return window.asked"))
    client.post(f"/jobs/{trial}/cancel").raise_for_status()
    client.delete(f"/jobs/{trial}").raise_for_status()
    browser.allowed.append("404")
    browser.js("release()")
    browser.shows("shrinking", "h1")


@pytest.fixture
def match(client: httpx.Client) -> str:
    """A match that waits for its time."""
    body = {"teams": ["example", "example"], "games": 2, "players": 1, "half_s": 2, "not_before": LATER}
    found: str = client.post("/matches", json=body).raise_for_status().json()["id"]
    return found


def state(browser: Browser) -> str | None:
    """Return the state in the head of a page."""
    return browser.find(".page-head [data-state]").get_attribute("data-state")


def test_the_page_of_an_ended_study_follows_its_extension_and_its_deletion(
    browser: Browser, token: str, client: httpx.Client
) -> None:
    study = make_study(client, "gamma")
    client.post(f"/studies/{study}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/studies/{study}")
    browser.until(lambda: state(browser) == "cancelled")
    client.post(f"/studies/{study}/extend", json={"trials": 3}).raise_for_status()
    browser.js(FOCUS)
    browser.until(lambda: state(browser) == "running", 20)
    client.post(f"/studies/{study}/cancel").raise_for_status()
    browser.until(lambda: state(browser) == "cancelled", message="the page does not follow the study that runs again")
    client.delete(f"/studies/{study}").raise_for_status()
    browser.allowed.append("404")
    browser.js(FOCUS)
    browser.shows("Studies", "h1", 20)
    browser.shows("followed was deleted.", "#toasts")


def test_the_page_of_an_ended_match_follows_its_retry_and_its_deletion(
    browser: Browser, token: str, client: httpx.Client, match: str
) -> None:
    client.post(f"/matches/{match}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/matches/{match}")
    browser.until(lambda: state(browser) == "cancelled")
    client.post(f"/matches/{match}/retry").raise_for_status()
    browser.js(FOCUS)
    browser.until(lambda: state(browser) == "queued", 20)
    client.post(f"/matches/{match}/cancel").raise_for_status()
    browser.until(lambda: state(browser) == "cancelled", 20)
    client.delete(f"/matches/{match}").raise_for_status()
    browser.allowed.append("404")
    browser.js(FOCUS)
    browser.shows("League", "h1", 20)
    browser.shows("was deleted.", "#toasts")


def test_pages_of_studies_and_matches_survive_a_lost_answer(
    browser: Browser, token: str, client: httpx.Client, match: str
) -> None:
    study = make_study(client, "gamma")
    client.post(f"/studies/{study}/cancel").raise_for_status()
    browser.sign_in(token)
    for place, words in ((f"/matches/{match}", "0 of 2 games"), (f"/studies/{study}", "0 of 2 trials")):
        browser.open(place)
        browser.shows(words)
        title = browser.text("h1")
        browser.js(f"{LOSE_ONE_ANSWER} {FOCUS}")
        browser.shows("The service does not answer")
        assert browser.text("h1") == title, "an error replaces what was read before"
        browser.shows(words, timeout_s=20)
        browser.until(lambda: "does not answer" not in browser.text("main"), 20, "the error outlasts the outage")


def test_tables_and_pages_stay_where_they_were_scrolled_to(browser: Browser, token: str, client: httpx.Client) -> None:
    study = make_study(client, "gamma", "gae_lambda", "clip_range", "ema_decay", trials=3)
    report(browser, client, study, 1.0)
    browser.sign_in(token)
    browser.size(360, 500)
    browser.open(f"/studies/{study}")
    table = "document.querySelector('[data-part=trials] .scroll-x')"
    browser.until(lambda: browser.js("return document.documentElement.scrollHeight - innerHeight") > 50)
    assert browser.js("return document.documentElement.scrollWidth") == 360
    before = browser.js(f"{table}.scrollLeft = 60; scrollTo(0, 1e6); return [{table}.scrollLeft, scrollY]")
    assert before[0] == 60
    report(browser, client, study, 2.0)
    browser.shows("2 of 3 trials")
    left, top = browser.js(f"return [{table}.scrollLeft, scrollY]")
    assert left == 60
    assert top == before[1]


def test_objectives_have_their_titles_and_units(browser: Browser, token: str) -> None:
    browser.sign_in(token)
    found = browser.module(
        """
        const { Descriptions } = await import("/ui/js/descriptions.js");
        const { coordinates, curves, front } = await import("/ui/js/study-figures.js");
        const results = [
          { name: "top_speed_mps", title: "Top speed", unit: "m/s", digits: 2 },
          { name: "fall_rate", title: "Falls", unit: "%", digits: 1 },
        ];
        const known = new Descriptions([{ name: "run", results, metrics: [] }]);
        const study = {
          spec: { space: { gamma: { low: 0.9, high: 1 } } },
          best: [0],
          trials: [
            { number: 0, state: "complete", params: { gamma: 0.9 }, values: [1, 0.25] },
            { number: 1, state: "complete", params: { gamma: 1 }, values: [2, 0.5] },
          ],
        };
        const goals = ["top_speed_mps", "fall_rate", "own_m"].map((name) => known.measured({ task: "run" }, name));
        const line = { label: "Trial 0", token: "--s1", x: [0, 1000], y: [0, 1500] };
        const drawn = [coordinates(400, study, goals.slice(0, 2)), front(400, study, goals.slice(0, 2)),
          curves(400, [line], goals[0]), curves(400, [{ ...line, y: [0, 0.5] }], goals[1])];
        return [goals.map((goal) => goal.title), ...drawn.map((each) => each.textContent)];
        """
    )
    assert found[0] == ["Top speed", "Falls", "Own m"]
    assert "Top speed, m/s" in found[1]
    assert "Trial 0: 1, 25" in found[2]
    assert "Falls, %" in found[2]
    assert "1,500" in found[3]
    assert "Top speed, m/s" in found[3]
    assert "50" in found[4]


def test_a_study_names_what_it_optimizes_by_its_title(browser: Browser, token: str, client: httpx.Client) -> None:
    gamma = {"type": "float", "low": 0.9, "high": 0.99}
    job = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}
    search = {"space": {"gamma": gamma}, "objectives": [{"metric": "fall_rate"}], "trials": 1}
    study = client.post("/studies", json={"name": "titled", "job": job, "search": search}).raise_for_status().json()
    client.post(f"/studies/{study['id']}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open("/studies")
    browser.shows("Minimize Falls", "tbody")
    browser.open(f"/studies/{study['id']}")
    browser.shows("Minimize Falls", ".page-head")


def test_times_are_local_and_of_one_style(browser: Browser, token: str, client: httpx.Client, match: str) -> None:
    browser.driver.execute_cdp_cmd("Emulation.setTimezoneOverride", {"timezoneId": "Asia/Tokyo"})
    try:
        browser.sign_in(token)
        browser.open(f"/matches/{match}")
        browser.shows("Waiting for its time. It is to start at 2100-01-01 09:00 or later.")
        old, *numbers = browser.module(
            "const { ago, significant } = await import('/ui/js/format.js');"
            "const numbers = [-1234.5, 999.7, 40_000_000, 1_234_567.5];"
            "return [ago('2020-03-12T20:00:00Z'), ...numbers.map((number) => significant(number))];"
        )
        assert old == "2020-03-13"
        assert numbers == ["\N{MINUS SIGN}1,235", "1,000", "40,000,000", "1.23e6"]
    finally:
        browser.driver.execute_cdp_cmd("Emulation.setTimezoneOverride", {"timezoneId": ""})


def test_a_comparison_reads_what_it_missed_and_leaves_out_what_was_deleted(
    browser: Browser, stack: Stack, token: str, client: httpx.Client
) -> None:
    body: dict[str, Any] = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}
    kept, dropped = (client.post("/jobs", json={"name": name, **body}).json()["id"] for name in ("kept", "dropped"))
    browser.sign_in(token)
    browser.open(f"/compare?jobs={kept},{dropped}")
    browser.shows("Live", ".top")
    browser.until(lambda: len(browser.all("tr[data-job]")) == 2)
    browser.js("dispatchEvent(new Event('pagehide'))")  # a page without a stream, as one in the background
    with stack.sessions.begin() as session:
        for i in range(1, 6):
            row = MetricsRecord(job_id=kept, attempt=1, step=i * 1000, time_s=float(i), values={"reward": 1.0})
            session.add(row)
        session.get_one(Job, kept).latest_metrics = {"step": 5000, "reward": 1.0}
        notify(session, kept)
    browser.js("dispatchEvent(new Event('pageshow'))")
    browser.shows("Live", ".top")
    table = browser.downloads / "comparison.csv"
    browser.driver.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(browser.downloads)}
    )

    def rows() -> list[str]:
        table.unlink(missing_ok=True)
        next(e for e in browser.all("button") if e.text == "CSV").click()
        browser.until(lambda: table.exists() and table.stat().st_size, 5)
        return table.read_text().splitlines()[1:]

    browser.until(lambda: len(rows()) == 5, 30, "the metrics from the time without a stream are missing")
    client.post(f"/jobs/{dropped}/cancel").raise_for_status()
    client.delete(f"/jobs/{dropped}").raise_for_status()
    browser.until(lambda: len(browser.all("tr[data-job]")) == 1, 20)
    browser.shows("dropped was deleted.", "#toasts")


def test_a_mean_stands_for_more_than_half_of_a_group(browser: Browser) -> None:
    browser.driver.get(f"{browser.base}/")
    mean = browser.module(
        """
        const { band } = await import("/ui/js/views/compare.js");
        return band([[[0, 10], [0, 10]], [[0, 5], [4, 4]]], [0, 5, 10]).mean;
        """
    )
    assert mean == [2, 4.5, None]


def test_jobs_are_plotted_by_a_result_that_most_of_them_have(browser: Browser) -> None:
    browser.driver.get(f"{browser.base}/")
    chosen = browser.module(
        """
        const { Descriptions } = await import("/ui/js/descriptions.js");
        const { JobPlots } = await import("/ui/js/views/job-plots.js");
        const result = (name) => ({ name, title: name, unit: "m", digits: 2, value: 1 });
        const job = (seed, ...names) => ({
          state: "succeeded", spec: { seed }, latest_metrics: null, result: { results: names.map(result) },
        });
        const plots = new JobPlots(new Descriptions(), {}, () => {});
        plots.update([job(1, "own", "shared"), job(2, "shared"), job(3, "shared")]);
        const { y } = plots.chosen();
        plots.destroy();
        return y;
        """
    )
    assert chosen == "shared"


def copies(row: Study | Match, count: int) -> list[dict[str, Any]]:
    """Return the columns of a row `count` times, each with an id of its own."""
    kept = {column.name: getattr(row, column.name) for column in row.__table__.columns}
    return [{**kept, "id": new_id(row.id.split("_")[0])} for _ in range(count)]


def test_older_studies_and_matches_are_shown_on_request(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, match: str
) -> None:
    study = make_study(client, "gamma")
    client.post(f"/studies/{study}/cancel").raise_for_status()
    client.post(f"/matches/{match}/cancel").raise_for_status()
    with stack.sessions.begin() as session:
        for kind, made in ((Study, study), (Match, match)):
            session.execute(insert(kind), copies(session.get_one(kind, made), 250))
    browser.sign_in(token)
    for place, link in (("/studies", "studies"), ("/league", "matches")):
        browser.open(place)
        rows = f"td a[href^='#/{link}/']"
        browser.until(lambda rows=rows: browser.all(rows))
        while len(browser.all(rows)) < 251:
            shown = len(browser.all(rows))
            browser.shows(f"The newest {shown} are shown.")
            browser.find("[data-action=older]").click()
            browser.until(lambda rows=rows, shown=shown: len(browser.all(rows)) > shown)
        assert not browser.all("[data-action=older]")
        assert browser.all(f"a[href='#/{link}/{study if link == 'studies' else match}']"), "the oldest is missing"
        browser.js(FOCUS)
        browser.until(lambda rows=rows: len(browser.all(rows)) == 251, message="a new answer hides the older ones")


def test_a_study_is_extended_and_deleted_on_its_page(browser: Browser, token: str, client: httpx.Client) -> None:
    study = make_study(client, "gamma")
    report(browser, client, study, 1.0)
    client.post(f"/studies/{study}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/studies/{study}")
    browser.find("[data-action=extend]").click()
    assert browser.find("#study-trials").get_attribute("value") == "12"
    browser.set("#study-trials", "4")
    browser.find("dialog [type=submit]").click()
    browser.until(lambda: state(browser) == "running")
    browser.shows("of 4 trials")
    assert not browser.all("[data-action=delete]")
    browser.find("[data-action=cancel]").click()
    browser.find("dialog .danger").click()
    browser.until(lambda: state(browser) == "cancelled")
    browser.find("[data-action=delete]").click()
    browser.find("dialog [value=no]").click()
    assert client.get(f"/studies/{study}").status_code == 200
    browser.find("[data-action=delete]").click()
    browser.find("dialog .danger").click()
    browser.shows("followed was deleted.", "#toasts")
    browser.shows("No studies yet")


def test_an_extension_that_the_service_refuses_says_why(browser: Browser, token: str, client: httpx.Client) -> None:
    gamma = {"type": "float", "low": 0.9, "high": 0.99}
    search = {"sampler": "population", "population": 4, "trials": 8, "parallel": 1, "space": {"gamma": gamma}}
    job = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}
    body = {"name": "grown", "job": job, "search": {**search, "pruning": {"name": "none"}}}
    study = client.post("/studies", json=body).raise_for_status().json()["id"]
    client.post(f"/studies/{study}/cancel").raise_for_status()
    answer = client.post(f"/studies/{study}/extend", json={"trials": 7})
    assert answer.status_code == 422
    browser.sign_in(token)
    browser.open(f"/studies/{study}")
    browser.find("[data-action=extend]").click()
    browser.set("#study-trials", "7")
    browser.allowed.append("422")
    browser.find("dialog [type=submit]").click()
    browser.shows(answer.json()["errors"][0]["message"], "dialog")


def test_a_match_is_deleted_on_its_page_and_only_by_those_who_may(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, match: str, request: pytest.FixtureRequest
) -> None:
    study = make_study(client, "gamma")
    client.post(f"/studies/{study}/cancel").raise_for_status()
    browser.sign_in(token)
    browser.open(f"/matches/{match}")
    browser.find("[data-action=cancel]")
    assert not browser.all("[data-action=delete]"), "only matches that have ended can be deleted"
    browser.find("[data-action=cancel]").click()
    browser.until(lambda: state(browser) == "cancelled")
    browser.find("[data-action=delete]")
    reader = stack.make_token(f"owner-{request.node.name[:80]}", "read")
    browser.module("(await import('/ui/js/api.js')).setToken(args[0])", reader)
    for place in (f"/studies/{study}", f"/matches/{match}"):
        browser.open(place)
        browser.until(lambda: state(browser) == "cancelled")
        assert not browser.all(".page-head button")
    browser.open("/studies")
    browser.shows("followed")
    assert not browser.all(".page-head .primary"), "a study is offered to a reader"
    browser.module("(await import('/ui/js/api.js')).setToken(args[0])", token)
    browser.open(f"/matches/{match}")
    browser.find("[data-action=delete]").click()
    browser.find("dialog .danger").click()
    browser.shows("was deleted.", "#toasts")
    browser.shows("No matches yet")


def test_lines_of_a_log_are_under_their_day(
    browser: Browser, stack: Stack, token: str, client: httpx.Client, match: str
) -> None:
    waiting = {"spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}
    job = client.post("/jobs", json={"name": "logged", **waiting}).raise_for_status().json()["id"]
    times = [datetime(2026, 3, day, 12, tzinfo=UTC) for day in (12, 12, 14)]
    with stack.sessions.begin() as session:
        for at in times:
            session.add(Log(job_id=job, attempt=1, at=at, level="info", message="line"))
            session.add(MatchEvent(match_id=match, attempt=0, at=at, kind="info", message="line"))
    browser.sign_in(token)
    for place in (f"/jobs/{job}/log", f"/matches/{match}"):
        browser.open(place)
        browser.shows("2026-03-14", ".log")
        days = [e.text for e in browser.all(".log .mark") if e.text.startswith("2026-03")]
        assert days == ["2026-03-12", "2026-03-14"], place


def train(stack: Stack, job: str, count: int = 3, **values: float) -> None:
    """Store rows of metrics of a job."""
    with stack.sessions.begin() as session:
        for i in range(1, count + 1):
            session.add(MetricsRecord(job_id=job, attempt=1, step=i * 1000, time_s=float(i), values=values))
        row = session.get_one(Job, job)
        row.latest_metrics = {"step": count * 1000, **values}
        row.updated_at = func.now()
        notify(session, job)


def test_a_comparison_draws_rewards_of_each_task_and_every_metric(
    browser: Browser, stack: Stack, token: str, client: httpx.Client
) -> None:
    def park(name: str, task: str, robot: str) -> str:
        spec = {"task": task, "robot": robot, "total_steps": 10_000_000}
        body = {"name": name, "spec": spec, "evaluation": None, "not_before": LATER}
        job: str = client.post("/jobs", json=body).raise_for_status().json()["id"]
        return job

    jobs = [park("saver", "block", "t1"), park("walker", "velocity", "t1"), park("small", "velocity", "k1")]
    train(stack, jobs[0], reward=100.0, fall_rate=0.5, conceded_rate=0.25, value_loss=50.0)
    train(stack, jobs[1], reward=1.0, fall_rate=0.1, velocity_error_mps=0.2, value_loss=1e-3)
    browser.sign_in(token)
    browser.open(f"/compare?jobs={','.join(jobs)}")
    browser.shows("Live", ".top")
    titles = browser.until(lambda: [e.text for e in browser.all(".chart h3")])
    assert [title for title in titles if title.startswith("Reward")] == ["Reward · block", "Reward · velocity"]
    assert [title for title in titles if title.startswith("Value")] == ["Value loss · block", "Value loss · velocity"]
    assert [title for title in titles if title.startswith("Fall")] == ["Falls"], "what tasks share is one chart"
    assert any(title.startswith("Goals against") for title in titles), "a metric of a chart of two is missing"
    latest = browser.all("[data-chart='conceded_rate'] .plot, [data-chart='fall_rate'] .plot")
    assert all("3 points" in (e.get_attribute("aria-label") or "") for e in latest)
    train(stack, jobs[2], reward=2.0, cpus=1.5)
    browser.until(
        lambda: browser.all("[data-chart=cpus]"), message="a metric that came later has no chart until a reload"
    )
    browser.open(f"/compare?by=robot&jobs={jobs[1]},{jobs[2]}")
    browser.until(lambda: browser.all("[data-chart=reward]"))
    assert "Reward" in [e.text for e in browser.all(".chart h3")], "one task needs no name in the titles"


def test_a_comparison_is_drawn_while_changes_arrive_without_a_pause(
    browser: Browser, stack: Stack, token: str, client: httpx.Client
) -> None:
    body = {"name": "busy", "spec": {"simulator": "server", "total_steps": 10_000_000}, "evaluation": None}
    job = client.post("/jobs", json=body).json()["id"]
    browser.sign_in(token)
    browser.open(f"/compare?jobs={job}")
    browser.shows("Live", ".top")
    steps = itertools.count(1000, 1000)

    def drawn() -> bool:
        with stack.sessions.begin() as session:
            row = session.get_one(Job, job)
            row.progress_step = next(steps)
            row.updated_at = func.now()
            notify(session, job)
        return browser.find("tr[data-job] .num").text != "0"

    browser.until(drawn, 20, "no change is drawn while more arrive")
