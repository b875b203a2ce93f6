"""Measure the deployment: sizes of images, times to start, and the needs of one job.

    python benchmarks/deployment/run.py [--record FILE] [--steps 1000000] [--no-sidecars]

Builds the images and starts a compose project of its own on the available engine, as tests/e2e/compose does, with the
same images in place of official ones where there is no registry. Results of a job are differences between before and
after it: rows and bytes in Postgres, bytes in the store, messages of the broker, and the highest memory of each
container meanwhile, sampled about each second.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import docker
from naospec.json_text import json_text
from naosprint.programs import integer, run_program

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "e2e" / "compose"))
from conftest import Project, missing_engine, open_project, run, write_settings  # noqa: E402

TABLES = ("metrics", "logs", "events", "checkpoints", "evaluations")
MB = 1_000_000
CONNECTIONS = (
    "SELECT application_name, count(*) FROM pg_stat_activity "
    "WHERE datname = 'naosprint' AND pid <> pg_backend_pid() GROUP BY 1"
)


def sql(project: Project, text: str) -> str:
    """Query the database."""
    flags = ("--username=naosprint", "--dbname=naosprint", "--no-align", "--tuples-only", f"--command={text}")
    return project.compose("exec", "-T", "postgres", "psql", *flags).stdout.strip()


def naoctl(project: Project, token: str, *arguments: str, timeout_s: float = 3600) -> Any:
    """Run the command line against the project; return what it printed, decoded where that is JSON."""
    environment = {**os.environ, "NAOCTL_URL": project.url, "NAOCTL_TOKEN": token, "NAOCTL_CONFIG": os.devnull}
    answer = run([sys.executable, "-m", "naoctl", *arguments], env=environment, timeout_s=timeout_s).stdout
    return json.loads(answer) if "--json" in arguments else answer


def image_sizes(project: Project) -> dict[str, float]:
    """Return the size of each image that the project runs, unpacked, in MB."""
    sizes = {}
    for container in project.containers():
        image = container["Image"]
        service = container["Config"]["Labels"]["com.docker.compose.service"]
        sizes[service] = int(run(["docker", "image", "inspect", "--format", "{{.Size}}", image]).stdout) / MB
    return sizes


def timed(action: Any) -> float:
    """Return how long an action takes, in seconds."""
    began = time.monotonic()
    action()
    return time.monotonic() - began


class Usage:
    """Samples memory and processor time of containers, as the engine reports them."""

    def __init__(self, containers: dict[str, str]) -> None:
        self._engine = docker.from_env().api
        self._containers = containers
        self.peak_mb = dict.fromkeys(containers, 0.0)
        self._cpu_ns: dict[str, list[int]] = {name: [] for name in containers}
        self.sample()

    def sample(self) -> None:
        """Sample once. Memory that the kernel may take back at once, inactive file cache, does not count."""
        for name, identifier in self._containers.items():
            try:
                found = self._engine.stats(identifier, stream=False, one_shot=True)
                detail = found["memory_stats"]["stats"]
            except (docker.errors.NotFound, KeyError):  # a server that has ended
                continue
            cache = detail.get("inactive_file", detail.get("total_inactive_file", 0))
            self.peak_mb[name] = max(self.peak_mb[name], (found["memory_stats"]["usage"] - cache) / MB)
            self._cpu_ns[name].append(found["cpu_stats"]["cpu_usage"]["total_usage"])

    def cpu_s(self) -> dict[str, float]:
        """Return the processor time of each container between the first look and the last, in seconds."""
        return {name: (seen[-1] - seen[0]) / 1e9 for name, seen in self._cpu_ns.items() if seen}


@contextmanager
def watching(usage: Usage) -> Iterator[None]:
    """Sample each second until the end."""
    stop = threading.Event()

    def look() -> None:
        while not stop.wait(1.0):
            usage.sample()

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        usage.sample()


def counts(project: Project) -> dict[str, int]:
    """Return rows of each table, bytes of the database and messages that the broker has taken."""
    found = {f"{table}_rows": int(sql(project, f"SELECT count(*) FROM {table}")) for table in TABLES}
    found["database_bytes"] = int(sql(project, "SELECT pg_database_size('naosprint')"))
    found["wal_bytes"] = int(sql(project, "SELECT pg_wal_lsn_diff(pg_current_wal_lsn(), '0/0')"))
    found["transactions"] = int(sql(project, "SELECT xact_commit FROM pg_stat_database WHERE datname = 'naosprint'"))
    stats = project.compose("exec", "-T", "broker", "valkey-cli", "info", "stats").stdout
    fields = dict(line.split(":", 1) for line in stats.splitlines() if ":" in line)
    found["broker_commands"] = int(fields["total_commands_processed"])
    return found


def store_bytes(project: Project, job: str) -> dict[str, int]:
    """Return the size of a job's files in the store, in bytes by kind."""
    code = (
        "import json, sys; from naojobs.settings import ServiceSettings; from naojobs.store import ArtifactStore; "
        "s = ArtifactStore.from_settings(ServiceSettings()); "
        "print(json.dumps({key: len(s.get_bytes(key)) for key in s.list(sys.argv[1])}))"
    )
    sizes = json.loads(project.compose("exec", "-T", "worker", "python", "-c", code, f"jobs/{job}").stdout)
    kinds: dict[str, int] = {}
    for key, size in sizes.items():
        kind = key.split("/")[2]
        kinds[kind] = kinds.get(kind, 0) + size
    return kinds


