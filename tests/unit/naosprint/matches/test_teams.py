"""Teams, their files and the limits of their agents."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import select
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import naopolicies
import pytest
from naosim.launchers import Address
from naospec.teams import skills_of
from naosprint.matches import agents, confine
from naosprint.matches.agents import AgentProcess, Limits, cpu_by_session
from naosprint.matches.game import GameSettings
from naosprint.matches.match import log_name, own_folder
from naosprint.matches.teams import Team, find_team, read_team, write_example


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
    assert skills_of("example")["kick"] == "t1-kick-firm"
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


@pytest.mark.skipif(
    subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False).returncode != 0,
    reason="no namespaces of users and mounts",
)
def test_a_full_disk_leaves_nothing_of_a_team(tmp_path: Path) -> None:
    script = 'mount -t tmpfs -o size=100k tmpfs "$1" && ! "$2" -m naosprint team "$1/team" && ls -A "$1/team"'
    command = ["unshare", "-rm", "sh", "-c", script, "sh", str(tmp_path), sys.executable]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")
    assert re.fullmatch(rf"error: {tmp_path}/team/\S+: No space left on device\n", done.stderr)


LANDLOCK = ctypes.CDLL(None, use_errno=True).syscall(444, None, ctypes.c_size_t(0), 1)
"""The version of this kernel's Landlock, -1 without one: landlock_create_ruleset(2)."""
HAS_SECCOMP = Path("/proc/sys/kernel/seccomp").exists() and os.uname().machine in ("x86_64", "aarch64")

needs_tcp_rules = pytest.mark.skipif(LANDLOCK < 4, reason="this kernel has no Landlock with rules for TCP")
needs_seccomp = pytest.mark.skipif(not HAS_SECCOMP, reason="this kernel has no filter of system calls")
needs_all_limits = pytest.mark.skipif(LANDLOCK < 6 or not HAS_SECCOMP, reason="this kernel cannot confine agents")


def write_team(folder: Path, program: str, arguments: Sequence[str], reads: Sequence[Path] = ()) -> Team:
    (folder / "player.py").write_text(program)
    content = {"command": ["{python}", "player.py", *arguments], "reads": [str(path) for path in reads]}
    (folder / "team.json").write_text(json.dumps(content))
    return read_team(folder)


def run_agent(
    folder: Path,
    program: str,
    arguments: Sequence[str] = ("{port}", "{number}"),
    reads: Sequence[Path] = (),
    port: int = 9,
    **limits: int,
) -> tuple[AgentProcess, str]:
    """Run a program as an agent to its end; return it and how it ended."""
    team = write_team(folder, program, arguments, reads)
    agent = AgentProcess(team, "left", 3, 1, Address("127.0.0.1", port, 10), Limits(**limits))
    pause = threading.Event()
    while agent.alive():
        agent.note_cpu(cpu_by_session())
        pause.wait(0.05)
    return agent, agent.describe()


def test_an_agent_gets_its_place_and_its_failure_has_words(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, "import sys; sys.exit(' '.join(sys.argv[1:]))")
    assert words == "exit code 1, log: ...9 3"
    agent.stop()
    assert {"cpu", "memory", "file size", "open files", "core dumps"} <= set(agent.enforced)


def test_memory_and_processor_time_are_limited(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, "bytearray(1 << 30)", memory_mb=256)
    agent.stop()
    assert "MemoryError" in words
    agent, words = run_agent(tmp_path, "while True: pass", cpu_s=1)
    agent.stop()
    assert words == "exit code 137"
    assert 0.5 <= agent.cpu_s <= 3.0


RESOURCES = """
import os, resource
with open(os.environ["HOME"] + "/large", "wb") as file:
    file.truncate(256 << 20)
    try:
        file.truncate((256 << 20) + 1)
    except OSError as error:
        print(error.strerror, end=";")
opened = [0]
try:
    while opened[-1] < 10_000:
        opened.append(os.open("/dev/null", os.O_RDONLY))
except OSError as error:
    print(error.strerror, opened[-1], end=";")
    os.close(opened.pop())
for name in ("CPU", "AS", "FSIZE", "NOFILE", "CORE"):
    soft, hard = resource.getrlimit(getattr(resource, "RLIMIT_" + name))
    print(name, soft, end=" " if soft == hard else " and more; ")
"""


