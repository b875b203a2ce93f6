"""Addresses of alerts: what they may name, and what is shown of them."""

from __future__ import annotations

import socket
import subprocess
import sys
from ipaddress import ip_network
from pathlib import Path

import pytest
from naojobs import webhooks
from naojobs.webhooks import is_alert
from naosprint_api import alerts

TOKENS = "T1JJ3T3L2/A1BRTD4JD/TIiajkdnlazkcOXrIdevi7FQ"


SHOWN = (
    (f"slack://{TOKENS}/#general", "slack://…"),
    ("tgram://123456789:abcdefg_hijklmnop/12315544/", "tgram://…"),
    ("discord://4174216298/JHMHI8qBe7bk2ZwO5U711o3dV_js", "discord://…"),
    ("mailtos://lab:secret@mail.example.org?to=ada@example.org", "mailtos://…@mail.example.org"),
    ("ntfys://lab:secret@ntfy.example.org/runs", "ntfys://…@ntfy.example.org"),
    ("ntfy://secret-topic", "ntfy://…"),
    (
        "workflows://prod-1.westus.logic.azure.com:443/643e69f83c8944/234fsdfsdf/",
        "workflows://…@prod-1.westus.logic.azure.com",
    ),
    ("https://hooks.example.org/x", "https://hooks.example.org/x"),
)


@pytest.mark.parametrize(("url", "shown"), SHOWN)
def test_an_address_is_accepted_and_its_secrets_are_not_shown(url: str, shown: str) -> None:
    assert alerts.shown_address(url) == shown
    if is_alert(url):
        alerts.check_address(url)
        alerts.check_hosts(url, ())


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("json://10.0.0.1/", "expected an address of http, https, discord"),
        ("file:///etc/passwd", "expected an address of http, https, discord"),
        ("hooks.example.org", "expected an address of http, https, discord"),
        (f"slack://{TOKENS}?template=/proc/self/environ", "no parameter of that name here; expected blocks, mode"),
        (f"slack://{TOKENS}?+X=1", "no parameter of that name here"),
        ("ntfys://topic?attach=http://10.0.0.1/", "no parameter of that name here"),
        ("mailtos://u:p@example.org?pgpprv=/root/key", "no parameter of that name here"),
        ("mailtos://u:p@example.org?verify=no", "no parameter of that name here"),
        (f"slack://{TOKENS}/#?template=file:///etc/passwd", "no parameter of that name here"),
        (f"slack://{TOKENS}/?mode=hook;template=file:///etc/passwd", "no parameter of that name here"),
        (f"slack://{TOKENS}/?mode=hook#&template=file:///etc/passwd", "no parameter of that name here"),
        (f"slack://{TOKENS}/?%74emplate=file:///etc/passwd", "no parameter of that name here"),
        (f"slack://{TOKENS}/#general ", "without spaces"),
    ],
)
def test_services_and_parameters_that_reach_further_are_refused(url: str, error: str) -> None:
    with pytest.raises(ValueError, match=error) as raised:
        alerts.check_address(url)
    assert TOKENS not in str(raised.value)


@pytest.mark.parametrize(
    "url",
    [
        "mailto://u:p@127.0.0.1",
        "mailto://u:p@example.org?smtp=10.0.0.1",
        "mailto://u:p@example.org?to=a@b.org;SMTP=10.0.0.1",
        "ntfy://localhost/topic",
        "mmost://[::1]/x",
    ],
)
def test_hosts_that_are_not_public_are_refused(url: str) -> None:
    with pytest.raises(ValueError, match="expected a public address"):
        alerts.check_hosts(url, ())
    alerts.check_hosts(url, (ip_network("0.0.0.0/0"), ip_network("::/0")))


def test_apprise_reads_the_addresses_of_all_services() -> None:
    urls = [url for url, _ in SHOWN if is_alert(url)]
    code = "import sys, apprise; print([bool(apprise.Apprise.instantiate(url)) for url in sys.argv[1:]])"
    done = subprocess.run([sys.executable, "-c", code, *urls], capture_output=True, text=True, check=True)
    assert done.stdout == f"{[True] * len(urls)}\n"


def test_an_address_that_apprise_cannot_read_is_refused() -> None:
    assert "that apprise can read" in str(alerts.try_address("slack://short"))
    assert alerts.try_address(f"slack://{TOKENS}") is None


