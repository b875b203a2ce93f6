"""Parts of the one-machine stack, with real processes, locks and sockets."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import shlex
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from naoctl.errors import StackError
from naoctl.stack import child as child_module
from naoctl.stack import launch, ports
from naoctl.stack.broker import Broker
from naoctl.stack.child import Program, StackProcess, rotate, tail
from naoctl.stack.doctor import examine
from naoctl.stack.layout import Layout
from naoctl.stack.passwords import read_secrets
from naoctl.stack.postgres import Postgres, find_programs, launch_command, missing_rights
from naoctl.stack.state import MARK, FolderLock, ProcessRecord, StackState, is_locked, marked_processes
from naoctl.stack.supervisor import Options, StackSupervisor, clear_leftovers, find_migrations

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="the kernel's signal at a parent's death is Linux's")


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    made = Layout.at(tmp_path / "data")
    made.make()
    return made


@pytest.fixture
def sleeper() -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Start processes that only wait, and see that none stays."""
    started: list[subprocess.Popen[bytes]] = []

    def start(**environment: str) -> subprocess.Popen[bytes]:
        code = "import sys, time; print('up', flush=True); time.sleep(600)"
        process = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, env={**os.environ, **environment}
        )
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_a_taken_port_is_not_free_and_another_is_chosen() -> None:
    with socket.socket() as taken:
        taken.bind((ports.HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert not ports.is_free(port)
        other = ports.choose([port])
        assert other != port
        assert ports.is_free(other)
    assert ports.is_free(port)
    assert ports.choose([port]) == port


def test_the_data_folder_is_closed_to_others(layout: Layout) -> None:
    assert stat.S_IMODE(layout.root.stat().st_mode) & 0o066 == 0
    for folder in (layout.artifacts, layout.work, layout.logs, layout.broker):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_a_data_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StackError, match="--data-dir"):
        Layout.at(tmp_path / "file" / "data").make()


def test_the_stop_command_names_the_data_folder_unless_it_is_the_usual_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert Layout.at(tmp_path / "my data").stop_command == f"naoctl down --data-dir '{tmp_path}/my data'"
    assert shlex.split(Layout.at(tmp_path / "it's").stop_command)[-1] == f"{tmp_path}/it's"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert Layout.at(tmp_path / "naosprint").stop_command == "naoctl down"
    monkeypatch.setenv("NAOCTL_DATA_DIR", str(tmp_path / "other"))
    assert Layout.at(None).stop_command == f"naoctl down --data-dir {tmp_path}/other"


@pytest.mark.parametrize("name", [b"a\nb", b"a\xff", b"a\x7f"], ids=["line break", "no UTF-8", "control"])
def test_a_data_folder_whose_path_no_file_can_hold_is_refused(tmp_path: Path, name: bytes) -> None:
    with pytest.raises(StackError, match="has a line break, or bytes that are not UTF-8"):
        Layout.at(tmp_path / os.fsdecode(name)).make()


def test_passwords_are_made_once_and_kept_private(layout: Layout) -> None:
    made = read_secrets(layout)
    assert made == read_secrets(layout)
    assert made.postgres != made.broker
    assert stat.S_IMODE(layout.secrets.stat().st_mode) == 0o600
    layout.secrets.write_text("{}")
    with pytest.raises(StackError, match="damaged"):
        read_secrets(layout)


def record_of(name: str, pid: int) -> ProcessRecord:
    """Return the record of a running process."""
    record = ProcessRecord.of(name, pid)
    assert record is not None
    return record


def test_state_survives_a_round_trip(layout: Layout) -> None:
    assert StackState.load(layout) is None
    own = record_of("api", os.getpid())
    state = StackState("abc", 8000, 6000, ready=True, supervisor=own, processes={"api": own})
    state.save(layout)
    assert StackState.load(layout) == state
    layout.state.write_text('{"stack_id": 1}')
    with pytest.raises(StackError, match="damaged"):
        StackState.load(layout)


def test_a_pid_that_is_used_again_is_not_mistaken() -> None:
    own = record_of("x", os.getpid())
    assert own.process() is not None
    for other in (replace(own.identity, ticks=own.identity.ticks - 1), replace(own.identity, boot="another")):
        assert ProcessRecord("x", other).process() is None


def test_a_copied_folder_is_a_stack_of_its_own(
    layout: Layout, tmp_path: Path, sleeper: Callable[..., subprocess.Popen[bytes]]
) -> None:
    marked, recorded = sleeper(**{MARK: "original"}), sleeper()
    StackState("original", 8000, 6000, processes={"api": record_of("api", recorded.pid)}).save(layout)
    copied = Layout.at(shutil.copytree(layout.root, tmp_path / "copy"))
    state = StackState.load(copied)
    assert state is not None
    assert (state.api_port, state.broker_port) == (8000, 6000)
    assert clear_leftovers(state, grace_s=5.0) == 0
    assert marked.poll() is recorded.poll() is None
    original = StackState.load(layout)
    assert original is not None
    assert clear_leftovers(original, grace_s=5.0) == 2


def test_state_of_an_earlier_version_is_read(layout: Layout) -> None:
    old = {"name": "api", "pid": 1, "started_at": 1.5}
    layout.state.write_text(
        json.dumps(
            {
                "stack_id": "abc",
                "api_port": 1,
                "broker_port": 2,
                "ready": False,
                "supervisor": None,
                "processes": {"api": old},
            }
        )
    )
    assert StackState.load(layout) == StackState("abc", 1, 2)


def test_the_folder_lock_ends_with_its_process(layout: Layout) -> None:
    code = textwrap.dedent(
        f"""
        import pathlib, subprocess, sys, time
        from naoctl.stack.state import FolderLock
        lock = FolderLock(pathlib.Path({str(layout.lock)!r}))
        assert lock.acquire()
        # A child must not keep the lock alive.
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        print(child.pid, flush=True)
        time.sleep(600)
        """
    )
    holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert holder.stdout is not None
    grandchild = psutil.Process(int(holder.stdout.readline()))
    try:
        assert is_locked(layout)
        assert not FolderLock(layout.lock).acquire()
        holder.kill()
        holder.wait(60)
        assert not is_locked(layout)
    finally:
        holder.kill()
        grandchild.kill()
        holder.communicate()
        grandchild.wait(60)


@LINUX
def test_a_launched_process_dies_with_its_parent() -> None:
    code = textwrap.dedent(
        """
        import subprocess, time
        from naoctl.stack.postgres import launch_command
        waits = ["sh", "-c", "trap 'exit 7' INT; echo up; while :; do sleep 0.02; done"]
        process = subprocess.Popen(launch_command(waits, death_signal=2), start_new_session=True)
        print(process.pid, flush=True)
        time.sleep(600)
        """
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    words = {parent.stdout.readline().strip() for _ in range(2)}
    assert b"up" in words
    child = psutil.Process(int(next(word for word in words if word != b"up")))
    parent.kill()
    parent.wait()
    child.wait(60)
    parent.stdout.close()


@LINUX
def test_a_process_whose_parent_is_gone_already_does_not_start() -> None:
    command = [sys.executable, "-I", "-S", launch.__file__, "1", "9", launch.SAME_ACCOUNT, "/bin/echo", "started"]
    done = subprocess.run(command, check=False, capture_output=True)
    assert done.returncode == 1
    assert done.stdout == b""


@LINUX
@pytest.mark.skipif(os.geteuid() != 0, reason="only root has rights to give up")
def test_giving_up_root_leaves_one_right_at_most(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o700)
    (closed / "inside").mkdir(mode=0o755)
    (closed / "program").touch(mode=0o755)
    show = [
        "sh",
        "-c",
        # access(2) is what Postgres asks when it looks for its programs
        f"id -u; id -G; ls -d {closed}/inside; "
        f"{sys.executable} -I -S -c 'import os; print(os.access(\"{closed}/program\", os.X_OK))'; "
        f"touch {closed}/x 2>/dev/null || echo no; grep CapEff /proc/self/status",
    ]

    def run(account: str) -> list[str]:
        command = [sys.executable, "-I", "-S", launch.__file__, str(os.getpid()), "9", account, *show]
        return subprocess.run(command, check=False, capture_output=True, text=True).stdout.split()

    # whether it can run the interpreter depends on where that lies
    given_up = [word for word in run("65534:65534:0") if word != "False"]
    assert given_up == ["65534", "65534", "no", "CapEff:", "0000000000000000"]
    kept = run("65534:65534:1")
    assert kept[:4] == ["65534", "65534", f"{closed}/inside", "True"]
    assert bin(int(kept[-1], 16)).count("1") == 1


def test_marked_processes_are_found_and_no_others(sleeper: Callable[..., subprocess.Popen[bytes]]) -> None:
    ours, other = sleeper(**{MARK: "stack-of-this-test"}), sleeper(**{MARK: "another"})
    assert [process.pid for process in marked_processes("stack-of-this-test")] == [ours.pid]
    assert other.poll() is None


def test_leftovers_are_cleared_only_if_they_are_provably_ours(sleeper: Callable[..., subprocess.Popen[bytes]]) -> None:
    marked, recorded, stranger, reused = sleeper(**{MARK: "left"}), sleeper(), sleeper(), sleeper()
    state = StackState(
        "left",
        processes={
            "worker": record_of("worker", recorded.pid),
            "api": ProcessRecord("api", replace(record_of("api", reused.pid).identity, ticks=1)),
        },
    )
    assert clear_leftovers(state, grace_s=5.0) == 2
    assert not any(psutil.pid_exists(process.pid) for process in (marked, recorded))
    assert stranger.poll() is None
    assert reused.poll() is None
    assert clear_leftovers(state, grace_s=5.0) == 0


def program(layout: Layout, code: str) -> Program:
    return Program("api", "API", [sys.executable, "-c", code], {"X": "y"}, layout.log("api"), lambda: True)


def test_a_child_that_dies_is_started_again_later_and_later(layout: Layout, monkeypatch: pytest.MonkeyPatch) -> None:
    child = StackProcess(program(layout, "import os; print(os.environ['X'], 'of this run'); raise SystemExit(3)"))
    waits = []
    for _ in range(8):
        child.start()
        assert child.process is not None
        child.process.wait(10)
        assert not child.is_alive
        waits.append(child.note_death())
        assert child.exit_code == 3
        assert child.record is None
    assert waits == [0.5, 1, 2, 4, 8, 16, 30, 30]
    assert child.last_words(1) == "y of this run"
    monkeypatch.setattr(child_module, "WELL_AFTER_S", 0.0)
    child.start()
    assert child.process is not None
    child.process.wait(10)
    assert child.note_death() == 0.5


def test_a_child_leads_a_session_that_is_killed_whole(layout: Layout) -> None:
    code = (
        "import subprocess, sys, time; "
        "p = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']); "
        "print(p.pid, flush=True); time.sleep(600)"
    )
    child = StackProcess(program(layout, code))
    child.start()
    deadline = time.monotonic() + 10
    while not child.last_words(1) and time.monotonic() < deadline:
        select.select([], [], [], 0.01)
    grandchild = psutil.Process(int(child.last_words(1)))
    assert child.process is not None
    assert os.getsid(child.process.pid) == child.process.pid
    child.stop_now()
    grandchild.wait(60)


def broker_program(broker: Broker, port: int, command: list[str]) -> Program:
    """A program of the broker that may listen on one port."""
    return Program(
        "broker",
        "Broker",
        command,
        {},
        broker.layout.log("broker"),
        broker.is_ready,
        listens=frozenset({(ports.HOST, port)}),
        folder=broker.layout.broker,
        stdin=broker.configuration,
    )


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ((), ""),
        (("--bind", "0.0.0.0"), r"listens on 0\.0\.0\.0 port \d+ instead of 127\.0\.0\.1 port"),
        (("--port", "{other}"), r"listens on 127\.0\.0\.1 port \d+ instead of 127\.0\.0\.1 port"),
        (("--requirepass", ""), "answers without a password"),
    ],
    ids=["as meant", "all addresses", "another port", "no password"],
)
def test_a_program_that_does_not_listen_as_meant_ends_the_start(
    supervisor: tuple[StackSupervisor, list[str]], tmp_path: Path, options: tuple[str, ...], error: str
) -> None:
    layout = Layout.at(tmp_path / "x[b]* 'c'")
    layout.make()
    broker = Broker(layout, "secret", ports.choose([]))
    broker.make()
    command = [*broker.command(), *(option.format(other=ports.choose([])) for option in options)]
    running = supervisor[0]
    expected = pytest.raises(StackError, match=error) if error else contextlib.nullcontext()
    with running._signals():
        running._launch(broker_program(broker, broker.port, command))
        try:
            with expected:
                running._await_ready("broker")
        finally:
            running.children["broker"].stop_now()


