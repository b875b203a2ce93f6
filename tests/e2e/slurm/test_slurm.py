"""Workers as jobs of Slurm: started with the queue, preempted, cancelled, and ended when there is nothing to do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from naoctl.stack.environment import service_environment
from naoctl.stack.layout import Layout

from .conftest import Cluster

ROOT = Path(__file__).parents[3]
SMALL = (
    *("--n-envs", "8", "--n-steps", "64", "--batch-size", "128", "--no-evaluate"),
    *("--simulator-threads", "1", "--learner-threads", "1", "--checkpoint-interval-steps", "10240"),
)


@dataclass(frozen=True)
class Service:
    """A service whose own worker has no embedded simulator, so that only Slurm's workers take jobs."""

    environment: dict[str, str]

    def __call__(self, *words: str) -> Any:
        """Run naoctl; return the decoded JSON."""
        command = [sys.executable, "-m", "naoctl", *words, "--json"]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    def scale(self) -> str:
        """Start and end workers once, at most two, of one processor each."""
        command = [str(ROOT / "deploy" / "slurm" / "scale"), "--max", "2", "--once", "--"]
        options = ["--cpus-per-task=1", "--mem=1500", f"--output={self.environment['HOME']}/worker-%j.log"]
        done = subprocess.run([*command, *options], env=self.environment, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()


@pytest.fixture(scope="module")
def service(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Start the service, and write the file of settings of Slurm's workers."""
    home = tmp_path_factory.mktemp("service")
    home.chmod(0o755)
    layout = Layout.at(home / "data")
    environment = {
        **cluster.environment,
        "PATH": f"{Path(sys.executable).parent}:{cluster.environment['PATH']}",
        "HOME": str(home),
        "NAOCTL_CONFIG": str(home / "config.toml"),
        "NAOCTL_DATA_DIR": str(layout.root),
        "NAOSPRINT_ENV": str(home / "worker.env"),
        "NAOSPRINT_WORKER_IDLE_EXIT_S": "5",
    }
    made = Service(environment)
    made("up", "--detach", "--queues", "server")
    names = ("MODE", "DATABASE_URL", "BROKER_URL", "ARTIFACT_URL")
    settings = service_environment(layout)
    lines = [f"NAOSPRINT_{name}='{settings[f'NAOSPRINT_{name}']}'\n" for name in names]
    (home / "worker.env").write_text("".join(lines))
    yield made
    subprocess.run([sys.executable, "-m", "naoctl", "down"], env=environment, check=True, timeout=120)


def test_workers_come_and_go_with_the_queue(cluster: Cluster, service: Service, wait_for: Callable[..., Any]) -> None:
    assert service.scale() == "0 wanted, 0 present"
    jobs = [service("submit", *SMALL, "--steps", "40960", "--seed", str(seed))["id"] for seed in (1, 2, 3)]
    assert service.scale() == "2 wanted, 0 present: started 2"
    assert service.scale() == "2 wanted, 2 present"

    def states() -> set[str]:
        return {service("status", job)["state"] for job in jobs}

    wait_for(lambda: states() == {"succeeded"}, 240, "the jobs did not end")
    wait_for(lambda: not cluster.jobs(), 60, "the workers did not end when there was nothing to do")
    assert service("workers") == [] or all(one["queues"] == ["server"] for one in service("workers"))
    assert service.scale() == "0 wanted, 0 present"


@pytest.mark.parametrize("command", ["requeue", "cancel"])
def test_a_worker_that_slurm_ends_loses_nothing(
    cluster: Cluster, service: Service, wait_for: Callable[..., Any], command: str
) -> None:
    job = service("submit", *SMALL, "--steps", "10000000")["id"]
    service.scale()
    wait_for(lambda: service("checkpoints", job), 120, "no checkpoint came")
    (worker,) = cluster.jobs()
    if command == "requeue":  # as a preemption does
        cluster.run("scontrol", "requeue", worker)
    else:
        cluster.run("scancel", worker)

    def given_back() -> Any:
        found = service("status", job)
        return found if found["attempt"] > 1 or found["state"] == "queued" else None

    back = wait_for(given_back, 60, "the job was not given back")
    if command == "cancel":
        wait_for(lambda: not cluster.jobs(), 60, "the worker did not end")
        # It was given back at the step at which it was stopped, by a checkpoint of that step.
        assert service("checkpoints", job)[0]["step"] == back["progress_step"]
        service.scale()
    resumed = wait_for(
        lambda: (found := service("status", job))["state"] == "running" and found["attempt"] == 2 and found,
        180,
        "the job did not resume on another worker",
    )
    assert resumed["failures"] == 0 and resumed["progress_step"] >= back["progress_step"]
    service("cancel", job)
    wait_for(lambda: not cluster.jobs(), 120, "the worker did not end")


def test_a_script_without_settings_says_so(tmp_path: Path) -> None:
    done = subprocess.run(
        ["bash", ROOT / "deploy" / "slurm" / "worker.sbatch"],
        env={"PATH": os.environ["PATH"]},
        capture_output=True,
        text=True,
        timeout=20,
    )
    assert done.returncode != 0 and "NAOSPRINT_ENV: is not set; name the file of settings" in done.stderr
