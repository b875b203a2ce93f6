"""Supervisor of the stack: starts its processes, restarts them, and stops them in order."""

from __future__ import annotations

import contextlib
import getpass
import importlib.util
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import httpx
import psutil
from naospec.files import write_whole

from naoctl.client import NO_CERTIFICATES
from naoctl.config import PRIVATE
from naoctl.errors import StackError
from naoctl.stack import ports
from naoctl.stack.broker import Broker
from naoctl.stack.child import Program, StackProcess
from naoctl.stack.environment import service_environment
from naoctl.stack.layout import Layout
from naoctl.stack.passwords import read_secrets
from naoctl.stack.postgres import Postgres, launch_command
from naoctl.stack.state import MARK, FolderLock, ProcessRecord, StackState, marked_processes

API_PORTS = list(range(8000, 8020))
"""Ports tried for the API before any free one is taken."""
API_ATTEMPTS = 3
"""Number of ports to try when another process takes each before the API does."""
STOP_ORDER = ("worker", "api", "broker", "postgres")
"""Order in which the processes are stopped: a process stops before those it depends on."""
WORKER_GRACE_S = 75.0
"""Seconds a training has for its last checkpoint when the worker is stopped, plus some for the worker itself."""
LEFTOVER_GRACE_S = 15.0
"""Seconds in which the trainings of a dead worker may write a checkpoint and end."""


class Stopped(Exception):
    """Interruption of a wait: a stop was requested."""


@dataclass(frozen=True)
class Options:
    """Options of a stack."""

    api_port: int | None = None
    worker_concurrency: int = 1
    worker_queues: str = "embedded"


@dataclass(frozen=True)
class RunningStack:
    """Running stack: its address, its administrator's token, and its supervisor's pid."""

    url: str
    token: str
    pid: int

    @property
    def sign_in_url(self) -> str:
        """Address that signs a browser in; the part behind the # is never sent."""
        return f"{self.url}/#/?token={self.token}"


