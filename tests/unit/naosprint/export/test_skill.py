"""A skill folder computes what the policy does in the simulator, with NumPy alone and without this project."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import naopolicies
import numpy as np
import pytest
from naosim import robots
from naosim.simspark.control import motor_speeds
from naosim.simspark.protocol import LANDMARKS
from naospec import TrainingSpec
from naosprint.export import export_policy
from naosprint.export.skill import TARGETS, write_skill
from naosprint.rl.checkpoint import Manifest
from naosprint.rl.policy import NetworkPolicy, load_policy
from naosprint.rl.runner import train
from naosprint.tasks import ObservationBlock
from naosprint.tasks import observations as offered
from naosprint.tasks.environment import open_environment
from naosprint.tasks.sprint import Sprint1
from naosprint.terms import constant, given, sin, uniform
from pydantic import Field


def random_policy(robot: dict[str, Any], task: Any) -> tuple[NetworkPolicy, Manifest]:
    """Return a policy of random weights for a task."""
    spec = TrainingSpec.model_validate({"robot": robot, "task": task})
    environment = open_environment(spec, 1, threads=1)
    names, actions = environment.observer.names, environment.actuation.names
    environment.close()
    rng = np.random.default_rng(3)
    layers = tuple(
        (rng.normal(0.0, 0.05, (after, before)).astype(np.float32), rng.normal(0.0, 0.05, after).astype(np.float32))
        for before, after in pairwise((len(names), 16, len(actions)))
    )
    policy = NetworkPolicy(np.zeros(len(names)), np.ones(len(names)), 10.0, layers, np.zeros(len(actions), np.float32))
    return policy, Manifest.model_construct(
        spec=spec, spec_sha256=spec.digest(), steps=0, stage=0, observations=names, actions=actions
    )


@pytest.fixture(scope="module")
def numpy_alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder to import from that has NumPy and nothing else."""
    folder = tmp_path_factory.mktemp("only")
    package = Path(np.__file__).parent
    for path in (package, *package.parent.glob("numpy.libs")):
        (folder / path.name).symlink_to(path)
    code = "import importlib.util as u, sys; sys.exit(bool(u.find_spec('naosprint')) or not u.find_spec('numpy'))"
    subprocess.run([sys.executable, "-S", "-c", code], env={"PYTHONPATH": str(folder)}, check=True)
    return folder


def check(folder: Path, numpy_alone: Path) -> subprocess.CompletedProcess[str]:
    """Run the check of a skill folder as a team does: without the packages of this environment."""
    return subprocess.run(
        [sys.executable, "-S", "check.py"],
        cwd=folder,
        env={"PYTHONPATH": str(numpy_alone)},
        capture_output=True,
        text=True,
        check=False,
    )


def folder_of(robot: str, directory: Path) -> Path:
    return directory / TARGETS[robots.get(robot).family].folder


@pytest.mark.parametrize(
    ("robot", "task"),
    [
        ({"name": "t1"}, "velocity"),
        ({"name": "k1"}, "sprint1"),
        ({"name": "t1"}, "getup"),
        ({"name": "nao-4"}, "sprint2"),
        ({"name": "nao-0", "ground_velocity": True}, {"name": "sprint1", "history_steps": 2}),
        (
            {"name": "t1", "onboard_sensing": True},
            {"name": "velocity", "history_steps": 3, "turn_acceleration_rad_s2": 4.0},
        ),
        ({"name": "t1", "head_pitch_rad": 0.6}, {"name": "kick", "power_fraction": 0.0}),
        ({"name": "t1", "head_pitch_rad": 0.6}, {"name": "kick", "power_fraction": 1.0, "rolling_fraction": 1.0}),
        ({"name": "t1", "head_pitch_rad": 0.6}, {"name": "dribble", "walker": "t1-run-steady"}),  # approaches commands
        ({"name": "t1", "head_pitch_rad": 0.6}, "block"),
    ],
    ids=[
        "t1",
        "k1",
        "t1-getup",
        "nao-4",
        "nao-0-velocity-history",
        "t1-onboard-history",
        "t1-pass",
        "t1-power-kick",
        "t1-dribble",
        "t1-block",
    ],
)
def test_the_skill_is_the_policy(robot: dict[str, Any], task: Any, tmp_path: Path, numpy_alone: Path) -> None:
    policy, manifest = random_policy(robot, task)
    write_skill(policy, manifest, tmp_path)
    folder = folder_of(robot["name"], tmp_path)
    vectors = np.load(folder / "parity.npz")
    assert len(vectors["observations"]) > 20
    assert np.ptp(vectors["observations"], axis=0).max() > 0.1
    checked = check(folder, numpy_alone)
    assert (checked.returncode, checked.stderr) == (0, ""), checked.stdout + checked.stderr


