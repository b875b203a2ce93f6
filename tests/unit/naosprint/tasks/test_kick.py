"""The task kick and its parts: hand-over states, a frozen walker, what is perceived, and results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.robots import Robot
from naosim.robots.booster import K1, T1
from naosim.simulator import BALL, STEP_S
from naospec import TrainingSpec
from naosprint.rl.ppo import Rollout
from naosprint.rl.warm_start import adapt
from naosprint.tasks import rolling
from naosprint.tasks.ball import principal
from naosprint.tasks.environment import Environment
from naosprint.tasks.episodes import Episodes, Statistics
from naosprint.tasks.frozen import FrozenPolicy
from naosprint.tasks.handover import HandOver, record
from naosprint.tasks.kick import Kick
from naosprint.tasks.kick_results import UPRIGHT_S
from naosprint.tasks.kick_settings import KickSettings
from naosprint.tasks.observations import ObservationBlock, Observer
from naosprint.tasks.velocity import Velocity, VelocitySettings
from naosprint.terms import constant, source
from pydantic import ValidationError

RADIUS = T1.field.ball_radius_m
PITCHED = T1.with_parameters({"head_pitch_rad": 0.6})
FAST = BoosterEmbeddedParameters(engine="fast")


def environment_of(n: int, *, robot: Robot = PITCHED, seed: int = 0, **settings: Any) -> Environment:
    """Return n robots at their starts."""
    parameters = Kick.resolve(KickSettings(name="kick", handover_states=8, **settings), robot)
    simulator = MujocoSimulator(robot, n, FAST, scene=Kick.scene)
    environment = Environment(simulator, Kick, parameters, seed, critic=True)
    environment.load_starts(environment.task.starts(2, seed, 2.0))
    environment.restart(np.arange(n), np.arange(n) % 2)
    return environment


def task_of(environment: Environment) -> Kick:
    assert isinstance(environment.task, Kick)
    return environment.task


def walk(environment: Environment, steps: int) -> None:
    """Take steps with the walker's actions."""
    walker = task_of(environment)._walker
    for _ in range(steps):
        environment.step(walker.act(environment.observer, slice(0, environment.n)))


@pytest.fixture(scope="module")
def states() -> HandOver:
    """States of the walker."""
    return recorded(2)


def recorded(n: int, seed: int = 0) -> HandOver:
    simulator = MujocoSimulator(T1, n)  # the engine of evaluations, whose bits do not depend on n
    settings = VelocitySettings(name="velocity", forward_min_mps=0.5, forward_max_mps=1.0, stand_fraction=0.0)
    return record(simulator, FrozenPolicy("t1-run"), Velocity, settings, 16, seed)


# --- hand-over ------------------------------------------------------------------------------------------------------


def test_hand_over_states_walk_whatever_the_number_of_robots(states: HandOver) -> None:
    assert len(states) == 16
    speed = np.hypot(*states.motion.torso_mps[:, :2].T)
    assert np.median(speed) > 0.3
    assert np.abs(states.motion.joints_rad_s).max(axis=1).min() > 0.1
    w, x, y, z = states.motion.torso_wxyz.T
    np.testing.assert_allclose(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)), 0.0, atol=1e-9)
    alone = recorded(1)
    np.testing.assert_array_equal(alone.actions, states.actions)
    np.testing.assert_array_equal(alone.motion.torso_mps, states.motion.torso_mps)


def test_another_seed_gives_other_states(states: HandOver) -> None:
    other = recorded(2, seed=1)
    apart = np.abs(other.actions[:, None] - states.actions[None]).max(axis=2)
    assert apart.min() > 1e-3


def test_a_walker_continues_from_its_states() -> None:
    """In any direction: nothing of the motion is lost, or it would fall."""
    environment = environment_of(8, aligned_fraction=0.0, ball_near_m=2.0, ball_far_m=2.0, time_penalty=0.0)
    before = environment.world.bodies["torso"].velocity.copy()
    walk(environment, 100)
    assert np.hypot(*before[:, :2].T).max() > 0.3
    assert not environment.ends["fallen"].any()
    assert environment.world.position(slice(0, 8))[:, 2].min() > 0.55


def test_the_first_observation_is_that_of_a_robot_in_motion() -> None:
    environment = environment_of(4)
    task, names = task_of(environment), environment.observer.names
    seen = environment.observations[:, [names.index(f"velocity_{axis}") for axis in "xyz"]]
    np.testing.assert_array_equal(seen, task._entered.states.velocity[task._entered.numbers])
    actions = environment.observations[:, [k for k, name in enumerate(names) if name.startswith("action_")]]
    np.testing.assert_array_equal(actions, task._entered.states.actions[task._entered.numbers])


