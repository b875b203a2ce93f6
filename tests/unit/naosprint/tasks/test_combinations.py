"""Incompatible robots, simulators and tasks are refused with a reason and a remedy."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pytest
from naosim import kinds, robots
from naosim.mujoco import world
from naosim.simulator import Scene
from naospec import TrainingSpec, plugins, specification, validation_words
from naospec.abilities import idle
from naospec.plugins import UnknownPluginError
from naosprint.rl.settings import PPOSettings
from naosprint.tasks.environment import open_environment
from naosprint.tasks.frozen import bundled
from pydantic import ValidationError
from pydantic.fields import FieldInfo

ROBOTS = "k1, nao-0, nao-1, nao-2, nao-3, nao-4, t1"

REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown robot": ({"robot": "t2"}, f"robot: unknown robot 't2': choose one of {ROBOTS}"),
    "an unknown simulator": (
        {"robot": "t1", "simulator": "mujoco"},
        "simulator: unknown simulator 'mujoco': choose one of embedded, server",
    ),
    "an unknown task": (
        {"robot": "t1", "task": "swim"},
        "task: unknown task 'swim': choose one of block, dribble, getup, kick, sprint1, sprint1-erect, sprint2, "
        "sprint2-erect, velocity",
    ),
    "a task that needs a perceived position": (
        {"robot": "nao-3", "task": "velocity"},
        "task: velocity is not possible with robot nao-3; use another task, or one of the robots k1, t1",
    ),
    "a task that needs lying robots": (
        {"robot": "nao-0", "task": "getup"},
        "task: getup is not possible with robot nao-0; use another task, or one of the robots k1, t1",
    ),
    "a setting of the embedded simulator on servers": (
        {"robot": "t1", "simulator": {"name": "server", "action_delay": 0}},
        "simulator.action_delay: server with robot t1 has no such setting: choose one of settle_steps",
    ),
    "a setting of another robot's simulator": (
        {"robot": "nao-0", "simulator": {"name": "embedded", "action_delay": 0}},
        "simulator.action_delay: embedded with robot nao-0 has no such setting: choose one of sensor_digits",
    ),
    "gains of a robot without gains": (
        {"robot": {"name": "nao-0", "kp": {"legs": 100}}},
        "robot.kp: nao-0 has no such setting: choose one of onboard_sensing, ground_velocity",
    ),
    "a player that observes its true velocity": (
        {"robot": {"name": "nao-0", "onboard_sensing": True, "ground_velocity": True}},
        "ground_velocity: a robot with onboard_sensing does not perceive it; set one of the two",
    ),
    "a ball for a robot that does not know its position": (
        {"robot": {"name": "t1", "onboard_sensing": True}, "task": "kick"},
        "robot: with these settings t1 does not know its position and cannot follow the ball's; use settings with "
        "which it does, such as onboard_sensing=false",
    ),
    "a joint that the robot lacks": (
        {"robot": {"name": "k1", "kp": {"waist": 60}}},
        "robot.kp: robot k1: there is no joint 'waist'; name a group (head, arms, legs), a kind of joint (head_yaw,",
    ),
    "a gain out of range": (
        {"robot": {"name": "t1", "kd": {"legs": -1}}},
        "robot.kd: robot t1: legs must be from 0 to 100, not -1",
    ),
    "a height that the robot does not reach": (
        {"robot": "k1", "task": {"name": "sprint1", "min_height_m": 0.6}},
        "task.min_height_m: 0.6 m is not below the standing height of robot k1, 0.552 m; use a smaller min_height_m",
    ),
    "pushes in a world that has none": (
        {"robot": "nao-0", "task": {"name": "sprint1", "push_mps": 0.5}},
        "task.push_mps: 0.5 needs pushes, which robot nao-0 with simulator embedded and task sprint1 lacks: leave it "
        "out, or use robot k1 or t1",
    ),
    "another friction on servers": (
        {"robot": "t1", "simulator": "server", "task": {"name": "sprint1", "friction_min": 0.5}},
        "task.friction_min: 0.5 needs other friction, which robot t1 with simulator server and task sprint1 lacks: "
        "leave it out, or use simulator embedded",
    ),
    "lying starts on servers": (
        {"robot": "t1", "simulator": "server", "task": "getup"},
        "task: getup needs lying starts, which robot t1 with simulator server and task getup lacks: use another task, "
        "or use simulator embedded",
    ),
    "imitation without a motion to imitate": (
        {"robot": "k1", "task": "velocity", "algorithm": {"imitation_steps": 1000}},
        "algorithm.imitation_steps: 1000 needs demonstrations, which robot k1 with simulator embedded and task "
        "velocity lacks: leave it out",
    ),
    "a stage with a robot that cannot do it": (
        {"robot": "t1", "stages": [{"steps": 1, "robot": "nao-1", "task": {"torque_penalty": 0.1}}]},
        "stages.0.task.torque_penalty: 0.1 needs motor torques, which robot nao-1",
    ),
    "a range of speeds the wrong way round": (
        {"robot": "t1", "task": {"name": "velocity", "forward_min_mps": 1.0, "forward_max_mps": 0.5}},
        "task: forward_min_mps: 1.0 is above forward_max_mps, 0.5; exchange them",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_specification_says_what_to_use_instead(what: str) -> None:
    content, message = REFUSED[what]
    with pytest.raises(ValidationError) as caught:
        TrainingSpec.model_validate(content)
    assert message in validation_words(caught.value.errors())


@pytest.mark.parametrize(("find", "unknown"), [(robots.get, "t2"), (kinds.get, "gazebo")])
def test_an_unknown_name_lists_the_known(find: Any, unknown: str) -> None:
    with pytest.raises(UnknownPluginError, match=f"{unknown}.*choose one of"):
        find(unknown)


def opened(n: int = 1, **content: Any) -> Any:
    return open_environment(TrainingSpec.model_validate(content), n, threads=1)


def other(name: str, info: FieldInfo, robot: str) -> Any:
    """Return a value of a setting between its default and one of its bounds; None for one that has none."""
    if name == "entry_policies":
        return tuple(bundled(robot, "velocity"))[:1]
    low, high = (
        next((getattr(part, end) for part in info.metadata for end in ends if hasattr(part, end)), None)
        for ends in (("ge", "gt"), ("le", "lt"))
    )
    end = high if name.endswith("_max") or low == info.default else low
    if isinstance(info.default, bool) or not isinstance(info.default, int | float) or end is None:
        return None
    return type(info.default)((info.default + end) / 2)


def runs(content: dict[str, Any]) -> bool:
    """Return whether a step of such a training can be taken, by taking it."""
    spec = TrainingSpec.model_validate(content)
    everyone = np.zeros(1, dtype=np.int64)
    with contextlib.ExitStack() as stack:
        try:
            environment = open_environment(spec, 1, threads=1)
            stack.callback(environment.close)
            environment.load_starts(environment.task.starts(1, 0, 0.0))
            environment.restart(everyone, everyone)
            environment.step(np.zeros((1, environment.actuation.n_actions)))
        except (ValueError, KeyError):
            return False
        return not spec.algorithm.imitation_steps or environment.task.demonstration(slice(0, 1)) is not None


@pytest.mark.parametrize("task", plugins.names(plugins.TASKS))
@pytest.mark.parametrize("robot", plugins.names(plugins.ROBOTS))
def test_what_is_accepted_runs_and_what_is_refused_would_not(
    monkeypatch: pytest.MonkeyPatch, robot: str, task: str
) -> None:
    if not plugins.load(plugins.TASKS, task).supports(robots.get(robot)):
        with pytest.raises(ValidationError, match="is not possible with robot"):
            TrainingSpec(robot=robot, task=task)
        return
    base = {"robot": robot, "simulator": "embedded", "task": {"name": task}, "algorithm": {"name": "ppo"}}
    usual, special = {}, []
    for section, model in (("task", plugins.load(plugins.TASKS, task).Parameters), ("algorithm", PPOSettings)):
        for name, info in model.model_fields.items():
            extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
            value = other(name, info, robot)
            if extra.get("needs"):
                assert value is not None, name
                special.append({**base, section: {**base[section], name: value}})
            elif section == "task" and value is not None and name != "version":
                usual[name] = value
    assert runs({**base, "task": {"name": task, **usual}}), "no setting without a need can be impossible"
    assert len(special) >= 8
    for content in special:
        try:
            TrainingSpec.model_validate(content)
            accepted = True
        except ValidationError as error:
            assert " needs " in str(error)
            accepted = False
        with monkeypatch.context() as patch:
            patch.setattr(specification, "lacking", lambda *sections: ())
            assert runs(content) is accepted, content


@pytest.mark.parametrize("task", plugins.names(plugins.TASKS))
def test_what_is_said_to_have_no_effect_has_none(task: str) -> None:
    robot = "t1" if plugins.load(plugins.TASKS, task).supports(robots.get("t1")) else "nao-0"
    base: dict[str, Any] = {"name": task, **({"handover_states": 8} if task in ("block", "dribble", "kick") else {})}
    model = plugins.load(plugins.TASKS, task).Parameters
    usual = TrainingSpec(robot=robot, task=base)
    settings = {name: other(name, model.model_fields[name], robot) for name, _ in idle(usual.task, model.model_fields)}
    settings |= {name: True for name in settings if model.model_fields[name].annotation is bool}
    said = {sentence.split(":")[0] for sentence in TrainingSpec(robot=robot, task=base | settings).without_effect()}
    assert said == {f"task.{name}" for name in settings}
    runs = []
    for content in (base, base | settings):
        with contextlib.closing(opened(2, robot=robot, task=content)) as environment:
            environment.load_starts(environment.task.starts(2, 0, environment.task.parameters.start_noise_deg))
            environment.restart(np.arange(2), np.arange(2))
            actions = np.random.default_rng(0).normal(0.0, 0.3, (20, 2, environment.actuation.n_actions))
            runs.append(np.array([np.column_stack([environment.step(each), environment.rewards]) for each in actions]))
    np.testing.assert_array_equal(*runs)


@pytest.fixture
def no_programs(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Return the environment of a machine with no server's program."""
    for name in ("NAOSPRINT_SIMSERVER", "NAOSPRINT_RCSSSERVERMJ"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", "/nowhere")
    return monkeypatch


def test_a_missing_server_is_named_with_what_to_install_or_set(no_programs: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        FileNotFoundError, match=r"NAOSPRINT_SIMSERVER: there is no program 'rcssserver3d'.*docker:IMAGE"
    ):
        opened(robot="nao-0", simulator="server")
    no_programs.setenv("NAOSPRINT_RCSSSERVERMJ", "/opt/rcssservermj")
    with pytest.raises(FileNotFoundError, match=r"NAOSPRINT_RCSSSERVERMJ: there is no program '/opt/rcssservermj'"):
        opened(robot="t1", simulator="server")


@pytest.mark.parametrize("simulator", ["embedded", "server"])
@pytest.mark.parametrize(("installed", "state"), [("3.4.0", "3.4.0 is installed"), (None, "it is not installed")])
def test_another_or_no_mujoco_is_named_with_the_command_that_installs_it(
    no_programs: pytest.MonkeyPatch, simulator: str, installed: str | None, state: str
) -> None:
    def version(package: str) -> str:
        if installed is None:
            raise world.metadata.PackageNotFoundError(package)
        return installed

    no_programs.setattr(world.metadata, "version", version)
    world.library.cache_clear()  # as in a process that has not imported it yet
    remedy = "run 'pip install mujoco==3.5.0 rcsssmj==0.2.1'"
    with pytest.raises(world.MujocoUnavailableError, match=rf"mujoco: version 3.5.0 is needed, {state}; {remedy}"):
        opened(robot="k1", simulator=simulator)


def test_more_servers_than_the_machine_runs_are_refused() -> None:
    with pytest.raises(ValueError, match=r"n_envs: 4096 robots need as many servers.*set n_envs to"):
        opened(4096, robot="t1", simulator="server")


def test_start_poses_that_do_not_stand_are_refused_with_gains_that_do() -> None:
    environment = opened(
        robot={"name": "t1", "kp": {"ankle_pitch": 10.0}}, simulator={"name": "embedded", "settle_steps": 200}
    )
    with pytest.raises(
        ValueError, match=r"t1 does not stand after 200 steps .* use stiffer ankles \(robot.kp.ankle_pitch"
    ):
        environment.load_starts(environment.task.starts(1, 0, 0.0))
    environment.close()


def test_a_task_with_a_ball_needs_a_simulator_that_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins.load(plugins.TASKS, "sprint1"), "scene", Scene(ball=True))
    for simulator in ("embedded", "server"):
        with pytest.raises(ValidationError, match=r"the worlds of nao-0 have no ball.*use a robot of rcssservermj"):
            TrainingSpec(task="sprint1", robot="nao-0", simulator=simulator)
