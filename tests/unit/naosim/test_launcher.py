from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from naosim.launchers import PortLease, ProcessLauncher, docker
from naosim.launchers.docker import ContainerSettings, container_options, is_orphan, owner_labels
from naosim.launchers.server import ServerProgram
from naosim.simspark.program import RCSSSERVER3D, SERVER_SCRIPT
from naospec.files import private_folder
from naospec.processes import start_ticks


def test_leases_never_share_a_port() -> None:
    leases = [PortLease(2) for _ in range(20)]
    try:
        ports = [port for lease in leases for port in lease.ports]
        assert len(set(ports)) == 40
    finally:
        for lease in leases:
            lease.release()


def test_a_missing_program_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="no-such-server: no such program"):
        ProcessLauncher(RCSSSERVER3D, ("no-such-server",))


LISTENER = """
import socket, sys
print("cannot load plug-in carbon", flush=True)
if sys.argv[1] == "listen":
    with socket.create_server(("127.0.0.1", int(sys.argv[2]))) as server:
        server.accept()[0].recv(1)
    print("cannot simulate", flush=True)
"""


@pytest.mark.parametrize("what", ["listen", "fail"])
def test_log_of_a_lost_server_is_quoted_without_what_it_prints_at_every_start(what: str) -> None:
    program = ServerProgram(sys.executable, ("-c", LISTENER, what, "{agent_port}"))
    server = ProcessLauncher(program).start()
    try:
        port, until = server.address.agent_port, time.monotonic() + 30
        while what == "listen" and not server.owns(port):
            assert time.monotonic() < until
        if what == "listen":
            with socket.create_connection(("127.0.0.1", port)) as connection:
                connection.send(b"x")
        while server.alive():
            assert time.monotonic() < until
        assert ("cannot simulate" in server.describe()) is (what == "listen")
        assert ("cannot load" in server.describe()) is (what == "fail")
    finally:
        server.stop()


def test_a_server_that_cannot_be_started_leaves_nothing(shared: Path) -> None:
    for program in (ServerProgram(sys.executable, (), files={"no/such": ""}), ServerProgram(sys.executable, ("\0",))):
        with pytest.raises((OSError, ValueError), match=r"no/such|null byte"):
            ProcessLauncher(program).start()
        (locks,) = shared.iterdir()
        assert list(locks.iterdir()) == []


def test_a_container_has_no_rights_and_is_reached_from_this_machine_alone() -> None:
    options = container_options(
        RCSSSERVER3D, ContainerSettings("server:1", {"job": "job_1", "attempt": "2"}, memory="256m", cpus=0.5)
    )
    assert options["cap_drop"] == ["ALL"]
    assert options["read_only"] and options["user"] == "10001:10001"
    assert options["nano_cpus"] == 500_000_000
    assert options["mem_limit"] == options["memswap_limit"] == "256m"
    assert set(options["ports"]) == set(options["port_bindings"])
    assert {host for host, _ in options["port_bindings"].values()} == {"127.0.0.1"}
    assert options["labels"]["job"] == "job_1"
    inside = container_options(RCSSSERVER3D, ContainerSettings("server:1", network="job_1"))
    assert not {"ports", "port_bindings"} & set(inside)
    assert inside["network_mode"] == "job_1"


def test_only_a_container_whose_owner_is_provably_dead_is_an_orphan() -> None:
    labels = owner_labels()
    assert not is_orphan(labels)
    assert not is_orphan({})
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        theirs = labels | {
            docker.OWNER_PID: str(process.pid),
            docker.OWNER_START: str(start_ticks(process.pid)),
        }
        assert not is_orphan(theirs)
        process.communicate(b"\n")
    assert is_orphan(theirs)
    assert is_orphan(labels | {docker.OWNER_START: "1"}), "the number belongs to another process now"
    assert not is_orphan(theirs | {docker.OWNER_HOST: "elsewhere"})
    assert not is_orphan(theirs | {docker.OWNER_START: ""})