def measure_start(project: Project) -> dict[str, float]:
    """Return the times to start with existing images, in seconds."""
    project.compose("down", "--volumes", "--timeout", "20")
    everything = timed(lambda: project.compose("up", "--detach", "--no-build", "--wait", "api", "worker"))
    project.compose("stop", "api", "worker")
    again = timed(lambda: project.compose("up", "--detach", "--no-build", "--wait", "api", "worker"))
    times = {"empty_volumes_to_all_healthy_s": everything, "api_and_worker_again_s": again}
    for service in ("api", "worker"):
        project.compose("stop", service)
        times[f"{service}_start_to_healthy_s"] = timed(
            partial(project.compose, "up", "--detach", "--no-build", "--wait", service)
        )
    return times


def measure_job(project: Project, token: str, *flags: str) -> dict[str, Any]:
    """Run one job; return its needs."""
    services = ("postgres", "broker", "store", "api", "worker")
    containers = {service: project.container(service)["Id"] for service in services}
    before, usage = counts(project), Usage(containers)
    idle = dict(usage.peak_mb)
    began = time.monotonic()
    with watching(usage):
        job = naoctl(project, token, "submit", *flags, "--json")["id"]
        while naoctl(project, token, "status", job, "--json")["progress_step"] == 0:
            time.sleep(0.5)
        connections = dict(line.split("|") for line in sql(project, CONNECTIONS).splitlines())
        naoctl(project, token, "watch", job)
    elapsed = time.monotonic() - began
    after = counts(project)
    done = naoctl(project, token, "status", job, "--json")
    return {
        "flags": list(flags),
        "seconds": elapsed,
        "steps": done["total_steps"],
        "idle_memory_mb": idle,
        "peak_memory_mb": usage.peak_mb,
        "cpu_s": usage.cpu_s(),
        "connections": {name: int(count) for name, count in connections.items()},
        **{name: after[name] - before[name] for name in after},
        "store_bytes": store_bytes(project, job),
    }


def measure_idle(project: Project, seconds: float) -> dict[str, Any]:
    """Return the needs of a worker without a job."""
    containers = {service: project.container(service)["Id"] for service in ("postgres", "broker", "api", "worker")}
    before, usage = counts(project), Usage(containers)
    with watching(usage):
        time.sleep(seconds)
    after = counts(project)
    return {
        "seconds": seconds,
        "cpu_s": usage.cpu_s(),
        "peak_memory_mb": usage.peak_mb,
        "transactions": after["transactions"] - before["transactions"],
        "broker_commands": after["broker_commands"] - before["broker_commands"],
    }


def measure_sidecars(project: Project, token: str) -> dict[str, Any]:
    """Return what one server's container takes while a job trains on it."""
    services = ("sidecar-worker", "launcher")
    project.compose("build", "simserver", "rcssservermj", timeout_s=1800)
    project.compose("up", "--detach", "--no-build", "--wait", *services)
    flags = ("--simulator", "server", "--n-envs", "2", "--n-steps", "128", "--batch-size", "128")
    began = time.monotonic()
    job = naoctl(project, token, "submit", *flags, "--steps", "20000", "--no-evaluate", "--json")["id"]
    listing = ["docker", "ps", "--quiet", "--no-trunc", "--filter", f"label=job={job}"]
    while len(servers := run(listing).stdout.split()) < 2:
        if time.monotonic() - began > 120:
            raise SystemExit("no servers came up")
        time.sleep(0.1)
    up = time.monotonic() - began
    names = {f"server_{k}": server for k, server in enumerate(servers)}
    usage = Usage({**names, **{name: project.container(name)["Id"] for name in services}})
    with watching(usage):
        naoctl(project, token, "watch", job)
    metrics = sql(
        project, f"SELECT values->>'steps_per_s' FROM metrics WHERE job_id = '{job}' ORDER BY step DESC LIMIT 1"
    )
    image = run(["docker", "image", "inspect", "--format", "{{.Size}}", "naosprint/simserver:0.2.0"]).stdout
    return {
        "image_mb": int(image) / MB,
        "submit_to_servers_s": up,
        "steps_per_s": float(metrics),
        "peak_memory_mb": usage.peak_mb,
    }


def rounded(value: Any) -> Any:
    """Return numbers with four significant digits."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    return value


def main() -> None:
    """Measure and print; write the record if requested."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--record", type=Path, help="write the results to this file")
    parser.add_argument("--steps", type=integer(), default=1_000_000, help="steps of the job that is measured")
    parser.add_argument("--no-sidecars", action="store_true", help="omit the job on servers")
    arguments = parser.parse_args()
    if reason := missing_engine():
        parser.exit(1, f"{reason}\n")
    with tempfile.TemporaryDirectory() as folder:
        settings = write_settings(Path(folder) / "settings.env")
        with settings.open("a", encoding="utf-8") as file:
            file.write("WORKER_CPUS=2\n")
        (Path(folder) / "wheels").mkdir()
        began = time.monotonic()
        with open_project(settings, Path(folder) / "wheels") as project:
            built = time.monotonic() - began
            record: dict[str, Any] = {
                "machine": {"processors": os.cpu_count(), "kernel": platform.release(), "load": os.getloadavg()[0]},
                "engine": run(["docker", "version", "--format", "{{.Server.Version}}"]).stdout.strip(),
                "official_images": project.has_registry,
                "build_and_first_start_s": built,
                "image_mb": image_sizes(project),
                "start": measure_start(project),
            }
            token = project.token("submit")
            record["idle"] = measure_idle(project, 60)
            record["embedded_job"] = measure_job(
                project, token, "--preset", "fast", "--steps", str(arguments.steps), "--name", "measured"
            )
            if not arguments.no_sidecars:
                record["sidecar_job"] = measure_sidecars(project, token)
    text = json_text(rounded(record))
    print(text)
    if arguments.record:
        arguments.record.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    run_program(main)
