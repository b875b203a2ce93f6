"""A worker offers the robots that its machine can run."""

from __future__ import annotations

import json
import logging
import os
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from naosim import robots
from naosim.mujoco import world
from naosprint_worker import capabilities
from naosprint_worker.capabilities import installed_capabilities
from naosprint_worker.settings import WorkerSettings


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Return the environment of a worker for jobs on servers, on a machine with no server's program."""
    for name, value in {
        "MODE": "local",
        "DATABASE_URL": "postgresql://localhost/naosprint",
        "BROKER_URL": "redis://localhost:6379/0",
        "ARTIFACT_URL": "file:///tmp/artifacts",
        "WORKER_QUEUES": "server",
    }.items():
        monkeypatch.setenv(f"NAOSPRINT_{name}", value)
    for name in ("NAOSPRINT_SIMSERVER", "NAOSPRINT_RCSSSERVERMJ"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", "/nowhere")
    return monkeypatch


def offered() -> list[str]:
    return list(installed_capabilities(WorkerSettings()).robots)  # type: ignore[call-arg]


def test_a_worker_with_one_server_offers_its_robots(
    environment: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        assert offered() == ["k1", "t1"]
    expected = "robot nao-0 cannot run in simulator server: NAOSPRINT_SIMSERVER: there is no program 'rcssserver3d'"
    assert expected in caplog.messages
    environment.setattr(world.metadata, "version", lambda name: "3.4.0")
    assert offered() == []
    for program in ("embedded", "docker:naosprint/simserver"):
        environment.setenv("NAOSPRINT_SIMSERVER", program)
        assert offered() == [f"nao-{robot_type}" for robot_type in range(5)]
    environment.setenv("NAOSPRINT_RCSSSERVERMJ", "docker:naosprint/rcssservermj")
    assert offered() == list(robots.names())
    environment.setenv("NAOSPRINT_RCSSSERVERMJ", "embedded")
    assert "t1" not in offered()


def test_a_worker_without_servers_offers_what_it_can_embed(environment: pytest.MonkeyPatch) -> None:
    environment.setenv("NAOSPRINT_WORKER_QUEUES", "embedded")
    assert offered() == list(robots.names())
    environment.setattr(world.metadata, "version", lambda name: "3.4.0")
    assert "t1" not in offered() and "nao-0" in offered()


def test_a_worker_offers_what_can_be_used(broken: Path, environment: pytest.MonkeyPatch) -> None:
    """Broken plug-ins of others keep it from nothing else."""
    environment.setenv("NAOSPRINT_WORKER_QUEUES", "embedded")
    found = installed_capabilities(WorkerSettings())  # type: ignore[call-arg]
    assert "t1" in found.robots and "limps" not in found.robots
    assert "sprint1" in found.tasks and not {"sinks", "dives"} & found.tasks.keys()


def test_trainings_find_both_servers(environment: pytest.MonkeyPatch) -> None:
    environment.setenv("NAOSPRINT_RCSSSERVERMJ", "docker:naosprint/rcssservermj")
    assert WorkerSettings().server_environment == {  # type: ignore[call-arg]
        "NAOSPRINT_SIMSERVER": "rcssserver3d",
        "NAOSPRINT_RCSSSERVERMJ": "docker:naosprint/rcssservermj",
        "NAOSPRINT_RELAY_IMAGE": "",
    }


def test_matches_wait_for_workers_that_embed_and_have_the_server(environment: pytest.MonkeyPatch) -> None:
    def queues() -> list[str]:
        return list(installed_capabilities(WorkerSettings()).simulators)  # type: ignore[call-arg]

    assert queues() == ["server"]
    environment.setenv("NAOSPRINT_WORKER_QUEUES", "embedded,server")
    assert queues() == ["embedded", "server", "match"]
    environment.setattr(world.metadata, "version", lambda name: "3.4.0")
    assert queues() == ["embedded", "server"]


class Engine(BaseHTTPRequestHandler):
    """What a Docker engine answers to a client that asks whether it is there."""

    def do_GET(self) -> None:
        body = b"OK" if self.path.endswith("/_ping") else json.dumps({"ApiVersion": "1.45"}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


def test_matches_of_teams_with_an_image_wait_for_workers_with_an_engine_and_a_relay(
    environment: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def kinds() -> set[str]:
        tasks = installed_capabilities(WorkerSettings()).tasks  # type: ignore[call-arg]
        return {name.removesuffix("match") for name in tasks if name.endswith("match")}

    environment.setenv("NAOSPRINT_WORKER_QUEUES", "embedded")
    environment.setattr(capabilities.confine, "missing", lambda: "")
    with ThreadingHTTPServer(("127.0.0.1", 0), Engine) as engine:
        thread = threading.Thread(target=engine.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        environment.setenv("DOCKER_HOST", f"tcp://127.0.0.1:{engine.server_port}")
        assert kinds() == {"", "confined-"}
        environment.setenv("NAOSPRINT_RELAY_IMAGE", "python:3.11")
        assert kinds() == {"", "confined-", "container-", "confined-container-"}
        environment.setattr(capabilities.confine, "missing", lambda: "no Landlock")
        assert kinds() == {"", "container-"}
        engine.shutdown()
        thread.join()
    assert kinds() == {""}
    assert "this worker plays no matches of teams with an image: Docker: " in caplog.text


@pytest.mark.parametrize(("processors", "slots", "games"), [(1, 1, 1), (2, 1, 1), (8, 1, 4), (8, 2, 2), (4, 4, 1)])
def test_a_slot_plays_one_game_for_every_two_of_its_processors(
    environment: pytest.MonkeyPatch, processors: int, slots: int, games: int
) -> None:
    environment.setattr(os, "sched_getaffinity", lambda _pid: set(range(processors)))
    environment.setenv("NAOSPRINT_WORKER_CONCURRENCY", str(slots))
    assert WorkerSettings().games_at_a_time == games  # type: ignore[call-arg]
    environment.setenv("NAOSPRINT_WORKER_GAMES", "3")
    assert WorkerSettings().games_at_a_time == 3  # type: ignore[call-arg]