@pytest.mark.parametrize("robot", ["t1", "k1"])
def test_a_task_of_another_package_observes_the_ball(
    robot: str, offer: Callable[[str], None], tmp_path: Path, numpy_alone: Path
) -> None:
    """The documented example: its skill is given what the camera reports, and needs it."""
    offer("naosprint-push")
    policy, manifest = random_policy({"name": robot, "head_pitch_rad": 0.6}, "push-ball")
    write_skill(policy, manifest, tmp_path)
    folder = folder_of(robot, tmp_path)
    vectors = dict(np.load(folder / "parity.npz"))
    assert "ball" in vectors["inputs"] and np.isfinite(vectors["ball"]).any()
    ball = [i for i, name in enumerate(manifest.observations) if name.startswith("ball_")]
    assert len(ball) == 5 and (np.ptp(vectors["observations"][:, ball], axis=0) > 0.01).all()
    checked = check(folder, numpy_alone)
    assert (checked.returncode, checked.stderr) == (0, ""), checked.stdout + checked.stderr
    vectors["inputs"] = np.array([name for name in vectors["inputs"] if name != "ball"])
    np.savez(folder / "parity.npz", **vectors)
    assert check(folder, numpy_alone).returncode == 1


@pytest.mark.parametrize("name", ["t1-sprint", "sprint", "sprint-blind"])
def test_the_check_fails_for_another_policy(name: str, tmp_path: Path, numpy_alone: Path) -> None:
    written = export_policy(naopolicies.folder(name), tmp_path, ["skill"])
    folder = folder_of(naopolicies.card(name)["robot"], tmp_path)
    assert {path.name for path in written if path.parent == folder} == {path.name for path in folder.iterdir()}
    checked = check(folder, numpy_alone)
    assert (checked.returncode, checked.stdout.startswith("64 cycles")) == (0, True), checked.stderr
    arrays = dict(np.load(folder / "policy.npz"))
    arrays["weights_0"] = arrays["weights_0"] * np.float32(1.0001)
    np.savez(folder / "policy.npz", **arrays)
    assert check(folder, numpy_alone).returncode == 1


@pytest.mark.parametrize(("robot", "file"), [("t1", "skill.py"), ("nao-0", "{name}.py")])
def test_two_skills_of_one_team_have_folders_and_names_of_their_own(
    robot: str, file: str, tmp_path: Path, numpy_alone: Path
) -> None:
    parent = folder_of(robot, tmp_path).parent
    for name in ("policy", "kick_far"):
        write_skill(*random_policy({"name": robot}, "sprint1"), tmp_path, name)
    for shown, folder in (("Naosprint", folder_of(robot, tmp_path)), ("NaosprintKickFar", None)):
        folder = folder or parent / ("naosprint_kick_far" if robot == "t1" else shown)
        source = (folder / file.format(name=shown)).read_text(encoding="utf-8")
        assert re.findall(r"^class (\w+)", source, re.MULTILINE) == [shown]
        texts = "".join(path.read_text(encoding="utf-8") for path in folder.glob("*.py"))
        assert set(re.findall(r"Naosprint\w*", texts)) == {shown}
        assert check(folder, numpy_alone).returncode == 0
    assert len({path.name for path in parent.iterdir()}) == 2