@pytest.fixture
def supervisor(layout: Layout) -> Iterator[tuple[StackSupervisor, list[str]]]:
    """A supervisor that has nothing to do yet, and what it says."""
    said: list[str] = []
    made = StackSupervisor(layout, Options(), lambda title, text: said.append(f"{title}: {text}"))
    yield made, said
    made._lock.release()
    for end in (made._wake_read, made._wake_write):
        end.close()


@pytest.mark.parametrize("text", ["", "{", '{"stack_id": 1}', "\0"], ids=["empty", "torn", "partial", "zeros"])
def test_a_state_that_a_power_cut_left_keeps_no_stack_from_starting(
    layout: Layout, supervisor: tuple[StackSupervisor, list[str]], text: str
) -> None:
    layout.state.write_text(text)
    supervisor[0]._take_folder()
    state = StackState.load(layout)
    assert state is not None
    assert state.supervisor == record_of("supervisor", os.getpid())
    assert "damaged" in supervisor[1][0]


def test_a_full_disk_ends_no_supervisor(layout: Layout, supervisor: tuple[StackSupervisor, list[str]]) -> None:
    running, said = supervisor
    running._take_folder()
    child = StackProcess(program(layout, "raise SystemExit(3)"))
    running.children["api"] = child
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))  # every write to a file fails
    try:
        running._start_child(child)
        assert child.process is not None
        child.process.wait(10)
        running._look_after_children()
        layout.logs.rename(layout.root / "away")  # nor can its log be opened
        child.restart_at = 0.0
        running._look_after_children()
        assert child.restart_at > time.monotonic()
        (layout.root / "away").rename(layout.logs)
        child.restart_at = 0.0
        running._look_after_children()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert child.process is not None
    child.process.wait(10)
    assert [line.split(";")[0].split(" (")[0] for line in said] == [
        "State: cannot be written",
        "State: cannot be written",
        "API: died",
        "API: cannot be started",
        "State: cannot be written",
        "API: started again",
    ]


