"""Benchmark of the engine's speed in cycles per second."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from naosim.simspark.batch import BatchSimulator
from naosim.simspark.motion import stepping_speeds

WARM_UP = 100


def measure(batch: int, threads: int, cycles: int, robot_type: int = 0, kernel: str | None = None) -> dict[str, Any]:
    """Step robots that keep moving on their feet; measure only the time inside `step`.

    Returns:
        `cycles_per_s`, `solves_per_step` (linear solves a group), `upright` and `awake` (shares of robots at the end).
    """
    sim = BatchSimulator(batch, robot_type, threads=threads, digits=None, kernel=kernel)
    sim.beam((0.0, 0.0, sim.model.standing_height + 0.005))
    busy = 0.0
    for cycle in range(WARM_UP + cycles):
        if cycle == WARM_UP:
            busy, before = 0.0, sim.statistics
        speeds = stepping_speeds(sim.model, cycle, sim.perceptors.joint_angles)
        start = time.perf_counter()
        sim.step(speeds)
        busy += time.perf_counter() - start
    after = sim.statistics
    return {
        "batch": batch,
        "threads": threads,
        "kernel": sim.kernel,
        "cycles_per_s": batch * cycles / busy,
        "solves_per_step": (after["solves"] - before["solves"]) / max(1, after["steps"] - before["steps"]),
        "fallback_rounds": after["fallback"] - before["fallback"],
        "upright": float(np.mean(sim.truth.torso_position[:, 2] > 0.27)),
        "awake": float(np.mean(sim.truth.enabled.all(axis=1))),
    }


def run(batch: int = 64, cycles: int = 2000, robot_type: int = 0, kernel: str | None = None) -> dict[str, Any]:
    """Measure one thread, then every power of two up to the processor's cores.

    Returns:
        `cycles_per_s_per_core` (one thread) and `scaling`, a list of `measure` results with `speed_up`.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    counts = [1]
    while counts[-1] * 2 <= cores:
        counts.append(counts[-1] * 2)
    results = [measure(batch, threads, cycles, robot_type, kernel) for threads in counts]
    for result in results:
        result["speed_up"] = result["cycles_per_s"] / results[0]["cycles_per_s"]
    return {
        "cycles_per_s_per_core": results[0]["cycles_per_s"],
        "robot_type": robot_type,
        "cores": cores,
        "scaling": results,
    }
