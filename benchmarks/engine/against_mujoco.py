"""Hold the fast engine against ``mj_step``: every cycle of running, getting up, flailing and kicking, from full states.

    python benchmarks/engine/against_mujoco.py [--robots 64] [--cycles 250] [--motion NAME]... [--json FILE]

For every robot and cycle of a motion, MuJoCo takes the four substeps from the state before the cycle, warm start and
command included, to the minimum of its cost (tolerance 0). Prints the median, the 99.9th percentile and the maximum of
the largest difference of a position and of a speed, and exits with 1 if any is outside 1e-10 m or rad and 1e-8 m/s or
rad/s. Cycles are counted apart in which MuJoCo jumps: each of the four substeps is MuJoCo's within these bounds from
the state before that substep, but which points of two meshes touch depends on the last digits, so that the cycles
differ. Then the recorded commands are run again by MuJoCo from the first state, and by MuJoCo with a cold warm start:
how far apart two exact runs are shows what a distance from the fast one means. Last, states that no policy reaches.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import naopolicies
import numpy as np
from naosim.mujoco.batch import MujocoBatch
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.mujoco.world import SUBSTEPS, MujocoWorld, library, world_of
from naosim.robots import Robot
from naosim.robots.booster import K1, T1
from naosim.simulator import PLAIN, Scene, Starts
from naospec import EvaluationSpec
from naospec.json_text import json_text
from naosprint.programs import integer, run_program
from naosprint.rl.policy import load_policy
from naosprint.tasks.environment import open_environment

MOST_M, MOST_MPS = 1e-10, 1e-8
AFTER = (10, 50, 100, 200)
"""Cycles after which free runs are compared."""

POLICIES = ("t1-sprint", "t1-run", "t1-getup", "t1-kick", "k1-sprint", "k1-kick")
Cycle = tuple[MujocoBatch, MujocoWorld, Callable[[], object]]


def driven(name: str, n: int, cycles: int) -> Iterator[Cycle]:
    """Yield the cycles of n robots that a bundled policy drives, with the noise with which it explored."""
    policy, manifest = load_policy(naopolicies.folder(name))
    spec = EvaluationSpec().applied_to(manifest.stage_spec)
    spec = spec.model_copy(update={"simulator": spec.simulator.model_copy(update={"engine": "fast"})})
    environment, rng = open_environment(spec, n, threads=1, seed=1), np.random.default_rng(1)
    try:
        starts = environment.task.starts(n, 1, spec.task.start_noise_deg)
        environment.load_starts(starts)
        environment.restart(np.arange(n), np.arange(n) % len(starts))
        simulator = environment.simulator
        assert isinstance(simulator, MujocoSimulator)
        for _ in range(cycles):
            actions = policy.act(environment.observations, rng)
            yield simulator.batch, simulator.world, partial(environment.step, actions)
            ended = np.flatnonzero(environment.terminated | environment.truncated)
            environment.restart(ended, ended % len(starts))
    finally:
        environment.close()


def scripted(robot: Robot, motion: str, n: int, cycles: int) -> Iterator[Cycle]:
    """Yield the cycles of n robots that stand, move at random, or swing a leg through a ball."""
    scene = Scene(ball=True) if motion == "swing" else PLAIN
    simulator = MujocoSimulator(robot, n, BoosterEmbeddedParameters(engine="fast"), scene=scene)
    rng, everyone = np.random.default_rng(2), np.arange(n)
    try:
        simulator.load_starts(Starts(robot.nominal[None]))
        simulator.start(everyone, np.zeros(n, dtype=np.int64))
        targets = np.repeat(robot.nominal[None], n, axis=0)
        hip = robot.joint_names.index("right_hip_pitch")
        for cycle in range(cycles):
            if motion == "flail" and cycle % 10 == 0:
                targets = robot.nominal + rng.normal(size=targets.shape) * 0.8
            if motion == "swing":
                targets[:, hip] = robot.nominal[hip] + (0.6 if cycle % 40 < 15 else -0.9)
                if cycle % 40 == 0:
                    simulator.start(everyone, np.zeros(n, dtype=np.int64))
                    feet = simulator.truth.torso_position + rng.uniform((0.1, -0.2, 0.0), (0.3, 0.2, 0.0), (n, 3))
                    simulator.place_ball(everyone, np.column_stack([feet[:, :2], np.full(n, 0.11)]))
            yield simulator.batch, simulator.world, partial(simulator.step, targets)
    finally:
        simulator.close()


def motions(n: int, cycles: int) -> dict[str, Iterator[Cycle]]:
    """Return all motions by name."""
    named = {name: driven(name, n, cycles) for name in POLICIES}
    for robot in (T1, K1):
        for motion in ("stand", "flail", "swing"):
            named[f"{robot.name}-{motion}"] = scripted(robot, motion, n, cycles)
    return named


def exact_model(world: MujocoWorld) -> Any:
    """Return the world's model with a solver that ends at the minimum, not within a tolerance."""
    model = copy.copy(world.model)
    model.opt.tolerance = 0.0
    return model


