"""Disturbances: what each does to the world, where it is refused, resuming, and evaluations without them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from naosim import robots
from naosim.mujoco.batch import MujocoBatch
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters, Engine
from naosim.robots.booster import T1
from naosim.simspark.embedded import EmbeddedSimulator
from naosim.simulator import BALL, Scene, Variation
from naospec import EvaluationSpec, TrainingSpec
from naosprint.tasks.base import Task
from naosprint.tasks.disturbance_settings import BallNoiseSettings, DisturbanceSettings
from naosprint.tasks.disturbances import NOISE
from naosprint.tasks.environment import Environment
from naosprint.tasks.sprint import Sprint1, SprintSettings
from pydantic import ValidationError

NAO = robots.get("nao-0")


def loaded(n: int = 4, seed: int = 0, engine: Engine = "mujoco", **settings: Any) -> Environment:
    """Return n robots T1 whose starts have been loaded."""
    parameters = Sprint1.resolve(SprintSettings(name="sprint1", **settings), T1)
    simulator = MujocoSimulator(T1, n, BoosterEmbeddedParameters(engine=engine))
    environment = Environment(simulator, Sprint1, parameters, seed)
    environment.load_starts(environment.task.starts(1, 0, 0.0))
    return environment


def environment_of(n: int = 4, seed: int = 0, engine: Engine = "mujoco", **settings: Any) -> Environment:
    """Return n robots T1 at their starts."""
    environment = loaded(n, seed, engine, **settings)
    environment.restart(np.arange(n), np.zeros(n, dtype=np.int64))
    return environment


def run(environment: Environment, steps: int) -> np.ndarray:
    """Return the (steps, n, 3) torso positions of robots that keep still."""
    still = np.zeros((environment.n, environment.actuation.n_actions))
    found = []
    for _ in range(steps):
        environment.step(still)
        found.append(environment.simulator.truth.torso_position.copy())
    return np.array(found)


def numbers(batch: MujocoBatch, name: str) -> np.ndarray:
    """Return an array of the model of every robot."""
    return np.array([getattr(batch.model(row), name).copy() for row in range(batch.n)])


def test_without_settings_nothing_differs() -> None:
    environment = environment_of()
    simulator = MujocoSimulator(T1, 4)
    simulator.load_starts(environment.task.starts(1, 0, 0.0))
    simulator.start(np.arange(4), np.zeros(4, dtype=np.int64))
    still = environment.actuation.targets(np.zeros((4, environment.actuation.n_actions)))
    for found in run(environment, 10):
        simulator.step(still)
        np.testing.assert_array_equal(found, simulator.truth.torso_position)


def test_pushes_move_the_torso_as_often_and_as_far_as_set() -> None:
    environment = environment_of(64, push_mps=0.5, push_steps=5)
    simulator = environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    still = np.zeros((64, environment.actuation.n_actions))
    changes = []
    for _ in range(10):
        environment.simulator.step(environment.actuation.targets(still))
        stepped = np.array([data.qvel[6:8] for data in simulator.batch.data])
        environment.disturbances.apply(slice(0, 64))
        changes.append(np.array([data.qvel[6:8] for data in simulator.batch.data]) - stepped)
    sizes = np.linalg.norm(np.concatenate(changes), axis=1)
    pushed = sizes[sizes > 0.0]
    assert len(pushed) / len(sizes) == pytest.approx(0.2, abs=0.04)
    assert pushed.max() <= 0.5 + 1e-12 and pushed.mean() == pytest.approx(0.25, abs=0.05)
    assert np.abs(np.concatenate(changes).mean(axis=0)).max() < 0.03  # in every direction


def test_every_robot_has_its_own_masses_and_friction() -> None:
    environment = environment_of(8, mass_variation=0.1, friction_min=0.6, friction_max=1.4)
    simulator = environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    usual = simulator.world
    rng = np.random.default_rng(0)
    varied = [usual.varied(Variation(masses=0.1, friction=0.6), rng) for _ in range(20)]
    robot = [body for body in range(usual.model.nbody) if usual.model.body(body).name.startswith("robot-")]
    ratios = np.array([world.model.body_mass[robot] / usual.model.body_mass[robot] for world in varied])
    assert 0.9 <= ratios.min() < 0.92 and 1.08 < ratios.max() <= 1.1
    np.testing.assert_allclose(
        varied[0].model.geom_friction[usual.geoms, 0], 0.6 * usual.model.geom_friction[usual.geoms, 0]
    )
    # the total mass decides how deep the soft soles sink
    heights = run(environment, 30)[-1, :, 2]
    assert len(np.unique(heights)) == 8
    again = run(environment_of(8, mass_variation=0.1, friction_min=0.6, friction_max=1.4), 30)[-1, :, 2]
    np.testing.assert_array_equal(again, heights)
    other = run(environment_of(8, seed=1, mass_variation=0.1, friction_min=0.6, friction_max=1.4), 30)[-1, :, 2]
    assert not np.array_equal(other, heights)


@pytest.mark.parametrize("engine", ["fast", "mujoco"])
def test_every_robot_has_its_own_gains_centre_of_mass_and_contacts(engine: Engine) -> None:
    settings = {"gain_variation": 0.2, "centre_of_mass_m": 0.02, "stiffness_min": 0.25, "stiffness_max": 4.0}
    environment = environment_of(24, engine=engine, **settings)
    simulator = environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    usual = simulator.world.model
    ipos, solref = numbers(simulator.batch, "body_ipos"), numbers(simulator.batch, "geom_solref")
    kp = simulator.batch.kp / usual.actuator_gainprm[1::3, 0]
    kd = simulator.batch.kd / usual.actuator_gainprm[2::3, 0]
    for factors in (kp, kd):
        assert 0.8 <= factors.min() < 0.82 and 1.18 < factors.max() <= 1.2
        assert len(np.unique(factors)) == factors.size
    torso = usual.body("robot-torso").id
    shifts = ipos[:, torso] - usual.body_ipos[torso]
    assert 0.018 < np.abs(shifts).max() <= 0.02 and len(np.unique(shifts)) == shifts.size
    times = solref[:, simulator.world.geoms[0], 0]
    assert 0.01 <= times.min() < 0.012 and 0.035 < times.max() <= 0.04
    assert [block.names for block in environment.disturbances.critic_blocks()] == [
        ("friction", "gravity"),
        ("contact_stiffness",),
    ]


@pytest.mark.parametrize("engine", ["fast", "mujoco"])
def test_softer_soles_sink_deeper(engine: Engine) -> None:
    heights = [
        run(environment_of(1, engine=engine, stiffness_min=factor, stiffness_max=factor), 20)[-1, 0, 2]
        for factor in (0.5, 1.0, 2.0)
    ]
    assert (np.diff(heights) > 5e-4).all()


def test_the_ground_is_as_slippery_as_set() -> None:
    found = []
    for friction in (0.6, 1.0):
        environment = environment_of(1, friction_min=friction, friction_max=friction)
        run(environment, 2)
        simulator = environment.simulator
        assert isinstance(simulator, MujocoSimulator)
        found.append(simulator.batch.data[0].contact.friction[:, 0].max())
    assert found[0] == pytest.approx(0.6 * found[1]) and found[1] > 0.0


def test_gravity_rises_from_the_first_robot_to_the_last() -> None:
    """What falls freely has its robot's acceleration."""
    environment = environment_of(4, gravity_min=0.1)
    simulator = environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    for data in simulator.batch.data:
        data.qpos[simulator.world.torso + 2] = 5.0
        data.qvel[:] = 0.0
    before = np.array([data.qpos[simulator.world.torso + 2] for data in simulator.batch.data])
    run(environment, 5)  # 0.1 s
    fallen = before - [data.qpos[simulator.world.torso + 2] for data in simulator.batch.data]
    np.testing.assert_allclose(fallen / fallen[-1], [0.1, 0.4, 0.7, 1.0], atol=0.05)
    assert fallen[-1] == pytest.approx(0.5 * 9.81 * 0.1**2, rel=0.1)


