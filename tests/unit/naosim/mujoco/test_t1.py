"""The kernel that steps several T1s at once, held against ``mj_step``."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from naosim.mujoco.batch import MujocoBatch
from naosim.mujoco.t1 import topology_difference
from naosim.mujoco.world import SUBSTEPS, library, world_of
from naosim.robots.booster import K1, T1

N = 24
FAST = world_of(T1, exact=False)


def violent(rng: np.random.Generator, data: object, row: int) -> None:
    """Set a state that no policy should reach: any orientation, in the ground, beyond the limits, fast."""
    low = row % 2 == 0
    quaternion = rng.normal(size=4) if low else np.array([1.0, 0.0, 0.0, 0.0]) + 0.1 * rng.normal(size=4)
    data.qpos[:3] = (*rng.normal(size=2), rng.uniform(0.05, 0.5) if low else rng.uniform(0.6, 0.7))  # type: ignore[attr-defined]
    data.qpos[3:7] = quaternion / np.linalg.norm(quaternion)  # type: ignore[attr-defined]
    data.qpos[7:] = np.array(T1.nominal) + rng.normal(size=23) * 0.5  # type: ignore[attr-defined]
    data.qvel[:] = rng.normal(size=29) * (4.0 if low else 1.0)  # type: ignore[attr-defined]
    data.qacc_warmstart[:] = 0.0  # type: ignore[attr-defined]


def filled(n: int = N, threads: int = 1, isa: str = "", seed: int = 3) -> MujocoBatch:
    batch = MujocoBatch(FAST, n, delay=0, truncate=False, threads=threads, isa=isa)
    rng = np.random.default_rng(seed)
    for row, data in enumerate(batch.data):
        violent(rng, data, row)
    return batch


def test_a_cycle_is_mj_steps_from_violent_states() -> None:
    """Floor, limits, self contacts, friction, air, sensors and foot forces; with other masses, friction and gravity."""
    mujoco = library()
    rng = np.random.default_rng(8)
    left = 0
    for varied in (False, True):
        batch = filled(120, seed=4 + varied)
        worlds = [
            FAST.varied(0.2, rng.uniform(0.5, 1.5), rng.uniform(0.9, 1.1), rng) if varied else FAST for _ in batch.data
        ]
        for row, world in enumerate(worlds):
            batch.set_world(row, world)
        targets = np.array(T1.nominal) + rng.normal(size=(batch.n, 23)) * 0.5
        before = [(data.qpos.copy(), data.qvel.copy()) for data in batch.data]
        batch.step(targets)
        left += batch.left_to_mujoco
        for row, (world, (qpos, qvel)) in enumerate(zip(worlds, before, strict=True)):
            model = copy.copy(world.model)
            model.opt.tolerance = 0.0  # to the minimum, as the kernel
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, batch.data[row].ctrl
            for _ in range(SUBSTEPS):
                mujoco.mj_step(model, data)
            ours = batch.data[row]
            np.testing.assert_allclose(ours.qpos, data.qpos, rtol=0, atol=1e-9)
            np.testing.assert_allclose(ours.qvel, data.qvel, rtol=0, atol=1e-7)
            np.testing.assert_allclose(ours.sensordata, data.sensordata, rtol=1e-7, atol=1e-5)
    assert 0 < left < 0.5 * 2 * 120 * SUBSTEPS, "boxes go to mj_step, most others do not"


def test_instruction_sets_threads_and_neighbours_do_not_change_a_bit() -> None:
    rng = np.random.default_rng(9)
    targets = np.array(T1.nominal) + rng.normal(size=(10, N, 23)) * 0.3

    def run(threads: int, isa: str, rows: list[int]) -> np.ndarray:
        source = filled()
        batch = MujocoBatch(FAST, len(rows), delay=0, truncate=False, threads=threads, isa=isa)
        for row, state in enumerate(source.save()[rows]):
            batch.load(row, state)
        for each in targets:
            batch.step(each[rows])
        return batch.save()

    everyone = list(range(N))
    expected = run(1, "", everyone)
    for threads, isa in ((2, ""), (1, "generic"), (2, "avx2"), (1, "avx512")):
        try:
            states = run(threads, isa, everyone)
        except ValueError:
            assert isa.startswith("avx")
            continue
        np.testing.assert_array_equal(states, expected)
    np.testing.assert_array_equal(run(1, "", everyone[::-1]), expected[::-1])
    np.testing.assert_array_equal(run(1, "", [5]), expected[[5]])


def test_a_broken_robot_is_left_to_mujoco_and_its_neighbours_keep_their_bits() -> None:
    whole, broken = filled(), filled()
    broken.data[3].qvel[7] = np.nan
    broken.data[9].qvel[3:6] = 1e12
    for batch in (whole, broken):
        for _ in range(3):
            batch.step(np.tile(T1.nominal, (N, 1)))
    others = [row for row in range(N) if row not in (3, 9)]
    np.testing.assert_array_equal(whole.save()[others], broken.save()[others])
    assert broken.diverged[3] and broken.warning(3)


def test_another_topology_is_refused() -> None:
    assert topology_difference(FAST) == ""
    assert topology_difference(world_of(T1)) == "it has a ball"
    assert topology_difference(world_of(K1, exact=False)) != ""
    with pytest.raises(ValueError, match="isa: expected generic"):
        MujocoBatch(FAST, 1, delay=0, isa="sse9")
