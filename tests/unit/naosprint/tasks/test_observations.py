"""Each of the observations of NAOs, and the assembly of blocks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from naosim import robots
from naosim.robots import Robot, nao_model
from naosim.robots.actuation import Actuation
from naosim.simspark import EmbeddedSimulator, centre_of_mass
from naosim.simulator import Simulator, Starts, Truth
from naosprint.tasks.base import Task
from naosprint.tasks.environment import Environment
from naosprint.tasks.observations import BLOCKS, ObservationBlock, Observer, blocks
from naosprint.tasks.robot_defaults import robot_defaults
from naosprint.tasks.sprint import Sprint1, SprintSettings
from naosprint.tasks.velocity import Velocity
from naosprint.tasks.world import World
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAO = robots.get("nao-0")


@dataclass
class Readings:
    """One robot's perceptors and truth, set by hand."""

    joint_angles: Array = field(default_factory=lambda: np.zeros((1, 22)))
    gyro: Array = field(default_factory=lambda: np.zeros((1, 3)))
    accel: Array = field(default_factory=lambda: np.zeros((1, 3)))
    foot_left: Array = field(default_factory=lambda: np.full((1, 6), np.nan))
    foot_right: Array = field(default_factory=lambda: np.full((1, 6), np.nan))
    torso_position: Array = field(default_factory=lambda: np.array([[-14.0, 0.0, 0.35]]))
    torso_rotation: Array = field(default_factory=lambda: _facing(0.0))


def _facing(yaw: float) -> Array:
    """Return the rotation of a torso whose front, +y, points ``yaw`` to the left of +x."""
    front = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.column_stack([np.cross(front, up), front, up])[None]


class Puppet(Simulator):
    """Simulator of one robot with given readings."""

    def __init__(self) -> None:
        super().__init__(NAO, 1)
        self.show(Readings())

    def show(self, readings: Readings) -> None:
        names = ("joint_angles", "gyro", "accel", "foot_left", "foot_right")
        self.perceptors = {name: getattr(readings, name) for name in names}
        self.truth = Truth(readings.torso_position, readings.torso_rotation)

    def step_async(self, targets_rad: Array, rows: slice, active: NDArray[np.bool_] | None = None) -> None: ...

    def step_wait(self, rows: slice) -> None: ...

    def load_starts(self, starts: Starts) -> None: ...

    def start(
        self, rows: NDArray[np.int64], starts: NDArray[np.int64], following: NDArray[np.int64] | None = None
    ) -> None: ...


class Watch:
    """Observer of readings, with the results by name."""

    def __init__(self, robot: Robot = NAO) -> None:
        self.simulator = Puppet()
        self.world = World(self.simulator)
        self.observer = Observer(1, blocks(self.world, robot_defaults(robot).observations))
        self.names = self.observer.names

    def begin(self, readings: Readings) -> dict[str, float]:
        """Begin an episode."""
        self.simulator.show(readings)
        self.world.steps[:] = 0
        self.observer.begin(np.array([0]))
        return self._by_name()

    def step(self, readings: Readings) -> dict[str, float]:
        """Take a step."""
        self.simulator.show(readings)
        self.world.steps += 1
        self.observer.update(slice(0, 1))
        return self._by_name()

    def _by_name(self) -> dict[str, float]:
        return dict(zip(self.names, self.observer.observations[0].tolist(), strict=True))


def environment_of(n: int) -> Environment:
    """Return n NAOs at their starts."""
    settings = Sprint1.resolve(SprintSettings(name="sprint1"), NAO)
    environment = Environment(EmbeddedSimulator(NAO, n), Sprint1, settings)
    environment.load_starts(environment.task.starts(n, 0, 2.0))
    environment.restart(np.arange(n), np.arange(n))
    return environment