def test_an_extra_delay_shifts_commands_by_whole_steps() -> None:
    action = np.zeros((1, environment_of(1).actuation.n_actions))
    action[0, -1] = 0.5
    first = []
    for delay in (0, 2):
        environment = environment_of(1, extra_delay=delay)
        resting = run(environment, 5)
        del resting
        seen = []
        for _ in range(8):
            environment.step(action)
            seen.append(environment.world.perceptors["joint_angles"][0].copy())
        first.append(np.array(seen))
    moved = [np.abs(angles[:, -6:] - angles[0, -6:]).max(axis=1) > 0.5 for angles in first]
    assert int(np.argmax(moved[1])) - int(np.argmax(moved[0])) == 2


def test_a_delay_is_drawn_for_each_episode() -> None:
    """A command acts after as many steps as its episode's delay says; every delay of the range occurs."""
    n = 24
    environment = environment_of(n, extra_delay=1, extra_delay_max=3)
    joints, rows = environment.actuation.n_joints, np.arange(n)
    drawn = []
    for _ in range(4):
        environment.restart(rows, np.zeros(n, dtype=np.int64))
        acted = np.array(
            [
                environment.disturbances.delayed(np.full((n, joints), 100.0 + step), slice(0, n))[:, 0]
                for step in range(6)
            ]
        )
        delays = (acted < 100.0).sum(axis=0)
        np.testing.assert_array_equal(acted[-1], 105.0 - delays)
        drawn.append(delays)
    assert set(np.ravel(drawn)) == {1, 2, 3}
    assert all((np.ptp(drawn, axis=0) > 0)[:8])  # no robot keeps the same one


