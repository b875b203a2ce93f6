"""The kernels that step several humanoids of a kind at once, held against ``mj_step``."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from naosim.mujoco.batch import MujocoBatch
from naosim.mujoco.humanoid import topology_difference
from naosim.mujoco.settings import Engine
from naosim.mujoco.world import SUBSTEPS, MujocoWorld, library, world_of
from naosim.robots.booster import K1, T1
from naosim.simulator import Scene, Variation

if TYPE_CHECKING:
    from naosim.robots import Robot

N = 12
PLAIN, BALL, PITCH = Scene(), Scene(ball=True), Scene(ball=True, goals=True)
GOAL_POST = (27.5, 1.83)  # m
CASES = [
    pytest.param(robot, scene, id=f"{robot.name}-{name}")
    for robot in (T1, K1)
    for name, scene in (("alone", PLAIN), ("ball", BALL), ("goals", PITCH))
]


def violent(rng: np.random.Generator, world: MujocoWorld, robot: Robot, data: Any, row: int) -> None:
    """Set a state that no policy should reach: any orientation, in the ground, beyond the limits, fast.

    With a ball, two of three touch the robot or nearly do, or a goal's post.
    """
    low, first, model = row % 2 == 0, world.torso, world.model
    quaternion = rng.normal(size=4) if low else np.array([1.0, 0.0, 0.0, 0.0]) + 0.1 * rng.normal(size=4)
    height = rng.uniform(0.05, 0.5) if low else robot.standing_height_m * rng.uniform(0.9, 1.05)
    data.qpos[first : first + 3] = (*rng.normal(size=2), height)
    data.qpos[first + 3 : first + 7] = quaternion / np.linalg.norm(quaternion)
    data.qpos[first + 7 :] = np.array(robot.nominal) + rng.normal(size=world.joints) * 0.5
    data.qvel[:] = rng.normal(size=model.nv) * (4.0 if low else 1.0)
    data.qacc_warmstart[:] = 0.0
    if not world.ball:
        return
    aside = rng.normal(size=3)
    data.qpos[:3] = (*rng.normal(size=2) * 3.0, 0.11)
    data.qpos[3:7] = aside[[0, 1, 2, 0]] / np.linalg.norm(aside[[0, 1, 2, 0]])
    if world.scene.goals and row % 3 == 0:
        data.qpos[:2] = GOAL_POST + rng.uniform(-0.15, 0.15, 2)
        data.qpos[first : first + 2] = data.qpos[:2] + 0.4 * rng.normal(size=2)
    elif row % 3 < 2:
        library().mj_kinematics(model, data)
        part = data.geom_xpos[rng.choice(world.geoms)]
        data.qpos[:3] = part + aside / np.linalg.norm(aside) * rng.uniform(0.1, 0.2)
    data.qpos[2] = max(data.qpos[2], rng.uniform(0.09, 0.115))


def filled(world: MujocoWorld, robot: Robot, n: int = N, seed: int = 3, **options: Any) -> MujocoBatch:
    batch = MujocoBatch(world, n, delay=0, truncate=False, **options)
    rng = np.random.default_rng(seed)
    for row, data in enumerate(batch.data):
        violent(rng, world, robot, data, row)
    return batch


def exact(world: MujocoWorld) -> tuple[Any, Any]:
    """Return a model whose solver ends at the minimum, as the kernel's, and data of it."""
    model = copy.copy(world.model)
    model.opt.tolerance = 0.0
    return model, library().MjData(model)


def compared(batch: MujocoBatch, worlds: list[MujocoWorld], targets: np.ndarray, steps: int) -> None:
    """Step the batch, and ``mj_step`` from the same states; compare all they leave."""
    mujoco = library()
    models = {number: exact(world) for number, world in {id(world): world for world in worlds}.items()}
    before = [(data.time, data.qpos.copy(), data.qvel.copy()) for data in batch.data]
    batch.step(targets)
    for row, (world, (moment, qpos, qvel)) in enumerate(zip(worlds, before, strict=True)):
        ours, (model, data) = batch.data[row], models[id(world)]
        mujoco.mj_resetData(model, data)
        data.time, data.qpos[:], data.qvel[:], data.ctrl[:] = moment, qpos, qvel, ours.ctrl
        for _ in range(steps):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(ours.qpos, data.qpos, rtol=0, atol=1e-10, err_msg=f"row {row}")
        np.testing.assert_allclose(ours.qvel, data.qvel, rtol=0, atol=1e-8, err_msg=f"row {row}")
        np.testing.assert_allclose(ours.sensordata, data.sensordata, rtol=1e-7, atol=1e-6, err_msg=f"row {row}")
        if world.ball:
            assert ours.time == data.time


