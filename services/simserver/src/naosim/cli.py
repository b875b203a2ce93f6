"""The `naosim` command: check the engine against recordings, measure its speed, show the robot tables."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from naosim import __version__, bench, robots, traces


def _check(arguments: argparse.Namespace) -> int:
    results = [traces.check(path) for path in arguments.traces]
    if arguments.json:
        _print(json.dumps(results, indent=2))
        return 0
    _print(
        f"{'trace':<18}{'type':>5}{'cycles':>8}{'median m':>11}{'p99 m':>11}{'max m':>11}"
        f"{'perceptors':>12}{'off 1 mm':>10}"
    )
    for r in results:
        error, off = r["position_error_m"], r["free_run_first_cycle_off_1mm"]
        _print(
            f"{r['trace']:<18}{r['robot_type']:>5}{r['cycles']:>8}{error['median']:>11.1e}{error['p99']:>11.1e}"
            f"{error['max']:>11.1e}{r['perceptors_within_digit']:>12.4%}{'never' if off is None else off:>10}"
        )
    return 0


def _bench(arguments: argparse.Namespace) -> int:
    result = bench.run(arguments.batch, arguments.cycles, arguments.robot_type, arguments.kernel)
    if arguments.json:
        _print(json.dumps(result, indent=2))
        return 0
    for r in result["scaling"]:
        _print(
            f"{r['threads']} thread(s), batch {r['batch']}, {r['kernel']}: {r['cycles_per_s']:,.0f} cycles/s "
            f"(x{r['speed_up']:.2f}), {r['solves_per_step']:.2f} solves a step, {r['upright']:.0%} upright"
        )
    return 0


def _robot(arguments: argparse.Namespace) -> int:
    _print(json.dumps(asdict(robots.model(arguments.robot_type)), indent=2))
    return 0


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="naosim", description=__doc__)
    parser.add_argument("--version", action="version", version=f"naosim {__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    check = commands.add_parser("check", help="compare the engine with recordings of a running rcssserver3d")
    check.add_argument("traces", nargs="+", type=Path, metavar="TRACE.npz")
    check.add_argument("--json", action="store_true", help="print a list of results as JSON")
    check.set_defaults(run=_check)
    speed = commands.add_parser("bench", help="measure cycles per second of robots on their feet")
    speed.add_argument("--batch", type=int, default=64)
    speed.add_argument("--cycles", type=int, default=2000)
    speed.add_argument("--robot-type", type=int, default=0)
    speed.add_argument("--kernel", choices=("avx512", "avx2", "generic"), help="default: the fastest that runs here")
    speed.add_argument("--json", action="store_true")
    speed.set_defaults(run=_bench)
    robot = commands.add_parser("robot", help="print a robot table as JSON")
    robot.add_argument("robot_type", type=int)
    robot.set_defaults(run=_robot)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code (2 for bad input)."""
    arguments = _parser().parse_args(argv)
    try:
        code: Any = arguments.run(arguments)
    except ValueError as error:
        sys.stderr.write(f"naosim: {error}\n")
        return 2
    return int(code)
