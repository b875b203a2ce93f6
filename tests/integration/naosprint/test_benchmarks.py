"""Programs that measure what nothing else calls, with as little as they take."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


def test_kicks_of_exported_skills_are_measured(tmp_path: Path) -> None:
    program = [sys.executable, str(BENCHMARKS / "learning/kick_server.py"), "t1-kick"]
    arguments = ["--kicks", "1", "--seed", "1", "--simulator", "embedded"]
    run = subprocess.run([*program, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert "embedded: touched 1 of 1, upright 1, distance " in run.stdout