class StackSupervisor:
    """Supervisor of the four processes of one data folder.

    Args:
        layout: the data folder.
        options: what the user chose.
        say: called with a title and a text for every event.
    """

    def __init__(self, layout: Layout, options: Options, say: Callable[[str, str], None]) -> None:
        self.layout = layout
        self.options = options
        self._say = say
        self.state = StackState()
        self.children: dict[str, StackProcess] = {}
        self.admin_token = ""
        self._lock = FolderLock(layout.lock)
        self._stop_asked = 0
        self._wake_read, self._wake_write = socket.socketpair()

    def run(self, when_ready: Callable[[], None]) -> None:
        """Start the stack, keep it running until a stop is requested, and stop it in any case.

        Args:
            when_ready: called once everything answers.

        Raises:
            StackError: when the folder is taken or a process does not start; nothing is left running then.
        """
        self._take_folder()
        with self._signals():
            try:
                self._start()
                when_ready()
                while True:
                    self._pause(self._until_restart())
                    self._look_after_children()
            except Stopped:
                pass
            finally:
                self._stop()
                self._lock.release()

    def say(self, title: str, text: str) -> None:
        """Report an event; a closed terminal or a broken pipe is no error."""
        with contextlib.suppress(OSError, SystemExit):
            self._say(title, text)

    def running_stack(self) -> RunningStack:
        """Return how to reach the stack."""
        assert self.state.url is not None
        return RunningStack(self.state.url, self.admin_token, os.getpid())

    # Start

    def _take_folder(self) -> None:
        self.layout.make()
        if not self._lock.acquire():
            raise running_already(self.layout)
        try:
            try:
                previous = StackState.load(self.layout)
            except StackError as error:  # after a power cut the file may be empty; no other process holds the lock
                self.say("State", f"{error.message}; starting with a new one")
                previous = None
            if previous:
                cleared = clear_leftovers(previous)
                if cleared:
                    self.say("Cleared", f"{cleared} process{'es' if cleared > 1 else ''} of a killed start stopped")
                self.state = StackState(previous.stack_id, previous.api_port, previous.broker_port)
            self.state.supervisor = ProcessRecord.of("supervisor", os.getpid())
            self.state.save(self.layout)
        except BaseException:
            self._lock.release()
            raise

    def _start(self) -> None:
        passwords = read_secrets(self.layout)
        postgres = Postgres(self.layout, passwords.postgres)
        self.state.broker_port = ports.choose([p for p in (self.state.broker_port,) if p])
        broker = Broker(self.layout, passwords.broker, self.state.broker_port)
        self.state.api_port = self._choose_api_port()
        self.state.save(self.layout)
        if not postgres.is_made:
            self.say("Postgres", f"making {self.layout.postgres}")
        postgres.make()
        broker.make()
        service = self._service_environment()

        self._launch(self._postgres_program(postgres), self._broker_program(broker))
        self._await_ready("postgres", "broker")
        postgres.ensure_database()
        self._migrate(service)
        self._launch(self._worker_program(service))
        self._start_api()
        self._ensure_admin_token(service)
        self._await_ready("worker")
        self.state.ready = True
        self.state.save(self.layout)

    def _start_api(self) -> None:
        """Start the API; if its port was taken since it was found free, try another one."""
        for attempts_left in reversed(range(API_ATTEMPTS)):
            self._launch(self._api_program(self._service_environment()))
            try:
                self._await_ready("api")
            except StackError:
                port = self.state.api_port
                taken = port is not None and not self.children["api"].is_alive and not ports.is_free(port)
                if not taken or not attempts_left or self.options.api_port is not None:
                    raise
                self.say("API", f"port {port} was taken in the meantime")
                self.state.api_port = self._choose_api_port()
            else:
                return

    def _choose_api_port(self) -> int:
        wanted = self.options.api_port
        if wanted is None:
            return ports.choose([p for p in (self.state.api_port,) if p] + API_PORTS)
        if not ports.is_free(wanted):
            raise StackError(f"Port {wanted} is taken", fix="Name another with --port, or leave it out.")
        return wanted

    def _service_environment(self) -> dict[str, str]:
        return {
            **service_environment(self.layout),
            "NAOSPRINT_WORKER_CONCURRENCY": str(self.options.worker_concurrency),
            "NAOSPRINT_WORKER_QUEUES": self.options.worker_queues,
        }

    def _postgres_program(self, postgres: Postgres) -> Program:
        return Program(
            "postgres",
            "Postgres",
            postgres.command(),
            {MARK: self.state.stack_id},
            self.layout.log("postgres"),
            postgres.is_ready,
            stop_signal=signal.SIGINT,
            stop_grace_s=20.0,
            account=postgres.account,
        )

    def _broker_program(self, broker: Broker) -> Program:
        return Program(
            "broker",
            "Broker",
            broker.command(),
            {MARK: self.state.stack_id},
            self.layout.log("broker"),
            broker.is_ready,
            listens=frozenset({(ports.HOST, broker.port)}),
            folder=self.layout.broker,
            stdin=broker.configuration,
        )

    def _api_program(self, environment: dict[str, str]) -> Program:
        command = [sys.executable, "-P", "-m", "naosprint_api"]
        assert self.state.api_port is not None
        return Program(
            "api",
            "API",
            command,
            environment,
            self.layout.log("api"),
            self._api_is_ready,
            stop_grace_s=15.0,
            listens=frozenset({(ports.HOST, self.state.api_port)}),
        )

    def _worker_program(self, environment: dict[str, str]) -> Program:
        command = [sys.executable, "-P", "-m", "naosprint_worker"]
        return Program(
            "worker",
            "Worker",
            command,
            environment,
            self.layout.log("worker"),
            self._worker_is_ready,
            # When the supervisor dies the database goes with it, and a worker asked politely would wait for it to come
            # back. Its training notices the worker's death, and ends by itself.
            stop_grace_s=WORKER_GRACE_S,
            death_signal=signal.SIGKILL,
        )

    def _api_is_ready(self) -> bool:
        try:
            return self._ask("/readyz").status_code == 200
        except httpx.TransportError:
            return False

    def _worker_is_ready(self) -> bool:
        """Return whether the API lists the worker process that runs now."""
        child = self.children["worker"]
        if child.process is None:
            return False
        try:
            response = self._ask("/workers?limit=200")
            return response.status_code == 200 and any(
                worker["pid"] == child.process.pid and worker["alive"] for worker in response.json()["items"]
            )
        except (httpx.TransportError, ValueError):
            return False

    def _launch(self, *programs: Program) -> None:
        for program in programs:
            child = StackProcess(program)
            self.children[program.name] = child
            self._start_child(child)

    def _start_child(self, child: StackProcess) -> None:
        child.start()
        if child.record is not None:  # else it has ended already
            self.state.processes[child.program.name] = child.record
        self._save_state()

    def _await_ready(self, *names: str) -> None:
        """Wait until the named processes answer; one that dies or takes too long ends the start.

        Nothing is asked, and no password sent, before the process itself listens on its addresses and on no others.
        """
        waiting = {name: self.children[name] for name in names}
        pause_s = 0.02
        while waiting:
            for name, child in list(waiting.items()):
                took_s = time.monotonic() - child.started_at
                program = child.program
                if not child.is_alive:
                    assert child.process is not None
                    raise StackError(
                        f"{program.title} ended with code {child.process.returncode}\n{child.last_words()}",
                        fix=f"The whole log is {program.log}.",
                    )
                listening = child.listening()
                if listening - program.listens:
                    raise StackError(
                        f"{program.title} listens on {_addresses(listening)} instead of {_addresses(program.listens)}",
                        fix=f"It was stopped at once. Its log is {program.log}.",
                    )
                if listening == program.listens and program.is_ready():
                    self.say(program.title, f"ready after {took_s:.1f} s")
                    del waiting[name]
                elif took_s > program.ready_within_s:
                    raise StackError(
                        f"{program.title} was not ready within {program.ready_within_s:g} s\n{child.last_words()}",
                        fix=f"The whole log is {program.log}.",
                    )
            if waiting:
                self._pause(pause_s)
                pause_s = min(pause_s * 1.5, 0.25)

    def _migrate(self, environment: dict[str, str]) -> None:
        command = [sys.executable, "-P", "-m", "naojobs", "migrate", "--directory", str(find_migrations())]
        self._run_tool(command, environment)
        self.say("Database", "up to date")

    def _ensure_admin_token(self, environment: dict[str, str]) -> None:
        """Return the administrator's token; create one if there is none or the database does not have it."""
        path = self.layout.admin_token
        self.admin_token = path.read_text(encoding="utf-8").strip() if path.exists() else ""
        if self.admin_token and self._ask("/workers").status_code != 401:
            return
        owner = _user_name()
        command = [sys.executable, "-P", "-m", "naojobs", "token", "create", "--owner", owner, "--name", "naoctl up"]
        answer = json.loads(self._run_tool([*command, "--scope", "admin"], environment))
        self.admin_token = answer["token"]
        write_whole(path, self.admin_token + "\n", mode=PRIVATE)
        self.say("Token", f"made for {owner}, kept in {path}")

    def _ask(self, path: str) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.admin_token}"} if self.admin_token else {}
        # Never through a proxy: this is the loopback.
        return httpx.get(
            f"{self.state.url}{path}", headers=headers, timeout=2.0, trust_env=False, verify=NO_CERTIFICATES
        )

    def _run_tool(self, command: list[str], environment: dict[str, str]) -> str:
        result = subprocess.run(
            launch_command(command, death_signal=signal.SIGKILL),
            check=False,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            env={**os.environ, **environment},
            cwd=self.layout.root,
        )
        with self.layout.log("setup").open("a", encoding="utf-8") as log:
            log.write(result.stderr)
        if result.returncode:
            words = "\n".join((result.stderr or result.stdout).strip().splitlines()[-8:])
            raise StackError(
                f"{' '.join(command[2:])} failed\n{words}", fix=f"The whole log is {self.layout.log('setup')}."
            )
        return result.stdout

    # Watch

    def _until_restart(self) -> float | None:
        waits = [c.restart_at - time.monotonic() for c in self.children.values() if c.restart_at is not None]
        return max(0.0, min(waits)) if waits else None

    def _look_after_children(self) -> None:
        for name, child in self.children.items():
            title = child.program.title
            if child.process is not None and not child.is_alive:
                wait_s = child.note_death()
                self.state.processes.pop(name, None)
                self._save_state()
                self.say(
                    title, f"died ({_cause(child.exit_code)}); starts again in {wait_s:g} s, log: {child.program.log}"
                )
            if child.restart_at is not None and time.monotonic() >= child.restart_at:
                try:
                    self._start_child(child)
                except OSError as error:
                    wait_s = child.put_off()
                    self.say(title, f"cannot be started ({error}); the next attempt is in {wait_s:g} s")
                else:
                    self.say(title, "started again")

    def _save_state(self) -> None:
        """Write the state for other processes; this one has it in memory and continues where the disk is full."""
        try:
            self.state.save(self.layout)
        except OSError as error:
            self.say("State", f"cannot be written ({error}); `naoctl down` may not find every process")

    # Stop

    def ask_to_stop(self) -> None:
        """Request a stop; the second request skips the grace periods."""
        self._stop_asked += 1
        with contextlib.suppress(OSError):
            self._wake_write.send(b"\0")

    def _stop(self) -> None:
        """Stop all processes in order, with their grace periods unless a stop was requested twice."""
        self.state.ready = False
        running = [name for name in STOP_ORDER if name in self.children and self.children[name].is_alive]
        if running:
            self.say("Stopping", "worker, API, broker, Postgres; a running job keeps its progress")
        for name in running:
            child = self.children[name]
            child.ask_to_stop()
            self._await_end(child)
            child.stop_now()
        clear_leftovers(self.state, grace_s=0.0 if self._stop_asked > 1 else LEFTOVER_GRACE_S)
        self.state.supervisor = None
        self.state.processes = {}
        self._save_state()
        if running:
            self.say("Stopped", "nothing is left running")

    def _await_end(self, child: StackProcess) -> None:
        deadline = time.monotonic() + child.program.stop_grace_s
        told = self._stop_asked
        while child.is_alive and time.monotonic() < deadline:
            if self._stop_asked > max(told, 1):
                self.say(child.program.title, "killed after the second request")
                return
            self._doze(deadline - time.monotonic())
        if child.is_alive:
            self.say(child.program.title, f"killed: did not end within {child.program.stop_grace_s:g} s")

    # Signals

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        """Convert signals to a stop request; the death of a child ends any wait."""

        def stop(number: int, frame: FrameType | None) -> None:
            self._stop_asked += 1

        def child_died(number: int, frame: FrameType | None) -> None:
            pass

        self._wake_read.setblocking(False)
        self._wake_write.setblocking(False)
        handlers = {signal.SIGINT: stop, signal.SIGTERM: stop, signal.SIGHUP: stop, signal.SIGCHLD: child_died}
        previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        previous_fd = signal.set_wakeup_fd(self._wake_write.fileno(), warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(previous_fd)
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _doze(self, seconds: float | None) -> None:
        """Wait for a signal, for a limited time."""
        poll = select.poll()  # `select.select` refuses descriptors above 1,023
        poll.register(self._wake_read, select.POLLIN)
        poll.poll(None if seconds is None else 1000 * seconds)
        with contextlib.suppress(BlockingIOError):
            while self._wake_read.recv(4096):
                pass

    def _pause(self, seconds: float | None) -> None:
        """Wait as ``_doze`` does; raise ``Stopped`` if a stop was requested."""
        if not self._stop_asked:
            self._doze(seconds)
        if self._stop_asked:
            raise Stopped


def running_already(layout: Layout) -> StackError:
    """Return the error that a supervisor uses the folder already, with its address."""
    state = StackState.load(layout)
    where = f" at {state.url}" if state and state.ready else ", still starting or stopping"
    who = f" (process {state.supervisor.pid})" if state and state.supervisor else ""
    return StackError(
        f"A stack is running on {layout.root}{where}{who}",
        fix=f"Use it, stop it with `{layout.stop_command}`, or use another --data-dir.",
    )


def clear_leftovers(state: StackState, *, grace_s: float = LEFTOVER_GRACE_S) -> int:
    """Stop the remaining processes of a stack whose supervisor is gone; return their number.

    Only processes that are provably the stack's are touched: those it recorded with their identities, and those that
    have its id in their environment. Trainings end by themselves once their worker is dead, after a last checkpoint.
    """
    found = {process.pid: process for process in marked_processes(state.stack_id)}
    signals = {}
    for record in state.processes.values():
        process = record.process()
        if process is not None:
            found[process.pid] = process
            signals[process.pid] = signal.SIGINT if record.name == "postgres" else signal.SIGTERM
    own = {os.getpid(), *(p.pid for p in psutil.Process().parents())}
    processes = [process for pid, process in found.items() if pid not in own]
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.send_signal(signals.get(process.pid, signal.SIGTERM))
    _, alive = psutil.wait_procs(processes, timeout=grace_s)
    for process in alive:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(alive, timeout=5.0)
    return len(processes)


def find_migrations() -> Path:
    """Return the folder of the database migrations: ``NAOSPRINT_MIGRATIONS``, or that of the installed service.

    Raises:
        StackError: when there is none.
    """
    named = os.environ.get("NAOSPRINT_MIGRATIONS")
    spec = importlib.util.find_spec("naojobs")
    if spec is None or spec.origin is None:
        raise StackError(
            "The service is not installed",
            fix="Install it: pip install naosprint-all, or `make install` in a checkout.",
        )
    folder = Path(named) if named else Path(spec.origin).with_name("migrations")
    if (folder / "env.py").is_file():
        return folder.resolve()
    raise StackError(
        f"No database migrations {'in ' + named if named else 'beside the installed service'}",
        fix="Name their folder with NAOSPRINT_MIGRATIONS.",
    )


def _addresses(addresses: frozenset[ports.Address]) -> str:
    return ", ".join(f"{ip} port {port}" for ip, port in sorted(addresses)) or "no address"


def _user_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "admin"


def _cause(code: int | None) -> str:
    if code is not None and code < 0:
        with contextlib.suppress(ValueError):
            return signal.Signals(-code).name
    return f"exit code {code}"