@pytest.mark.parametrize("varied", [False, True])
@pytest.mark.parametrize(("robot", "scene"), CASES)
def test_a_substep_is_mj_steps_from_violent_states(robot: Robot, scene: Scene, varied: bool) -> None:
    """Floor, limits, self contacts, ball, goals, friction, air, sensors; with another robot on another ground.

    One substep at a time: MuJoCo's contacts of meshes and posts jump with the last digit of a pose.
    """
    rng = np.random.default_rng(8)
    world = world_of(robot, engine="fast", scene=scene)
    batch = filled(world, robot, 24, seed=4 + varied, substeps=1)
    worlds = [world] * 2
    if varied:
        others = [
            Variation(0.2, 0.3, 0.02, friction=factor, gravity=1.1 * factor, stiffness=stiffness)
            for factor, stiffness in ((0.8, 0.3), (1.2, 1.0 if robot == K1 else 3.0))
        ]
        worlds = [world.varied(other, rng) for other in others]
    worlds *= batch.n // 2
    for row, each in enumerate(worlds):
        batch.set_world(row, each)
    for _ in range(SUBSTEPS):
        targets = np.array(robot.nominal) + rng.normal(size=(batch.n, world.joints)) * 0.5
        compared(batch, worlds, targets, 1)
    assert batch.collided_by_mujoco > 0 and batch.left_to_mujoco == 0
    if scene.ball:
        assert any(data.sensordata[-4] for data in batch.data), "a ball touches a robot"


@pytest.mark.parametrize(("robot", "scene"), CASES)
def test_a_model_varied_again_is_one_varied_from_the_start(robot: Robot, scene: Scene) -> None:
    world = world_of(robot, engine="fast", scene=scene)
    usual = copy.copy(world.model)
    strong = Variation(0.3, 0.3, 0.05, friction=0.5, gravity=0.9, stiffness=0.4)
    for other in (Variation(0.1, 0.1, 0.01, friction=0.8, stiffness=0.7), Variation()):
        fresh = world.varied(other, np.random.default_rng(2))
        used = world.varied(strong, np.random.default_rng(1))
        assert not equal_models(used.model, fresh.model)
        again = world.varied(other, np.random.default_rng(2), used.model)
        assert again.model is used.model and equal_models(again.model, fresh.model)
        assert again.stiffness == fresh.stiffness
        library().mj_setConst(fresh.model, library().MjData(fresh.model))
        assert equal_models(again.model, fresh.model), "what MuJoCo computed before changes nothing"
    assert equal_models(world.model, usual)


def equal_models(one: Any, other: Any) -> bool:
    """Return whether two models are the same bits."""
    sizes = [library().mj_sizeModel(model) for model in (one, other)]
    buffers = [np.zeros(size, dtype=np.uint8) for size in sizes]
    for model, buffer in zip((one, other), buffers, strict=True):
        library().mj_saveModel(model, None, buffer)
    return buffers[0].tobytes() == buffers[1].tobytes()


@pytest.mark.parametrize("pitch", [-0.3, 0.6, 0.85])
def test_meshes_are_bounded_by_more_than_their_boxes(pitch: float) -> None:
    """A K1 that looks down has the box around its head in that around its torso, but touches nothing."""
    world = world_of(K1, engine="fast")
    batch = filled(world, K1)
    pose = K1.nominal.copy()
    pose[K1.joint_names.index("head_pitch")] = pitch
    for data in batch.data:
        data.qpos[world.torso :] = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, *pose)
        data.qvel[:] = 0.0
    batch.step(np.tile(pose, (N, 1)))
    assert batch.collided_by_mujoco == 0


def test_a_cycle_is_mj_steps() -> None:
    world, rng = world_of(T1, engine="fast"), np.random.default_rng(8)
    batch = filled(world, T1, 120)
    compared(batch, [world] * batch.n, np.array(T1.nominal) + rng.normal(size=(batch.n, 23)) * 0.5, SUBSTEPS)


