"""Measure how fast T1 and K1 are simulated and trained; write throughput.json and ../engine/results_mujoco.json.

    python benchmarks/learning/throughput.py [--seconds 20] [--only engine loop mj_step]

Everything is driven by bundled policies in running states, with the noise of a training:

- ``mj_step``: the fast engine and bare ``mj_step`` in turns, for every instruction set of this processor, one thread
  (``benchmarks/engine/run_mujoco.py``).
- ``engine``: from the same states with the same commands, in turns, the engine with one and with two threads, and the
  environments with two: perceptors, observations, rewards, ends and restarts included.
- ``loop``: trainings with preset ``fast`` on two threads, on the fast engine and on MuJoCo. They start from the bundled
  policy and learn at a rate so small that it stays what it is: every update takes all of its epochs.

Seconds are wall-clock time, so the machine should be quiet; the load before and after is part of the result. CPU time
per step (of all threads) depends less on other work.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from naosprint.programs import above_zero, run_program
from naosprint.threads import quiet_openmp

quiet_openmp()

import naopolicies  # noqa: E402
import numpy as np  # noqa: E402
from naosim.mujoco.embedded import MujocoSimulator  # noqa: E402
from naosim.mujoco.settings import BoosterEmbeddedParameters  # noqa: E402
from naospec import TrainingSpec  # noqa: E402
from naospec.flat import nest  # noqa: E402
from naospec.json_text import json_text  # noqa: E402
from naosprint import train  # noqa: E402
from naosprint.rl.policy import load_policy  # noqa: E402
from naosprint.rl.rollout import TrainingEnvironment  # noqa: E402
from naosprint.tasks.environment import open_training_environment  # noqa: E402

HERE, RECORD = Path(__file__).parent, Path(__file__).with_suffix(".json")

POLICIES = {"t1-sprint": "sprint1", "t1-run": "velocity", "k1-sprint": "sprint1"}
"""Policies, and the tasks in which they run."""

THREADS = 2
LOG_STD = -2.0
"""Logarithm of the exploration's standard deviation."""

BOUNDS = {
    "two_threads_to_one": 1.8,
    "environments_to_engine": 0.85,
    "fast_to_mujoco": 4.5,
    "t1-sprint": 100_000.0,
    "t1-run": 100_000.0,
    "k1-sprint": 80_000.0,
}
"""What is aimed at: ratios, and steps/s of the loops on the fast engine."""


def spec_of(policy: str, **settings: Any) -> TrainingSpec:
    """Return the training with preset ``fast`` of a policy's task and robot, which does not change the policy."""
    constant = {"learning_rate": 1e-8, "learning_rate_schedule": "constant"}
    noise = {"initial_log_std": LOG_STD, "final_log_std": LOG_STD, "log_std_steps": None}
    runtime = {"simulator_threads": THREADS, "learner_threads": THREADS}
    robot, task = policy.partition("-")[0], POLICIES[policy]
    return TrainingSpec.model_validate(
        nest({"task": task, "robot": robot, "total_steps": 10_000_000_000, **constant, **noise, **runtime, **settings})
    )


class Clock:
    """Wall-clock and CPU seconds of each turn."""

    def __init__(self) -> None:
        self.wall: list[float] = []
        self.cpu: list[float] = []

    def __enter__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def __exit__(self, *_: object) -> None:
        self.wall.append(time.perf_counter() - self._began[0])
        self.cpu.append(time.process_time() - self._began[1])


def engine(policy: str, seconds: float) -> dict[str, Any]:
    """Measure the engine on one and two threads, and the environments, in turns."""
    spec = spec_of(policy)
    environment, n_starts = open_training_environment(spec)
    training = TrainingEnvironment.from_spec(spec, environment, n_starts)
    parameters = spec.simulator
    assert isinstance(parameters, BoosterEmbeddedParameters)
    engines = {
        count: MujocoSimulator(
            environment.simulator.robot, environment.n, parameters, threads=count, scene=environment.simulator.scene
        )
        for count in (1, THREADS)
    }
    clocks = {name: Clock() for name in ("engine_1", "engine_2", "environments")}
    acting, _ = load_policy(naopolicies.folder(policy))
    rng, groups = np.random.default_rng(0), environment.simulator.groups
    training.reset()
    warm, until = 100, np.inf
    while warm > 0 or time.monotonic() < until:
        actions = acting.act(environment.observations, rng)
        targets = environment.actuation.targets(np.clip(actions, -1.0, 1.0))
        state = environment.simulator.snapshot()
        assert state is not None
        for count, simulator in engines.items():
            simulator.restore(state)
            with clocks[f"engine_{count}"]:
                for group in groups:
                    simulator.step_async(targets[group], group)
                for group in groups:
                    simulator.step_wait(group)
        with clocks["environments"]:
            for group in groups:
                training.step_async(actions[group], group)
            for group in groups:
                training.step_wait(group)
        warm -= 1
        if warm == 0:  # the robots run
            until = time.monotonic() + seconds
            for clock in clocks.values():
                clock.wall.clear()
                clock.cpu.clear()
    environment.close()
    for simulator in engines.values():
        simulator.close()
    found: dict[str, Any] = {
        name: {
            "steps_per_s": environment.n / float(np.median(clock.wall)),
            "cpu_us_per_step": 1e6 * float(np.median(clock.cpu)) / environment.n,
        }
        for name, clock in clocks.items()
    }
    pace = {name: each["steps_per_s"] for name, each in found.items()}
    found["two_threads_to_one"] = pace["engine_2"] / pace["engine_1"]
    found["environments_to_engine"] = pace["environments"] / pace["engine_2"]
    found["compiled"] = environment.compiled
    return found