def held(cycles: Iterator[Cycle]) -> dict[str, Any]:
    """Compare every cycle of a motion; return the distribution of the differences, and of those of free runs."""
    mujoco = library()
    apart: list[tuple[float, float]] = []
    states: list[np.ndarray] = []
    commands: list[np.ndarray] = []
    places: list[np.ndarray] = []
    continued: np.ndarray = np.zeros(0)
    model, data, alone, jumping, largest = None, None, None, 0, np.zeros(2)
    for batch, world, step in cycles:
        if model is None:
            model = exact_model(world)
            data = mujoco.MjData(model)
            alone = MujocoBatch(world, 1, delay=0, truncate=False, substeps=1)
            states = [np.concatenate([[each.time], each.qpos, each.qvel, each.qacc_warmstart]) for each in batch.data]
            continued = np.ones(batch.n, dtype=np.bool_)
        if places:
            moved = np.array([each.qpos for each in batch.data])
            continued &= (moved == places[-1]).all(axis=1)  # not started again
        before = [(each.time, each.qpos.copy(), each.qvel.copy(), each.qacc_warmstart.copy()) for each in batch.data]
        saved = batch.save()
        step()
        for state, row, ours in zip(before, saved, batch.data, strict=True):
            qpos, qvel = cycle_of(model, data, state, ours.ctrl)
            difference = np.abs(qpos - ours.qpos).max(), np.abs(qvel - ours.qvel).max()
            apart.append(difference)
            if not (difference[0] <= MOST_M and difference[1] <= MOST_MPS):
                assert alone is not None
                substeps = by_substep(model, data, alone, row, ours)
                if (substeps <= (MOST_M, MOST_MPS)).all():
                    jumping += 1
                    largest = np.maximum(largest, substeps.max(axis=0))
        commands.append(np.array([each.ctrl for each in batch.data]))
        places.append(np.array([each.qpos for each in batch.data]))
        left = batch.left_to_mujoco
    differences = np.array(apart)
    return {
        "states": len(differences),
        "left_to_mujoco": left,
        **{
            name: dict(zip(("median", "p99.9", "max"), np.quantile(column, (0.5, 0.999, 1.0)).tolist(), strict=True))
            for name, column in zip(("position", "speed"), differences.T, strict=True)
        },
        "outside": int(np.count_nonzero(~(differences <= (MOST_M, MOST_MPS)).all(axis=1))) - jumping,  # NaN included
        "jumping": jumping,
        "jumping_by_substep": dict(zip(("position", "speed"), largest.tolist(), strict=True)),
        "free": free_runs(model, states, commands, places, np.flatnonzero(continued)),
    }


