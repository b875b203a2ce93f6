"""Skill folders: a policy as a skill for public team code, with values that it can be checked against."""

from __future__ import annotations

import importlib.util
import inspect
import json
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from naosim.npz import write_npz
from naosim.simulator import BALL
from naospec import EvaluationSpec
from naospec.files import write_whole

from naosprint.export import booster, nao
from naosprint.export.arrays import policy_arrays
from naosprint.export.header import DEFAULT_NAME, exact_actions
from naosprint.tasks.environment import open_environment
from naosprint.tasks.measurements import StoredNumbers
from naosprint.terms.description import Description

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from naosprint.arrays import AnyArray, FloatArray
    from naosprint.rl.checkpoint import Manifest
    from naosprint.rl.policy import NetworkPolicy
    from naosprint.tasks.environment import Environment
    from naosprint.tasks.world import World

_SOURCES = Path(__file__).with_name("skills")
CYCLES = 64
"""Cycles of the recorded episode."""
_NOISE_DEG = 2.0
_SAME = 1e-5


@dataclass(frozen=True)
class _Target:
    """Team code for the robots of a family."""

    folder: str
    """Folder of the skill, below the team code's own."""
    inputs: Mapping[str, Callable[[Environment], AnyArray]]
    """What the robot perceives, by the name of the argument of `Runner.observe`, in their order."""
    optional: Mapping[str, Callable[[Environment], bool]] = field(default_factory=dict)
    """Inputs that only some policies need, and whether this one does."""


def _perceived(name: str) -> Callable[[Environment], AnyArray]:
    return lambda environment: environment.world.perceptors[name]


def _pose(measure: Callable[[World], FloatArray]) -> Callable[[Environment], AnyArray]:
    """Return a part of the true pose; NaN where the skill estimates it from the other inputs."""
    return lambda environment: measure(environment.world) * (np.nan if _sees(environment) else 1.0)


def _sees(environment: Environment) -> bool:
    return "vision" in environment.world.perceptors


TARGETS = {
    booster.FAMILY: _Target(
        "mujococodebase/mujococodebase/skills/naosprint",
        {
            "position": _perceived("torso_pos"),
            "quaternion": _perceived("torso_quat"),
            "gyro_deg": _perceived("gyro"),
            "angles_deg": _perceived("joint_angles"),
            "speeds_deg": _perceived("joint_speeds"),
            "ball": _perceived(BALL),
        },
        {"ball": lambda environment: BALL in environment.world.perceptors},
    ),
    nao.FAMILY: _Target(
        "FCPCodebase/behaviors/custom/Naosprint",
        {
            "yaw": _pose(lambda world: world.yaw(slice(0, 1))),
            "height": _pose(lambda world: world.position(slice(0, 1))[:, 2]),
            "angles_deg": _perceived("joint_angles"),
            "gyro_deg": _perceived("gyro"),
            "accel": _perceived("accel"),
            "left_foot": _perceived("foot_left"),
            "right_foot": _perceived("foot_right"),
            "vision": _perceived("vision"),
            "position": lambda environment: environment.world.position(slice(0, 1))[:, :2],
        },
        {"vision": _sees, "position": lambda environment: "forward_velocity" in environment.observer.names},
    ),
}
"""Team code by the family of robots that it plays with."""


def write_skill(policy: NetworkPolicy, manifest: Manifest, directory: Path, name: str = DEFAULT_NAME) -> list[Path]:
    """Write a policy as a skill to a folder below ``directory`` and return the paths of its files.

    With another ``name`` than the default, folder and class have it after naosprint's, such as ``naosprint_kick`` and
    ``NaosprintKick``, so that a team can have several, and none is called like a part of the team's code.

    Raises:
        ValueError: if there is no team code for the robot, or the policy observes what the skill cannot compute.
    """
    family = manifest.stage_spec.family
    if family not in TARGETS:
        raise ValueError(f"format skill: no team code for robots of family {family}; use another format")
    target = TARGETS[family]
    recorded, description = record(policy, manifest, target)
    arrays = {**policy_arrays(policy, manifest), "terms": np.array(json.dumps(description.document()))}
    _require_computable(_SOURCES / family, arrays, recorded, manifest, description)
    parent, _, own = target.folder.rpartition("/")
    module, skill = ("naosprint", "Naosprint") if name == DEFAULT_NAME else (f"naosprint_{name}", _class_name(name))
    named = {"Naosprint": skill, "skills.naosprint": f"skills.{module}"}
    folder = directory / parent / (skill if own.istitle() else module)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for path in (_SOURCES / "check.py", _SOURCES / "terms.py", *sorted((_SOURCES / family).glob("*.py"))):
        text, file = path.read_text(encoding="utf-8"), path.name
        for ours, theirs in named.items():
            text, file = text.replace(ours, theirs), file.replace(ours, theirs)
        written.append(folder / file)
        write_whole(written[-1], text)
    for stem, content in (("policy", arrays), ("parity", recorded)):
        written.append(folder / f"{stem}.npz")
        write_npz(written[-1], content)
    return written


def _class_name(name: str) -> str:
    """Return the name of the class: another one for every name, also for `a1` and `a_1`."""
    return "Naosprint" + "".join(part.capitalize() if part[0].isalpha() else f"_{part}" for part in name.split("_"))


