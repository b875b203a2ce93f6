"""Teams, their files and the limits of their agents."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import naopolicies
import pytest
from naosim.launchers import Address
from naospec.teams import skills_of
from naosprint.matches import confine
from naosprint.matches.agents import AgentProcess, Limits, cpu_by_session
from naosprint.matches.game import GameSettings
from naosprint.matches.match import log_name, own_folder
from naosprint.matches.teams import find_team, read_team, write_example


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no team.json; write one"),
        ({"command": "player"}, "command: expected a list of texts"),
        ({"command": []}, "command: expected a list of texts"),
        ({"command": ["player", "{side}"]}, "no placeholder side; use python, host"),
        ({"command": ["player"], "reads": 1}, "reads: expected a list"),
    ],
)
def test_a_malformed_team_is_refused_with_what_to_write(tmp_path: Path, content: object, message: str) -> None:
    if content is not None:
        (tmp_path / "team.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        read_team(tmp_path)


def test_an_example_names_its_skills(tmp_path: Path) -> None:
    assert skills_of("example:walk=t1-run-robust")["walk"] == "t1-run-robust"
    assert skills_of("example")["kick"] == "t1-kick"
    for wrong in ("example:fly=t1-run", "example:walk"):
        with pytest.raises(ValueError, match="expected one of walk, kick, keep, getup"):
            skills_of(wrong)
    with pytest.raises(ValueError, match="no such folder"):
        find_team(str(tmp_path / "none"), tmp_path)


def test_a_skill_of_another_task_is_refused(tmp_path: Path) -> None:
    bundled = {"walk": "t1-getup", "kick": "t1-kick", "getup": "t1-getup"}
    with pytest.raises(ValueError, match="skill walk: expected a T1's policy of task velocity, got one of task getup"):
        write_example(tmp_path / "team", {skill: naopolicies.resolve(name) for skill, name in bundled.items()})
    assert not (tmp_path / "team").exists()


def run_agent(
    folder: Path, program: str, arguments: Sequence[str] = ("{port}", "{number}"), **limits: int
) -> tuple[AgentProcess, str]:
    """Run a program as an agent to its end; return it and how it ended."""
    (folder / "player.py").write_text(program)
    (folder / "team.json").write_text(json.dumps({"command": ["{python}", "player.py", *arguments]}))
    agent = AgentProcess(read_team(folder), "left", 3, 1, Address("127.0.0.1", 9, 10), Limits(**limits))
    pause = threading.Event()
    while agent.alive():
        agent.note_cpu(cpu_by_session())
        pause.wait(0.05)
    return agent, agent.describe()


def test_an_agent_gets_its_place_and_its_failure_has_words(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, "import sys; sys.exit(' '.join(sys.argv[1:]))")
    agent.stop()
    assert words == "exit code 1, output: ...9 3"
    assert {"cpu", "memory"} <= set(agent.enforced or ["cpu", "memory"])


def test_memory_and_processor_time_are_limited(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, "bytearray(1 << 30)", memory_mb=256)
    agent.stop()
    assert "MemoryError" in words
    agent, words = run_agent(tmp_path, "while True: pass", cpu_s=1)
    agent.stop()
    assert words.startswith("exit code 1")
    assert agent.cpu_s <= 3.0


def test_files_and_network_are_limited_where_the_kernel_can(tmp_path: Path) -> None:
    program = """
import socket, sys
for what in (lambda: open("/proc/1/environ"), lambda: open("mark", "w"), lambda: open("/root/.profile")):
    try:
        what()
        print("open")
    except OSError as error:
        print(type(error).__name__)
try:
    socket.create_connection(("127.0.0.1", 10), 5)
except OSError as error:
    print(type(error).__name__)
sys.exit(1)
"""
    (tmp_path / "team").mkdir()
    agent, words = run_agent(tmp_path / "team", program)
    enforced = set()
    path = agent._report
    if path.exists():
        enforced = set(json.loads(path.read_text()))
    agent.stop()
    if "TCP" not in enforced:
        pytest.skip("this kernel has no Landlock with rules for TCP")
    assert words.count("PermissionError") == 4, words
    assert not (tmp_path / "team" / "mark").exists()
    assert sys.executable


needs_all_limits = pytest.mark.skipif(bool(confine.missing()), reason=confine.missing())

ATTACKS = """
import ctypes, os, resource, signal, socket, sys

path, abstract, victim, port = sys.argv[1], "\\0" + sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
libc = ctypes.CDLL(None, use_errno=True)

def unix(kind=socket.SOCK_STREAM, to=path):
    socket.socket(socket.AF_UNIX, kind).connect(to)

def through_a_pair():
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    pair[0].sendto(b"x", path + ".datagrams")