# --- another policy acts ----------------------------------------------------------------------------------------------


def test_the_states_are_of_the_nominal_world() -> None:
    """What a training varies does not reach the walker whose states it records."""
    nominal = task_of(environment_of(4))._entered.states
    varied = environment_of(4, friction_min=0.4, friction_max=0.5, mass_variation=0.3)
    np.testing.assert_array_equal(task_of(varied)._entered.states.actions, nominal.actions)
    assert (varied.disturbances._world[:, 0] <= 0.5).all()


def test_with_a_delay_a_state_s_command_acts_until_the_first_of_the_episode_does() -> None:
    environment = environment_of(4, extra_delay=2)
    last = environment.actuation.targets(environment.world.actions.copy())
    assert np.abs(last - PITCHED.nominal).max(axis=1).min() > 0.05  # it walks
    for targets in (last, last, last + 1.0):
        acting = environment.disturbances.delayed(last + 1.0, slice(0, 4))
        np.testing.assert_array_equal(acting, targets)


def test_a_frozen_policy_names_what_it_misses() -> None:
    block = ObservationBlock(("gravity_x",), lambda rows: np.zeros((1, 1)))
    with pytest.raises(ValueError, match="t1-run cannot act here: it observes action_left_ankle_pitch, "):
        FrozenPolicy("t1-run").act(Observer(1, [block]), slice(0, 1))


@pytest.mark.parametrize("walker", ["t1-sprint", "sprint", "unknown"])
def test_only_a_walker_of_the_robot_can_take_over(walker: str) -> None:
    content = {"task": {"name": "kick", "walker": walker}, "robot": "t1", "total_steps": 1}
    with pytest.raises(ValidationError, match=rf"task.walker: '{walker}' is no bundled policy .* use t1-run"):
        TrainingSpec.model_validate(content)


@pytest.mark.parametrize(
    ("robot", "settings", "walker", "remembered"),
    [
        (T1, {}, "t1-run", 0),
        (T1, {"walker": "t1-run-robust"}, "t1-run-robust", 2),
        (T1, {"walker": "t1-run-robust", "history_steps": 3}, "t1-run-robust", 3),
        (K1, {}, "k1-run", 2),
    ],
)
def test_a_task_remembers_what_its_walker_does(
    robot: Robot, settings: dict[str, Any], walker: str, remembered: int
) -> None:
    environment = environment_of(2, robot=robot, **settings)
    task = task_of(environment)
    assert (task.parameters.walker, task.parameters.history_steps) == (walker, remembered)
    assert np.isfinite(task._walker.act(environment.observer, slice(0, 2))).all()


def test_the_walker_takes_over_after_the_perceived_kick() -> None:
    environment = environment_of(2, takeover_steps=3)
    task, rows = task_of(environment), np.arange(2)
    walk(environment, 3)
    assert not task.frozen.any()
    ball = environment.world.bodies[BALL].position[:1].copy()
    environment.world.place_ball(rows[:1], ball, np.array([[3.0, 0.0, 0.0]]))
    nothing = np.zeros((2, environment.actuation.n_actions))
    for _ in range(12):
        frozen = task.frozen.copy()
        expected = np.where(frozen[:, None], task._walker.act(environment.observer, slice(0, 2)), nothing)
        environment.step(nothing)
        np.testing.assert_array_equal(environment.world.actions, expected)
    assert task.frozen.tolist() == [True, False]
    assert not task.arrays["command"][0].any()


def test_frozen_actions_teach_the_actor_nothing() -> None:
    rollout = Rollout(2, 3, 1, 1)
    rollout.advantages[:] = [[1.0, 2.0, 50.0], [3.0, 4.0, -70.0]]
    rollout.returns[:] = 7.0
    rollout.frozen[:, 2] = True
    rollout.leave_out_frozen(normalized=True)
    np.testing.assert_array_equal(rollout.advantages[:, 2], 2.5)
    assert (rollout.advantages - rollout.advantages.mean())[0, 2] == 0.0
    assert (rollout.returns == 7.0).all()
    rollout.leave_out_frozen(normalized=False)
    np.testing.assert_array_equal(rollout.advantages[:, 2], 0.0)