STARTING = {
    "k1": """
import sys, types
def module(name, **content):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__dict__.update(content)
class Robot:
    name = "T1"
    def __init__(self, agent):
        self.targets = {}
    def set_motor_target_position(self, name, target, kp, kd):
        self.targets[name] = target
class Agent:
    def __init__(self, *words):
        def connect():
            raise ConnectionRefusedError
        self.robot, self.skills_manager = Robot(self), types.SimpleNamespace(skills={})
        self.server = types.SimpleNamespace(connect=connect)
        agents.append(self)
class Skill:
    def __init__(self, agent):
        self.agent = agent
agents = []
import mujococodebase.skills
module("mujococodebase.agent", Agent=Agent)
module("mujococodebase.robot", Robot=Robot)
module("mujococodebase.skills.skill", Skill=Skill)
options = types.SimpleNamespace(team="a", number=1, host="", port=0, monitor_port=None, lane=0.0)
start = "mujococodebase.skills.naosprint_{name}.play"
""",
    "nao-0": """
import sys, types
class Base_Agent:
    def __init__(self, *words):
        robot = types.SimpleNamespace(MAP_PERCEPTOR_TO_INDEX=Every(), FIX_PERCEPTOR_SET=())
        self.world, self.behavior = types.SimpleNamespace(robot=robot), types.SimpleNamespace(behaviors={})
        self.skills_manager = types.SimpleNamespace(skills=self.behavior.behaviors)
        agents.append(self)
class Every(dict):
    def __missing__(self, name):
        return 0
agents = []
sys.modules["agent.Base_Agent"] = types.ModuleType("agent.Base_Agent")
sys.modules["agent.Base_Agent"].Base_Agent = Base_Agent
options = types.SimpleNamespace(team="a", host="127.0.0.1", port=0, monitor_port=1, localization=False)
start = "behaviors.custom.{shown}.play"
""",
}
"""What a skill's `play` needs of the team's code to come as far as the server."""


@pytest.mark.parametrize(
    ("robot", "names"),
    [
        ("k1", {"runner": "Runner", "path": "Path", "skill": "Skill", "agent": "Agent", "k1": "K1", "true": "True"}),
        ("nao-0", {"base_agent": "BaseAgent", "monitor_port": "MonitorPort", "a1": "A1", "a_1": "A_1"}),
    ],
)
def test_a_skill_starts_whatever_its_name(robot: str, names: dict[str, str], tmp_path: Path, numpy_alone: Path) -> None:
    """Also if the team's code, Python or the skill itself calls a part of them so."""
    policy, manifest = random_policy({"name": robot}, "sprint1")
    for name in names:
        write_skill(policy, manifest, tmp_path, name)
    (root,) = tmp_path.iterdir()
    for name, shown in names.items():
        start = STARTING[robot].replace("{name}", name).replace("{shown}", f"Naosprint{shown}")
        code = f"""{start}
import importlib
try:
    importlib.import_module(start).run(options)
except ConnectionRefusedError:
    (skills,) = (agent.skills_manager.skills for agent in agents)
    print(*skills)
"""
        environment = {"PYTHONPATH": f"{root}:{numpy_alone}"}
        done = subprocess.run(
            [sys.executable, "-S", "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        assert (done.stdout, done.stderr) == (f"Naosprint{shown}\n", ""), name


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], Any]:
    """Write the skill of a bundled policy and import a module of it, from the folder that holds the team's code."""

    def load(policy: str, module: str) -> Any:
        write_skill(*load_policy(naopolicies.folder(policy)), tmp_path)
        base = tmp_path / "mujococodebase" / "mujococodebase" / "skills"
        if base.exists():  # the one class that a skill needs of that code
            (base / "skill.py").write_text("class Skill:\n    def __init__(self, agent):\n        self.agent = agent\n")
        root = next(tmp_path.iterdir())
        package = module.partition(".")[0]
        assert package not in sys.modules
        monkeypatch.syspath_prepend(str(root))
        found = importlib.import_module(module)
        for name in [name for name in sys.modules if name.partition(".")[0] == package]:
            del sys.modules[name]
        return found

    return load


def begin(policy: str) -> tuple[Any, NetworkPolicy]:
    """Return an environment at the start of an episode, and the policy."""
    loaded, manifest = load_policy(naopolicies.folder(policy))
    environment = open_environment(manifest.stage_spec, 1, threads=1)
    environment.load_starts(environment.task.starts(1, 0, 2.0))
    environment.restart(np.arange(1), np.zeros(1, dtype=np.int64))
    return environment, loaded