def _require_computable(
    sources: Path,
    arrays: Mapping[str, AnyArray],
    recorded: Mapping[str, AnyArray],
    manifest: Manifest,
    description: Description,
) -> None:
    """Compare what the skill's own code observes with the recorded observations, cycle by cycle, as its check does.

    Raises:
        ValueError: naming the observations that it cannot compute, and why.
    """
    task, names = manifest.stage_spec.task.name, manifest.observations
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "policy.npz", allow_pickle=False, **arrays)
        runner = _module(sources / "runner.py").Runner(Path(folder) / "policy.npz")
    for method, given in ((runner.begin, recorded["begin"]), (runner.observe, recorded["inputs"])):
        if unknown := [str(name) for name in given if str(name) not in inspect.signature(method).parameters]:
            raise ValueError(
                f"format skill: the team code's skill does not take {', '.join(unknown)} of task {task}; use another "
                "format"
            )
    runner.begin(**{str(name): recorded[f"begin_{name}"] for name in recorded["begin"]})
    for cycle, expected in enumerate(recorded["observations"]):
        try:
            seen = runner.observe(**{str(name): recorded[str(name)][cycle] for name in recorded["inputs"]})
        except (KeyError, AttributeError) as error:  # an input, or a function that only trainings have
            missing = str(error.args[0] if isinstance(error, KeyError) else error.name)
            reason = f"it has no {missing!r}, only {', '.join(sorted(runner.observations.inputs))}"
            raise _uncomputable(task, description.observed_by(missing), reason) from error
        differing = ~(np.abs(seen - expected) <= _SAME)  # NaN included
        if differing.any():
            unknown = [name for name, differs in zip(names, differing, strict=True) if differs]
            raise _uncomputable(task, unknown, f"in cycle {cycle + 1} it differs from the training's")
        runner.act(seen)


def _uncomputable(task: str, observations: Sequence[str], reason: str) -> ValueError:
    """Return the error of a policy that observes what its skill cannot compute."""
    what = f"observation {', '.join(observations[:8])}" if observations else "the observations"
    return ValueError(
        f"format skill: the team code's skill cannot compute {what} of task {task}: {reason}; use another format, or "
        "observe expressions (naosprint.terms) of what the skill has"
    )


def _module(path: Path) -> Any:
    """Import one of the skill's files as it stands, beside the others of its folder."""
    spec = importlib.util.spec_from_file_location(f"naosprint_skill_{path.parent.name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    folders = [str(path.parent), str(_SOURCES)]
    sys.path[:0] = folders
    try:
        spec.loader.exec_module(module)
    finally:
        for folder in folders:
            sys.path.remove(folder)
    return module


def record(policy: NetworkPolicy, manifest: Manifest, target: _Target) -> tuple[dict[str, AnyArray], Description]:
    """Run an episode in the embedded simulator; return what the robot perceived, observed and did by name.

    The second value describes what it observes.

    Every array has a row per cycle; the episode ends early if the robot falls.
    """
    spec = EvaluationSpec(episodes=1, simulator="embedded").applied_to(manifest.stage_spec)
    environment = open_environment(spec, 1, threads=1)
    left_out = {name for name, needed in target.optional.items() if not needed(environment)}
    measured = {name: measure for name, measure in target.inputs.items() if name not in left_out}
    rows: dict[str, list[AnyArray]] = {name: [] for name in (*measured, *_EXPECTED)}
    try:
        environment.load_starts(environment.task.starts(1, 0, _NOISE_DEG))
        everyone = np.zeros(1, dtype=np.int64)
        environment.restart(everyone, everyone)
        begin = _begin(environment)
        description = _description(environment)
        commanded = _commands(environment)
        if commanded is not None:
            rows["command"] = []
            given = commanded.copy()
        for _ in range(CYCLES):
            if commanded is not None:
                if (commanded != given).any():
                    break  # the task has drawn a new command and begun a new path
                rows["command"].append(commanded[0].copy())
            for name, measure in measured.items():
                rows[name].append(np.array(measure(environment)[0]))
            observations = environment.observations.copy()
            actions = exact_actions(policy, observations)
            for name, values in zip(
                _EXPECTED, (observations, actions, environment.actuation.targets(actions)), strict=True
            ):
                rows[name].append(values[0])
            environment.step(actions)
            if environment.task.frozen is not None and environment.task.frozen[0]:
                break  # another policy acts from here on
            if environment.terminated[0] or environment.truncated[0]:
                break
    finally:
        environment.close()
    inputs = [*measured, *(("command",) if commanded is not None else ())]
    recorded: dict[str, AnyArray] = {
        "inputs": np.array(inputs),
        "begin": np.array(list(begin), dtype=np.str_),
        **{f"begin_{name}": value for name, value in begin.items()},
        **{name: np.array(values) for name, values in rows.items()},
    }
    return recorded, description


_EXPECTED = ("observations", "actions", "targets_rad")


def _description(environment: Environment) -> Description:
    """Return the description of what a policy observes."""
    task = environment.task
    measured = [each for each in task.measurements if isinstance(each, StoredNumbers)]
    stores = [store for measurement in measured for store in measurement.stores]
    # the skill itself knows the action, also that of the policy before it
    actions = (environment.world.actions, environment.world.previous_actions)
    stores = [store for store in stores if not any(store.target.array is each for each in actions)]
    return Description(environment.observer.blocks, stores, task.start_position())


def _commands(environment: Environment) -> AnyArray | None:
    """Return the array of the robots' commands, each forward, sideways and turn; None if the task has none."""
    commands = getattr(environment.task, "command", None)
    return commands if isinstance(commands, np.ndarray) and commands.shape[1:] == (3,) else None


def _begin(environment: Environment) -> dict[str, AnyArray]:
    """Return the arguments of `Runner.begin` for the task's path."""
    handed_over = getattr(environment.task, "handed_over", None)
    if handed_over is not None:
        found: dict[str, AnyArray] = handed_over(0)
        return found
    if _commands(environment) is not None:
        return {}
    begin = {"heading": np.array(0.0)}
    if "line_offset" in environment.observer.names:
        begin["lane"] = np.array(environment.task.start_position())
    return begin