def test_logs_are_set_aside_when_they_grow_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "api.log"
    log.write_text("".join(f"line {n}\n" for n in range(10_000)))
    assert tail(log, 2) == "line 9998\nline 9999"
    rotate(log)
    assert log.exists()
    monkeypatch.setattr(child_module, "MAX_LOG_BYTES", 1000)
    rotate(log)
    assert not log.exists()
    assert (tmp_path / "api.log.1").exists()
    assert tail(log, 2) == ""


def test_postgres_is_reached_by_a_socket_of_short_name_only(tmp_path: Path) -> None:
    near = Postgres(Layout.at(tmp_path), "secret")
    assert near.socket_dir == tmp_path / "run"
    assert "listen_addresses=" in near.command()
    assert near.url.startswith("postgresql://naosprint:secret@/naosprint?host=/")
    for name in ("x" * 120, "a,b", 'a"b', "a\\b"):
        far = Postgres(Layout.at(tmp_path / name), "secret")
        assert len(str(far.socket_dir)) < 60
        assert far.socket_dir == Postgres(Layout.at(tmp_path / name), "other").socket_dir
        assert far.socket_dir != near.socket_dir


def test_folders_of_others_are_neither_used_nor_given_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link that another user has put where the socket, or the data folder, will be."""
    shared, victim = tmp_path / "tmp", tmp_path / "victim"
    for folder, mode in ((shared, 0o1777), (victim, 0o755)):
        folder.mkdir()
        folder.chmod(mode)
    monkeypatch.setattr(tempfile, "tempdir", str(shared))
    before = victim.stat()
    server = Postgres(Layout.at(tmp_path / ("x" * 120)), "secret")
    server.layout.make()
    server.socket_dir.symlink_to(victim)
    with pytest.raises(StackError, match="not a folder of this user alone"):
        server.make()
    assert (victim.stat().st_uid, victim.stat().st_mode) == (before.st_uid, before.st_mode)
    assert not any(victim.iterdir())
    taken = shared / "stack"
    taken.mkdir()
    taken.chmod(0o777)
    with pytest.raises(StackError, match="not a folder of this user alone"):
        Layout.at(taken).make()


def test_a_root_without_its_rights_is_told_from_one_with_them(tmp_path: Path) -> None:
    status = tmp_path / "status"
    assert missing_rights(status) == ""
    status.write_text("Name:\tx\nCapEff:\t00000000a80425fb\n")  # a container's default
    assert missing_rights(status) == ""
    status.write_text("CapEff:\t0000000000000000\n")
    assert missing_rights(status) == "CHOWN, DAC_OVERRIDE, KILL, SETGID, SETUID"


def test_data_of_an_unknown_postgres_is_refused(layout: Layout) -> None:
    layout.postgres.mkdir()
    newest = find_programs(layout.postgres)
    (layout.postgres / "PG_VERSION").write_text("9\n")
    assert find_programs(layout.postgres) == newest  # no cluster yet
    (layout.postgres / "global").mkdir()
    (layout.postgres / "global" / "pg_control").touch()
    for text, shown in (("9\n", "9"), ("", "")):
        (layout.postgres / "PG_VERSION").write_text(text)
        with pytest.raises(StackError, match=f"is of Postgres {shown},"):
            find_programs(layout.postgres)


def fail(*_arguments: str) -> None:
    raise StackError("initdb failed")


def test_a_copy_of_a_cluster_without_its_mark_is_used(
    supervisor: tuple[StackSupervisor, list[str]], layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one of `cp -r postgres/* ...`, which leaves files out whose names begin with a dot."""
    postgres = Postgres(layout, "secret")
    leftover = layout.root / "postgres.part" / "global" / "pg_control"  # of a start that was interrupted
    leftover.parent.mkdir(parents=True)
    leftover.touch()
    layout.postgres.mkdir()  # as an earlier version left it there
    with monkeypatch.context() as patch:
        patch.setattr(postgres, "_run", fail)
        with pytest.raises(StackError, match="initdb failed"):
            postgres.make()
    assert not postgres.is_made
    postgres.make()
    assert postgres.is_made
    assert not leftover.parent.parent.exists()
    running = supervisor[0]

    def ask(statement: str) -> str:
        """Start the server, ask it and stop it."""
        postgres.make()
        with running._signals():
            running._launch(running._postgres_program(postgres))
            try:
                running._await_ready("postgres")
                postgres.ensure_database()
                return postgres._psql(statement)
            finally:
                running.children["postgres"].stop_now()

    ask("CREATE TABLE kept (x integer); INSERT INTO kept VALUES (7)")
    (layout.postgres / ".finished").unlink()
    assert Postgres(layout, "secret").is_made
    assert ask("SELECT x FROM kept").strip() == "7"
    assert (layout.postgres / ".finished").exists(), "earlier versions would delete it"


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        (["my notes.txt"], "has no global/pg_control"),
        (["PG_VERSION", "base/1/PG_VERSION", "base/16384/2619"], "has no global/pg_control"),
        (["PG_VERSION", "base/1/PG_VERSION", "global/pg_control"], "it has 1 of 3 databases"),
    ],
)
def test_a_data_folder_that_cannot_be_used_stays_as_it_is(layout: Layout, files: list[str], reason: str) -> None:
    postgres = Postgres(layout, "secret")
    for name in files:
        path = layout.postgres / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    with pytest.raises(StackError, match=reason) as caught:
        postgres.make()
    assert caught.value.fix is not None and "from a copy" in caught.value.fix
    found = [path.relative_to(layout.postgres).as_posix() for path in layout.postgres.rglob("*") if path.is_file()]
    assert sorted(found) == sorted(files)