def cycle_of(model: Any, data: Any, state: tuple[Any, ...], ctrl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and speeds after a cycle of MuJoCo from a full state."""
    data.time, data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = state
    data.ctrl[:] = ctrl
    for _ in range(SUBSTEPS):
        library().mj_step(model, data)
    return data.qpos.copy(), data.qvel.copy()


def by_substep(model: Any, data: Any, alone: MujocoBatch, row: np.ndarray, ours: Any) -> np.ndarray:
    """Return the (4, 2) largest differences of positions and speeds after each substep of a cycle.

    The engine takes the cycle again, one substep at a time, and MuJoCo takes each substep from the engine's state
    before it. Where these agree and the cycle does not, MuJoCo jumps: which points of two meshes touch depends on the
    last digits, so that two cycles of MuJoCo itself differ from states that differ by rounding.

    Args:
        model: the model with which MuJoCo steps.
        data: MuJoCo's scratch data.
        alone: a batch of one robot with steps of one substep.
        row: the robot's saved state before the cycle.
        ours: the engine's data after the cycle.

    Raises:
        AssertionError: if the engine alone does not end where it did among its neighbours.
    """
    engine = alone.data[0]
    alone.load(0, row)
    engine.ctrl[:] = ours.ctrl
    found = np.empty((SUBSTEPS, 2))
    for substep in range(SUBSTEPS):
        data.time, data.qpos[:], data.qvel[:] = engine.time, engine.qpos, engine.qvel
        data.qacc_warmstart[:], data.ctrl[:] = engine.qacc_warmstart, engine.ctrl
        library().mj_step(model, data)
        alone.step_unchanged()
        found[substep] = np.abs(data.qpos - engine.qpos).max(), np.abs(data.qvel - engine.qvel).max()
    if not (np.array_equal(engine.qpos, ours.qpos) and np.array_equal(engine.qvel, ours.qvel)):
        raise AssertionError("a cycle of single substeps ends elsewhere than the same cycle at once")
    return found


def free_runs(
    model: Any, states: list[np.ndarray], commands: list[np.ndarray], places: list[np.ndarray], rows: np.ndarray
) -> list[dict[str, float]]:
    """Compare runs of many cycles: the recorded one and MuJoCo's, and MuJoCo's with a cold warm start and MuJoCo's."""
    mujoco = library()
    ends = [after for after in AFTER if after <= len(places)]
    found: dict[int, list[tuple[float, float]]] = {after: [] for after in ends}
    for row in rows.tolist():
        pair = [mujoco.MjData(model) for _ in range(2)]
        for cold, data in enumerate(pair):
            data.time, rest = states[row][0], states[row][1:]
            data.qpos[:], data.qvel[:] = rest[: model.nq], rest[model.nq : model.nq + model.nv]
            data.qacc_warmstart[:] = 0.0 if cold else rest[model.nq + model.nv :]
        for cycle in range(max(ends, default=0)):
            for data in pair:
                data.ctrl[:] = commands[cycle][row]
                for _ in range(SUBSTEPS):
                    mujoco.mj_step(model, data)
            if cycle + 1 in found:
                warm, cold = (data.qpos for data in pair)
                ours = places[cycle][row]
                found[cycle + 1].append((np.abs(ours - warm).max(), np.abs(cold - warm).max()))
    return [
        {
            "cycles": after,
            "robots": len(values),
            **{
                f"{name}_{word}": float(function(np.array(values)[:, k]))
                for k, name in enumerate(("fast", "cold"))
                for word, function in (("median", np.median), ("max", np.max))
            },
        }
        for after, values in found.items()
        if values
    ]


def fuzzed(robot: Robot, n: int, scene: Scene = PLAIN) -> dict[str, Any]:
    """Step states that no policy reaches: spins, deep penetration, joints far beyond their limits, NaN commands.

    Every eighth robot gets a command that is not a number. The others keep their bits; finite ones stay finite or are
    reported as diverged.
    """
    world, rng = world_of(robot, engine="fast", scene=scene), np.random.default_rng(3)
    batches = [MujocoBatch(world, n, delay=0, truncate=False) for _ in range(2)]
    scale = 10.0 ** rng.uniform(-1.0, 3.0, n)
    for row in range(n):
        quaternion = rng.normal(size=4)
        state = (rng.normal(size=2), rng.uniform(-1.0, 0.7), quaternion / np.linalg.norm(quaternion))
        angles, speeds = rng.normal(size=world.joints) * 2.0, rng.normal(size=world.model.nv) * scale[row]
        for batch in batches:
            data, first = batch.data[row], world.torso
            data.qpos[first : first + 3], data.qpos[first + 3 : first + 7] = (*state[0], state[1]), state[2]
            data.qpos[first + 7 :], data.qvel[:] = angles, speeds
    targets = robot.nominal + rng.normal(size=(n, world.joints))
    broken = targets.copy()
    broken[::8, 0] = np.nan
    for _ in range(5):
        batches[0].step(targets)
        batches[1].step(broken)
    others = np.arange(n) % 8 != 0
    same = (batches[0].save() == batches[1].save())[others]
    diverged = batches[0].diverged
    finite = np.array([np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all() for data in batches[0].data])
    return {
        "robots": n,
        "diverged": int(diverged.sum()),
        "left_to_mujoco": batches[0].left_to_mujoco,
        "changed_by_neighbours": int(np.count_nonzero(~same.all(axis=1) & ~diverged[others])),
        "not_finite_unreported": int(np.count_nonzero(~finite & ~diverged)),
    }


def compared(name: str, cycles: Iterator[Cycle]) -> tuple[dict[str, Any], bool]:
    """Compare a motion, print what was found, and return it and whether the engine passes."""
    result = held(cycles)
    position, speed = result["position"], result["speed"]
    print(
        f"{name:<10} {result['states']:>7,} states, {result['outside']} outside, "
        f"{result['jumping']} where MuJoCo jumps, "
        f"{result['left_to_mujoco']} substeps left to mj_step; "
        f"median, 99.9 %, max: {position['median']:.0e} {position['p99.9']:.0e} {position['max']:.1e} m or rad, "
        f"{speed['median']:.0e} {speed['p99.9']:.0e} {speed['max']:.1e} m/s or rad/s"
    )
    if result["jumping"]:
        apart = result["jumping_by_substep"]
        print(f"  substeps of jumping cycles: {apart['position']:.1e} m or rad, {apart['speed']:.1e} m/s or rad/s")
    for run in result["free"]:
        print(
            f"  free run of {run['cycles']} cycles, {run['robots']} robots, median and max: "
            f"fast {run['fast_median']:.0e} {run['fast_max']:.0e}, "
            f"cold warm start {run['cold_median']:.0e} {run['cold_max']:.0e}"
        )
    return result, result["outside"] == 0


def shaken(name: str, robot: Robot, n: int) -> tuple[dict[str, Any], bool]:
    """Step states that no policy reaches, print what was found, and return it and whether the engine passes."""
    result = fuzzed(robot, n)
    print(f"{name:<10} " + ", ".join(f"{key} {value}" for key, value in result.items()))
    return result, not (result["changed_by_neighbours"] or result["not_finite_unreported"])


def main(words: list[str] | None = None) -> int:
    """Compare the motions, print the results, and return 1 if a state is outside."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=integer(), default=64)
    parser.add_argument("--cycles", type=integer(), default=250)
    parser.add_argument("--motion", action="append", help="compare this one only; can be repeated")
    parser.add_argument("--json", type=Path, help="write the results to this file; those of other motions stay in it")
    options = parser.parse_args(words)
    works: dict[str, Callable[[], tuple[dict[str, Any], bool]]] = {
        name: partial(compared, name, cycles) for name, cycles in motions(options.robots, options.cycles).items()
    }
    for robot in (T1, K1):
        works[f"{robot.name}-fuzz"] = partial(shaken, f"{robot.name}-fuzz", robot, 4 * options.robots)
    for name in options.motion or ():
        if name not in works:
            parser.error(f"--motion: unknown motion {name!r}; choose from {', '.join(works)}")
    outside = 0
    for name in options.motion or works:
        result, passes = works[name]()
        outside += not passes
        sys.stdout.flush()
        if options.json:
            kept = json.loads(options.json.read_bytes()) if options.json.exists() else {}
            results = {each: (kept | {name: result}).get(each) for each in works}
            options.json.write_text(
                json_text({each: found for each, found in results.items() if found}), encoding="utf-8"
            )
    return int(outside > 0)


if __name__ == "__main__":
    run_program(main)