def test_a_fraction_of_the_robots_is_left_undisturbed() -> None:
    """Nothing of what the others meet reaches them."""
    n = 40
    everything: dict[str, Any] = {
        "push_mps": 1.0, "push_steps": 1, "sensor_noise": 1.0, "mass_variation": 0.1, "friction_min": 0.5,
        "extra_delay": 1, "undisturbed_fraction": 0.5,
    }  # fmt: skip
    environment, ideal = environment_of(n, **everything), environment_of(n)
    moved, expected = run(environment, 12), run(ideal, 12)
    calm = (moved == expected).all(axis=(0, 2))
    seen, undisturbed = environment.world.perceptors, ideal.world.perceptors
    assert 10 <= calm.sum() <= 30
    np.testing.assert_array_equal(seen["gyro"][calm], undisturbed["gyro"][calm])
    assert (np.abs(seen["gyro"] - undisturbed["gyro"])[~calm] > 0.0).all()


@pytest.mark.parametrize("by_episode", [False, True])
def test_each_kind_of_disturbance_is_drawn_for_itself(monkeypatch: pytest.MonkeyPatch, by_episode: bool) -> None:
    """With a probability every set of kinds occurs, as often as chance says."""
    n = 256
    environment = environment_of(
        n, engine="fast", push_mps=1.0, push_steps=1, sensor_noise=1.0, mass_variation=0.1, friction_min=0.5,
        friction_max=0.6, stiffness_min=0.5, extra_delay=1, undisturbed_fraction=0.2, disturbance_probability=0.5,
        episode_worlds=by_episode,
    )  # fmt: skip
    simulator = environment.simulator
    assert isinstance(simulator, MujocoSimulator)
    after_episodes(environment, 1, failed=False)
    disturbances, batch, usual = environment.disturbances, simulator.batch, simulator.world.model
    nominal = environment.actuation.targets(np.zeros((n, environment.actuation.n_actions)))
    seen, pushes = environment.world.perceptors["gyro"].copy(), np.zeros((n, 2))
    monkeypatch.setattr(simulator, "push", lambda velocities, rows: np.copyto(pushes[rows], velocities))
    disturbances.apply(slice(0, n))
    found = np.column_stack(
        [
            np.linalg.norm(pushes, axis=1) > 0.0,
            np.abs(numbers(batch, "body_mass") - usual.body_mass).max(axis=1) > 1e-9,
            disturbances._world[:, 0] < 1.0,
            disturbances._stiffness[:, 0] < 1.0,
            (disturbances.delayed(nominal + 1.0, slice(0, n)) == nominal).all(axis=1),
            (environment.world.perceptors["gyro"] != seen).all(axis=1),
        ]
    )
    disturbed = found.any(axis=1)
    assert found.mean(axis=0) == pytest.approx(0.4, abs=0.1)  # 0.8 of the robots, half of them each
    assert disturbed.mean() == pytest.approx(0.8 * (1 - 0.5**6), abs=0.08)
    assert len(np.unique(found, axis=0)) >= 40