def test_no_new_passwords_are_made_for_a_database(layout: Layout) -> None:
    read_secrets(layout)
    (layout.postgres / "global").mkdir(parents=True)
    (layout.postgres / "global" / "pg_control").touch()
    layout.secrets.unlink()
    with pytest.raises(StackError, match="is missing: it has the password"):
        read_secrets(layout)
    assert not layout.secrets.exists()


def test_postgres_locks_of_a_power_cut_are_cleared(
    supervisor: tuple[StackSupervisor, list[str]], layout: Layout
) -> None:
    """Their number is now that of another process, or they are empty; those of a server that runs stay."""
    postgres = Postgres(layout, "secret")
    postgres.make()
    locks = (layout.postgres / "postmaster.pid", postgres.socket_dir / ".s.PGSQL.5432.lock")
    account = {"user": postgres.account.uid, "group": postgres.account.gid} if postgres.account else {}
    running = supervisor[0]
    with running._signals(), subprocess.Popen(["sleep", "600"], **account) as other:
        try:
            for text in (f"{other.pid}\n{layout.postgres}\n", "", "\0\0\0\0"):
                for lock in locks:
                    lock.write_text(text)
                    lock.chmod(0o666)
                postgres.make()
                running._launch(running._postgres_program(postgres))
                try:
                    running._await_ready("postgres")
                    postgres.make()
                    server = running.children["postgres"].process
                    assert server is not None
                    assert [int(lock.read_text().split()[0]) for lock in locks] == [server.pid] * 2
                    postgres.ensure_database()
                finally:
                    running.children["postgres"].stop_now()
        finally:
            other.kill()