class Robot(SimpleNamespace):
    """What a skill reads and sets of the team's robot."""

    def set_motor_target_position(self, motor_name: str, target_position: float, kp: float, kd: float) -> None:
        self.targets[motor_name] = (target_position, kp, kd)


def test_the_skill_reads_and_commands_the_teams_robot(load: Callable[[str, str], Any]) -> None:
    """Fed with a run of the simulator in the team's units, it commands what the policy does."""
    skill = load("t1-sprint", "mujococodebase.skills.naosprint.skill")
    environment, policy = begin("t1-sprint")
    perceptors, description = environment.simulator.perceptors, environment.world.robot
    joints = ["q_" + joint.effector.replace("e", "j") for joint in description.joints]
    agent = SimpleNamespace(robot=Robot(targets={}), world=SimpleNamespace())
    made = skill.Naosprint(agent)
    for step in range(50):
        w, x, y, z = perceptors["torso_quat"][0]
        agent.robot.global_orientation_quat = np.array([x, y, z, w])
        agent.robot.gyroscope = perceptors["gyro"][0]
        # in another order: it goes by names
        agent.robot.motor_positions = dict(reversed([*zip(joints, perceptors["joint_angles"][0], strict=True)]))
        agent.robot.motor_speeds = dict(zip(joints, perceptors["joint_speeds"][0], strict=True))
        agent.world.global_position = perceptors["torso_pos"][0]
        assert step or made.is_ready()
        assert made.execute(step == 0, orientation=0.0, lane=environment.task.start_position()) is False
        actions = policy.act(environment.observations)
        expected = np.degrees(environment.actuation.targets(actions)[0])
        found = [agent.robot.targets[joint.effector] for joint in description.joints]
        np.testing.assert_allclose([target for target, _, _ in found], expected, atol=1e-3)
        environment.step(actions)
    gains = {joint.name: gain[1:] for joint, gain in zip(description.joints, found, strict=True)}
    assert gains == {name: description.parameters.gains(name) for name in description.joint_names}
    following = skill.Naosprint(agent)
    assert following.execute(True, orientation=0.0, after=made) is False
    np.testing.assert_array_equal(following.runner.action.shape, made.runner.action.shape)
    agent.world.global_position = np.array([0.0, 0.0, 0.2])
    assert made.execute(False) is True
    assert not made.is_ready()
    environment.close()