def test_sensor_noise_has_the_stated_deviation() -> None:
    quiet, noisy = environment_of(64), environment_of(64, sensor_noise=2.0)
    run(quiet, 1)
    run(noisy, 1)
    for name, deviation in NOISE.items():
        difference = noisy.world.perceptors[name] - quiet.world.perceptors[name]
        assert difference.std() == pytest.approx(2.0 * deviation, rel=0.2), name
    np.testing.assert_array_equal(noisy.simulator.truth.torso_position, quiet.simulator.truth.torso_position)


def test_a_resumed_environment_is_disturbed_alike() -> None:
    settings: dict[str, Any] = {
        "push_mps": 0.3, "push_steps": 5, "sensor_noise": 1.0, "extra_delay_max": 2, "mass_variation": 0.1,
        "history_steps": 2, "undisturbed_fraction": 0.3,
    }  # fmt: skip
    environment = environment_of(3, **settings)
    run(environment, 10)
    state = {name: array.copy() for name, array in environment.state().items()}
    resumed = environment_of(3, **settings)
    resumed.load_state(state)
    np.testing.assert_array_equal(run(resumed, 10), run(environment, 10))
    np.testing.assert_array_equal(resumed.observations, environment.observations)


def test_noise_that_reaches_a_naos_motors_is_part_of_a_checkpoint() -> None:
    """Its motors are driven by what it perceives."""
    settings: dict[str, Any] = {"sensor_noise": 1.0, "extra_delay": 1, "history_steps": 2}

    def begin() -> Environment:
        parameters = Sprint1.resolve(SprintSettings(name="sprint1", **settings), NAO)
        environment = Environment(EmbeddedSimulator(NAO, 3), Sprint1, parameters, 0)
        environment.load_starts(environment.task.starts(1, 0, 0.0))
        environment.restart(np.arange(3), np.zeros(3, dtype=np.int64))
        return environment

    environment = begin()
    run(environment, 10)
    environment.restart(np.array([1]), np.array([0]))
    state = {name: array.copy() for name, array in environment.state().items()}
    resumed = begin()
    resumed.load_state(state)
    np.testing.assert_array_equal(run(resumed, 10), run(environment, 10))
    np.testing.assert_array_equal(resumed.observations, environment.observations)


GROWING: dict[str, Any] = {
    "push_mps": 1.0, "push_steps": 1, "sensor_noise": 1.0, "mass_variation": 0.3, "friction_min": 0.4,
    "friction_max": 0.5, "stiffness_min": 0.2, "extra_delay_max": 2, "disturbance_growth": 0.25,
}  # fmt: skip


def after_episodes(environment: Environment, count: int, *, failed: bool) -> None:
    """Begin ``count`` episodes more, each after one with this end."""
    rows = np.arange(environment.n)
    for _ in range(count):
        environment.world.steps[:], environment.failed[:] = 1, failed
        environment.restart(rows, np.zeros_like(rows))


@pytest.mark.parametrize("engine", ["fast", "mujoco"])
def test_disturbances_grow_with_success_and_shrink_with_failures(engine: Engine) -> None:
    growing, ideal = environment_of(engine=engine, **GROWING), environment_of(engine=engine)
    assert growing.disturbances.strength == 0.0 and ideal.disturbances.strength is None
    np.testing.assert_array_equal(run(growing, 12), run(ideal, 12))
    after_episodes(growing, 3, failed=False)
    assert growing.disturbances.strength == 0.75
    after_episodes(growing, 2, failed=True)
    assert growing.disturbances.strength == 0.25
    after_episodes(growing, 40, failed=False)
    assert growing.disturbances.strength == 1.0
    masses = numbers(growing.simulator.batch, "body_mass")  # type: ignore[attr-defined]
    assert np.ptp(masses, axis=0).max() > 0.0
    assert (np.abs(growing.disturbances._world[:, 0] - 0.45) <= 0.05).all()
    assert len(set(growing.disturbances._stiffness[:, 0].tolist())) == 4
    assert np.abs(run(growing, 12) - run(ideal, 12)).max() > 0.01


