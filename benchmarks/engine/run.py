"""Step the same motion on naosim and on libode's dWorldStep; compare paths and cycles per second.

Needs libode's headers (Debian: libode-dev) and a C++ compiler; writes results.json beside this file with --write.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from naosim.robots import nao_model
from naosim.simspark import BatchSimulator
from naosim.simspark.batch import engine_table
from naosim.simspark.motion import stepping_speeds
from naospec.json_text import json_text
from naosprint.programs import integer, run_program

HERE = Path(__file__).parent
WARM_UP = 100


def record(cycles: int, robot_type: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Step one robot in place; return its commands, its torso's path and its start height."""
    sim = BatchSimulator(1, robot_type, digits=None, self_collision=False)
    height = sim.model.standing_height + 0.005
    sim.beam((0.0, 0.0, height))
    commands, path = [], []
    for cycle in range(cycles):
        speeds = stepping_speeds(sim.model, cycle, sim.perceptors.joint_angles)
        sim.step(speeds)
        commands.append(speeds[0])
        path.append(sim.truth.torso_position[0].copy())
    return np.array(commands), np.array(path), height


def libode(commands: np.ndarray, robot_type: int, height: float) -> tuple[np.ndarray, float]:
    """Run the commands on libode; return the torso's path and the seconds inside the steps."""
    model, table = nao_model.model(robot_type), engine_table(nao_model.model(robot_type))
    lines = [f"{len(model.bodies)} {len(commands)} {height!r}"]
    for k, body in enumerate(model.bodies):
        shape = int(table["shape"][k])
        fields = [table["mass"][k], *table["inertia"][k], *table["offset"][k], table["parent"][k], *table["anchor"][k]]
        fields += [*table["axis"][k], table["low"][k], table["high"][k], shape, *body.shape.size]
        lines.append(" ".join(repr(float(x)) for x in fields))
    lines.append(str(WARM_UP))
    order = [model.joint_index[next(j.name for j in model.joints if j.body == b.name)] for b in model.bodies[1:]]
    lines += [" ".join(repr(float(x)) for x in row[order]) for row in commands]
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "ode_oracle"
        compiler = [os.environ.get("CXX", "g++"), "-O3", "-march=native", "-std=c++17"]
        subprocess.run([*compiler, HERE / "ode_oracle.cpp", "-o", program, "-lode"], check=True)
        out = subprocess.run([program], input="\n".join(lines), capture_output=True, text=True, check=True).stdout
    rows = out.split("\n")
    path = np.array([[float(x) for x in row.split()] for row in rows[: len(commands)]])
    return path, float(rows[len(commands)])


def naosim(commands: np.ndarray, robot_type: int, height: float, batch: int) -> float:
    """Run the commands in a whole batch, each environment a little later than the last; return the seconds in steps."""
    sim = BatchSimulator(batch, robot_type, digits=None, self_collision=False)
    sim.beam((0.0, 0.0, height))
    seconds = 0.0
    late = np.arange(batch)
    for cycle in range(len(commands)):
        speeds = commands[np.maximum(0, cycle - late)]
        start = time.perf_counter()
        sim.step(speeds)
        if cycle >= WARM_UP:
            seconds += time.perf_counter() - start
    return seconds


def measure(cycles: int, batch: int, robot_type: int) -> dict[str, Any]:
    """Return both speeds and the distance of the two paths."""
    commands, path, height = record(cycles, robot_type)
    oracle, ode_seconds = libode(commands, robot_type, height)
    ours_seconds = naosim(commands, robot_type, height, batch)
    counted = cycles - WARM_UP
    off = np.linalg.norm(path - oracle, axis=1)
    return {
        "robot_type": robot_type,
        "cycles": cycles,
        "naosim_cycles_per_s": batch * counted / ours_seconds,
        "naosim_batch": batch,
        "libode_cycles_per_s": counted / ode_seconds,
        "times_libode": (batch * counted / ours_seconds) / (counted / ode_seconds),
        "torso_apart_after_100_cycles_m": float(off[99]),
        "torso_apart_max_m": float(off.max()),
    }


def main() -> None:
    """Print one result a robot type; with the machine's name and load."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=integer(WARM_UP + 1), default=2000)
    parser.add_argument("--batch", type=integer(), default=64)
    parser.add_argument("--write", action="store_true", help="write results.json")
    arguments = parser.parse_args()
    result = {
        "processor": platform.processor() or platform.machine(),
        "kernel": BatchSimulator(1).kernel,
        "load_average": os.getloadavg()[0],
        "results": [measure(arguments.cycles, arguments.batch, robot_type) for robot_type in nao_model.ROBOT_TYPES],
    }
    text = json_text(result)
    print(text)
    if arguments.write:
        (HERE / "results.json").write_text(text + "\n")


if __name__ == "__main__":
    run_program(main)
