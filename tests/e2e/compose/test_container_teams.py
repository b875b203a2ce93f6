"""Teams that play from a container image, on an available container engine."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from naosim.launchers import Address
from naosprint.matches.agents import Limits
from naosprint.matches.containers import RELAY_VARIABLE, ContainerAgents
from naosprint.matches.endpoints import AgentEndpoints
from naosprint.matches.game import GameSettings, TeamFailedError, play_game
from naosprint.matches.teams import Team, find_team, read_team

BASE = "python:3.11-slim-bookworm"
PROBE = """
import json, os, socket, sys

def tried(what):
    try:
        return what() or "done"
    except OSError as error:
        return type(error).__name__

host, port, other = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
server = socket.create_connection((host, port), 10)
server.sendall(b"\\0\\0\\0\\x10(init T1 left 1)")
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
found = {
    "user": os.getuid(),
    "capabilities": int(status["CapEff"], 16),
    "no new privileges": int(status["NoNewPrivs"]),
    "interfaces": [name for _, name in socket.if_nameindex()],
    "other port": tried(lambda: socket.create_connection((host, other), 5).close()),
    "bridge": tried(lambda: socket.create_connection(("172.17.0.1", other), 5).close()),
    "datagram": tried(lambda: socket.socket(type=socket.SOCK_DGRAM).sendto(b"x", ("172.17.0.1", 53)) and None),
    "name": tried(lambda: socket.getaddrinfo("example.org", 80) and None),
    "write": tried(lambda: open("/mark", "w").close()),
    "scratch": tried(lambda: open("/tmp/mark", "w").close()),
    "socket": os.path.exists("/run/naosprint"),
}
server.sendall(json.dumps(found).encode() + b"\\n")
assert server.recv(10) == b"more\\n"
kept = [bytearray(os.urandom(1 << 20)) for _ in range(512)]
"""

Builder = Callable[[str, dict[str, str | Path]], Team]


@pytest.fixture
def build(engine: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Builder:
    """Build an image with files, and return the team that plays from it with a command."""
    if subprocess.run([engine, "image", "inspect", BASE], capture_output=True).returncode:
        pytest.skip(f"needs the image {BASE}")
    monkeypatch.setenv(RELAY_VARIABLE, BASE)

    def built(command: str, files: dict[str, str | Path]) -> Team:
        tag = f"naosprint-test/{tmp_path.name.lower()}:1"
        (context := tmp_path / "context").mkdir()
        for name, content in files.items():
            if isinstance(content, str):
                (context / name).write_text(content)
            elif content.is_dir():
                shutil.copytree(content, context / name)
            else:
                shutil.copyfile(content, context / name)
        (context / "Dockerfile").write_text(f"FROM {BASE}\nCOPY . /team/\nENV PYTHONPATH=/team\nWORKDIR /team\n")
        subprocess.run([engine, "build", "-q", "-t", tag, context], check=True, capture_output=True)
        request.addfinalizer(lambda: subprocess.run([engine, "rmi", "-f", tag], capture_output=True))
        (folder := tmp_path / "team").mkdir()
        (folder / "team.json").write_text(json.dumps({"image": tag, "command": command.split()}))
        return read_team(folder)

    return built


def containers(engine: str) -> set[str]:
    """Return the names of all containers of servers and agents."""
    shown = subprocess.run(
        [engine, "ps", "-a", "--filter", "label=naosim.server=1", "--format", "{{.Names}}"],
        check=True,
        capture_output=True,
        text=True,
    )
    return set(shown.stdout.split())


def test_an_agent_reaches_its_server_alone_and_has_limits(build: Builder, engine: str) -> None:
    before = containers(engine)
    with socket.create_server(("0.0.0.0", 0)) as other, socket.create_server(("127.0.0.1", 0)) as server:
        number = other.getsockname()[1]
        team = build(f"python3 probe.py {{host}} {{port}} {number}", {"probe.py": PROBE})
        player = ("left", 1)
        endpoints = AgentEndpoints(Address("127.0.0.1", server.getsockname()[1], number), {player: True})
        agents = ContainerAgents()
        try:
            agent = agents.start(team, *player, 1, endpoints.folder(player), Limits(cpu_s=60, memory_mb=128))
            server.settimeout(60)
            client, _ = server.accept()
            with client, client.makefile("rb") as lines:
                client.settimeout(60)
                assert lines.read(20)[4:] == b"(init T1 left 1)"
                found = json.loads(lines.readline())
                assert agent.alive()
                client.sendall(b"more\n")
                lines.read()  # it has ended
            words = agent.describe()
            agent.note_cpu({})
            agent.stop()
        finally:
            agents.close()
            endpoints.close()
    assert found["user"] == 10001
    assert (found["capabilities"], found["no new privileges"]) == (0, 1)
    assert found["interfaces"] == ["lo"]
    assert found["other port"] == "ConnectionRefusedError"
    for way in ("bridge", "datagram"):
        assert found[way] == "OSError", found  # no route
    assert found["name"] == "gaierror"
    assert (found["write"], found["scratch"], found["socket"]) == ("OSError", "done", False)
    assert "out of memory" in words
    assert not agent.alive()
    assert containers(engine) == before
    assert not endpoints.folder(player).exists()


def test_a_missing_image_is_named(build: Builder, tmp_path: Path) -> None:
    (tmp_path / "team.json").write_text(json.dumps({"image": "naosprint-test/none:1", "command": ["player"]}))
    team, example = read_team(tmp_path), find_team("example", tmp_path / "example")
    with pytest.raises(
        TeamFailedError, match="team A: image: there is no image 'naosprint-test/none:1' on this machine"
    ):
        play_game((team, example), ("a", "b"), 0, GameSettings(1, 1.0))


def test_a_team_plays_from_its_image(build: Builder, engine: str, tmp_path: Path) -> None:
    """The example team, once from an image and once as processes; the container's robot moves as it wants to."""
    before = containers(engine)
    example = find_team("example", tmp_path / "example")
    packages = Path(np.__file__).parent
    files: dict[str, str | Path] = {path.name: path for path in example.folder.iterdir() if path.name != "team.json"}
    files |= {name: packages.with_name(name) for name in ("numpy", "numpy.libs")}
    team = build("python3 player.py {host} {port} {team} {number} {players}", files)
    log = play_game((team, example), ("image", "processes"), 0, GameSettings(1, 4.0))
    for half in log.notes["halves"]:
        assert half["lost"] == []
        assert {"cpu", "memory", "TCP"} >= set(half["enforced"]) & {"cpu", "memory", "TCP"} >= {"cpu", "memory"}
        assert all(each["s"] > 0.0 for each in half["cpu_s"]), half["cpu_s"]
    moved = np.linalg.norm(np.diff(log.torso_m[:, 0, :2], axis=0), axis=1)
    assert moved[moved < 0.2].sum() > 1.0, "the robot of the image has not walked"
    assert containers(engine) == before