def test_what_says_nothing_about_a_robot_changes_no_strength() -> None:
    """An episode whose server was lost; and one that is truncated to train the start must only not fail."""
    environment = environment_of(engine="fast", **GROWING)
    after_episodes(environment, 2, failed=False)
    environment.lost[0] = True
    environment.short[1] = True
    environment.task.succeeded = lambda rows: rows == 2  # type: ignore[method-assign]
    after_episodes(environment, 1, failed=False)
    assert environment.disturbances._strength.tolist() == [0.5, 0.75, 0.75, 0.25]


def test_an_episode_of_a_seed_begins_without_strength_and_in_the_nominal_world() -> None:
    settings = {**GROWING, "push_mps": 0.0, "extra_delay_max": 0}
    environment = environment_of(engine="fast", **settings)
    rows, found = np.arange(environment.n), []
    for _ in range(2):
        environment.restart(rows, np.zeros_like(rows), episodes=rows + 7)
        assert environment.disturbances.strength == 0.0
        masses = numbers(environment.simulator.batch, "body_mass")  # type: ignore[attr-defined]
        assert (environment.disturbances._world[:, 0] == 1.0).all() and np.ptp(masses, axis=0).max() == 0.0
        assert (environment.disturbances._stiffness == 1.0).all()
        after_episodes(environment, 3, failed=False)
        found.append(environment.disturbances._world[:, 0].copy())
    assert (found[0] < 1.0).all() and found[0].tolist() == found[1].tolist()


def test_worlds_are_drawn_once_for_a_robot_or_for_every_episode() -> None:
    settings = {"mass_variation": 0.3, "friction_min": 0.4, "friction_max": 0.8, "undisturbed_fraction": 0.5}
    for by_episode in (False, True):
        environment = environment_of(12, engine="fast", episode_worlds=by_episode, **settings)
        batch, disturbed = environment.simulator.batch, environment.disturbances._disturbed  # type: ignore[attr-defined]
        assert disturbed.any() and not disturbed.all()
        found = []
        for _ in range(3):
            after_episodes(environment, 1, failed=False)
            friction = environment.disturbances._world[:, 0]
            found.append(np.column_stack([friction, numbers(batch, "body_mass")]))
        assert (found[0][~disturbed] == found[1][~disturbed]).all()
        assert (found[0][:, 0] == 1.0).tolist() == (~disturbed).tolist()
        assert (found[0] != found[1])[disturbed][:, 0].all() == by_episode
        assert len(np.unique(np.array(found)[:, disturbed, 0])) == (3 if by_episode else 1) * disturbed.sum()


def test_light_robots_that_are_not_disturbed_yet_continue_after_a_checkpoint() -> None:
    """Gravity does not grow: it is part of their worlds from the first episode on."""
    settings = {"gravity_min": 0.4, "mass_variation": 0.1, "disturbance_growth": 0.25}
    environment, resumed = environment_of(engine="fast", **settings), loaded(engine="fast", **settings)
    resumed.load_state({name: array.copy() for name, array in environment.state().items()})
    assert environment.disturbances.strength == 0.0
    np.testing.assert_array_equal(run(resumed, 10), run(environment, 10))


@pytest.mark.parametrize("growth", [0.0, 0.25])
def test_worlds_of_episodes_continue_after_a_checkpoint(growth: float) -> None:
    settings = {**GROWING, "disturbance_growth": growth, "episode_worlds": True}
    environment = environment_of(engine="fast", **settings)
    after_episodes(environment, 20, failed=False)
    after_episodes(environment, 1, failed=True)
    run(environment, 3)
    state = {name: array.copy() for name, array in environment.state().items()}
    resumed = environment_of(engine="fast", **settings)
    resumed.load_state(state)
    for _ in range(2):
        np.testing.assert_array_equal(run(resumed, 10), run(environment, 10))
        np.testing.assert_array_equal(resumed.observations, environment.observations)
        for each in (environment, resumed):
            after_episodes(each, 17, failed=False)