@pytest.mark.parametrize("robot", [T1, K1])
def test_the_motion_of_bodies_is_mujocos(robot: Robot) -> None:
    mujoco, world = library(), world_of(robot, engine="fast", scene=Scene(ball=True, bodies=True))
    batch = filled(world, robot, 10)
    batch.step(np.tile(robot.nominal, (batch.n, 1)))
    for row, ours in enumerate(batch.data):
        data, motion = copy.copy(ours), np.zeros(6)
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            compute(world.model, data)
        for body, found in zip(world.moving, batch.bodies.values(), strict=True):
            mujoco.mj_objectVelocity(world.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, motion, 0)
            for name, value in (
                ("position", data.xpos[body]),
                ("rotation", data.xmat[body].reshape(3, 3)),
                ("velocity", motion[3:]),
                ("spin", motion[:3]),
            ):
                np.testing.assert_allclose(getattr(found, name)[row], value, rtol=0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(("robot", "scene"), CASES)
def test_a_snapshot_continues_with_the_same_bits_in_another_batch(robot: Robot, scene: Scene) -> None:
    """It contains which rows of the solver were active: the next substep starts from them."""
    world, targets = world_of(robot, engine="fast", scene=scene), np.tile(robot.nominal, (6, 1))
    one, other = filled(world, robot, 6), MujocoBatch(world, 6, delay=0, truncate=False)
    one.step(targets)
    for row, state in enumerate(one.save()):
        other.load(row, state)
    for batch in (one, other):
        batch.step(targets)
    np.testing.assert_array_equal(one.save(), other.save())


@pytest.mark.parametrize(("robot", "scene"), CASES)
def test_instruction_sets_threads_and_neighbours_do_not_change_a_bit(robot: Robot, scene: Scene) -> None:
    world, rng = world_of(robot, engine="fast", scene=scene), np.random.default_rng(9)
    targets = np.array(robot.nominal) + rng.normal(size=(6, N, world.joints)) * 0.3
    source = filled(world, robot)

    def run(threads: int, isa: str, rows: list[int]) -> np.ndarray:
        batch = MujocoBatch(world, len(rows), delay=0, truncate=False, threads=threads, isa=isa)
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


@pytest.mark.parametrize(("robot", "scene"), CASES)
def test_a_broken_robot_is_left_to_mujoco_and_its_neighbours_keep_their_bits(robot: Robot, scene: Scene) -> None:
    world = world_of(robot, engine="fast", scene=scene)
    whole, broken = filled(world, robot), filled(world, robot)
    broken.data[3].qvel[-7] = np.nan
    broken.data[9].qvel[world.first_speed - 3 : world.first_speed] = 1e12
    for batch in (whole, broken):
        for _ in range(3):
            batch.step(np.tile(robot.nominal, (N, 1)))
    others = [row for row in range(N) if row not in (3, 9)]
    np.testing.assert_array_equal(whole.save()[others], broken.save()[others])
    assert broken.diverged[3] and broken.warning(3)
    assert broken.left_to_mujoco > whole.left_to_mujoco == 0


def test_robots_differ_in_what_is_not_shared_only() -> None:
    world = world_of(T1, engine="fast")
    batch = MujocoBatch(world, 2, delay=0)
    batch.set_world(0, world.varied(Variation(0.2, 0.2, 0.01, 0.5, 1.1, 2.0), np.random.default_rng(1)))
    for name in ("body_pos", "geom_solref"):
        model = copy.copy(world.model)
        getattr(model, name)[5] += 0.01
        with pytest.raises(ValueError, match=f"world: {name} differ"):
            batch.set_world(1, replace(world, model=model))


@pytest.mark.parametrize("engine", ["fast", "mujoco"])
@pytest.mark.parametrize("robot", [T1, K1])
def test_robots_that_share_models_move_as_with_their_own(robot: Robot, engine: Engine) -> None:
    """Every bit of a model, and of the states after steps of more robots than threads have models."""
    world, rng = world_of(robot, engine=engine), np.random.default_rng(6)
    stiffest = 1.0 if robot == K1 else 2.0
    others = [
        world.varied(Variation(0.2, 0.2, 0.02, rng.uniform(0.4, 1.2), 1.1, rng.uniform(0.5, stiffest)), rng)
        for _ in range(5)
    ]
    worlds = [*others, world]
    batch = filled(world, robot, 6, threads=2)
    # the fast engine has the stiffness of one robot for all, and others' as factors
    alone = [filled(world if engine == "fast" else each, robot, 6) for each in worlds]
    for row, other in enumerate(others):
        batch.set_world(row, other)
        if engine == "fast":
            alone[row].set_world(row, other)
    for _ in range(3):
        targets = np.array(robot.nominal) + rng.normal(size=(6, world.joints)) * 0.3
        for each in (batch, *alone):
            each.step(targets)
        for row, each in enumerate(alone):
            assert equal_models(batch.model(row), worlds[row].model)
            np.testing.assert_array_equal(batch.save()[row], each.save()[row])


def test_a_variation_of_nothing_changes_no_bit() -> None:
    world = world_of(T1, engine="fast")
    usual, varied = filled(world, T1), filled(world, T1)
    for row in range(N):
        varied.set_world(row, world.varied(Variation(), np.random.default_rng(row)))
    for batch in (usual, varied):
        for _ in range(5):
            batch.step(np.tile(T1.nominal, (N, 1)))
    np.testing.assert_array_equal(usual.save(), varied.save())


@pytest.mark.parametrize(("robot", "most"), [(T1, 4), (K1, 1)])
def test_contacts_cannot_be_stiffer_than_the_steps_allow(robot: Robot, most: int) -> None:
    world = world_of(robot, engine="mujoco")
    world.varied(Variation(stiffness=most), np.random.default_rng(0))
    with pytest.raises(ValueError, match=f"stiffness_max: contacts of robot {robot.name} can be at most {most} times"):
        world.varied(Variation(stiffness=1.1 * most), np.random.default_rng(0))


def test_another_topology_is_refused() -> None:
    for robot in (T1, K1):
        for scene in (PLAIN, BALL, PITCH):
            assert topology_difference(world_of(robot, engine="fast", scene=scene)) == ""
    world = world_of(T1, engine="fast")
    assert topology_difference(replace(world, robot="K1")) == "its bodies form another tree"
    model = copy.copy(world.model)
    model.geom_margin[3] = 0.01
    assert topology_difference(replace(world, model=model)) == "it has margins, or another integrator or friction cone"
    with pytest.raises(ValueError, match="isa: expected generic"):
        MujocoBatch(world, 1, delay=0, isa="sse9")
