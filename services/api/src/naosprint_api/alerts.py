"""Alerts: messages as text for people, by e-mail or through a chat service, at an address of the library apprise.

Apprise has well over a hundred services, reads files and fetches addresses that its own addresses name, and looks up
hosts itself. So an address may name only the services and parameters below, and each alert is sent by a process of its
own (`alert_process`), which has no setting of this service in its environment, connects only to addresses that webhooks
may go to, and is killed at its deadline.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote, urlsplit

from naojobs.webhooks import is_alert

from naosprint_api.outbound import Network, is_refused_literal

START_S, DEADLINE_S = 30.0, 20.0
"""Seconds that the process of an attempt may take to start, and then for the attempt: together they have to be less
than `naojobs.webhooks.TAKEN_S`.
"""
TRIED_AT_A_TIME = 4
"""Addresses that are tried at a time."""
GUIDE = "https://appriseit.com/services/"
"""Where the addresses of the services are described."""

NOT_PUBLIC = "expected a public address; the operator can allow private ones (NAOSPRINT_API_WEBHOOK_NETWORKS)"

_trying = threading.BoundedSemaphore(TRIED_AT_A_TIME)

_PASSED_ON = ("PATH", "LANG", "LC_ALL", "SSL_CERT_FILE", "SSL_CERT_DIR")
"""Variables that a process of an alert gets."""


class BusyError(Exception):
    """Too many addresses are being tried, or this machine is too busy to start a process."""


@dataclass(frozen=True, slots=True)
class Channel:
    """Service that alerts can be sent to."""

    parameters: frozenset[str]
    """Parameters that its addresses may have; others read files, fetch addresses or change how connections are made."""
    own_host: bool = False
    """Whether its addresses name a host."""


def _channel(*parameters: str, own_host: bool = False) -> Channel:
    return Channel(frozenset(parameters), own_host)


_MAIL = _channel("bcc", "cc", "from", "mode", "name", "pass", "reply", "smtp", "to", "user", own_host=True)
_NTFY = _channel("auth", "mode", "priority", "tags", "to", "token", own_host=True)
_MATTERMOST = _channel("channel", "mode", "team", "to", own_host=True)
_ROCKET_CHAT = _channel("mode", "to", own_host=True)

CHANNELS: Mapping[str, Channel] = {
    "discord": _channel("ping", "thread"),
    "gchat": _channel("key", "thread", "token", "workspace"),
    "mailto": _MAIL,
    "mailtos": _MAIL,
    "mmost": _MATTERMOST,
    "mmosts": _MATTERMOST,
    "ntfy": _NTFY,
    "ntfys": _NTFY,
    "pover": _channel("priority", "sound", "to"),
    "rocket": _ROCKET_CHAT,
    "rockets": _ROCKET_CHAT,
    "slack": _channel("blocks", "mode", "to", "token"),
    "tgram": _channel("silent", "thread", "to", "topic"),
    "workflows": _channel("id", "sig", "workflow", own_host=True),
    "wxteams": _channel("mode", "to", "token"),
    "zulip": _channel("to", "token"),
}
"""Services by the scheme of their addresses: chat, push and mail; `workflows` is Microsoft Teams."""


def check_address(url: str) -> None:
    """Check which service and parameters an address of an alert names.

    Raises:
        ValueError: why it is refused, without the address, which is a secret.
    """
    if not url.isprintable() or " " in url:
        raise ValueError("expected an address without spaces and control characters; write %20 for a space")
    check_parameters(urlsplit(url).scheme, (name for name, _ in _parameters(url)))


def check_parameters(scheme: str, names: Iterable[str]) -> None:
    """Check what an address of an alert names. Raises ValueError."""
    channel = CHANNELS.get(scheme)
    if channel is None:
        raise ValueError(f"expected an address of http, https, {', '.join(CHANNELS)}")
    if not channel.parameters.issuperset(names):
        known = ", ".join(sorted(channel.parameters))
        raise ValueError(f"an address of {scheme} has no parameter of that name here; expected {known}")


def _parameters(url: str) -> list[tuple[str, str]]:
    """Return the parameters of an address as apprise reads them: behind the first `?`, even in a fragment."""
    pairs = (pair.partition("=") for pair in re.split("[&;]", url.partition("?")[2]) if pair)
    return [(unquote(name).strip().lower(), unquote(value).strip()) for name, _, value in pairs]


def check_hosts(url: str, networks: Sequence[Network]) -> None:
    """Check the hosts that an address of an alert names, as far as they need not be looked up.

    Raises:
        ValueError: if nothing may be sent to one of them.
    """
    hosts = [_own_host(url), *(value for name, value in _parameters(url) if name == "smtp")]
    if any(is_refused_literal(host, networks) for host in hosts if host):
        raise ValueError(NOT_PUBLIC)


def shown_address(url: str) -> str:
    """Return a webhook's address as it may be shown: of an alert the scheme, and the host if it names one."""
    if not is_alert(url):
        return url
    host = _own_host(url)
    return f"{urlsplit(url).scheme}://…" + (f"@{host}" if host else "")


