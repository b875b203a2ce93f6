"""Measure the throughput of two checkouts in turn; write comparison.json beside this file.

    python benchmarks/learning/compare.py OTHER_CHECKOUT WORKDIR [--rounds 3]

Both checkouts need their ``.venv`` (``make install``), and the machine must be idle. Compare only the ratios: this
checkout's steps a second over the other's, within each round.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from naospec.json_text import json_text
from naosprint.programs import integer, run_program
from run import machine

HERE = Path(__file__).parent
THIS = HERE.parent.parent
NAMES = ("engine", "environments", "learner", "whole_loop")


def measured(checkout: Path, workdir: Path) -> dict[str, float]:
    """Return the section ``throughput`` of a checkout, measured by its own benchmark; keep its record."""
    record = checkout / "benchmarks/learning/results.json"
    before = record.read_bytes()
    try:
        command = [checkout / ".venv/bin/python", "benchmarks/learning/run.py", workdir, "--only", "throughput"]
        subprocess.run(list(map(str, command)), cwd=checkout, check=True, stdout=subprocess.DEVNULL)
        # an earlier version writes it among the committed results
        written = record if record.read_bytes() != before else checkout / "build" / record.relative_to(checkout)
        found: dict[str, float] = json.loads(written.read_text(encoding="utf-8"))["throughput"]
    finally:
        record.write_bytes(before)
    return {name: found[name] for name in NAMES}


def commit(checkout: Path) -> str:
    """Return the commit of a checkout."""
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="the other checkout")
    parser.add_argument("workdir", type=Path)
    parser.add_argument("--rounds", type=integer(), default=3)
    parser.add_argument("--json", type=Path, default=HERE / "comparison.json", help="file for the results")
    options = parser.parse_args()
    rounds: list[dict[str, Any]] = []
    for number in range(options.rounds):
        workdir = options.workdir.resolve() / str(number)
        other, this = (measured(path.resolve(), workdir / name) for name, path in (("b", options.other), ("a", THIS)))
        ratios = {name: round(this[name] / other[name], 3) for name in NAMES}
        rounds.append({"other": other, "this": this, "ratio": ratios})
        print(f"round {number + 1}: {ratios}")
    means = {name: round(float(np.mean([found["ratio"][name] for found in rounds])), 3) for name in NAMES}
    content = {"other": commit(options.other), "this": commit(THIS), "ratio": means, "rounds": rounds}
    options.json.write_text(json_text({**machine(), **content}), encoding="utf-8")
    print(f"mean: {means}")


if __name__ == "__main__":
    run_program(main)