def test_a_warm_start_takes_the_spreads_of_new_observations() -> None:
    spreads = environment_of(1).observer.spreads
    assert spreads["ball_left"] == 0.2
    assert "gravity_x" not in spreads
    names, joints = ("a", "b"), ("knee",)
    layers = {f"mlp_extractor.{net}_net.0.weight": np.ones((2, 2), np.float32) for net in ("policy", "value")}
    action = {"action_net.weight": np.ones((1, 2), np.float32), "action_net.bias": np.zeros(1, np.float32)}
    statistics = {"observation_mean": np.array([1.0, 2.0]), "observation_variance": np.array([3.0, 4.0])}
    statistics["observation_counts"] = np.array([5.0, 5.0])
    policy = {**layers, **action, **statistics, "log_std": np.zeros(1, np.float32)}
    new = (names, ("b", "ball_left", "other"))
    found = adapt(policy, observations=new, actions=(joints, joints), rest=np.zeros(1), spreads=spreads)
    np.testing.assert_allclose(found["observation_variance"], [4.0, 0.04, 1.0])
    np.testing.assert_array_equal(found["observation_mean"], [2.0, 0.0, 0.0])
    assert not found["mlp_extractor.policy_net.0.weight"][:, 1:].any()


# --- starts and perception --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("robot", "foot_m"), [(PITCHED, 0.106), (K1.with_parameters({"head_pitch_rad": 0.6}), 0.096)])
def test_balls_are_before_a_foot_or_somewhere_near(robot: Robot, foot_m: float) -> None:
    environment = environment_of(64, robot=robot, aligned_fraction=0.5, rolling_fraction=0.0)
    task, everyone = task_of(environment), slice(0, 64)
    apart = environment.world.bodies[BALL].position[:, :2] - environment.world.position(everyone)[:, :2]
    yaw = environment.world.yaw(everyone)
    ahead, aside = (
        np.cos(yaw) * apart[:, 0] + np.sin(yaw) * apart[:, 1],
        np.cos(yaw) * apart[:, 1] - np.sin(yaw) * apart[:, 0],
    )
    aim = (task._target[:, 0] - yaw + np.pi) % (2 * np.pi) - np.pi
    aligned = task._aligned
    assert 16 <= aligned.sum() <= 48
    assert np.degrees(np.abs(aim[aligned])).max() <= 10.01
    assert np.degrees(np.abs(aim[~aligned])).max() <= 30.01
    assert np.degrees(np.abs(aim[~aligned])).max() > 20.0
    line = np.abs(np.cos(aim) * aside - np.sin(aim) * ahead)
    assert (np.abs(line[aligned] - foot_m) <= 0.0601).all()
    assert ((ahead > 0.349) & (ahead < 0.901)).all()
    assert np.ptp(yaw) > 5.0


EVENED = {"kicked_m": 0.07, "sight_share": 0.25}


def approaching(rolling_fraction: float, **settings: float) -> Environment:
    """Robots that walk to a ball out of their reach, for half a second."""
    environment = environment_of(
        32, rolling_fraction=rolling_fraction, aligned_fraction=0.0, ball_near_m=0.9, **settings
    )
    for _ in range(25):
        environment.step(task_of(environment)._walker.act(environment.observer, slice(0, 32)))
    return environment


@pytest.mark.parametrize("settings", [{}, EVENED, {**EVENED, "ball_noise_m": 0.01}])
@pytest.mark.parametrize("rolling_fraction", [0.0, 1.0])
def test_nothing_but_a_kick_looks_like_one(rolling_fraction: float, settings: dict[str, float]) -> None:
    """Neither a ball at rest, nor one that rolls and slows down, nor noise, while the robot walks."""
    task = task_of(approaching(rolling_fraction, **settings))
    untouched = task._touched < 0
    assert untouched.sum() > 16 and (task._kicked[untouched] < 0).all()


def test_noise_looks_like_a_kick_where_the_last_sight_is_taken_for_the_place() -> None:
    assert (task_of(approaching(0.0, ball_noise_m=0.02))._kicked >= 0).sum() > 8


def test_a_soft_kick_is_noticed_from_several_sights() -> None:
    """A ball struck with 1.3 m/s moves by less than 7 cm between two sights."""
    environment = approaching(0.0, **EVENED)
    task, everyone, ball = task_of(environment), np.arange(32), environment.world.bodies[BALL]
    away = np.stack([np.cos(task._aim), np.sin(task._aim), np.zeros(32)], axis=1)
    environment.world.place_ball(everyone, ball.position.copy(), 1.3 * away, np.zeros((32, 3)))
    for _ in range(12):
        environment.step(task._walker.act(environment.observer, slice(0, 32)))
    assert (task._kicked >= 0).mean() > 0.9