@pytest.mark.parametrize("name", ["sprint", "sprint-blind"])
def test_the_behavior_reads_and_commands_the_teams_robot(name: str, load: Callable[[str, str], Any]) -> None:
    """The same for a NAO, whose team code has frames, signs and an order of joints of its own."""
    module = load(name, "behaviors.custom.Naosprint.Naosprint")
    environment, policy = begin(name)
    onboard = "vision" in environment.simulator.perceptors
    perceptors, description = environment.simulator.perceptors, environment.world.robot
    names = list(description.joint_names)
    order = {name: number for number, name in enumerate(reversed(names))}
    turned = {"rlj2", "rlj6", "raj2", "laj3", "laj4"}
    sign = np.array([-1.0 if name in turned else 1.0 for name in names])
    robot = SimpleNamespace(type=0, MAP_PERCEPTOR_TO_INDEX=order, FIX_PERCEPTOR_SET=turned, frp={})
    world = SimpleNamespace(robot=robot)
    made = module.Naosprint(SimpleNamespace(world=world))

    def theirs(values: np.ndarray) -> np.ndarray:
        """Return vectors in the team's frame: x to the front, y to the left."""
        x, y, z = values.reshape(-1, 3).T
        return np.stack([y, -x, z], axis=1).ravel()

    for step in range(50):
        robot.imu_torso_orientation = np.degrees(environment.world.yaw(slice(0, 1))[0])
        robot.imu_weak_torso_position = environment.world.position(slice(0, 1))[0]
        if onboard:  # it has an estimate of its own
            robot.imu_torso_orientation += 90.0 * (step > 0)
            robot.imu_weak_torso_position = robot.imu_weak_torso_position - (0.3 if step else 0.0)
            seen = [tuple(polar) for polar in perceptors["vision"].reshape(-1, 3).tolist()]
            sighted = {at: polar for (_, at), polar in zip(LANDMARKS, seen, strict=True) if polar[0] == polar[0]}
            world.flags_posts = {at: polar for at, polar in sighted.items() if at[2]}
            world.flags_corners = {at: polar for at, polar in sighted.items() if not at[2]}
        robot.joints_position = (perceptors["joint_angles"][0] * sign)[::-1]
        robot.joints_target_speed = np.zeros(len(names))
        robot.gyro, robot.acc = theirs(perceptors["gyro"][0]), theirs(perceptors["accel"][0])
        feet = {"lf": perceptors["foot_left"][0], "rf": perceptors["foot_right"][0]}
        robot.frp = {name: theirs(foot) for name, foot in feet.items() if not np.isnan(foot).any()}
        assert step or made.is_ready()
        assert made.execute(step == 0, 0.0) is False
        actions = policy.act(environment.observations)
        angles, limits = perceptors["joint_angles"], made.runner.max_speed
        expected = motor_speeds(environment.actuation.targets(actions), angles, limits)[0]
        np.testing.assert_allclose(robot.joints_target_speed[::-1] * sign, expected, atol=1e-3)
        environment.step(actions)
    environment.close()
    robot.type = 4
    with pytest.raises(ValueError, match="the policy is for robot type 0"):
        made.execute(False)


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("t1-run", "mujococodebase.skills.naosprint.runner"),
        ("t1-run-blind", "mujococodebase.skills.naosprint.runner"),  # observes earlier steps, too
        ("t1-keeper", "mujococodebase.skills.naosprint.runner"),
        ("sprint-blind", "behaviors.custom.Naosprint.runner"),  # estimates its pose from step to step
    ],
)
def test_a_cycle_that_is_not_finite_keeps_the_targets(name: str, module: str, load: Callable[[str, str], Any]) -> None:
    """The next cycle acts again, also if the run begins with such a cycle."""
    runners = load(name, module)
    folder = Path(runners.__file__).parent
    vectors = np.load(folder / "parity.npz")
    inputs = [str(each) for each in vectors["inputs"]]
    runner = runners.Runner(folder / "policy.npz")

    def run(broken: int | None, lost: list[str]) -> np.ndarray:
        runner.begin(**{str(each): vectors[f"begin_{each}"] for each in vectors["begin"]})
        targets = []
        for cycle in range(30):
            perceived = {each: np.array(vectors[each][cycle]) for each in inputs}
            if cycle == broken:
                perceived |= {each: np.full_like(perceived[each], np.nan) for each in lost}
            targets.append(runner.act(runner.observe(**perceived)))
        return np.array(targets)

    usual, start = run(None, []), runner.start_pose_rad
    if "begin_action" in vectors:  # of the policy that walked so far
        start = np.clip(runner.middle_rad + runner.reach_rad @ vectors["begin_action"], runner.low_rad, runner.high_rad)
    for lost in (["gyro_deg"], inputs):
        late, early = run(10, lost), run(0, lost)
        np.testing.assert_array_equal(late[:10], usual[:10])
        np.testing.assert_array_equal(late[10], late[9])
        np.testing.assert_allclose(early[0], start, atol=1e-9)
        for after in (late[10:], early):
            assert (np.abs(np.diff(after, axis=0)).max(axis=1) > 0.0).all()
    if hasattr(runner, "speeds"):
        np.testing.assert_array_equal(runner.speeds(usual[0], np.full_like(usual[0], np.nan)), 0.0)
    if "vision" in inputs:  # which comes in every third cycle only
        perceived = {each: np.array(vectors[each][0]) for each in inputs}
        blind = [runner.observe(**perceived | {"vision": seen}) for seen in (None, np.full((8, 3), np.nan))]
        runner.begin()
        seeing_none = runner.observe(**perceived | {"vision": None})
        runner.begin()
        np.testing.assert_array_equal(seeing_none, runner.observe(**perceived | {"vision": np.full((8, 3), np.nan)}))
        assert np.isfinite(blind).all()


