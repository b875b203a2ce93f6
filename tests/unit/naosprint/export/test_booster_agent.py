"""The example agent for T1 and K1 observes and does what the environment does."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import naopolicies
import numpy as np
import pytest
from naosim import robots
from naosim.robots import Robot
from naosim.simulator import Starts
from naospec import TrainingSpec
from naosprint.export import describe, export_policy, policy_arrays
from naosprint.rl.checkpoint import Manifest
from naosprint.rl.policy import NetworkPolicy
from naosprint.tasks.environment import Environment, open_environment

AGENT = Path(__file__).parents[4] / "packages/naosprint/examples/run_policy_t1.py"
BOTH = pytest.mark.parametrize("robot", ["t1", "k1"])


def load_agent() -> ModuleType:
    """Return the example agent as a module."""
    spec = importlib.util.spec_from_file_location("run_policy_t1", AGENT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def untrained(spec: TrainingSpec, environment: Environment, seed: int = 0) -> tuple[NetworkPolicy, Manifest]:
    """Return a policy of random weights, some of whose actions are beyond the limits, and its manifest."""
    rng = np.random.default_rng(seed)
    names, actions = environment.observer.names, environment.actuation.names
    sizes = (len(names), 16, len(actions))
    layers = tuple(
        (rng.normal(0.0, 0.3, (after, before)).astype(np.float32), rng.normal(0.0, 0.3, after).astype(np.float32))
        for before, after in pairwise(sizes)
    )
    mean, scale = rng.normal(0.0, 0.1, len(names)), rng.uniform(0.5, 2.0, len(names))
    manifest = Manifest.model_construct(
        spec=spec, spec_sha256=spec.digest(), stage=0, steps=0, observations=names, actions=actions
    )
    return NetworkPolicy(mean, scale, 10.0, layers, np.zeros(len(actions), np.float32)), manifest


def message(environment: Environment, row: int) -> str:
    """Write what a robot perceives as the server does."""
    perceptors, robot = environment.simulator.perceptors, environment.world.robot

    def numbers(name: str) -> str:
        return " ".join(str(float(value)) for value in perceptors[name][row])

    parts = [
        "(time (now 1.02))(GS (t 0.0)(pm BeforeKickOff)(tl naosprint)(tr <Right>)(sl 0)(sr 0))",
        f"(quat (n torso_quat) (q {numbers('torso_quat')}))(pos (n torso_pos) (p {numbers('torso_pos')}))",
        f"(GYR (n torso_gyro) (rt {numbers('gyro')}))(ACC (n torso_acc) (a {numbers('accel')}))",
    ]
    for joint, angle, speed in zip(
        robot.joints, perceptors["joint_angles"][row], perceptors["joint_speeds"][row], strict=True
    ):
        parts.append(f"(HJ (n q_{joint.effector.replace('e', 'j')})(ax {float(angle)})(vx {float(speed)}))")
    return "".join(parts) + "(See (B (pol 14.2 3.1 -0.2))(P (team other)(id 3)(head (pol 4.0 1.0 2.0))))"


@BOTH
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["left", "right"])
def test_the_agent_observes_and_does_what_the_environment_does(robot: str, side: float, tmp_path: Path) -> None:
    """Step by step; on the right side from the opposite place, where the robot perceives the field turned round."""
    spec = TrainingSpec.model_validate({"robot": robot, "task": "sprint1"})
    environment = open_environment(spec, 1, threads=1)
    policy, manifest = untrained(spec, environment)
    np.savez(tmp_path / "policy.npz", **policy_arrays(policy, manifest))
    runner: Any = load_agent().PolicyAgent(tmp_path / "policy.npz", 3.0, side)
    pose = environment.world.robot.nominal[None]
    heading = 0.0 if side > 0.0 else np.pi
    # beyond the finish line on the right side
    environment.simulator.load_starts(Starts(pose, (-14.0 * side, 3.0 * side), heading))
    environment.restart(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64))
    # a robot that does the same in the training's simulator
    trained = open_environment(spec, 1, threads=1)
    trained.load_starts(Starts(pose, trained.task.start_position()))
    trained.restart(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64))
    runner.perceive(message(environment, 0))
    runner.begin()
    names = np.array(manifest.observations)
    # a number may be truncated to the next digit, and one of a velocity then differs by 1 mm in a step of 20 ms
    tolerance = np.where(np.char.startswith(names, "velocity_"), 0.11, 2.1e-3)
    for step in range(25):
        seen = runner.observe()
        exact = environment.observations[0]
        expected = trained.observations[0]
        assert (np.abs(seen - expected) < tolerance).all(), (step, names[np.abs(seen - expected) >= tolerance])
        if side > 0.0:
            np.testing.assert_allclose(np.delete(seen, -1), np.delete(exact, -1), atol=1e-9)
        actions = policy.act(expected[None])
        np.testing.assert_allclose(runner.act(expected), trained.actuation.targets(actions)[0], atol=1e-5)
        np.testing.assert_allclose(runner.action, actions[0], atol=1e-5)
        runner.action = actions[0]
        environment.step(actions)
        trained.step(actions)
        runner.perceive(message(environment, 0))
    assert np.abs(actions).max() == 1.0
    environment.close()
    trained.close()


@BOTH
def test_a_command_is_for_every_joint(robot: str, tmp_path: Path) -> None:
    """In the server's order and units, with the robot's gains."""
    spec = TrainingSpec.model_validate({"robot": {"name": robot, "kp": {"left_knee_pitch": 77.5}}})
    environment = open_environment(spec, 1, threads=1)
    policy, manifest = untrained(spec, environment)
    environment.close()
    np.savez(tmp_path / "policy.npz", **policy_arrays(policy, manifest))
    runner: Any = load_agent().PolicyAgent(tmp_path / "policy.npz")
    description: Robot = robots.get(robot)
    nodes = [node.split() for node in runner.command(runner.start_pose_rad)[1:-1].split(")(")]
    assert [node[0] for node in nodes] == [joint.effector for joint in description.joints]
    np.testing.assert_allclose([float(node[1]) for node in nodes], np.degrees(description.nominal), atol=1e-4)
    knee = next(node for node in nodes if node[0] == "lle4")
    assert [float(word) for word in knee[2:]] == [0.0, 77.5, description.parameters.gains("left_knee_pitch")[1], 0.0]
    controller = describe(policy, manifest)["controller"]
    assert controller["kp_nm_per_rad"]["left_knee_pitch"] == 77.5
    assert list(controller["kd_nms_per_rad"]) == list(description.joint_names)


def test_earlier_steps_are_what_the_agent_observed_then(tmp_path: Path) -> None:
    """And those before an episode are like its first, as in the environment."""
    spec = TrainingSpec.model_validate({"robot": "t1", "task": {"name": "sprint1", "history_steps": 2}})
    environment = open_environment(spec, 1, threads=1)
    policy, manifest = untrained(spec, environment)
    np.savez(tmp_path / "policy.npz", **policy_arrays(policy, manifest))
    runner: Any = load_agent().PolicyAgent(tmp_path / "policy.npz")
    runner.perceive(message(environment, 0))
    runner.begin()
    steps = []
    for _ in range(4):
        present, *past = np.split(runner.observe(), 3)
        steps.append(present)
        for ago, seen in enumerate(past, start=1):
            np.testing.assert_array_equal(seen, steps[max(len(steps) - 1 - ago, 0)])
        environment.step(policy.act(environment.observations))
        runner.perceive(message(environment, 0))
    assert not np.array_equal(steps[0], steps[1])
    environment.close()


def test_the_agent_is_short_and_needs_numpy_alone() -> None:
    """No module of the project, and only NumPy besides the standard library."""
    assert len(AGENT.read_text(encoding="utf-8").splitlines()) < 160
    program = (
        "import sys, runpy\n"
        f"runpy.run_path({str(AGENT)!r}, run_name='agent')\n"
        "roots = {name.partition('.')[0] for name in sys.modules}\n"
        "assert not roots & {'naosim', 'naosprint', 'naospec', 'torch', 'mujoco', 'rcsssmj'}, roots\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize(
    ("program", "policy", "words"),
    [
        ("run_policy.py", "t1-sprint", "not the policy.npz of a NAO"),
        ("run_policy.py", "sprint-blind", "observes what the robot senses"),
        ("run_policy_t1.py", "sprint", "not the policy.npz of a T1 or K1"),
        ("play_t1.py", "t1-sprint", "follows no commands"),
    ],
)
def test_a_policy_that_a_program_cannot_run_is_refused(program: str, policy: str, words: str, tmp_path: Path) -> None:
    """With one line, before it connects to a server; a file of another kind, too."""
    export_policy(naopolicies.folder(policy), tmp_path, ["numpy"])
    for file, line in (("policy.npz", words), ("policy.json", "not the policy.npz of a")):
        command = [sys.executable, str(AGENT.with_name(program)), str(tmp_path / file)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert done.stderr.startswith("no run: ") and line in done.stderr and done.stderr.count("\n") == 1


def test_a_policy_that_observes_more_is_refused(tmp_path: Path) -> None:
    """Before the robot moves, not by a KeyError in its first step."""
    export_policy(naopolicies.folder("t1-run"), tmp_path, ["numpy"])
    agent = load_agent()
    runner = agent.PolicyAgent(tmp_path / "policy.npz")
    runner.rotation, runner.gyro, runner.joints = np.eye(3), np.zeros(3), np.zeros((2, len(runner.joint_names)))
    runner.begin()
    with pytest.raises(SystemExit, match="observes command_forward, command_sideways, command_turn, which this"):
        agent.require_seen(runner)