@pytest.mark.parametrize(("speed", "aside"), [(1.3, 0.0), (1.3, 0.3), (6.0, 0.0)])
def test_a_kick_that_is_too_weak_is_followed_by_another(speed: float, aside: float) -> None:
    """The robot then aims, from where the ball will stop, at the point to which it was to be kicked."""
    environment = approaching(0.0, **EVENED, power_fraction=0.0, distance_min_m=6.0, least_share=0.6, takeover_steps=6)
    task, everyone, ball = task_of(environment), np.arange(32), environment.world.bodies[BALL]
    place, aim, asked = ball.position[:, :2].copy(), task._aim.copy(), task._speed.copy()
    way = aim + aside
    moves = speed * np.stack([np.cos(way), np.sin(way), np.zeros(32)], axis=1)
    environment.world.place_ball(everyone, ball.position.copy(), moves, np.zeros((32, 3)))
    noticed = np.zeros(32, dtype=np.bool_)
    for _ in range(20):
        environment.step(task._walker.act(environment.observer, slice(0, 32)))
        noticed |= task._kicked >= 5
    assert noticed.mean() > 0.9
    if speed > 5.0:
        assert task.frozen[noticed].all()
        np.testing.assert_array_equal(task._aim, aim)
        return
    assert not task.frozen.any()
    rolled = rolling.straight(constant(speed / rolling.SLIDES))(slice(0, 1))[0, 0]
    length = rolling.straight(source(asked))(slice(0, 32))[:, 0]
    stop = place + rolled * np.stack([np.cos(way), np.sin(way)], axis=1)
    left = place + length[:, None] * np.stack([np.cos(aim), np.sin(aim)], axis=1) - stop
    off = np.degrees(principal(task._aim - np.arctan2(left[:, 1], left[:, 0])))
    assert np.median(np.abs(off[noticed])) < 2.0
    assert np.median(np.abs(task._speed / rolling.speed_of(source(np.hypot(*left.T)))(slice(0, 32))[:, 0] - 1.0)) < 0.05
    assert (task._speed[noticed] < asked[noticed]).all()


def test_a_kick_cannot_be_weighed_before_its_roll_is_seen() -> None:
    KickSettings(least_share=0.6, takeover_steps=2)
    KickSettings(takeover_steps=0)
    with pytest.raises(ValidationError, match=r"least_share: .*takeover_steps, 1; use 2 or more, or least_share 0"):
        KickSettings(least_share=0.6, takeover_steps=1)


def test_the_last_of_several_kicks_is_scored() -> None:
    """By direction and distance of the first command, whose target the ball has to reach."""
    environment = approaching(0.0, **EVENED, power_fraction=0.0, distance_min_m=6.0, least_share=0.6)
    task, ball = task_of(environment), environment.world.bodies[BALL]
    asked, since = task.arrays["asked"].copy(), task.arrays["since"]
    since[:], task._touched[:] = 26, 60
    task.arrays["weak"][:16] = True
    away = 3.0 * np.stack([np.cos(asked[:, 0]), np.sin(asked[:, 0]), np.zeros(32)], axis=1)
    environment.world.place_ball(np.arange(32), ball.position.copy(), away, np.zeros((32, 3)))
    task.arrays["weak"][:16] = True
    environment.step(np.zeros((32, environment.actuation.n_actions)))
    assert (since[:16] == -1).all() and (since[16:] == 27).all()
    since[:16] = 0
    environment.step(np.zeros((32, environment.actuation.n_actions)))
    assert (task._score[:16] > 0.3).all() and not task._score[16:].any()
    assert (task._touched == 62).all()


