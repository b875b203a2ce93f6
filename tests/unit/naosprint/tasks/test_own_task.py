"""Tasks of other packages have the parts of the bundled ones, and are exported or refused by what they observe."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import EvaluationSpec, TrainingSpec
from naosprint import evaluate, train
from naosprint.__main__ import main
from naosprint.export import FORMATS, export_policy
from naosprint.tasks.environment import open_environment

SMALL = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "hidden_sizes": [16]}
STROLL = {"torque_penalty": 0.01, "smoothness_penalty": 0.01, "hop_penalty": 0.01, "push_mps": 0.5, "push_steps": 5}


def specification(robot: str, task: Any, **algorithm: Any) -> TrainingSpec:
    return TrainingSpec.model_validate(
        {
            "robot": robot,
            "task": task,
            "algorithm": SMALL | algorithm,
            "total_steps": 128,
            "runtime": {"learner_threads": 1},
        }
    )


def test_a_task_of_public_parts_is_disturbed_penalized_and_runs_compiled(offer: Callable[[str], None]) -> None:
    offer("naosprint-stroll")
    plain = {"sensor_noise": 1.0, "extra_delay": 1}
    for robot, settings in (("t1", plain | STROLL), ("nao-0", plain)):
        seen = []
        for disturbed in (True, False):
            task = {"name": "stroll", **(settings if disturbed else {})}
            environment = open_environment(specification(robot, task), 2, threads=1)
            assert environment.compiled
            environment.load_starts(environment.task.starts(2, 0, 0.0))
            for _ in range(10):
                environment.step(np.zeros((2, environment.actuation.n_actions)))
            seen.append((environment.observations.copy(), environment.world.position(slice(0, 2)).copy()))
            environment.close()
        assert (seen[0][0] != seen[1][0]).any()
        assert (seen[0][1] != seen[1][1]).any()


def test_a_task_of_public_parts_is_imitated_evaluated_and_exported(
    offer: Callable[[str], None], tmp_path: Path, recorder: Any
) -> None:
    offer("naosprint-stroll")
    spec = specification("t1", {"name": "stroll", **STROLL}, imitation_steps=64)
    result = train(spec, workdir=tmp_path / "run", reporter=recorder)
    results = evaluate(result.checkpoint, EvaluationSpec(episodes=2)).summary["results"]
    assert {each["name"] for each in results} == {"way_m", "fall_rate"}
    assert len(export_policy(result.checkpoint, tmp_path / "export", FORMATS)) > len(FORMATS)


@pytest.mark.parametrize("robot", ["nao-0", "t1"])
def test_the_documented_task_is_exported_and_a_skill_names_what_it_cannot_compute(
    robot: str, offer: Callable[[str], None], tmp_path: Path, recorder: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """By default the others are written; a skill that was requested is an error."""
    offer("naosprint-backwards")
    result = train(specification(robot, "run-backwards"), workdir=tmp_path / "run", reporter=recorder)
    warnings: list[str] = []
    written = export_policy(result.checkpoint, tmp_path / "export", warn=warnings.append)
    assert {path.suffix for path in written} == {".npz", ".onnx", ".h", ".c", ".json"}
    (sentence,) = warnings
    reason = (
        "the team code's skill cannot compute observation gait_sin of task run-backwards: it has no 'gait_sin', only "
    )
    assert sentence.startswith(f"format skill is left out: {reason}")
    with pytest.raises(ValueError, match=f"^format skill: {reason}"):
        export_policy(result.checkpoint, tmp_path / "skill", FORMATS)
    words = ("export", str(result.checkpoint), str(tmp_path / "printed"))
    assert main(words) == 0
    out, error = capsys.readouterr()
    assert error == f"warning: {sentence}\n"
    assert [Path(line).name for line in out.splitlines()] == [path.name for path in written]
    assert main([*words, "--format", "skill"]) == 1
    assert capsys.readouterr().err.startswith(f"error: format skill: {reason}")