def ring():
    if libc.syscall(425, 1, ctypes.create_string_buffer(120)) < 0:
        raise OSError(ctypes.get_errno(), "io_uring_setup")

attacks = {
    "stream": unix,
    "abstract": lambda: unix(to=abstract),
    "datagrams": lambda: unix(socket.SOCK_DGRAM, path + ".datagrams"),
    "pair of datagrams": through_a_pair,
    "kill": lambda: os.kill(victim, signal.SIGKILL),
    "limits of others": lambda: resource.prlimit(victim, resource.RLIMIT_CPU, (1, 1)),
    "mptcp": lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM, 262).connect(("127.0.0.1", port)),
    "smc": lambda: socket.socket(43, socket.SOCK_STREAM).connect(("127.0.0.1", port)),
    "fast open": lambda: socket.socket().sendto(b"x", 0x20000000, ("127.0.0.1", port)),
    "fast open, message": lambda: socket.socket().sendmsg([b"x"], [], 0x20000000, ("127.0.0.1", port)),
    "mode": lambda: os.chmod(path, 0),
    "attribute": lambda: os.setxattr(path + ".file", "user.x", b"1"),
    "ring": ring,
}
for name, attack in attacks.items():
    try:
        attack()
        print(name, "done;")
    except PermissionError:
        pass
    except OSError as error:
        print(name, error, ";")
"""
NEEDS = """
import asyncio, multiprocessing, os, signal, socket, ssl, subprocess, sys, threading
import numpy

asyncio.run(asyncio.sleep(0))
with socket.socketpair()[0], socket.socket(type=socket.SOCK_DGRAM) as datagrams:
    datagrams.sendto(b"x", ("127.0.0.1", 9))
socket.getaddrinfo("localhost", 80)
process = multiprocessing.get_context("fork").Process(target=signal.pause)
process.start()
process.kill()
process.join()
assert subprocess.run(["/bin/sh", "-c", "ulimit -n && id -un && date"], capture_output=True).returncode == 0
open(os.environ["HOME"] + "/note", "w").close()
numpy.linalg.inv(numpy.random.default_rng().random((300, 300)))
assert ssl.create_default_context()
print("all of it")
"""


@needs_all_limits
def test_an_agent_reaches_no_socket_process_or_file_outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not on the ways that Landlock does not see, either."""
    monkeypatch.chdir(tmp_path)  # the name of a socket is short
    (tmp_path / "team").mkdir()
    (tmp_path / "endpoint.file").write_text("")
    with subprocess.Popen(["sleep", "600"]) as victim, socket.create_server(("127.0.0.1", 0)) as server:
        with contextlib.ExitStack() as stack:
            for name in ("endpoint", f"\0{tmp_path}", "endpoint.datagrams"):
                kind = socket.SOCK_DGRAM if name == "endpoint.datagrams" else socket.SOCK_STREAM
                each = stack.enter_context(socket.socket(socket.AF_UNIX, kind))
                each.bind(name)
                if kind == socket.SOCK_STREAM:
                    each.listen()
            words = [str(tmp_path / "endpoint"), str(tmp_path), str(victim.pid), str(server.getsockname()[1])]
            agent, said = run_agent(tmp_path / "team", ATTACKS, arguments=words)
            enforced, ended = agent.enforced, victim.poll()
            agent.stop()
        victim.kill()
    assert (said, ended) == ("exit code 0", None)
    assert {"files", "TCP", "signals", "Unix sockets"} <= set(enforced)
    assert (tmp_path / "endpoint").stat().st_mode & 0o777


@needs_all_limits
def test_an_agent_has_what_programs_need(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, NEEDS)
    agent.stop()
    assert words == "exit code 0, output: ...all of it"


@needs_all_limits
def test_an_agent_reads_no_secrets_of_the_machine(tmp_path: Path) -> None:
    """Other settings than programs need, devices, and programs that no team names."""
    program = "import os\nfor name in ('/etc', '/etc/fstab', '/etc/shadow', '/dev', '/dev/shm', '/opt'):\n"
    program += "    try:\n        os.close(os.open(name, os.O_RDONLY))\n        print(name)\n"
    program += "    except (PermissionError, FileNotFoundError):\n        pass\n"
    agent, words = run_agent(tmp_path, program)
    agent.stop()
    assert words == "exit code 0"


def refused_by(program: bytes, architecture: int, number: int, *arguments: int) -> bool | None:
    """Run a filter of system calls; return whether it refuses one, none if it ends the process."""
    code = list(struct.iter_unpack("HBBI", program))
    data = struct.pack("IIQ6Q", number, architecture, 0, *arguments, *[0] * (6 - len(arguments)))
    at, value = 0, 0
    while True:
        operation, true, false, operand = code[at]
        at += 1
        if operation == 0x20:
            (value,) = struct.unpack_from("I", data, operand)
        elif operation == 0x54:
            value &= operand
        elif operation in (0x15, 0x35):
            at += true if (value == operand if operation == 0x15 else value >= operand) else false
        else:
            return {0x7FFF0000: False, 0x00050001: True, 0x80000000: None}[operand]


