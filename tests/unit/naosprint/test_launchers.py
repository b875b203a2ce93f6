"""What stands for one environment is a setting, and a machine starts no more servers than it carries."""

from __future__ import annotations

import os

import pytest
from naosim.launchers import ProcessLauncher
from naospec import TrainingSpec
from naosprint import servers
from naosprint.environment import open_training_batch


def test_the_embedded_server_sends_the_digits_that_a_training_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else may run, nothing can send all digits."""
    monkeypatch.setenv(servers.PROGRAM_VARIABLE, "embedded")
    launcher = servers.server_launcher(3)
    assert isinstance(launcher, ProcessLauncher)
    assert launcher.command[-2:] == ("--digits", "3")
    with pytest.raises(ValueError, match="sensor_digits: servers send 2 or 3 decimals"):
        servers.server_launcher(None)


def test_more_servers_than_a_machine_carries_are_refused_before_the_first_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The message says what to set."""
    monkeypatch.setenv(servers.PROGRAM_VARIABLE, "no-such-server")
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    spec = TrainingSpec(simulator="rcssserver3d", n_envs=9, n_steps=64, batch_size=64)
    with pytest.raises(ValueError, match=r"n_envs: 9 .* at most 8; set n_envs to 8 or less"):
        open_training_batch(spec)


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
    """Before any engine is asked."""
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=message):
        servers.server_launcher()


def test_containers_need_an_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs are nobody's orphans: only containers are asked about."""
    monkeypatch.setenv("DOCKER_HOST", "tcp://127.0.0.1:9")
    monkeypatch.setenv(servers.PROGRAM_VARIABLE, "docker:naosim")
    with pytest.raises(OSError, match="Docker: "):
        servers.server_launcher()
    with pytest.raises(OSError, match="Docker: "):
        servers.reap_servers("docker:naosim")
    assert servers.reap_servers("rcssserver3d") == 0
