"""An exported policy is the policy."""

from __future__ import annotations

import importlib.util
import itertools
import json
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import onnxruntime  # type: ignore[import-untyped]
import pytest
import torch
from naosim import robots
from naosim.robots import nao_model
from naosim.robots.actuation import Actuation
from naosim.simspark import centre_of_mass
from naosim.simspark.control import motor_speeds
from naospec import TrainingSpec
from naosprint import train
from naosprint.export import build_check, build_header, build_onnx, describe, export_policy, policy_arrays
from naosprint.export.header import exact_actions
from naosprint.export.nao import kinematics
from naosprint.rl.checkpoint import CheckpointError, Manifest
from naosprint.rl.policy import NetworkPolicy, load_policy
from naosprint.rl.reporter import NullReporter
from naosprint.tasks.environment import open_environment

if TYPE_CHECKING:
    from collections.abc import Callable

    from naosprint.tasks.environment import Environment

AGENT = Path(__file__).parents[4] / "packages/naosprint/examples/run_policy.py"


@pytest.fixture(scope="module")
def exported(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the exported files."""
    return export_policy(checkpoint, tmp_path_factory.mktemp("export"))[0].parent


@pytest.fixture(scope="module")
def agent() -> ModuleType:
    """Return the example agent as a module."""
    spec = importlib.util.spec_from_file_location("run_policy", AGENT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def raw_observations(checkpoint: Path, count: int = 200) -> np.ndarray:
    """Return observations spread as widely as the policy has seen them, and some beyond."""
    policy, _ = load_policy(checkpoint)
    rng = np.random.default_rng(0)
    spread = 4.0 * rng.standard_normal((count, len(policy.mean)))
    return np.asarray(policy.mean + spread / np.minimum(policy.scale, 1e3))


def test_onnx_gives_the_actions_of_torch(checkpoint: Path, exported: Path) -> None:
    """The ONNX runtime, the NumPy policy and torch agree."""
    observations = raw_observations(checkpoint)
    session = onnxruntime.InferenceSession(exported / "policy.onnx", providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"observations": observations.astype(np.float32)})
    policy, _ = load_policy(checkpoint)
    hidden = torch.from_numpy(policy.standardize(observations))
    for i, (weights, bias) in enumerate(policy.layers):
        hidden = torch.nn.functional.linear(hidden, torch.from_numpy(weights), torch.from_numpy(bias))
        hidden = torch.tanh(hidden) if i < len(policy.layers) - 1 else hidden.clamp(-1.0, 1.0)
    np.testing.assert_allclose(found, hidden.numpy(), atol=2e-5)
    np.testing.assert_allclose(found, policy.act(observations), atol=2e-5)
    assert found.std() > 1e-3


@pytest.mark.parametrize("example", ["run_policy.py", "run_policy_t1.py"])
def test_the_example_agents_act_with_the_functions_of_the_policys_layers(
    example: str, checkpoint: Path, exported: Path, tmp_path: Path
) -> None:
    arrays = dict(np.load(exported / "policy.npz"))
    policy, _ = load_policy(checkpoint)
    rectified = replace(policy, activation="relu")
    np.savez(tmp_path / "policy.npz", **arrays | {"activations": np.array(rectified.activations)})
    runner = runpy.run_path(str(AGENT.with_name(example)))["PolicyAgent"](tmp_path / "policy.npz")
    for observation in raw_observations(checkpoint, 20):
        targets = runner.middle_rad + runner.reach_rad @ exact_actions(rectified, observation)
        np.testing.assert_allclose(
            runner.act(observation), np.clip(targets, runner.low_rad, runner.high_rad), atol=1e-6
        )


def test_what_cannot_be_written_here_is_left_out_unless_it_is_requested(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Without the package onnx, or the simulator that records a skill's values."""

    def missing(*arguments: object) -> list[Path]:
        raise FileNotFoundError("no simulator here")

    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.setattr("naosprint.export.write_skill", missing)
    written = export_policy(checkpoint, tmp_path, name="kick")
    assert [path.name for path in written] == ["kick.npz", "kick.json", "kick.h", "kick_check.c"]
    assert caplog.messages == [
        "format onnx is left out: kick.onnx needs onnx: pip install naosprint[export]",
        "format skill is left out: no simulator here",
    ]
    with pytest.raises(OSError, match=r"policy\.onnx needs onnx: pip install naosprint\[export\]"):
        export_policy(checkpoint, tmp_path, ["onnx"])
    with pytest.raises(FileNotFoundError, match="no simulator here"):
        export_policy(checkpoint, tmp_path, ["skill"])


def test_onnx_file_is_small_and_well_formed(exported: Path) -> None:
    """Names, shapes and an operator set that old runtimes support."""
    model = onnx.load(exported / "policy.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert [entry.name for entry in model.graph.input] == ["observations"]
    assert [entry.name for entry in model.graph.output] == ["actions"]
    assert model.opset_import[0].version <= 17


def test_description_names_what_goes_in_and_out(checkpoint: Path, exported: Path) -> None:
    """In the network's order, with the joints' ranges."""
    document = json.loads((exported / "policy.json").read_text())
    _, manifest = load_policy(checkpoint)
    assert tuple(document["observations"]) == manifest.observations
    assert [action["joint"] for action in document["actions"]] == list(manifest.actions)
    knee = next(action for action in document["actions"] if action["joint"] == "llj4")
    assert (knee["minus_one_deg"], knee["plus_one_deg"], knee["sign"]) == (-1.0, 130.0, -1.0)
    assert knee["zero_deg"] == 64.5
    assert document["controller"] == {"gain_per_s": 7.0, "cycle_s": 0.02}


@pytest.mark.parametrize("robot", robots.names())
def test_exported_tables_are_the_robots_actuation(robot: str) -> None:
    """For every robot, ``clip(middle + reach @ action, low, high)`` is what the environment drives the joints to."""
    spec = TrainingSpec.model_validate({"robot": robot, "task": {"name": "sprint1"}})
    actuation = Actuation(robots.get(robot))
    names = tuple(f"o{i}" for i in range(3))
    manifest = Manifest.model_construct(
        spec=spec, spec_sha256=spec.digest(), stage=0, steps=0, observations=names, actions=actuation.names
    )
    layers = ((np.zeros((actuation.n_actions, 3), np.float32), np.zeros(actuation.n_actions, np.float32)),)
    policy = NetworkPolicy(np.zeros(3), np.ones(3), np.inf, layers, np.zeros(actuation.n_actions, np.float32))
    arrays = policy_arrays(policy, manifest)
    rng = np.random.default_rng(0)
    for action in rng.uniform(-1.5, 1.5, (20, actuation.n_actions)):
        wanted = arrays["middle_rad"] + arrays["reach_rad"] @ np.clip(action, -1, 1)
        found = np.clip(wanted, arrays["low_rad"], arrays["high_rad"])
        np.testing.assert_allclose(found, actuation.targets(action[None])[0], atol=1e-12)
        seen = arrays["joint_view"] @ found
        np.testing.assert_allclose(seen, actuation.angles(np.rad2deg(found)[None])[0], atol=1e-12)
    document = describe(policy, manifest)
    nominal = dict(zip(actuation.names, np.rad2deg(actuation.nominal), strict=True))
    for entry in document["actions"]:
        assert entry["minus_one_deg"] <= entry["zero_deg"] <= entry["plus_one_deg"]
        if robots.get(robot).action_range_rad is not None:
            assert entry["zero_deg"] == pytest.approx(nominal[entry["joint"]], abs=1e-5)
    json.dumps(document, allow_nan=False)


@pytest.mark.parametrize("robot", ["nao-0", "t1"])
def test_header_computes_what_the_checkpoint_does(robot: str, tmp_path: Path) -> None:
    """Compiled with all warnings as errors; actions and joint targets to 1e-6.

    An observation that is not finite leaves them as they are.
    """
    policy, manifest = random_policy(robot)
    rng = np.random.default_rng(1)
    (tmp_path / "policy.h").write_text(build_header(policy, manifest))
    (tmp_path / "policy_check.c").write_text(build_check(policy))
    observations = policy.mean + rng.standard_normal((20, len(policy.mean))) / policy.scale
    broken = observations.repeat(2, axis=0)
    broken[1::2][[0, 1], [3, 29]] = np.nan, -np.inf
    (tmp_path / "run.c").write_text(RUN)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    for name in ("policy_check", "run"):
        subprocess.run(["cc", *flags, f"{name}.c", "-o", name, "-lm"], cwd=tmp_path, check=True)
    checked = subprocess.run([tmp_path / "policy_check"], capture_output=True, text=True, check=True).stdout
    assert checked.startswith("64 vectors, largest difference ")
    values = " ".join(repr(float(value)) for value in broken.ravel())
    printed = subprocess.run([tmp_path / "run"], input=values, capture_output=True, text=True, check=True).stdout
    returned, *found = np.array([line.split() for line in printed.splitlines()], dtype=np.float64).T
    np.testing.assert_array_equal(returned, np.isfinite(broken).all(axis=1))
    found = np.transpose(found)
    np.testing.assert_array_equal(found[1::2], found[::2])
    found = found[::2]
    actuation = Actuation(robots.get(robot))
    expected = exact_actions(policy, observations)
    np.testing.assert_allclose(found[:, : expected.shape[1]], expected, atol=1e-6)
    np.testing.assert_allclose(found[:, expected.shape[1] :], actuation.targets(expected), atol=1e-6)
    np.testing.assert_allclose(policy.act(observations), expected, atol=2e-5)
    assert expected.std() > 0.1


def test_exports_of_double_weights_are_those_of_the_policy_that_was_evaluated() -> None:
    """Policies act in single precision, whatever type the arrays of an algorithm have."""
    policy, manifest = random_policy("nao-0")
    layers = tuple((weights.astype(np.float64), bias.astype(np.float64)) for weights, bias in policy.layers)
    double = replace(policy, layers=layers)
    assert build_header(double, manifest) == build_header(policy, manifest)
    assert build_onnx(double).SerializeToString() == build_onnx(policy).SerializeToString()
    np.testing.assert_array_equal(double.act(policy.mean[None]), policy.act(policy.mean[None]))
    for field, message in (
        ({"layers": ((layers[0][0] * 1e39, layers[0][1]), *layers[1:])}, "weights of layer 0: .* finite in float32"),
        ({"scale": np.append(policy.scale[1:], np.inf)}, "scale: expected numbers that are finite in float64"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(policy, **field)


def test_two_policies_in_one_source_file_are_an_error(tmp_path: Path) -> None:
    """The second would be skipped silently; the same one twice is fine, as is each in a file of its own."""
    policy, manifest = random_policy("nao-0")
    other = replace(policy, mean=policy.mean + 1.0)
    for name, each in (("first.h", policy), ("second.h", other)):
        (tmp_path / name).write_text(build_header(each, manifest), encoding="utf-8")
    (tmp_path / "main.c").write_text("int main(void) { return 0; }\n", encoding="utf-8")

    def compiles(*headers: str) -> bool:
        (tmp_path / "both.c").write_text("".join(f'#include "{name}"\n' for name in headers), encoding="utf-8")
        done = subprocess.run(["cc", "-c", "both.c"], cwd=tmp_path, capture_output=True, text=True, check=False)
        return done.returncode == 0 or "Another policy.h is included" not in done.stderr

    assert compiles("first.h", "first.h")
    assert compiles("second.h")
    assert not compiles("first.h", "second.h")
    assert not compiles("second.h", "first.h")


def test_check_of_the_header_fails_for_another_policy(tmp_path: Path) -> None:
    """A weight that differs in the fourth digit is found."""
    policy, manifest = random_policy("nao-0")
    weights, bias = policy.layers[0]
    other = replace(policy, layers=((weights * np.float32(1.0001), bias), *policy.layers[1:]))
    (tmp_path / "policy.h").write_text(build_header(other, manifest))
    (tmp_path / "policy_check.c").write_text(build_check(policy))
    subprocess.run(["cc", "-std=c99", "policy_check.c", "-o", "check", "-lm"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "check"], capture_output=True, check=False).returncode == 1


HOSTILE = (
    'x"};\nstatic int evil = 1;\nstatic const char *const y[] = {"',
    "??/",  # a trigraph for a backslash: the string would not end
    "a\\",
    "*/ static int evil = 1; /*",
    "x\n#include </etc/passwd>",
    "\u2028\udcff",
)


def test_names_stay_text_in_the_header(tmp_path: Path) -> None:
    """Even those that no checkpoint can have: a quote, a trigraph, the end of a comment, a line."""
    policy, manifest = random_policy("nao-0")
    names = (*HOSTILE, *manifest.observations[len(HOSTILE) :])
    header = build_header(policy, manifest.model_copy(update={"observations": names}))
    (tmp_path / "policy.h").write_text(header)
    (tmp_path / "names.c").write_text(NAMES)
    flags = ["-std=c99", "-trigraphs", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wno-unused-function"]
    subprocess.run(["cc", *flags, "names.c", "-o", "names", "-lm"], cwd=tmp_path, check=True)
    printed = subprocess.run([tmp_path / "names"], capture_output=True, check=True).stdout
    assert printed.split(b"\0")[:-1] == [name.encode("utf-8", "surrogatepass") for name in names]


@pytest.mark.parametrize("name", HOSTILE)
def test_checkpoint_with_a_name_that_is_code_is_refused(name: str, checkpoint: Path, tmp_path: Path) -> None:
    """Nothing of it reaches a generated file."""
    copy = Path(shutil.copytree(checkpoint, tmp_path / "copy"))
    manifest = json.loads((copy / "checkpoint.json").read_text())
    for field in ("observations", "actions"):
        (copy / "checkpoint.json").write_text(json.dumps({**manifest, field: [name, *manifest[field][1:]]}))
        with pytest.raises(CheckpointError, match=f"{field}.0"):
            export_policy(copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_actions_are_joints_of_the_robot(checkpoint: Path, tmp_path: Path) -> None:
    """Other plain names do not pass for the robot's."""
    copy = Path(shutil.copytree(checkpoint, tmp_path / "copy"))
    manifest = json.loads((copy / "checkpoint.json").read_text())
    (copy / "checkpoint.json").write_text(json.dumps({**manifest, "actions": manifest["actions"][::-1]}))
    with pytest.raises(CheckpointError, match="actions: not the joints of robot nao-0"):
        export_policy(copy, tmp_path / "out")


NAMES = """
#include <stdio.h>
#include "policy.h"

int main(void)
{
    int i;
    (void)policy_action_names;
    (void)policy_joint_names;
    for (i = 0; i < POLICY_OBSERVATIONS; i++)
        printf("%s%c", policy_observation_names[i], 0);
    return 0;
}
"""

RUN = """
#include <stdio.h>
#include "policy.h"

int main(void)
{
    double observations[POLICY_OBSERVATIONS], actions[POLICY_ACTIONS] = {0.0}, targets[POLICY_JOINTS];
    int i;
    for (;;) {
        for (i = 0; i < POLICY_OBSERVATIONS; i++)
            if (scanf("%lf", observations + i) != 1)
                return 0;
        printf("%d ", policy_act(observations, actions));
        policy_targets(actions, targets);
        for (i = 0; i < POLICY_ACTIONS; i++)
            printf("%.17g ", actions[i]);
        for (i = 0; i < POLICY_JOINTS; i++)
            printf("%.17g ", targets[i]);
        printf("\\n");
    }
}
"""


def random_policy(robot: str) -> tuple[NetworkPolicy, Manifest]:
    """Return a policy with random weights, two hidden layers and standardized observations."""
    spec = TrainingSpec.model_validate({"robot": robot, "task": {"name": "sprint1"}})
    actuation = Actuation(robots.get(robot))
    names = tuple(f"o{i}" for i in range(30))
    manifest = Manifest.model_construct(
        spec=spec, spec_sha256=spec.digest(), stage=0, steps=0, observations=names, actions=actuation.names
    )
    rng = np.random.default_rng(0)
    sizes = (len(names), 64, 48, actuation.n_actions)
    layers = tuple(
        ((rng.standard_normal((b, a)) / np.sqrt(a)).astype(np.float32), rng.standard_normal(b).astype(np.float32) / 4)
        for a, b in itertools.pairwise(sizes)
    )
    mean, scale = rng.standard_normal(len(names)), np.exp(rng.standard_normal(len(names)))
    return NetworkPolicy(mean, scale, 5.0, layers, np.zeros(actuation.n_actions, np.float32)), manifest


def test_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    """Nothing is written in case of an error."""
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        export_policy(tmp_path / "nothing", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def _message(environment: Environment) -> str:
    """Write what the robot perceives as a server does, with two decimals."""
    perceptors, robot = environment.simulator.perceptors, environment.world.robot

    def numbers(values: np.ndarray) -> str:
        return " ".join(f"{value:.2f}" for value in values)

    gyro, accel = numbers(perceptors["gyro"][0]), numbers(perceptors["accel"][0])
    parts = ["(time (now 1.00))(GS (t 0.00)(pm PlayOn))", f"(GYR (n torso) (rt {gyro}))(ACC (n torso) (a {accel}))"]
    parts += [
        f"(HJ (n {name}) (ax {angle:.2f}))"
        for name, angle in zip(robot.joint_names, perceptors["joint_angles"][0], strict=True)
    ]
    for name, foot in (("rf", perceptors["foot_right"][0]), ("lf", perceptors["foot_left"][0])):
        if not np.isnan(foot).any():
            parts.append(f"(FRP (n {name}) (c {numbers(foot[:3])}) (f {numbers(foot[3:])}))")
    return "".join(parts)


@pytest.mark.parametrize(
    "settings", [{}, {"ground_velocity": True}, {"history_steps": 2}], ids=["", "velocity", "past"]
)
def test_example_agent_sees_and_does_what_the_environment_does(
    checkpoint: Path,
    exported: Path,
    agent: ModuleType,
    make_spec: Callable[..., TrainingSpec],
    tmp_path: Path,
    settings: dict[str, Any],
) -> None:
    """From a server's messages it computes the same observations and joint speeds, step by step through a whole run."""
    if settings:
        spec = make_spec(**settings, total_steps=256)
        checkpoint = train(spec, workdir=tmp_path, reporter=NullReporter()).checkpoint
        exported = export_policy(checkpoint, tmp_path / "export", ["numpy"])[0].parent
    policy, manifest = load_policy(checkpoint)
    environment = open_environment(manifest.spec, 1, threads=1)
    environment.load_starts(environment.task.starts(1, 0, 2.0))
    environment.restart(np.arange(1), np.zeros(1, dtype=np.int64))
    actuation = environment.actuation
    runner: Any = agent.PolicyAgent(exported / "policy.npz")
    rng = np.random.default_rng(1)
    for step in range(400):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = (
            environment.simulator.truth.torso_rotation[0],
            environment.simulator.truth.torso_position[0],
        )
        seen = runner.observe(_message(environment), pose)
        np.testing.assert_allclose(seen, environment.observations[0], atol=1e-6, err_msg=f"step {step}")
        actions = policy.act(environment.observations)
        targets = runner.act(seen)
        np.testing.assert_allclose(targets, actuation.targets(actions)[0], atol=1e-5)
        speeds = dict(part.split() for part in runner.command(targets).replace("(syn)", "")[1:-1].split(")("))
        angles, limits = environment.simulator.perceptors["joint_angles"], runner.max_speed
        expected = motor_speeds(actuation.targets(actions), angles, limits)[0]
        ours = [float(speeds[joint.effector]) for joint in environment.world.robot.joints]
        np.testing.assert_allclose(ours, expected, atol=2e-4)
        # some noise, so that it falls and both feet leave the ground
        environment.step(actions + 0.3 * rng.standard_normal(actions.shape))
        if environment.terminated[0]:
            break
    assert step > 20


@pytest.mark.parametrize("robot_type", range(5))
def test_exported_kinematics_give_the_centre_of_mass(robot_type: int, exported: Path, agent: ModuleType) -> None:
    """For every robot type the example's forward kinematics are the engine's."""
    model = nao_model.model(robot_type)
    runner: Any = agent.PolicyAgent(exported / "policy.npz")
    vars(runner).update(kinematics(model))
    rng = np.random.default_rng(robot_type)
    for angles in rng.uniform(model.low_deg, model.high_deg, (5, len(model.joints))):
        runner.angles = angles
        np.testing.assert_allclose(runner.centre_of_mass(), centre_of_mass(robot_type, angles[None])[0], atol=1e-5)


def test_example_agent_reads_the_torso_from_a_scene_graph(agent: ModuleType) -> None:
    """Matrices come column after column; the mesh has one of its own, which does not count."""
    scene = (
        "((time 0))(RSG 0 1)((nd TRF (SLT 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1)"
        "(nd TRF (SLT 0 -1 0 0 1 0 0 0 0 0 1 0 -13.9 0.1 0.36 1)"
        "(nd TRF (SLT -1 0 0 0 0 0 1 0 0 1 0 0 0 0 0 1)(nd StaticMesh (setVisible 1) (load models/naobody.obj) "
        "(sSc 0.1 0.1 0.1)(resetMaterials matNum1 matLeft naoblack naowhite))))))"
    )
    pose = agent.torso_pose(scene)
    np.testing.assert_allclose(pose[:3, 3], [-13.9, 0.1, 0.36])
    # the front, its second column, faces +x
    np.testing.assert_allclose(pose[:3, 1], [1, 0, 0])
    assert agent.torso_pose("((time 0.02))(RDS 0 1)((nd)(nd (SLT 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1)))") is None


def test_example_agent_needs_numpy_alone() -> None:
    """No module of the project, and only NumPy besides the standard library."""
    program = (
        "import sys, runpy\n"
        f"runpy.run_path({str(AGENT)!r}, run_name='agent')\n"
        "roots = {name.partition('.')[0] for name in sys.modules}\n"
        "assert not roots & {'naosim', 'naosprint', 'naospec', 'torch', 'onnx'}, roots\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


TWO = """
#include <stdio.h>
#include "run_fast.h"
#include "kick.h"
int main(void)
{
    double seen[RUN_FAST_OBSERVATIONS] = {0}, other[KICK_OBSERVATIONS] = {0};
    double first[RUN_FAST_ACTIONS], second[KICK_ACTIONS], targets[KICK_JOINTS];
    int i;
    run_fast_act(seen, first);
    kick_act(other, second);
    kick_targets(second, targets);
    for (i = 0; i < RUN_FAST_ACTIONS; i++) printf("%.17g ", first[i]);
    for (i = 0; i < KICK_ACTIONS; i++) printf("%.17g ", second[i]);
    return targets[0] < -9.0;
}
"""


def test_two_policies_of_different_names_in_one_program(checkpoint: Path, tmp_path: Path) -> None:
    """Of two robots; each file has its name, and each header has a check of its own."""
    expected = []
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    for name, robot in (("run_fast", "nao-0"), ("kick", "t1")):
        policy, manifest = random_policy(robot)
        (tmp_path / f"{name}.h").write_text(build_header(policy, manifest, name), encoding="utf-8")
        (tmp_path / f"{name}_check.c").write_text(build_check(policy, name), encoding="utf-8")
        subprocess.run(["cc", *flags, f"{name}_check.c", "-o", name, "-lm"], cwd=tmp_path, check=True)
        subprocess.run([tmp_path / name], check=True, capture_output=True)
        expected.append(exact_actions(policy, np.zeros((1, len(policy.mean))))[0])
    (tmp_path / "two.c").write_text(TWO, encoding="utf-8")
    subprocess.run(["cc", *flags, "-Wno-unused-function", "two.c", "-o", "two", "-lm"], cwd=tmp_path, check=True)
    printed = subprocess.run([tmp_path / "two"], capture_output=True, text=True, check=True).stdout
    np.testing.assert_allclose(np.array(printed.split(), dtype=np.float64), np.concatenate(expected), atol=1e-6)

    written = {path.name for path in export_policy(checkpoint, tmp_path / "out", ["c", "numpy"], "kick")}
    assert written == {"kick.h", "kick_check.c", "kick.npz", "kick.json"}


@pytest.mark.parametrize("name", ["", "Kick", "2x", "a-b", "a b", "../a", "ä", "a" * 41, "class", "a__b", "a_"])
def test_names_of_exports_are_those_of_c_and_python(name: str, checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a letter and then letters"):
        export_policy(checkpoint, tmp_path / "out", None, name)
    assert not (tmp_path / "out").exists()
