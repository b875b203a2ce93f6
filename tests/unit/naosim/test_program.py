"""The server's program is a setting, and a machine starts no more servers than it can run."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from naosim import kinds, robots
from naosim.launchers import ProcessLauncher, ServerProgram, reap_servers
from naosim.simspark import server_launcher
from naosim.simspark.program import PROGRAM_VARIABLE


def test_the_embedded_server_sends_the_digits_of_the_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PROGRAM_VARIABLE, "embedded")
    launcher = server_launcher(3)
    assert isinstance(launcher, ProcessLauncher)
    assert launcher.command[-2:] == ("--digits", "3")
    with pytest.raises(ValueError, match="sensor_digits: servers send 2 or 3 decimals"):
        server_launcher(None)


def test_more_servers_than_a_machine_runs_are_refused_before_the_first_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PROGRAM_VARIABLE, "no-such-server")
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    kind, robot = kinds.get("server"), robots.get("nao-0")
    parameters = kind.parameters(robot)()
    assert kind.max_robots() == 8
    with pytest.raises(ValueError, match=r"n_envs: 9 .* at most 8; set n_envs to 8 or less"):
        kind.open(robot, 9, parameters)
    with pytest.raises(FileNotFoundError, match=r"NAOSPRINT_SIMSERVER: .*'no-such-server'.*or to 'embedded'"):
        kind.open(robot, 8, parameters)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"NAOSPRINT_SIMSERVER": "docker:"}, "NAOSPRINT_SIMSERVER: name the image"),
        (
            {"NAOSPRINT_SIMSERVER": "docker:naosim", "NAOSPRINT_SIMSERVER_LABELS": "job"},
            "NAOSPRINT_SIMSERVER_LABELS: must be key=value,key=value, not 'job'",
        ),
    ],
)
def test_malformed_container_settings_are_named(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], message: str
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=message):
        server_launcher()


def test_only_containers_need_an_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DOCKER_HOST", "tcp://127.0.0.1:9")
    monkeypatch.setenv(PROGRAM_VARIABLE, "docker:naosim")
    with pytest.raises(OSError, match="Docker: "):
        server_launcher()
    with pytest.raises(OSError, match="Docker: "):
        reap_servers("rcssserver3d", "docker:naosim")
    assert reap_servers("rcssserver3d", "") == 0


def test_a_program_gets_its_ports_its_files_and_its_own_signal(tmp_path: Path) -> None:
    """Differences between rcssserver3d and other servers are data."""
    report = tmp_path / "report"
    os.mkfifo(report)
    code = """
import os, signal, sys
report = open(sys.argv[1], "w", buffering=1)
def ended(*_):
    report.write("ended")
    sys.exit()
signal.signal(signal.SIGINT, ended)
print(*sys.argv[2:], open("settings").read(), os.getcwd() == os.environ["HOME"], file=report)
while True:
    signal.pause()
"""
    program = ServerProgram(
        name="server",
        arguments=("--aport", "{agent_port}", "--mport", "{monitor_port}"),
        process_arguments=("{home}/settings",),
        files={"settings": "content"},
        agent_port=1,
        monitor_port=2,
        stop_signal=signal.SIGINT,
    )
    assert program.container_command() == ["--aport", "1", "--mport", "2"]
    handle = ProcessLauncher(program, (sys.executable, "-c", code, str(report))).start()
    try:
        with report.open() as lines:
            words = lines.readline().split()
            handle.stop()
            assert lines.read() == "ended"
    finally:
        handle.stop()
    assert not handle.alive()
    address = handle.address
    assert words[:4] == ["--aport", str(address.agent_port), "--mport", str(address.monitor_port)]
    assert words[4].endswith("/settings")
    assert words[5:] == ["content", "True"]