@pytest.mark.parametrize(
    ("machine", "own", "other", "numbers"),
    [
        ("x86_64", 0xC000003E, 0x40000003, {"read": 0, "socket": 41, "socketpair": 53, "sendto": 44, "chmod": 90}),
        ("aarch64", 0xC00000B7, 0x40000028, {"read": 63, "socket": 198, "socketpair": 199, "sendto": 206, "chmod": 53}),
    ],
)
def test_calls_are_refused_on_both_machines(machine: str, own: int, other: int, numbers: dict[str, int]) -> None:
    program = confine.call_filter(machine)

    def refused(name: str, *arguments: int) -> bool | None:
        return refused_by(program, own, numbers[name], *arguments)

    assert not refused("read", 1)
    assert [refused("socket", family, 1) for family in (1, 2, 10, 16, 17, 40)] == [True, *3 * [False], True, True]
    assert refused("socket", 1 << 32 | 1, 1), "the kernel reads 32 bits"
    assert [refused("socketpair", 1, kind | 0o2000000) for kind in (1, 2, 3, 5)] == [False, True, True, False]
    assert [refused("sendto", 3, 0, 0, flags) for flags in (0, 0x4000, 0x20004000)] == [False, False, True]
    assert refused("chmod")
    assert refused_by(program, own, numbers["read"] | 1 << 30), "x32"
    assert refused_by(program, other, numbers["read"]) is None
    assert confine.call_filter("riscv64") == b""


def test_what_a_machine_lacks_to_confine_an_agent_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confine, "landlock_version", lambda: 5)
    assert confine.missing() == "the kernel has no Landlock of version 6; use Linux 6.12 or newer with it"
    monkeypatch.setattr(confine, "landlock_version", lambda: 6)
    monkeypatch.setattr(confine, "_MACHINES", {})
    assert "no filter of system calls (seccomp)" in confine.missing()


def test_a_teams_digest_is_that_of_its_files(tmp_path: Path) -> None:
    """Wherever they are; compiled files, which appear while it plays, do not count."""
    for name in ("a", "b"):
        folder = tmp_path / name
        (folder / "parts").mkdir(parents=True)
        (folder / "team.json").write_text(json.dumps({"command": ["{python}", "player.py"]}))
        (folder / "parts" / "legs.py").write_text("left = 1")
    first, second = (read_team(tmp_path / name) for name in ("a", "b"))
    known = first.digest()
    assert second.digest() == known
    (tmp_path / "b" / "parts" / "__pycache__").mkdir()
    (tmp_path / "b" / "parts" / "__pycache__" / "legs.pyc").write_bytes(b"1")
    assert second.digest() == known
    (tmp_path / "b" / "parts" / "legs.py").rename(tmp_path / "b" / "legs.py")
    assert second.digest() != known
    (tmp_path / "a" / "team.json").write_text(json.dumps({"command": ["{python}", "player.py", "fast"]}))
    assert read_team(tmp_path / "a").digest() != known


def test_a_folder_has_the_games_of_one_match(tmp_path: Path) -> None:
    """Otherwise a new version of a team would have the results of the old one."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "team.json").write_text(json.dumps({"command": ["{python}", name]}))
    teams = (read_team(tmp_path / "a"), read_team(tmp_path / "b"))
    settings, logs = GameSettings(players=2, half_s=10.0), tmp_path / "logs"
    assert own_folder(logs, teams, settings) == 0
    assert own_folder(logs, (teams[1], teams[0]), settings) == 0, "nothing has been played"
    assert own_folder(logs, teams, settings) == 0
    (logs / log_name(1)).write_bytes(b"")
    assert own_folder(logs, teams, settings) == 1
    for others, what in (
        ((teams[1], teams[0]), "first team, second team"),
        (teams, "players, seconds"),
    ):
        other = settings if others != teams else GameSettings(players=3, half_s=20.0)
        with pytest.raises(ValueError, match=rf"logs: has 1 games of another match \({what}\); name another folder"):
            own_folder(logs, others, other)
    (tmp_path / "b" / "player.py").write_text("faster = True")
    with pytest.raises(ValueError, match=r"\(second team\)"):
        own_folder(logs, teams, settings)
    (logs / "match.json").unlink()
    with pytest.raises(ValueError, match="which one, is not known"):
        own_folder(logs, teams, settings)


@pytest.mark.parametrize("limits", [{"cpu_s": 0}, {"memory_mb": -1}])
def test_limits_are_positive(limits: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be at least 1"):
        Limits(**limits)