def test_velocity_on_the_field_is_that_of_the_last_step() -> None:
    """Forward and lateral, in metres per second, zero at the start; a robot with the setting observes it last."""
    watch = Watch(NAO.with_parameters({"ground_velocity": True}))
    assert watch.names[-2:] == ("forward_velocity", "lateral_velocity")
    assert watch.names[:-2] == Watch().names
    seen = watch.begin(Readings())
    assert (seen["forward_velocity"], seen["lateral_velocity"]) == (0.0, 0.0)
    seen = watch.step(Readings(torso_position=np.array([[-13.92, 0.01, 0.36]])))
    assert seen["forward_velocity"] == pytest.approx(4.0)
    assert seen["lateral_velocity"] == pytest.approx(0.5)
    seen = watch.step(Readings(torso_position=np.array([[-13.92, 0.0, 0.36]])))
    assert (seen["forward_velocity"], seen["lateral_velocity"]) == pytest.approx((0.0, -0.5))
    mirrored = watch.observer.mirror.sign[-2:]
    assert mirrored.tolist() == [1.0, -1.0]


@pytest.fixture
def watch() -> Watch:
    """Return a fresh observer of one robot."""
    return Watch()


def test_there_are_89_in_the_order_of_the_papers_code() -> None:
    """Step counter, joints, rates, torso, centre of mass, sensors, feet, counters."""
    names = Watch().names
    assert len(names) == len(set(names)) == 89
    assert names[0] == "step"
    assert names[1:21] == Actuation(NAO).names
    assert names[21:41] == tuple(f"{name}_rate" for name in names[1:21])
    assert names[41:45] == ("yaw", "yaw_rate", "height", "height_rate")
    assert names[45:51] == ("com_x", "com_y", "com_z", "com_x_rate", "com_y_rate", "com_z_rate")
    assert names[51] == "gyro_x"
    assert names[57] == "accel_x"
    assert names[63] == "left_foot_origin_x"
    assert names[69] == "left_foot_force_x"
    assert names[75] == "right_foot_origin_x"
    assert names[81] == "right_foot_force_x"
    assert names[87:] == ("right_foot_counter", "left_foot_counter")


def test_rates_make_up_what_the_paper_counts() -> None:
    """43 rates, one for each number except the three counters."""
    names = Watch().names
    assert sum(name.endswith("_rate") for name in names) == 43


def test_step_counts_from_zero(watch: Watch) -> None:
    """The first observation is number 0, and a new episode starts over."""
    assert watch.begin(Readings())["step"] == 0
    assert [watch.step(Readings())["step"] for _ in range(3)] == [1, 2, 3]
    assert watch.begin(Readings())["step"] == 0


@pytest.mark.parametrize("joint", Actuation(NAO).names)
def test_joint_and_its_rate(watch: Watch, joint: str) -> None:
    """A joint is its perceived angle in radians with the policies' sign; the rate is the difference."""
    index = nao_model.model(0).joint_index[joint]
    reverse = joint[1:] in ("aj1", "lj3", "lj4", "lj5") or (
        joint[0] == "r" and joint[1:] in ("aj2", "aj3", "aj4", "lj2", "lj6")
    )
    sign = -1.0 if reverse else 1.0
    first, second = Readings(), Readings()
    first.joint_angles[0, index], second.joint_angles[0, index] = 10.0, 14.0
    seen = watch.begin(first)
    assert seen[joint] == pytest.approx(sign * np.deg2rad(10.0))
    assert seen[f"{joint}_rate"] == 0.0
    seen = watch.step(second)
    assert seen[joint] == pytest.approx(sign * np.deg2rad(14.0))
    assert seen[f"{joint}_rate"] == pytest.approx(sign * np.deg2rad(4.0))
    others = [name for name in Actuation(NAO).names if name != joint]
    assert all(seen[name] == 0.0 and seen[f"{name}_rate"] == 0.0 for name in others)


def test_yaw_is_relative_to_the_running_direction(watch: Watch) -> None:
    """Zero along +x, positive to the left; the rate goes the short way round."""
    assert watch.begin(Readings(torso_rotation=_facing(0.0)))["yaw"] == pytest.approx(0.0)
    seen = watch.step(Readings(torso_rotation=_facing(0.3)))
    assert (seen["yaw"], seen["yaw_rate"]) == pytest.approx((0.3, 0.3))
    watch.step(Readings(torso_rotation=_facing(3.1)))
    seen = watch.step(Readings(torso_rotation=_facing(-3.1)))
    assert seen["yaw"] == pytest.approx(-3.1)
    assert seen["yaw_rate"] == pytest.approx(2 * np.pi - 6.2)