@pytest.mark.parametrize(
    ("name", "word", "values"),
    [("t1-run", "command", (0.5, 0.1, 0.0)), ("t1-dribble", "target", (0.3, 1.0)), ("t1-kick", "target", (0.3, 5.0))],
)
def test_a_command_that_is_not_a_number_is_ignored(
    name: str, word: str, values: tuple[float, ...], load: Callable[[str, str], Any]
) -> None:
    """It begins no new path or line, neither itself nor by the next, which is that before it; nor ends the agent."""
    runners = load(name, "mujococodebase.skills.naosprint.runner")
    folder = Path(runners.__file__).parent
    vectors = np.load(folder / "parity.npz")
    inputs = [str(each) for each in vectors["inputs"] if each != word]
    runner, nothing = runners.Runner(folder / "policy.npz"), (np.nan, *values[1:])

    def run(begin: dict[str, Any], broken: int | None) -> np.ndarray:
        runner.begin(**begin)
        targets = []
        for cycle in range(20):
            perceived = {each: np.array(vectors[each][cycle]) for each in inputs}
            targets.append(runner.act(runner.observe(**perceived, **{word: nothing if cycle == broken else values})))
        return np.array(targets)

    begin = {str(each): vectors[f"begin_{each}"] for each in vectors["begin"]}
    np.testing.assert_array_equal(run(begin, 10), run(begin, None))
    if word == "target":
        np.testing.assert_array_equal(run({**begin, "target": nothing}, None), run({**begin, "target": None}, None))


def test_a_robot_without_team_code_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("naosprint.export.skill.TARGETS", {})
    policy, manifest = load_policy(naopolicies.folder("sprint"))
    with pytest.raises(ValueError, match="format skill: no team code for robots of family nao"):
        write_skill(policy, manifest, tmp_path)
    assert not any(tmp_path.iterdir())


