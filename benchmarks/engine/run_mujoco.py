"""Measure the MuJoCo loop beside a bare loop over ``mj_step`` in C++, in the same worlds on the same core.

    python benchmarks/engine/run_mujoco.py [--json results.json]

Both loops step 64 robots from the same states with the same commands, in turns, and CPU time of the one thread is
counted, so that other work on the machine disturbs both alike. The bare loop calls ``mj_step`` four times a cycle and
does nothing else; the other one prints perceptors and reads contact forces besides. Bundled policies drive the robots
of the first measurements; both loops take their states and commands, so the ratio is that of running states.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from against_mujoco import POLICIES, driven
from naosim.mujoco.batch import MujocoBatch
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters, Engine
from naosim.mujoco.world import MUJOCO_VERSION, world_of
from naosim.robots.booster import ROBOTS, T1
from naosim.robots.description import Robot
from naosim.simulator import Starts
from naospec.json_text import json_text
from naosprint.programs import run_program
from naosprint.tasks.robot_defaults import robot_defaults

ROBOTS_AT_ONCE = 64
STEPS = 300
ENGINES: tuple[Engine, ...] = ("mujoco", "fast")


def targets_of(robot: Robot, motion: str, step: int) -> np.ndarray:
    """Return the (n, J) targets of a step: standing, or stepping on the spot."""
    targets = np.repeat(robot.nominal[None], ROBOTS_AT_ONCE, axis=0)
    if motion == "trot":
        phase = np.sin(2 * np.pi * (step / 25 + np.arange(ROBOTS_AT_ONCE) / ROBOTS_AT_ONCE))
        for side, swing in (("left", np.maximum(phase, 0)), ("right", np.maximum(-phase, 0))):
            for joint, angle in (("hip_pitch", -0.3), ("knee_pitch", 0.6), ("ankle_pitch", -0.3)):
                targets[:, robot.joint_names.index(f"{side}_{joint}")] += angle * swing
    return targets


def measure(robot: Robot, motion: str, engine: Engine) -> dict[str, Any]:
    """Return cycles per CPU second of both loops."""
    simulator = MujocoSimulator(robot, ROBOTS_AT_ONCE, BoosterEmbeddedParameters(engine=engine, action_delay=0))
    simulator.load_starts(Starts(robot.nominal[None]))
    everyone = np.arange(ROBOTS_AT_ONCE)
    simulator.start(everyone, np.zeros(ROBOTS_AT_ONCE, dtype=np.int64))
    bare = MujocoBatch(simulator.world, ROBOTS_AT_ONCE, delay=0)
    seconds: dict[str, list[float]] = {"loop": [], "bare": []}
    for step in range(STEPS):
        # a fallen robot costs more
        down = everyone[simulator.truth.torso_position[:, 2] < robot_defaults(robot).fall_height_m]
        simulator.start(down, np.zeros(len(down), dtype=np.int64))
        targets = targets_of(robot, motion, step)
        for row, state in enumerate(simulator.batch.save()):
            bare.load(row, state)
            bare.data[row].ctrl[1::3] = targets[row]
        for name in ("loop", "bare") if step % 2 else ("bare", "loop"):
            began = time.thread_time()
            if name == "loop":
                simulator.step(targets)
            else:
                bare.step_bare(1)
            seconds[name].append(time.thread_time() - began)
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    return {
        "robot": robot.name,
        "motion": motion,
        "engine": engine,
        "loop_cycles_per_s": round(ROBOTS_AT_ONCE / medians["loop"]),
        "bare_cycles_per_s": round(ROBOTS_AT_ONCE / medians["bare"]),
        "ratio": round(medians["bare"] / medians["loop"], 4),
    }


def instruction_sets() -> list[str]:
    """Return those that this processor has, of what the engine is compiled for."""
    world, found = world_of(T1, engine="fast"), []
    for name in ("avx512", "avx2", "generic"):
        with suppress(ValueError):
            MujocoBatch(world, 1, delay=0, isa=name)
            found.append(name)
    return found


def measure_driven(name: str, isa: str) -> dict[str, Any]:
    """Return cycles per CPU second of the fast engine and of the bare loop, in states to which a policy drives."""
    seconds: dict[str, list[float]] = {"loop": [], "bare": []}
    batches: dict[str, MujocoBatch] = {}
    for step, (source, world, advance) in enumerate(driven(name, ROBOTS_AT_ONCE, STEPS)):
        batches = batches or {each: MujocoBatch(world, ROBOTS_AT_ONCE, delay=0, isa=isa) for each in seconds}
        states = source.save()
        advance()
        for batch in batches.values():
            for row, state in enumerate(states):
                batch.load(row, state)
                batch.data[row].ctrl[:] = source.data[row].ctrl
        for each in ("loop", "bare") if step % 2 else ("bare", "loop"):
            began = time.thread_time()
            if each == "loop":
                batches[each].step_unchanged()
            else:
                batches[each].step_bare(1)
            seconds[each].append(time.thread_time() - began)
    medians = {each: float(np.median(values)) for each, values in seconds.items()}
    return {
        "robot": name.partition("-")[0],
        "motion": name,
        "engine": "fast",
        "instructions": isa,
        "loop_cycles_per_s": round(ROBOTS_AT_ONCE / medians["loop"]),
        "bare_cycles_per_s": round(ROBOTS_AT_ONCE / medians["bare"]),
        "ratio": round(medians["bare"] / medians["loop"], 4),
    }


def main() -> None:
    """Measure all robots and motions, print a table, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=Path(__file__).with_name("results_mujoco.json"))
    arguments = parser.parse_args()
    results = []
    print(f"{'robot':<6}{'motion':<12}{'engine':<16}{'loop cycles/s':>14}{'bare cycles/s':>14}{'ratio':>8}")
    measurements = [
        *(partial(measure_driven, name, isa) for name in POLICIES for isa in instruction_sets()),
        *(
            partial(measure, robot, motion, engine)
            for robot in ROBOTS
            for motion in ("stand", "trot")
            for engine in ENGINES
        ),
    ]
    for one in measurements:
        result = one()
        results.append(result)
        print(
            f"{result['robot']:<6}{result['motion']:<12}{result['engine']} {result.get('instructions', ''):<10}"
            f"{result['loop_cycles_per_s']:>14,}{result['bare_cycles_per_s']:>14,}{result['ratio']:>8.2f}"
        )
    document = {
        "measured": time.strftime("%Y-%m-%d"),
        "mujoco": MUJOCO_VERSION,
        "processor": platform.processor() or platform.machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "robots_at_once": ROBOTS_AT_ONCE,
        "results": results,
    }
    arguments.json.write_text(json_text(document), encoding="utf-8")


if __name__ == "__main__":
    run_program(main)