def test_height_is_the_torsos(watch: Watch) -> None:
    """Height above the ground in metres, and its difference."""
    assert watch.begin(Readings(torso_position=np.array([[1.0, 2.0, 0.35]])))["height"] == 0.35
    seen = watch.step(Readings(torso_position=np.array([[3.0, 4.0, 0.37]])))
    assert seen["height"] == 0.37
    assert seen["height_rate"] == pytest.approx(0.02)


def test_centre_of_mass_follows_the_perceived_angles(watch: Watch) -> None:
    """In the torso's frame, wherever the torso is."""
    angles = np.zeros((1, 22))
    angles[0, nao_model.model(0).joint_index["llj3"]] = 40.0
    before = watch.begin(Readings())
    seen = watch.step(Readings(joint_angles=angles, torso_position=np.array([[9.0, 9.0, 9.0]])))
    expected = centre_of_mass(0, angles)[0]
    for axis, value in zip("xyz", expected, strict=True):
        assert seen[f"com_{axis}"] == pytest.approx(value)
        assert seen[f"com_{axis}_rate"] == pytest.approx(value - before[f"com_{axis}"])


def test_gyro_is_in_radians_per_second(watch: Watch) -> None:
    """The perceptor's degrees per second, in radians."""
    watch.begin(Readings())
    seen = watch.step(Readings(gyro=np.array([[90.0, -180.0, 45.0]])))
    for axis, value in zip("xyz", (np.pi / 2, -np.pi, np.pi / 4), strict=True):
        assert seen[f"gyro_{axis}"] == pytest.approx(value)
        assert seen[f"gyro_{axis}_rate"] == pytest.approx(value)


def test_accelerometer_is_passed_on(watch: Watch) -> None:
    """Metres per second squared as perceived."""
    watch.begin(Readings(accel=np.array([[0.0, 0.0, 9.81]])))
    seen = watch.step(Readings(accel=np.array([[1.0, -2.0, 10.81]])))
    for axis, value, rate in zip("xyz", (1.0, -2.0, 10.81), (1.0, -2.0, 1.0), strict=True):
        assert seen[f"accel_{axis}"] == pytest.approx(value)
        assert seen[f"accel_{axis}_rate"] == pytest.approx(rate)


@pytest.mark.parametrize("side", ["left", "right"])
def test_foot_records_are_zero_without_contact(watch: Watch, side: str) -> None:
    """Origin and force as perceived, zeros where the server sends nothing."""
    record = np.array([[0.01, 0.02, -0.01, 1.0, -2.0, 30.0]])
    watch.begin(Readings())
    touching = Readings(foot_left=record) if side == "left" else Readings(foot_right=record)
    names = [f"{side}_foot_{part}_{axis}" for part in ("origin", "force") for axis in "xyz"]
    seen = watch.step(touching)
    assert [seen[name] for name in names] == record[0].tolist()
    assert [seen[f"{name}_rate"] for name in names] == record[0].tolist()
    other = "right" if side == "left" else "left"
    assert seen[f"{other}_foot_force_z"] == 0.0
    seen = watch.step(Readings())
    assert [seen[name] for name in names] == [0.0] * 6
    assert [seen[f"{name}_rate"] for name in names] == (-record[0]).tolist()


@pytest.mark.parametrize("side", ["left", "right"])
def test_foot_counter_restarts_at_touchdown(watch: Watch, side: str) -> None:
    """It counts while the foot stands and while it swings, and restarts as it touches the ground again."""
    record = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 20.0]])

    def readings(down: bool) -> Readings:
        if not down:
            return Readings()
        return Readings(foot_left=record) if side == "left" else Readings(foot_right=record)

    assert watch.begin(readings(True))[f"{side}_foot_counter"] == 0
    contacts = [True, True, False, False, True, True, False, True]
    counts = [watch.step(readings(down))[f"{side}_foot_counter"] for down in contacts]
    assert counts == [1, 2, 3, 4, 0, 1, 2, 0]
    other = "right" if side == "left" else "left"
    assert watch.step(readings(True))[f"{other}_foot_counter"] == len(contacts) + 1


