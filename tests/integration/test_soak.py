"""A few seeded faults on a whole stack of real processes; `benchmarks/service/soak.py` runs as many as one likes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SOAK = Path(__file__).parents[2] / "benchmarks" / "service" / "soak.py"


@pytest.mark.timeout(600)
def test_nothing_is_lost_by_a_few_faults() -> None:
    options = ["--faults", "6", "--seed", "3", "--longest", "2", "--updates", "120", "--patience", "240"]
    done = subprocess.run([sys.executable, str(SOAK), *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