class Rows:
    """Reporter that keeps metrics and the CPU time at which they came."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self.cpu: list[float] = []

    def metrics(self, row: dict[str, float]) -> None:
        """Keep a row."""
        self.rows.append(row)
        self.cpu.append(time.process_time())

    def checkpoint(self, path: Path, step: int) -> None:
        """Ignore it."""

    def log(self, level: str, message: str) -> None:
        """Ignore it."""


def loop(policy: str, simulated_by: str, seconds: float) -> dict[str, Any]:
    """Measure a training."""
    spec, rows = spec_of(policy, engine=simulated_by), Rows()

    def stop() -> bool:
        return len(rows.rows) > 3 and rows.rows[-1]["time_s"] - rows.rows[0]["time_s"] > 1.25 * seconds

    with tempfile.TemporaryDirectory() as folder:
        train(spec, workdir=Path(folder), reporter=rows, stop=stop, initial_policy=naopolicies.folder(policy))
    late = [k for k, row in enumerate(rows.rows) if row["time_s"] - rows.rows[0]["time_s"] >= seconds / 4.0]
    last = len(rows.rows) - 1
    first = min(late[0], last - 2)
    steps = rows.rows[last]["step"] - rows.rows[first]["step"]
    chosen = rows.rows[first + 1 : last + 1]
    shares = {name: float(np.mean([row[f"{name}_s"] for row in chosen])) for name in ("collect", "learn")}
    return {
        "steps_per_s": steps / (rows.rows[last]["time_s"] - rows.rows[first]["time_s"]),
        "cpu_us_per_step": 1e6 * (rows.cpu[last] - rows.cpu[first]) / steps,
        "collect_share": shares["collect"] / sum(shares.values()),
    }


def machine() -> dict[str, Any]:
    """Return a description of the machine and its load."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":")[1].strip() for line in lines if "model name" in line), platform.processor())
    return {"processor": model, "cores": os.cpu_count(), "load": [round(load, 1) for load in os.getloadavg()]}


def show(name: str, value: float, bound: float | None = None) -> None:
    """Print a number, and whether it is what is aimed at."""
    text = f"{value:,.0f} steps/s" if value > 50.0 else f"{value:.2f}"
    print(f"  {name}: {text}" + ("" if bound is None else f" ({'met' if value >= bound else 'not met'}: {bound:,g})"))


def main() -> int:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=above_zero, default=20.0, help="length of each measurement")
    parser.add_argument("--only", nargs="+", choices=("engine", "loop", "mj_step"), default=None)
    parser.add_argument("--json", type=Path, default=RECORD)
    options = parser.parse_args()
    chosen = options.only or ("mj_step", "engine", "loop")
    kept = json.loads(options.json.read_bytes()) if options.json.exists() else {}
    results: dict[str, Any] = {**kept, "measured": datetime.now(UTC).date().isoformat(), "before": machine()}

    def keep() -> None:
        results["after"] = machine()
        options.json.write_text(json_text(results), encoding="utf-8")

    if "mj_step" in chosen:
        own = [] if options.json == RECORD else ["--json", str(options.json.with_suffix(".mj_step.json"))]
        subprocess.run([sys.executable, str(HERE.parent / "engine/run_mujoco.py"), *own], check=True)
    if "engine" in chosen:
        results["engine"] = {}
        for policy in POLICIES:
            results["engine"][policy] = found = engine(policy, options.seconds)
            print(f"{policy}{'' if found['compiled'] else ' (environments in Python)'}")
            for name in ("engine_1", "engine_2", "environments"):
                show(name, found[name]["steps_per_s"])
            for name in ("two_threads_to_one", "environments_to_engine"):
                show(name, found[name], BOUNDS[name])
            keep()
    if "loop" in chosen:
        results["loop"] = {}
        for policy, task in POLICIES.items():
            found = {name: loop(policy, name, options.seconds) for name in ("fast", "mujoco")}
            found["fast_to_mujoco"] = found["fast"]["steps_per_s"] / found["mujoco"]["steps_per_s"]
            results["loop"][policy] = found
            print(f"whole loop, {task} from {policy}")
            show("fast", found["fast"]["steps_per_s"], BOUNDS[policy])
            show("mujoco", found["mujoco"]["steps_per_s"])
            show("fast_to_mujoco", found["fast_to_mujoco"], BOUNDS["fast_to_mujoco"])
            keep()
    return 0


if __name__ == "__main__":
    run_program(main)