def _own_host(url: str) -> str | None:
    """Return the host that an address names, if its service has no host of its own."""
    parts = urlsplit(url)
    topic_only = parts.scheme.startswith("ntfy") and not parts.path.strip("/")  # a secret topic of ntfy.sh
    return parts.hostname if CHANNELS[parts.scheme].own_host and not topic_only else None


def try_address(url: str) -> str | None:
    """Return none if apprise can read an address, or why not. It starts a process, and sends nothing.

    Raises:
        BusyError: if :data:`TRIED_AT_A_TIME` others are being tried, or the process did not start in time.
    """
    if not _trying.acquire(blocking=False):  # threads that wait here would be missing for other requests
        raise BusyError("other addresses are being tried; send the request again in a few seconds")
    try:
        return _run({"url": url})
    finally:
        _trying.release()


def send(url: str, body: str, networks: Sequence[Network]) -> str | None:
    """Send a message as an alert; return none, or the error without the address's secrets.

    Args:
        url: address for apprise.
        body: the message as webhooks get it, JSON.
        networks: private networks that may be reached.

    Raises:
        BusyError: the process did not start in time.
    """
    message = json.loads(body)
    title, text = wording(message["type"], message["data"])
    return _run({"url": url, "title": title, "body": text, "networks": [str(network) for network in networks]})


def _run(request: Mapping[str, Any]) -> str | None:
    """Have a process of its own handle an address; return its error. Raises BusyError."""
    environment = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    command = [sys.executable, "-P", "-m", "naosprint_api.alert_process"]
    try:
        done = subprocess.run(
            command,
            input=json.dumps({**request, "deadline_s": DEADLINE_S}).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            timeout=START_S + DEADLINE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise BusyError("this machine is too busy; try again later") from None
    if done.returncode == -signal.SIGALRM:
        return f"no answer within {DEADLINE_S:g} s"
    if done.returncode != 0:
        return f"the process that sends alerts ended with status {done.returncode}"
    answer: dict[str, str | None] = json.loads(done.stdout)
    return answer["error"]


def wording(kind: str, data: Mapping[str, Any]) -> tuple[str, str]:
    """Return the title and the text of a message for people."""
    subject, _, event = kind.partition(".")
    name = data.get("name") or data.get(f"{subject}_id") or data.get("job_id")
    state = "makes no steps" if event == "stalled" else data["state"]
    lines = []
    if data.get("total_steps"):
        lines.append(f"Step {data['step']:,} of {data['total_steps']:,}, attempt {data['attempt']}")
    if data.get("teams"):
        lines.append(" against ".join(str(team) for team in data["teams"]))
        lines.append(f"{data['wins']} won, {data['draws']} drawn, {data['losses']} lost, of {data['games']} games")
    results = data.get("results") or {}
    lines += [f"{result}: {value:.4g}" for result, value in results.items() if value is not None]
    lines += [str(data["error"])] if data.get("error") else []
    identifiers = [data[key] for key in ("job_id", "evaluation_id", "match_id", "study_id") if data.get(key)]
    lines += [" ".join(identifiers)] if identifiers else []
    title = f"naosprint: {subject} {name} {state}"
    return title, "\n".join(lines) or title  # apprise sends no empty text


def secrets_of(url: str) -> list[str]:
    """Return what an error may not repeat of an address, the longest first: all of its parts but a host's name."""
    parts = urlsplit(url)
    text = f"{parts.netloc}/{parts.path}/{parts.fragment}"
    found = {*re.split("[/:@?&=#;]", text), *(value for _, value in _parameters(url))}
    found |= {unquote(part) for part in found} | {part.lower() for part in found} | {url}
    return sorted((part for part in found - {_own_host(url)} if len(part) > 3), key=len, reverse=True)
