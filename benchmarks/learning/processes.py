"""Measure one training in one and in two processes; write processes.json beside this file.

    python benchmarks/learning/processes.py WORKDIR [--rounds 3] [--robot nao-0]

Each process has one thread, so that both cases use a core a process; the machine must be idle. The figures for more
processes are a model, not a measurement: the time of a rollout and an update in one process, divided by their number,
plus the averages of its gradients. One average of b bytes among p processes takes 2 (p - 1) messages of b / p bytes
one after the other, as in Gloo's ring. The time of a message is measured between two processes on this machine, or that
of a network with NETWORK_S and NETWORK_BYTES_S.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from naospec.json_text import json_text
from naosprint.programs import integer, run_program
from run import machine

HERE = Path(__file__).parent
UPDATES, SKIPPED = 30, 5
NETWORK_S, NETWORK_BYTES_S = 50e-6, 1.25e9  # 10 Gbit Ethernet
MANY = (4, 8, 16)

AVERAGES = """
import json, sys, time, torch
from naosprint.rl.processes import connected
with connected() as processes:
    found = []
    for count in map(int, sys.argv[1:]):
        numbers = torch.zeros(count)
        times = []
        for _ in range(220):
            began = time.perf_counter()
            processes.average([numbers])
            times.append(time.perf_counter() - began)
        found.append(sorted(times[20:])[100])
    if processes.rank == 0:
        print(json.dumps(found))
"""


def launched(size: int, *command: str) -> str:
    """Run a command in several processes; return what the first one prints."""
    place = {"WORLD_SIZE": str(size), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29547"}
    team = [
        subprocess.Popen(
            [sys.executable, *command],
            env={**os.environ, **place, "RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        for rank in range(size)
    ]
    said = [process.communicate()[0] for process in team]
    if any(process.returncode for process in team):
        raise RuntimeError(f"{command[:4]} failed")
    return said[0]


def training(workdir: Path, size: int, robot: str) -> dict[str, float]:
    """Return medians of a training's updates: steps a second, and the seconds that an update takes."""
    shutil.rmtree(workdir, ignore_errors=True)
    shape = ("--task", "sprint1", "--robot", robot, "--preset", "fast", "--total-steps", str(UPDATES * 8192))
    threads = ("--simulator-threads", "1", "--learner-threads", "1")
    launched(size, "-m", "naosprint", "train", str(workdir), *shape, *threads)
    rows = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()][SKIPPED:]
    steps = statistics.median(row["steps_per_s"] for row in rows)
    return {"steps_per_s": round(steps), "learn_s": statistics.median(row["learn_s"] for row in rows)}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workdir", type=Path)
    parser.add_argument("--rounds", type=integer(), default=3)
    parser.add_argument("--robot", default="nao-0")
    parser.add_argument("--json", type=Path, default=HERE / "processes.json", help="file for the results")
    options = parser.parse_args()
    rounds: list[dict[str, Any]] = []
    for number in range(options.rounds):
        one, two = (training(options.workdir / str(number) / str(size), size, options.robot) for size in (1, 2))
        rounds.append({"one": one, "two": two, "ratio": round(two["steps_per_s"] / one["steps_per_s"], 3)})
        print(f"round {number + 1}: {rounds[-1]}")
    # 89-128-128 twice, tied or not; five epochs of four minibatches
    count, averages = 60_000, 20
    small, whole = json.loads(launched(2, "-c", AVERAGES, "1", str(count)))
    one = statistics.median(found["one"]["steps_per_s"] for found in rounds)
    model: dict[str, dict[str, int]] = {}
    for name, message_s, byte_s in (
        ("this machine", small / 2, (whole - small) / (4 * count)),
        ("10 Gbit/s", NETWORK_S, 1.0 / NETWORK_BYTES_S),
    ):
        model[name] = {}
        for size in (2, *MANY):
            average_s = 2 * (size - 1) * (message_s + 4 * count / size * byte_s)
            model[name][str(size)] = round(8192 / (8192 / one / size + averages * average_s))
    content = {"robot": options.robot, "rounds": rounds, "average_s": {"1": small, str(count): whole}, "model": model}
    options.json.write_text(json_text({**machine(), **content}), encoding="utf-8")
    print(json.dumps(content["model"], indent=2))


if __name__ == "__main__":
    run_program(main)