@pytest.mark.parametrize(
    ("arguments", "field"),
    [({"image": ""}, "image"), ({"image": "a", "cpus": 0}, "cpus"), ({"image": "a", "pids": 1}, "pids")],
)
def test_bad_container_settings_are_named(arguments: dict[str, object], field: str) -> None:
    with pytest.raises(ValueError, match=field):
        ContainerSettings(**arguments)  # type: ignore[arg-type]


def test_the_image_configures_the_server_as_the_launcher_does() -> None:
    script = Path(__file__).parents[3] / "services" / "simserver" / "docker" / "trainer.rb"
    assert script.read_text() == SERVER_SCRIPT


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a temporary folder of all users."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_locks_of_ports_change_no_file_of_others(shared: Path, tmp_path: Path) -> None:
    """A link in the place of a lock is neither followed nor emptied, and a link for the folder is not used."""
    victim = tmp_path / "victim"
    victim.write_text("precious", encoding="utf-8")
    locks = private_folder(shared / f"naosim-ports-{os.getuid()}")
    for port in ("1", "3100"):
        (locks / port).symlink_to(victim)
    PortLease(2).release()
    assert victim.read_text(encoding="utf-8") == "precious"
    shutil.rmtree(locks)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "precious").write_text("precious", encoding="utf-8")
    locks.symlink_to(elsewhere)
    leases = [PortLease(2), PortLease(2)]
    assert len({port for lease in leases for port in lease.ports}) == 4
    assert [path.name for path in elsewhere.iterdir()] == ["precious"]
    (own,) = {Path(lock.name).parent for lease in leases for lock in lease._locks}
    assert own.parent == shared and own != locks and own.stat().st_mode & 0o777 == 0o700
    for lease in leases:
        lease.release()
    assert (elsewhere / "precious").read_text(encoding="utf-8") == "precious"


def test_a_folder_that_others_may_write_to_is_refused(shared: Path) -> None:
    """It may be full of files of theirs; in a folder of this user's own it is this user's affair."""
    folder = private_folder(shared / "worker")
    assert folder.stat().st_mode & 0o777 == 0o700
    for mode in (0o777, 0o770, 0o1777):
        folder.chmod(mode)
        with pytest.raises(OSError, match="not a folder of this user alone"):
            private_folder(folder)
    folder.chmod(0o755)
    deep = private_folder(folder / "attempts" / "first")  # below a folder that is nobody else's
    folder.chmod(0o757)
    with pytest.raises(OSError, match=r"not a folder of this user alone.*worker'"):
        private_folder(deep)
    (shared / "link").symlink_to(shared / "worker")
    with pytest.raises(OSError, match=r"not a folder of this user alone.*link'"):
        private_folder(shared / "link" / "new")
    shared.chmod(0o700)
    assert private_folder(folder) == folder
    if os.getuid() == 0:
        shared.chmod(0o1777)
        folder.chmod(0o700)
        os.chown(folder, 12345, 12345)
        for taken in (folder, folder / "attempts"):
            with pytest.raises(OSError, match="not a folder of this user alone"):
                private_folder(taken)
        assert private_folder(folder, 12345) == folder


def test_child_processes_do_not_import_from_the_current_folder() -> None:
    """Every Python child process has -P or -I, so a numpy.py in the current folder is ignored."""
    root = Path(__file__).parents[3]
    sources = [path for part in ("packages", "services") for path in (root / part).glob("*/src/**/*.py")]
    starts = {
        path.relative_to(root): re.findall(r"sys\.executable,\s*(\"\S+?)[,\s]", path.read_text(encoding="utf-8"))
        for path in sources
    }
    found = {path: flags for path, flags in starts.items() if flags}
    assert len(found) >= 8
    assert {flag for flags in found.values() for flag in flags} <= {'"-P"', '"-I"'}, found