def test_evaluations_leave_disturbances_out_unless_they_set_them() -> None:
    trained = TrainingSpec.model_validate(
        {"task": {"name": "sprint1", "push_mps": 0.5, "drift_penalty": 2.0}, "robot": "t1", "total_steps": 1_000_000}
    )
    assert EvaluationSpec().applied_to(trained).task.push_mps == 0.0
    assert EvaluationSpec().applied_to(trained).task.drift_penalty == 2.0
    disturbed = EvaluationSpec.model_validate({"task": {"name": "sprint1", "friction_min": 0.6, "friction_max": 0.6}})
    assert disturbed.applied_to(trained).task.friction_max == 0.6


def test_impossible_disturbances_are_refused() -> None:
    with pytest.raises(ValidationError, match="exchange them"):
        DisturbanceSettings(name="sprint1", friction_min=1.2)
    with pytest.raises(ValidationError, match="extra_delay: 2 is above extra_delay_max, 1; exchange them"):
        DisturbanceSettings(name="sprint1", extra_delay=2, extra_delay_max=1)
    nao = EmbeddedSimulator(NAO, 1)
    with pytest.raises(ValidationError, match="stiffness_min: 2"):
        DisturbanceSettings(name="sprint1", stiffness_min=2.0)
    for settings, named in (
        ({"push_mps": 0.1}, "push_mps"),
        ({"mass_variation": 0.1}, "mass_variation"),
        ({"gain_variation": 0.1}, "gain_variation"),
        ({"centre_of_mass_m": 0.01}, "centre_of_mass_m"),
        ({"stiffness_min": 0.5}, "stiffness_min"),
    ):
        parameters = Sprint1.resolve(SprintSettings(name="sprint1", **settings), NAO)
        with pytest.raises(ValueError, match=named):
            environment = Environment(nao, Sprint1, parameters)
            environment.load_starts(environment.task.starts(1, 0, 0.0))


class Look(Task[BallNoiseSettings]):
    """Look at a ball; of all settings of disturbances the task has its noise only."""

    name = "look"
    scene = Scene(ball=True)
    Parameters = BallNoiseSettings

    def place(self, rows: np.ndarray) -> None:
        """Place the ball at the edge of what the robot sees."""
        ball = self.world.position(rows).copy()
        ball[:, 0] += 1.5
        ball[:, 2] = self.robot.field.ball_radius_m
        self.world.place_ball(rows, ball)


def test_noise_on_the_ball_is_a_setting_of_its_own() -> None:
    """A task may have it without the other disturbances."""
    seen, n, robot = [], 64, T1.with_parameters({"head_pitch_rad": 0.3})
    for noise in (0.0, 0.1):
        simulator = MujocoSimulator(robot, n, scene=Look.scene)
        environment = Environment(simulator, Look, BallNoiseSettings(name="look", ball_noise_m=noise))
        environment.load_starts(environment.task.starts(1, 0, 0.0))
        environment.restart(np.arange(n), np.zeros(n, dtype=np.int64))
        run(environment, 2)
        seen.append(environment.world.perceptors[BALL][:, 0].copy())
        assert environment.state().keys() >= ({"disturbances.count"} if noise else set())
    off = seen[1] - seen[0]
    assert not np.isnan(off).any() and off.std() == pytest.approx(0.1, rel=0.25)


def test_noise_on_a_ball_that_is_not_perceived_is_refused() -> None:
    class Blind(Look):
        scene = Scene()

    with pytest.raises(ValueError, match=r"task.ball_noise_m: robot nao-0 perceives no ball; give the task a scene"):
        Environment(EmbeddedSimulator(NAO, 1), Blind, BallNoiseSettings(name="look", ball_noise_m=0.1))