def test_a_history_has_the_observations_of_the_steps_before() -> None:
    """Those before an episode are like its first; mirror images are those of the same step."""
    now = np.zeros((2, 2))
    block = ObservationBlock(("left", "right"), lambda rows: now[rows], partners=("right", "left"))
    observer = Observer(2, [block], history=2)
    assert observer.names == ("left", "right", "left_ago1", "right_ago1", "left_ago2", "right_ago2")
    now[:] = [[1.0, 2.0], [10.0, 20.0]]
    observer.begin(np.array([0, 1]))
    np.testing.assert_array_equal(observer.observations[1], [10.0, 20.0] * 3)
    for step in range(3):
        now[0] = [3.0 + step, -3.0 - step]
        observer.update(slice(0, 1))
    np.testing.assert_array_equal(observer.observations[0], [5.0, -5.0, 4.0, -4.0, 3.0, -3.0])
    np.testing.assert_array_equal(observer.observations[1], [10.0, 20.0] * 3)  # it took no step
    observer.begin(np.array([0]))
    np.testing.assert_array_equal(observer.observations[0], [5.0, -5.0] * 3)
    assert observer.mirror.index.tolist() == [1, 0, 3, 2, 5, 4]


def test_beginning_one_robot_leaves_the_others_alone() -> None:
    """Only the rows named begin a new episode."""
    environment = environment_of(3)
    for _ in range(5):
        environment.step(np.zeros((3, 20)))
    before = environment.observations.copy()
    environment.restart(np.array([1]), np.array([1]))
    after = environment.observations
    assert np.array_equal(after[[0, 2]], before[[0, 2]])
    assert after[1, 0] == 0
    assert before[1, 0] == 5


def test_observations_agree_with_the_simulator_step_by_step() -> None:
    """On the running engine, every observation matches its definition by the perceptors."""
    environment = environment_of(4)
    simulator, actuation = environment.simulator, environment.actuation
    names = environment.observer.names
    column = {name: i for i, name in enumerate(names)}
    rng = np.random.default_rng(1)
    previous = environment.observations.copy()
    for step in range(1, 60):
        seen = environment.step(rng.uniform(-1, 1, (4, 20))).copy()
        p, g = simulator.perceptors, simulator.truth
        assert (seen[:, 0] == step).all()
        np.testing.assert_allclose(seen[:, 1:21], np.deg2rad(p["joint_angles"][:, 2:]) * actuation.sign, atol=1e-12)
        np.testing.assert_allclose(seen[:, column["height"]], g.torso_position[:, 2])
        np.testing.assert_allclose(seen[:, 45:48], centre_of_mass(0, p["joint_angles"]))
        np.testing.assert_allclose(seen[:, 51:54], np.deg2rad(p["gyro"]))
        np.testing.assert_allclose(seen[:, 57:60], p["accel"])
        for foot, record in (("left", p["foot_left"]), ("right", p["foot_right"])):
            at = column[f"{foot}_foot_origin_x"]
            np.testing.assert_allclose(seen[:, at : at + 3], np.nan_to_num(record[:, :3]))
            at = column[f"{foot}_foot_force_x"]
            np.testing.assert_allclose(seen[:, at : at + 3], np.nan_to_num(record[:, 3:]))
        for name in names:
            if name.endswith("_rate") and name != "yaw_rate":
                value = column[name.removesuffix("_rate")]
                np.testing.assert_allclose(
                    seen[:, column[name]], seen[:, value] - previous[:, value], atol=1e-12, err_msg=name
                )
        previous = seen


