"""What the container engine is asked for when a team plays from an image, and the relay that takes it to the server."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from naosim.launchers import Address
from naosprint.matches import relay
from naosprint.matches.agents import Limits
from naosprint.matches.containers import RELAY_VARIABLE, ContainerAgents, agent_options, relay_options
from naosprint.matches.endpoints import SOCKET, AgentEndpoints
from naosprint.matches.teams import read_team


def test_a_team_may_name_an_image_in_place_of_programs_of_this_machine(tmp_path: Path) -> None:
    (tmp_path / "team.json").write_text(json.dumps({"image": "base:1", "command": ["{host}", "{port}"]}))
    team = read_team(tmp_path)
    assert team.image == "base:1"
    assert team.agent(host="127.0.0.1", port=3100) == ["127.0.0.1", "3100"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"image": "", "command": ["a"]}, "image: expected the name of a container image"),
        ({"image": "-v /:/host", "command": ["a"]}, "image: expected the name of a container image"),
        ({"image": 3, "command": ["a"]}, "image: expected the name of a container image"),
        ({"image": "a"}, "command: expected a list of texts"),
        ({"image": "a", "command": ["{python}"]}, "command: {python} is of this machine; name the image's own"),
        ({"image": "a", "command": ["b"], "reads": ["/opt"]}, "reads: an image has its own files; leave it out"),
    ],
)
def test_a_malformed_image_is_refused_with_what_to_write(tmp_path: Path, content: object, message: str) -> None:
    (tmp_path / "team.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        read_team(tmp_path)


def test_agents_have_limits_and_no_network_but_that_of_their_relay() -> None:
    options = agent_options("naosim-relay", Limits(cpu_s=60, memory_mb=300))
    assert options["network_mode"] == "container:naosim-relay"
    assert (options["mem_limit"], options["memswap_limit"]) == ("300m", "300m")
    assert options["ulimits"] == [{"name": "cpu", "soft": 60, "hard": 60}]
    for each in (options, relay_options(Path("/tmp/relay"))):
        assert each["user"] != "0" and not each["user"].startswith("0:")
        assert each["read_only"] and each["cap_drop"] == ["ALL"] and each["security_opt"] == ["no-new-privileges"]
        assert (each["pids_limit"], each["nano_cpus"]) == (64, 1_000_000_000)
        assert list(each["tmpfs"]) == ["/tmp"] and each["tmpfs"]["/tmp"].startswith("size=16m,")
        assert "ports" not in each
    assert "binds" not in options
    alone = relay_options(Path("/tmp/relay"))
    assert alone["network_mode"] == "none"
    assert [bind["mode"] for bind in alone["binds"].values()] == ["ro"]


def test_without_a_relay_image_the_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(RELAY_VARIABLE, raising=False)
    with pytest.raises(OSError, match=f"{RELAY_VARIABLE}: not set, .* set it to an image with Python 3"):
        ContainerAgents()


@pytest.fixture
def echo() -> Iterator[int]:
    """Port of a server that returns what it gets."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    client, _ = server.accept()
                except OSError:
                    return
                with client:
                    while data := client.recv(1 << 16):
                        client.sendall(data)

        thread = threading.Thread(target=serve)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
    thread.join()


def test_a_relay_passes_both_ways_and_ends_a_connection_with_its_other_side(tmp_path: Path, echo: int) -> None:
    path = tmp_path / "server"
    command = [sys.executable, "-I", "-S", relay.__file__, f"tcp:127.0.0.1:{echo}", f"unix:{path}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"listening\n"
        for text in (b"(init T1 left 3)", bytes(300_000)):
            with socket.socket(socket.AF_UNIX) as client:
                client.settimeout(30)
                client.connect(str(path))
                threading.Thread(target=client.sendall, args=(text,)).start()
                got = bytearray()
                while len(got) < len(text):
                    got += client.recv(1 << 16)
                assert got == text
                client.shutdown(socket.SHUT_WR)
                assert client.recv(1) == b""
        process.kill()


def began(address: str | tuple[str, int], text: str) -> bytes:
    """Begin a connection with a message; return the first message that comes back, none if it is closed."""
    with socket.socket(socket.AF_UNIX if isinstance(address, str) else socket.AF_INET) as client:
        client.settimeout(30)
        client.connect(address)
        client.sendall(len(text).to_bytes(4, "big") + text.encode())
        try:
            return client.recv(4 + len(text), socket.MSG_WAITALL)[4:]
        except ConnectionError:
            return b""


def test_an_endpoint_passes_one_connection_of_its_player_only(echo: int) -> None:
    """As the other team's player, as one more of its own, or a second time."""
    endpoints = AgentEndpoints(
        Address("127.0.0.1", echo, 1), {("left", 1): False, ("right", 1): False, ("right", 2): True}
    )
    try:
        left, right = ((each.host, each.agent_port) for each in map(endpoints.address, [("left", 1), ("right", 1)]))
        socket_path = str(endpoints.folder(("right", 2)) / SOCKET)
        for text in ("(init T1 right 1)", "(init T1 left 2)", "(init T1 left 101)", "(init T1 left 1)(init)", "(syn)"):
            assert began(left, text) == b"", text
        assert endpoints.entered() == set()
        assert endpoints.refused(("left", 1)).startswith(
            "; it began with '(init T1 right 1)', not with (init MODEL left 1"
        )
        # connections of one agent take no place from others
        waiting = [socket.create_connection(left) for _ in range(100)]
        assert began(right, "(init T1 right 1)") == b"(init T1 right 1)"
        assert began(socket_path, "(init K1 right 2)") == b"(init K1 right 2)"
        for each in waiting:
            each.close()
        assert began(left, " (init  T1 left 1) ") == b"(init T1 left 1)", "what the server gets is in one form"
        assert endpoints.entered() == {("left", 1), ("right", 1), ("right", 2)}
        assert endpoints.refused(("left", 1)) == ""
        with pytest.raises(ConnectionRefusedError):
            began(right, "(init T1 right 1)")
    finally:
        endpoints.close()
    assert not endpoints.folder(("right", 2)).parent.exists()


def test_endpoints_that_do_not_open_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for name, error in (("no/such", "No such file"), ("x" * 100, r"relay to 127.0.0.1:9 does not start: .* too long")):
        with pytest.raises(OSError, match=error):
            AgentEndpoints(Address("127.0.0.1", 9, 10), {(name, 1): True})
        assert list(tmp_path.iterdir()) == []


def test_many_refusals_at_one_endpoint_do_not_hold_up_another(echo: int) -> None:
    endpoints = AgentEndpoints(Address("127.0.0.1", echo, 1), {("left", 1): False, ("right", 1): False})
    try:
        left, right = ((each.host, each.agent_port) for each in map(endpoints.address, [("left", 1), ("right", 1)]))
        for _ in range(200):
            assert began(left, "\N{SNOWMAN}" * 300) == b""
        assert began(right, "(init T1 right 1)") == b"(init T1 right 1)"
        assert endpoints.entered() == {("right", 1)}
    finally:
        endpoints.close()