def test_postgres_without_passwords_is_refused(supervisor: tuple[StackSupervisor, list[str]], layout: Layout) -> None:
    postgres = Postgres(layout, "secret")
    postgres.make()
    rules = layout.postgres / "pg_hba.conf"
    rules.write_text("local all all trust\n" + rules.read_text())
    running = supervisor[0]
    with running._signals():
        running._launch(running._postgres_program(postgres))
        try:
            running._await_ready("postgres")
            with pytest.raises(StackError, match="1 rules that need no password"):
                postgres.ensure_database()
        finally:
            running.children["postgres"].stop_now()


def test_the_brokers_password_stands_in_a_private_file_alone(layout: Layout) -> None:
    broker = Broker(layout, "secret", 6000)
    broker.make()
    path = layout.broker / "valkey.conf"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    text = path.read_text()
    assert "requirepass secret" in text
    assert "bind 127.0.0.1" in text
    assert "appendonly yes" in text
    assert "secret" not in " ".join(broker.command())
    assert not broker.is_ready()


def test_migrations_are_found_beside_the_source_or_where_the_user_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (find_migrations() / "versions").is_dir()
    monkeypatch.setenv("NAOSPRINT_MIGRATIONS", str(tmp_path))
    with pytest.raises(StackError, match="NAOSPRINT_MIGRATIONS"):
        find_migrations()
    (tmp_path / "env.py").touch()
    assert find_migrations() == tmp_path.resolve()


def test_the_doctor_looks_at_everything_without_leaving_a_trace(tmp_path: Path) -> None:
    findings = {finding.subject: finding for finding in examine(Layout.at(tmp_path / "none"))}
    wanted = {
        "Python",
        "Processor",
        "Memory",
        "Disk",
        "Packages",
        "Engine",
        "Postgres",
        "Broker",
        "Migrations",
        "Stack",
        "Port",
    }
    assert wanted <= findings.keys()
    assert [finding for finding in findings.values() if finding.verdict == "failed"] == []
    assert "10 cycles of 2 robots" in findings["Engine"].text
    assert not (tmp_path / "none").exists()


def test_launch_command_names_this_very_process() -> None:
    command = launch_command(["true"], death_signal=signal.SIGINT)
    assert command[4:7] == [str(os.getpid()), "2", launch.SAME_ACCOUNT]