def test_blocks_that_do_not_exist_are_listed() -> None:
    with pytest.raises(ValueError, match="unknown block 'smell': choose one of accel"):
        blocks(Watch().world, ["step", "smell"])


def test_two_numbers_of_one_name_are_refused() -> None:
    """A policy is adapted to other robots by the names of its observations."""
    world = Watch().world
    with pytest.raises(ValueError, match="step: two blocks have a number of this name"):
        Observer(1, blocks(world, ["step", "height", "step"]))


def test_a_mirror_image_that_is_not_observed_is_named() -> None:
    observer = Observer(1, [ObservationBlock(("left",), lambda rows: np.zeros((1, 1)), partners=("right",))])
    with pytest.raises(ValueError, match="left: its mirror image right is not among"):
        _ = observer.mirror


@pytest.mark.parametrize("robot", robots.names())
def test_every_robot_has_observations_that_exist_and_heights_below_its_own(robot: str) -> None:
    described = robots.get(robot)
    defaults = robot_defaults(described)
    assert set(defaults.observations) <= set(BLOCKS)
    assert defaults.fall_height_m < defaults.erect_height_m < described.standing_height_m


def test_policies_of_an_onboard_robot_observe_the_estimate_in_place_of_the_truth() -> None:
    plain, onboard = robots.get("nao-3"), robots.get("nao-3").with_parameters({"onboard_sensing": True})
    assert {"yaw", "height"} <= set(robot_defaults(plain).observations)
    assert not {"yaw", "height"} & set(robot_defaults(onboard).observations)


@pytest.mark.parametrize("name", ["t1", "k1"])
@pytest.mark.parametrize("kind", [Velocity, Sprint1])
def test_only_critics_observe_where_an_onboard_booster_is_and_how_fast(name: str, kind: type[Task]) -> None:
    """The distance from a line or path says where it is, too."""
    mujoco = pytest.importorskip("naosim.mujoco.embedded")
    robot = robots.get(name).with_parameters({"onboard_sensing": True})
    world = {"height", "velocity_x", "velocity_y", "velocity_z", "line_offset"}
    names = {}
    for critic in (False, True):
        simulator = mujoco.MujocoSimulator(robot, 2)
        task = kind.Parameters(name=kind.name, min_height_m=0.3)
        environment = Environment(simulator, kind, task, critic=critic)
        names[critic] = set(environment.observer.names), set(environment.observer.critic_names)
        assert environment.compiled
        simulator.close()
    assert not names[True][0] & world
    assert names[False] == (names[True][0], set())
    assert world <= names[True][1]


@pytest.mark.parametrize("what", ["signs", "partners", "spread"])
def test_a_block_has_one_entry_for_each_of_its_names(what: str) -> None:
    entries: dict[str, Any] = {what: ("a",) if what == "partners" else (1.0,)}
    with pytest.raises(
        ValueError, match=f"observations: a, b: {what} has 1 entries for 2 names; one for each is needed"
    ):
        ObservationBlock(("a", "b"), lambda rows: np.zeros((1, 2)), **entries)


def test_a_text_is_not_taken_for_the_names_of_its_letters() -> None:
    with pytest.raises(TypeError, match=r"observations: yaw: names is a text; a tuple is needed, as \('yaw',\)"):
        ObservationBlock("yaw", lambda rows: np.zeros((1, 3)))


@pytest.mark.parametrize("name", ["memory", "observations", "features"])
def test_arrays_of_blocks_that_would_replace_each_other_in_a_checkpoint_are_refused(name: str) -> None:
    shared = np.zeros((3, 1))
    blocks = [ObservationBlock((each,), lambda _: shared, arrays={name: array}) for each, array in
              (("slow", shared), ("quick", shared if name == "memory" else np.zeros((3, 1))))]  # fmt: skip
    if name == "memory":
        assert Observer(3, blocks).state().keys() == {"observations", "features", "memory"}
        blocks[1] = ObservationBlock(("quick",), lambda _: shared, arrays={name: np.zeros((3, 1))})
    with pytest.raises(ValueError, match=f"another array is named '{name}' in checkpoints"):
        Observer(3, blocks)
