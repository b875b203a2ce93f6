"""How the program of rcssservermj is found."""

from __future__ import annotations

import signal
import sys

import pytest
from naosim.launchers import DockerLauncher, ProcessLauncher
from naosim.mujoco import program
from naosim.mujoco.world import MujocoUnavailableError, metadata


def test_the_environments_own_server_is_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(program.PROGRAM_VARIABLE, raising=False)
    launcher = program.server_launcher()
    assert isinstance(launcher, ProcessLauncher)
    assert launcher.command[1:] == ("-P", "-m", "rcsssmj") and launcher.command[0].startswith(sys.prefix)


def test_a_process_listens_on_this_machine_alone_and_is_interrupted() -> None:
    command = program.RCSSSERVERMJ.process_command(1, 2, "/home")
    assert command[:4] == ["--aport", "1", "--mport", "2"]
    assert {"--sync", "--no-realtime", "--no-render"} <= set(command)
    assert command[command.index("--host") + 1] == "127.0.0.1"
    assert "--host" not in program.RCSSSERVERMJ.container_command()
    assert program.RCSSSERVERMJ.stop_signal == signal.SIGINT


def test_another_version_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(program.PROGRAM_VARIABLE, raising=False)
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(metadata, "version", lambda name: "3.4.0")
    with pytest.raises(MujocoUnavailableError, match=r"mujoco: version 3.5.0 is needed, 3.4.0 is installed; run 'pip"):
        program.server_launcher()


def test_the_variable_names_a_program_or_an_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(program.PROGRAM_VARIABLE, "/no/such/server")
    with pytest.raises(FileNotFoundError, match="NAOSPRINT_RCSSSERVERMJ: there is no program '/no/such/server'"):
        program.server_launcher()
    monkeypatch.setattr(
        DockerLauncher, "__init__", lambda self, kind, settings: vars(self).update(kind=kind, image=settings.image)
    )
    monkeypatch.setenv(program.PROGRAM_VARIABLE, "docker:naosprint/rcssservermj")
    launcher = program.server_launcher()
    assert vars(launcher) == {"kind": program.RCSSSERVERMJ, "image": "naosprint/rcssservermj"}
