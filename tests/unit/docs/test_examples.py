"""Each example runs and prints what it promises."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

from .documents import ROOT

EXAMPLES = ROOT / "examples"
PRINTS = {
    "act_without_naosprint.py": r"22 joints; \w+: -?\d+\.\d degrees",
    "compare_two_policies.py": r"sprint-hour: [34]\.\d\d m/s\nsprint: [34]\.\d\d m/s",
    "continue_from_a_policy.py": r"finished at step 512",
    "draw_a_robot.py": r"t1\.png: \d{4,} bytes",
    "drive_the_engine.py": r"torso at 0\.3\d m after 1 s",
    "evaluate_a_policy.py": r"Falls: 0\.0 % \(0\.0 to 32\.4 %\)",
    "export_a_skill.py": r"runner\.py, skill\.py, sprint\.json, sprint\.npz",
    "list_plugins.py": r"kick: Kick a ball .* Robots: k1, t1",
    "read_a_policys_card.py": r"t1-sprint: \d+ trainings, \d+ million steps",
    "record_a_replay.py": r"28\.\d m in 7\.\d s; replay\.json, replay\.npz",
    "resume_bit_for_bit.py": r"the same bits: True",
    "run_a_policy_in_many_environments.py": r"mean reward of the last of 100 steps: [5-9]\.",
    "step_an_environment.py": r"89 observations, \d+ steps until the fall",
    "train_a_policy.py": r"step 512: .*\nstep 1,024: .*\nfinished at step 1024: trained/step-000000001024",
    "write_a_specification.py": r"seed 1: digest [0-9a-f]{12}, differs from the preset in",
}
"""What each program prints, among others, as a pattern."""


def test_every_example_is_listed() -> None:
    names = {path.name for path in EXAMPLES.glob("*.py")}
    assert names == PRINTS.keys()
    listed = re.findall(r"^\| \[(\w+\.py)\]\((\w+\.py)\)", (EXAMPLES / "README.md").read_text("utf-8"), re.MULTILINE)
    assert {name for name, target in listed if name == target} == names


@pytest.mark.parametrize("name", sorted(PRINTS))
def test_an_example_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert re.search(PRINTS[name], capsys.readouterr().out)