def test_a_ball_is_seen_with_the_stated_noise() -> None:
    """Off by as much in every direction, in every sight differently; not at all for undisturbed robots."""
    seen = {}
    for noise in (0.0, 0.02):
        environment = environment_of(32, ball_noise_m=noise, undisturbed_fraction=0.5, takeover_steps=1000)
        seen[noise] = []
        for _ in range(40):
            environment.step(np.zeros((32, environment.actuation.n_actions)))
            seen[noise].append(environment.simulator.perceptors[BALL].copy())
    exact, noisy = np.array(seen[0.0]), np.array(seen[0.02])
    np.testing.assert_array_equal(np.isnan(exact), np.isnan(noisy))
    off = noisy - exact
    off[:, :, 1:] = np.radians(off[:, :, 1:]) * exact[:, :, :1]
    disturbed = np.nanmax(np.abs(off), axis=(0, 2)) > 0.0
    assert 8 <= disturbed.sum() <= 24
    off = off[:, disturbed][~np.isnan(off[:, disturbed]).any(axis=2)]
    assert len(off) > 200 and len(np.unique(off[:, 0])) > 0.9 * len(off)
    np.testing.assert_allclose(off.std(axis=0), 0.02, rtol=0.15)
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.004)
    assert KickSettings(name="kick", ball_noise_m=0.01).for_evaluation().ball_noise_m == 0.0


def test_a_score_prefers_straight_kicks_of_the_commanded_distance() -> None:
    environment = environment_of(3)
    task, everyone = task_of(environment), slice(0, 3)
    task._power[:] = False
    task._speed[:] = rolling.launch(np.full(3, 4.0), np.zeros(3))[0]
    angles, far = np.radians([0.0, 5.0, 20.0]), np.full(3, 4.0)

    def scored(angle: np.ndarray, reached: np.ndarray) -> np.ndarray:
        return task._scored(source(angle), source(reached))(everyone)[:, 0]

    straight, off, wide = scored(angles, far)
    assert straight > 1.2 * off > 2.0 * wide
    short, right, long = scored(np.zeros(3), np.array([2.0, 4.0, 7.0]))
    assert right > 1.5 * max(short, long)
    task._power[:] = True
    assert scored(np.zeros(3), np.array([2.0, 4.0, 7.0])).argmax() == 2


def test_a_walk_through_the_ball_moves_it_and_ends_upright() -> None:
    environment = environment_of(8, seed=3, aligned_fraction=1.0, rolling_fraction=0.0, watch_steps=5)
    walk(environment, 75)
    task = task_of(environment)
    touched = task._touched >= 0
    assert touched.sum() >= 6
    launch_error_deg = task.measure(np.arange(8))[:, 1]
    assert (launch_error_deg[touched] < 90.0).all() and (launch_error_deg[~touched] == 180.0).all()
    task._touched[:] = -1
    assert (task.measure(np.arange(8))[:, 1] == 180.0).all()
    task._touched[touched] = 0
    angle, reached = task._launch[task._touched >= 0].T
    assert np.median(reached) > 0.5
    assert np.abs(np.degrees(angle)).max() < 90.0


def test_an_early_touch_costs_what_a_miss_costs_and_its_placement_can_count_more_narrowly() -> None:
    settings = {"seed": 3, "aligned_fraction": 1.0, "rolling_fraction": 0.0, "place_weight": 0.0, "miss_penalty": 2.0}
    usual = environment_of(8, **settings)
    patient = environment_of(8, **settings, earliest_touch_steps=60, place_spread=0.5)
    lost, moments = np.zeros(8), np.full(8, np.inf)
    for step in range(1, 76):
        for environment in (usual, patient):
            walk(environment, 1)
        lost += (usual.rewards - patient.rewards) / usual.task.parameters.reward_scale
        moments[task_of(usual)._touched == 0] = step
    early = moments < 60
    assert early.any() and (moments[~early] < np.inf).any()
    np.testing.assert_allclose(lost, np.where(early, 2.0, 0.0), atol=1e-4)
    wide, narrow = (task_of(each)._placement()(slice(0, 8))[:, 0] for each in (usual, patient))
    assert (narrow < wide).all()


def test_a_state_is_complete() -> None:
    first = environment_of(4, seed=1)
    walk(first, 30)
    saved = first.state()
    walk(first, 10)
    second = environment_of(4, seed=1)
    second.load_state(saved)
    walk(second, 10)
    np.testing.assert_array_equal(second.observations, first.observations)
    np.testing.assert_array_equal(second.rewards, first.rewards)


# --- results ----------------------------------------------------------------------------------------------------------