def test_files_are_limited_in_size_and_number_and_there_are_no_core_dumps(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, RESOURCES, cpu_s=60, memory_mb=512)
    agent.stop()
    limits = f"CPU 60 AS {512 << 20} FSIZE {256 << 20} NOFILE 256 CORE 0"
    assert words == f"exit code 0, log: ...File too large;Too many open files 255;{limits}"


ACCESS = """
import os, socket, sys
others, folder, port, other_port = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
home = os.environ["HOME"]
tries = {
    "reading": lambda: open(others),
    "reading of processes": lambda: open("/proc/1/environ"),
    "reading of the log": lambda: open(home + "/../output.log"),
    "writing of its folder": lambda: open("mark", "w"),
    "writing of what it reads": lambda: open(folder + "/mark", "w"),
    "truncating": lambda: os.truncate("player.py", 0),
    "deleting": lambda: os.unlink("player.py"),
    "renaming": lambda: os.rename("player.py", "other.py"),
    "a folder": lambda: os.mkdir("folder"),
    "a link": lambda: os.symlink("player.py", "link"),
    "connecting": lambda: socket.create_connection(("127.0.0.1", other_port), 5),
    "binding": lambda: socket.socket().bind(("127.0.0.1", 0)),
}
for name, attempt in tries.items():
    try:
        attempt()
        print(name, "done;")
    except PermissionError:
        pass
print(open("player.py").read().split()[0], open(folder + "/legs").read())
with open(home + "/note", "w") as note:
    note.write("1")
os.rename(home + "/note", home + "/other")
socket.create_connection(("127.0.0.1", port), 5).close()
"""


@needs_tcp_rules
def test_files_and_network_are_limited_where_the_kernel_can(tmp_path: Path) -> None:
    """It reads its folder and what `reads` names, writes its home directory, and connects to its own port."""
    for name in ("team", "library"):
        (tmp_path / name).mkdir()
    (tmp_path / "others").write_text("secret")
    library = tmp_path / "library"
    (library / "legs").write_text("two")
    with socket.create_server(("127.0.0.1", 0)) as own, socket.create_server(("127.0.0.1", 0)) as other:
        words = [str(tmp_path / "others"), str(library), "{port}", str(other.getsockname()[1])]
        agent, said = run_agent(tmp_path / "team", ACCESS, words, [library], own.getsockname()[1])
    assert said == "exit code 0, log: ...import two"
    agent.stop()
    assert {"files", "TCP"} <= set(agent.enforced)
    assert sorted(path.name for path in tmp_path.glob("*/*")) == ["legs", "player.py", "team.json"]


TREE = """
import os, signal, socket, sys
for leave in (os.getpid, os.setsid, lambda: os.setpgid(0, 0)):
    if not os.fork():
        try:
            leave()
        except PermissionError:
            pass
        break
with socket.create_connection(("127.0.0.1", int(sys.argv[1]))) as server:
    server.sendall(f"{os.getpid()} {os.environ['HOME']}".encode())
signal.pause()
"""


@pytest.mark.parametrize(
    "write",
    [
        "[open(f'{home}/{n}', 'wb').write(bytes(100_000)) for n in range(40)]",
        "[open(f'{home}/{n}', 'wb') for n in range(200)], [os.mkdir(f'{home}/folder{n}') for n in range(600)]",
        "[print('x' * 99_999, flush=True) for n in range(40)]",
    ],
    ids=["files", "names", "output"],
)
def test_an_agent_that_fills_the_disk_is_stopped(write: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agents, "MOST_DISK_BYTES", 3 << 20)
    program = f"import os, signal; home = os.environ['HOME']; {write}; signal.pause()"
    agent, words = run_agent(tmp_path, program)
    assert words == "stopped: its files and its output have more than 3 MiB"
    assert not agent.folder.exists()


OWNER = """
import sys
from pathlib import Path
from naosim.launchers import Address
from naosprint.matches.agents import AgentProcess, Limits
from naosprint.matches.teams import read_team
agent = AgentProcess(read_team(Path(sys.argv[1])), "left", 3, 1, Address("127.0.0.1", int(sys.argv[2]), 10), Limits())
sys.stdin.read()
"""