@pytest.mark.parametrize("parameters", ["#?template=file://{}", "?silent=no;template=file://{}"])
def test_no_alert_reads_a_file(tmp_path: Path, parameters: str) -> None:
    """The process that sends it checks an address as apprise reads it, whatever was registered."""
    file = tmp_path / "none"
    url = "tgram://123456789:abcdefg_hijklmnop/12315544/" + parameters.format(file)
    body = '{"type": "job.ended", "data": {"name": "x", "state": "failed"}}'
    for error in (alerts.try_address(url), alerts.send(url, body, ())):
        assert "no parameter of that name here" in str(error) and str(file) not in str(error)


@pytest.mark.parametrize(
    ("url", "host"),
    [("ntfy://{}:9/topic", "127.0.0.1"), ("mailto://u:p@{}:9?to=a@example.org", "localhost")],
)
def test_nothing_reaches_an_inner_address(url: str, host: str) -> None:
    """Also behind a name, which is looked up by the library that connects."""
    body = '{"type": "job.ended", "data": {"name": "x", "state": "failed"}}'
    error = alerts.send(url.format(host), body, ())
    assert error == "the host has no public address; the operator can allow private networks"


def test_an_error_repeats_no_secret() -> None:
    """Nothing listens there; apprise names the address in its error."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    url = f"mailto://ada:hunter22@127.0.0.1:{port}?to=eve@example.org&from=lab@example.org"
    body = '{"type": "job.ended", "data": {"name": "x", "state": "failed"}}'
    error = alerts.send(url, body, (ip_network("127.0.0.1/32"),))
    assert error and not any(secret in error for secret in alerts.secrets_of(url))
    assert {"hunter22", "eve@example.org"} <= set(alerts.secrets_of(url))


def test_an_attempt_ends_at_its_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mail server that accepts the connection and says nothing; the start of the process takes no time of it."""
    assert alerts.START_S + alerts.DEADLINE_S < webhooks.TAKEN_S
    monkeypatch.setattr(alerts, "DEADLINE_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"mailto://u:p@127.0.0.1:{silent.getsockname()[1]}?from=b@example.org&to=a@example.org"
        body = '{"type": "job.ended", "data": {"name": "x", "state": "failed"}}'
        assert alerts.send(url, body, (ip_network("127.0.0.1/32"),)) == "no answer within 0.2 s"


def test_a_machine_too_busy_to_start_a_process_is_no_fault_of_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alerts, "START_S", 0.0)
    monkeypatch.setattr(alerts, "DEADLINE_S", 0.001)
    with pytest.raises(alerts.BusyError, match="too busy"):
        alerts.try_address(f"slack://{TOKENS}")


def test_its_process_has_no_setting_of_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NAOSPRINT_DATABASE_URL", "postgresql://secret@/")
    seen: list[dict[str, str]] = []

    def run(command: list[str], **options: object) -> object:
        seen.append(options["env"])  # type: ignore[arg-type]
        return real(command, **options)  # type: ignore[call-overload]

    real = alerts.subprocess.run
    monkeypatch.setattr(alerts.subprocess, "run", run)
    assert alerts.try_address("slack://short") is not None
    assert set(seen[0]) <= {"PATH", "LANG", "LC_ALL", "SSL_CERT_FILE", "SSL_CERT_DIR"}


def test_messages_are_worded_for_people() -> None:
    job = {
        "job_id": "job_1",
        "name": "night",
        "state": "failed",
        "error": "no memory",
        "step": 1200,
        "total_steps": 4000,
    }
    assert alerts.wording("job.ended", {**job, "attempt": 2}) == (
        "naosprint: job night failed",
        "Step 1,200 of 4,000, attempt 2\nno memory\njob_1",
    )
    assert alerts.wording("job.stalled", {**job, "attempt": 2})[0] == "naosprint: job night makes no steps"
    evaluation = {"evaluation_id": "evl_1", "job_id": "job_1", "name": "night", "state": "succeeded", "error": None}
    results = {"top_speed_mps": 4.0312, "time_28m_s": None}
    assert alerts.wording("evaluation.finished", {**evaluation, "results": results}) == (
        "naosprint: evaluation night succeeded",
        "top_speed_mps: 4.031\njob_1 evl_1",
    )
    match = {
        "match_id": "mtc_1",
        "teams": ["a", "b"],
        "games": 3,
        "wins": 2,
        "draws": 1,
        "losses": 0,
        "state": "succeeded",
    }
    assert alerts.wording("match.ended", {**match, "error": None}) == (
        "naosprint: match mtc_1 succeeded",
        "a against b\n2 won, 1 drawn, 0 lost, of 3 games\nmtc_1",
    )