def test_a_skill_observes_as_many_earlier_steps_as_its_task(
    tmp_path: Path, numpy_alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also more than the bundled tasks offer."""

    class Settings(Sprint1.Parameters):  # type: ignore[misc, name-defined]
        history_steps: int = Field(default=15, ge=0, le=30, title="History", description="Earlier steps.")

    monkeypatch.setattr(Sprint1, "Parameters", Settings)
    files = write_skill(*random_policy({"name": "t1"}, "sprint1"), tmp_path)
    assert np.load(files[0].parent / "parity.npz")["observations"].shape[1] % 16 == 0
    assert check(files[0].parent, numpy_alone).returncode == 0


@pytest.mark.parametrize("robot", ["nao-0", "t1"])
def test_an_expression_of_another_package_is_exported_and_a_function_is_named(
    robot: str, tmp_path: Path, numpy_alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = Sprint1.observation_blocks

    def with_gait(task: Sprint1) -> list[ObservationBlock]:
        gait = sin(0.3 * task.world.step) * task.world.perceived("gyro")[0]
        return [*usual(task), ObservationBlock(("gait_sin",), gait if exportable else gait.__call__)]

    monkeypatch.setattr(Sprint1, "observation_blocks", with_gait)
    exportable = True
    files = write_skill(*random_policy({"name": robot}, "sprint1"), tmp_path / "skill")
    assert check(files[0].parent, numpy_alone).returncode == 0
    exportable = False
    with pytest.raises(ValueError, match=r"format skill: .* cannot compute observation gait_sin of task sprint1"):
        write_skill(*random_policy({"name": robot}, "sprint1"), tmp_path / "none")
    assert not (tmp_path / "none").exists()


LACKING = {
    "input": (
        lambda task: offered.blocks(task.world, ["accel"]),
        "accel_x, accel_y, accel_z of task sprint1: it has no 'perceptors.accel', only action, command, ",
    ),
    "given": (
        lambda task: offered.blocks(task.world, ["yaw"]),
        "observation yaw of task sprint1: it has no 'yaw', only action, ",
    ),
    "truth": (
        lambda task: offered.blocks(task.world, ["true_height"]),
        'observation true_height of task sprint1: it has no "the robot\'s true state", only action, ',
    ),
    "random numbers": (
        lambda task: [ObservationBlock(("drawn",), uniform(0, constant(0.0), task.world.step, 1))],
        "the observations of task sprint1: it has no 'uniform', only action, ",
    ),
    "another value": (
        lambda task: [ObservationBlock(("twice",), given("steps", 2.0 * task.world.step))],
        "observation twice of task sprint1: in cycle 2 it differs from the training's; use another format",
    ),
}
"""What a T1 observes besides, and what the error says."""


@pytest.mark.parametrize("what", LACKING)
def test_the_error_names_what_the_skill_lacks(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (added, words), usual = LACKING[what], Sprint1.observation_blocks
    monkeypatch.setattr(Sprint1, "observation_blocks", lambda task: [*usual(task), *added(task)])
    with pytest.raises(
        ValueError, match=r"use another format, or observe expressions .* of what the skill has"
    ) as seen:
        write_skill(*random_policy({"name": "t1"}, "sprint1"), tmp_path)
    assert words in str(seen.value) and not any(tmp_path.iterdir())


def test_a_robot_without_a_skill_before_it_enters_at_rest(
    tmp_path: Path, numpy_alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, rest = Sprint1.observation_blocks, given("entry_velocity", constant([0.0, 0.0, 0.0]))
    entered = ObservationBlock(("entry_x", "entry_y", "entry_z"), rest)
    monkeypatch.setattr(Sprint1, "observation_blocks", lambda task: [*usual(task), entered])
    files = write_skill(*random_policy({"name": "t1"}, "sprint1"), tmp_path)
    assert check(files[0].parent, numpy_alone).returncode == 0


def test_commands_of_a_task_are_those_that_the_skill_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Sprint1, "command", property(lambda task: np.zeros((task.n, 2))), raising=False)
    assert write_skill(*random_policy({"name": "t1"}, "sprint1"), tmp_path / "t1"), "something else of the same name"
    monkeypatch.setattr(Sprint1, "command", property(lambda task: np.zeros((task.n, 3))))
    with pytest.raises(ValueError, match="format skill: the team code's skill does not take command of task sprint1"):
        write_skill(*random_policy({"name": "nao-0"}, "sprint1"), tmp_path / "nao")


def test_a_walker_that_takes_over_faces_where_it_is_going(load: Callable[[str, str], Any]) -> None:
    """Its heading begins as the torso's, in any direction, and its velocity is that of the skill before it."""
    module = load("t1-run", "mujococodebase.skills.naosprint.runner")
    skill = module.Runner(Path(module.__file__).with_name("policy.npz"))
    joints, yaw = np.zeros(len(skill.joint_names)), 2.0
    upright = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
    skill.begin(action=np.full(len(skill.action_names), 0.1), position=np.array([1.0, 2.0, 0.66]))
    forward = 0.02 * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    names = [str(name) for name in skill.observation_names]
    for cycle in (1, 2):
        position = np.array([1.0, 2.0, 0.66]) + cycle * forward
        seen = skill.observe(position, upright, np.zeros(3), joints, joints, command=np.zeros(3))
        found = dict(zip(names, seen, strict=True))
        assert (found["heading_sin"], found["heading_cos"]) == pytest.approx((0.0, 1.0), abs=1e-9)
        assert (found["velocity_x"], found["velocity_y"]) == pytest.approx((1.0, 0.0), abs=1e-9)
        assert found["line_offset"] == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_array_equal(skill.position, position)
    assert found[f"action_{skill.action_names[0]}"] == pytest.approx(0.1)


def test_a_checkpoint_of_an_earlier_stage_is_exported_with_that_stages_settings(
    make_spec: Callable[..., TrainingSpec], recorder: Any, tmp_path: Path
) -> None:
    """A later stage limits accelerations, and its policies observe the velocity on the way to the command."""
    later = {"steps": 256, "task": {"forward_acceleration_mps2": 4.0}}
    spec = make_spec(robot="t1", task="velocity", stages=[{"steps": 256}, later])
    train(spec, workdir=tmp_path / "run", reporter=recorder)
    limited = []
    for step, _ in recorder.checkpoints:
        export_policy(step, tmp_path / step.name, ["skill"])
        (policy,) = (tmp_path / step.name).rglob("policy.npz")
        with np.load(policy) as arrays:
            texts = [str(array) for array in arrays.values() if array.dtype.kind == "U"]
        limited.append(any("task.reference" in text for text in texts))
    assert limited == sorted(limited) and set(limited) == {False, True}