def episodes_of(*kicks: tuple[float, float, float, bool]) -> Episodes:
    """Return episodes in which the ball goes straight, each by angle from the command, distance, command and fall."""
    traces, rows = [], round(UPRIGHT_S / STEP_S) + 60
    for angle, far, asked, _ in kicks:
        way = np.linspace(0.0, far, rows)
        x, y = way * np.cos(1.0 + np.radians(angle)), way * np.sin(1.0 + np.radians(angle))
        touched, ones = (np.arange(rows) >= 20).astype(float), np.ones(rows)
        rest = np.zeros((rows, 2))
        traces.append(np.column_stack([x, y, touched, ones, asked * ones, ones, angle * ones, rest]))
    lengths = [80 if fell else rows for *_, fell in kicks]
    blank: Any = [np.zeros(length) for length in lengths]
    fallen = np.array([fell for *_, fell in kicks])
    traces = [trace[:length] for trace, length in zip(traces, lengths, strict=True)]
    ends = {"fallen": fallen, "done": ~fallen, "missed": np.zeros(len(kicks), dtype=np.bool_)}
    return Episodes(blank, blank, blank, blank, blank, blank, traces, ends, 1000)


def test_results_follow_from_the_balls_ways() -> None:
    kicks = episodes_of(
        (0.0, 6.0, np.inf, False), (4.0, 8.1, np.inf, False), (9.0, 6.0, 5.5, False), (0.0, 9.0, 9.0, True)
    )
    task = task_of(environment_of(1))
    results, tables = task.summarize(kicks, Statistics(0.95, 100, 0))
    found = {result.metric.name: result.value for result in results}
    assert found["contact_rate"] == 1.0
    assert found["upright_rate"] == 0.75
    assert found["fall_rate"] == 0.25
    assert found["stop_error_deg"] == pytest.approx(2.0)
    assert found["distance_error"] == pytest.approx(6.0 / 5.5 - 1.0)
    assert found["power_distance_m"] == pytest.approx(7.05)
    # far enough and upright is the second power kick alone, 4 degrees off; three kicks had to go that far
    assert found["goal_rate"] == pytest.approx(1 / 3)
    corridors = tables[0].columns["Aligned"]
    assert [result.value for result in corridors] == [0.75, 0.5, 0.5]


def test_a_ball_that_still_rolls_as_the_robot_falls_is_rolled_to_its_stop() -> None:
    kicks = episodes_of((0.0, 6.0, np.inf, False), (0.0, 6.0, np.inf, True))
    kicks.trace[1][:, 7:9] = 2.0 * np.array([np.cos(1.0), np.sin(1.0)])
    fell = 6.0 * 79 / (len(kicks.trace[0]) - 1)
    further, way = rolling.stop(np.array([2.0]), np.array([1.0]))
    whole = np.hypot(fell * np.cos(1.0) + further * np.cos(way), fell * np.sin(1.0) + further * np.sin(way))
    results, _ = task_of(environment_of(1)).summarize(kicks, Statistics(0.95, 100, 0))
    found = {result.metric.name: result for result in results}
    assert found["power_distance_m"].high == pytest.approx(whole.item()) and whole > fell + 1.0
    assert found["power_distance_m"].low == pytest.approx(6.0)


def test_the_trace_has_the_velocity_with_which_a_ball_rolls() -> None:
    environment = environment_of(1)
    task, row = task_of(environment), np.array([0])
    place, spin = task.world.bodies[BALL].position.copy(), np.array([[-1.0 / RADIUS, 2.0 / RADIUS, 0.0]])
    environment.simulator.place_ball(row, place + np.array([3.0, 0.0, 0.0]), np.array([[2.0, 1.0, 0.0]]), spin)
    np.testing.assert_allclose(task.trace_row(row)[0, 7:9], [2.0, 1.0], atol=0.01)


def test_kicks_that_need_not_go_far_have_no_rate_of_far_ones() -> None:
    """An evaluation of short passes only has no corridor of 5 m and no goal."""
    results, _ = task_of(environment_of(1)).summarize(episodes_of((0.0, 3.0, 3.0, False)), Statistics(0.95, 100, 0))
    found = {result.metric.name: result.value for result in results}
    assert (found["corridor_5_rate"], found["goal_rate"]) == (None, None)


def test_a_resumed_robot_whose_walker_has_taken_over_continues_with_it() -> None:
    first, second = (environment_of(4, takeover_steps=2, approach_steps=100) for _ in range(2))
    still = np.zeros((4, first.actuation.n_actions))
    task_of(first)._kicked[1:3] = 2
    first.step(still)
    assert first.task.frozen is not None and first.task.frozen.tolist() == [False, True, True, False]
    second.load_state({name: array.copy() for name, array in first.state().items()})
    np.testing.assert_array_equal(second.task.frozen, first.task.frozen)
    np.testing.assert_array_equal(second.step(still), first.step(still))
    np.testing.assert_array_equal(second.world.actions, first.world.actions)