@needs_seccomp
@pytest.mark.parametrize("killed", [False, True], ids=["stopped", "owner killed"])
def test_all_that_an_agent_has_started_ends_with_it(killed: bool, tmp_path: Path) -> None:
    """Also if that tries to leave the group of processes, and if the process that runs the match is killed."""
    team = write_team(tmp_path, TREE, ["{port}"])
    with socket.create_server(("127.0.0.1", 0)) as server, contextlib.ExitStack() as stack:
        server.settimeout(30)
        port = server.getsockname()[1]
        if killed:
            owner = subprocess.Popen(
                [sys.executable, "-P", "-c", OWNER, str(tmp_path), str(port)], stdin=subprocess.PIPE
            )
            stack.enter_context(owner)
            stack.callback(owner.kill)
            end = owner.kill
        else:
            agent = AgentProcess(team, "left", 3, 1, Address("127.0.0.1", port, 10), Limits())
            stack.callback(agent.stop)
            end = agent.stop
        descriptors = []
        for _ in range(4):
            with server.accept()[0] as connection, connection.makefile() as lines:
                pid, home = lines.read().split(" ", 1)
            descriptors.append(os.pidfd_open(int(pid)))
            stack.callback(os.close, descriptors[-1])
        assert Path(home).is_dir()
        assert not select.select(descriptors, [], [], 0.0)[0]
        end()
        for descriptor in descriptors:
            assert select.select([descriptor], [], [], 30.0)[0], "a process is left"
    assert not Path(home).parent.exists()


def test_an_agent_that_does_not_start_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For example because its folder has been removed."""
    (tmp_path / "team").mkdir()
    (tmp_path / "temporary").mkdir()
    team = write_team(tmp_path / "team", "", [])
    shutil.rmtree(team.folder)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    with pytest.raises(FileNotFoundError, match="team"):
        AgentProcess(team, "left", 3, 1, Address("127.0.0.1", 9, 10), Limits())
    assert list((tmp_path / "temporary").iterdir()) == []


ATTACKS = """
import ctypes, os, resource, signal, socket, sys

path, abstract, victim, port = sys.argv[1], "\\0" + sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
libc = ctypes.CDLL(None, use_errno=True)

def unix(kind=socket.SOCK_STREAM, to=path):
    socket.socket(socket.AF_UNIX, kind).connect(to)

def through_a_pair():
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    pair[0].sendto(b"x", path + ".datagrams")

def system_v(call, *arguments):
    if call(*arguments) < 0:
        raise OSError(ctypes.get_errno(), call.__name__)

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
    "owner": lambda: os.chown(path + ".file", os.getuid(), os.getgid()),
    "attribute": lambda: os.setxattr(path + ".file", "user.x", b"1"),
    "ring": ring,
    "listening": lambda: socket.socket().listen(),
    "memory of System V": lambda: system_v(libc.shmget, 0, 4096, 0o1600),
    "messages of System V": lambda: system_v(libc.msgget, 0, 0o1600),
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
            ended = victim.poll()
            agent.stop()
        victim.kill()
    assert (said, ended) == ("exit code 0", None)
    assert {"files", "TCP", "signals", "Unix sockets"} <= set(agent.enforced)
    assert (tmp_path / "endpoint").stat().st_mode & 0o777


@needs_all_limits
def test_an_agent_has_what_programs_need(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, NEEDS)
    agent.stop()
    assert words == "exit code 0, log: ...all of it"


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
        (
            "x86_64",
            0xC000003E,
            0x40000003,
            {
                "read": 0,
                "socket": 41,
                "socketpair": 53,
                "sendto": 44,
                "chmod": 90,
                "listen": 50,
                "setpgid": 109,
                "setsid": 112,
                "shmget": 29,
                "semget": 64,
                "msgget": 68,
            },
        ),
        (
            "aarch64",
            0xC00000B7,
            0x40000028,
            {
                "read": 63,
                "socket": 198,
                "socketpair": 199,
                "sendto": 206,
                "chmod": 53,
                "listen": 201,
                "setpgid": 154,
                "setsid": 157,
                "shmget": 194,
                "semget": 190,
                "msgget": 186,
            },
        ),
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
    assert all(map(refused, ("chmod", "listen", "setpgid", "setsid", "shmget", "semget", "msgget")))
    assert refused_by(program, own, numbers["read"] | 1 << 30), "x32"
    assert refused_by(program, other, numbers["read"]) is None
    assert confine.call_filter("riscv64") == b""


def test_what_a_machine_lacks_to_confine_an_agent_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (confine.missing() == "") is (LANDLOCK >= 6 and HAS_SECCOMP)
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
