"""The `naosim` command: check the engine, measure its speed, show the robot tables, serve the network protocol."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from naospec.arguments import ArgumentParser

from naosim import __version__
from naosim.robots import nao_model
from naosim.simspark import bench, traces


def _check(arguments: argparse.Namespace) -> int:
    from naosim.mujoco import traces as mujoco_traces  # the other commands need no MuJoCo

    results = [(mujoco_traces if mujoco_traces.is_recording(path) else traces).check(path) for path in arguments.traces]
    if arguments.json:
        _print(json.dumps(results, indent=2))
        return 0
    _print_exact([result for result in results if "exact" in result])
    _print_close([result for result in results if "exact" not in result])
    return 0


def _print_exact(results: list[dict[str, Any]]) -> None:
    """Print the results of recordings of rcssservermj."""
    state_keys = ("qpos", "qvel", "qacc_warmstart", "time")
    if results:
        _print(
            f"{'trace':<18}{'robot':>6}{'cycles':>8}{'state':>11}{'sensors':>11}{'perceptors':>12}{'differs at':>12}"
        )
    for r in results:
        difference, first = r["differences"], r["first_difference"]
        state = max(difference[key] for key in state_keys)
        perceptors = max(value for key, value in difference.items() if key not in (*state_keys, "sensordata"))
        _print(
            f"{r['trace']:<18}{r['robot']:>6}{r['cycles']:>8}{state:>11.1e}{difference['sensordata']:>11.1e}"
            f"{perceptors:>12.1e}{'never' if first is None else first:>12}"
        )


def _print_close(results: list[dict[str, Any]]) -> None:
    """Print the results of recordings of rcssserver3d."""
    if not results:
        return
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
    _print(json.dumps(asdict(nao_model.model(arguments.robot_type)), indent=2))
    return 0


def _serve(arguments: argparse.Namespace) -> int:
    from naosim.simspark import server  # the other commands need no network

    settings = server.ServerSettings(
        host=arguments.host,
        agent_port=arguments.agent_port,
        monitor_port=arguments.server_port,
        realtime=arguments.realtime,
        digits=arguments.digits,
        seed=arguments.seed,
        noise=not arguments.no_noise,
        max_agents=arguments.max_agents,
        max_connections=arguments.max_connections,
    )
    level = logging.WARNING if arguments.quiet else logging.INFO
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr)
    try:
        server.serve(settings)
    except OSError as error:
        sys.stderr.write(f"naosim: {arguments.host}, ports {arguments.agent_port}, {arguments.server_port}: {error}\n")
        return 1
    return 0


def _reap(arguments: argparse.Namespace) -> int:
    from naosim.launchers.docker import remove_orphans  # the other commands need no engine

    try:
        removed = remove_orphans(min_age_s=arguments.min_age)
    except OSError as error:
        sys.stderr.write(f"naosim: {error}\n")
        return 1
    _print(f"{removed} removed")
    return 0


def _launcher(arguments: argparse.Namespace) -> int:
    from naosim import sidecars  # the other commands need no web server

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr)
    images = {"rcssserver3d": arguments.rcssserver3d, "rcssservermj": arguments.rcssservermj}
    try:
        sidecars.serve(images, arguments.host, arguments.port)
    except OSError as error:
        sys.stderr.write(f"naosim: {error}\n")
        return 1
    return 0


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(prog="naosim", description=__doc__)
    parser.add_argument("--version", action="version", version=f"naosim {__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    check = commands.add_parser(
        "check", help="compare the engines with recordings of running servers, rcssserver3d or rcssservermj"
    )
    check.add_argument("traces", nargs="+", type=Path, metavar="TRACE.npz")
    check.add_argument("--json", action="store_true", help="print a list of results as JSON")
    check.set_defaults(run=_check)
    speed = commands.add_parser("bench", help="measure the engine's speed in cycles per second")
    speed.add_argument("--batch", type=int, default=64)
    speed.add_argument("--cycles", type=int, default=2000)
    speed.add_argument("--robot-type", type=int, default=0)
    speed.add_argument("--kernel", choices=("avx512", "avx2", "generic"), help="default: the fastest supported one")
    speed.add_argument("--json", action="store_true")
    speed.set_defaults(run=_bench)
    robot = commands.add_parser("robot", help="print a robot table as JSON")
    robot.add_argument("robot_type", type=int)
    robot.set_defaults(run=_robot)
    serve = commands.add_parser(
        "serve",
        help="run a stand-in for rcssserver3d: agent port and monitor port on the embedded engine",
        description="Each robot runs alone on its own field; see docs/how-to/rcssserver3d.md.",
    )
    serve.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: %(default)s, this machine only)"
    )
    serve.add_argument("--agent-port", type=int, default=3100, help="default: %(default)s; 0: any free port")
    serve.add_argument("--server-port", type=int, default=3200, help="monitor port; default: %(default)s")
    pace = serve.add_mutually_exclusive_group()
    pace.add_argument("--sync", action="store_true", help="run a robot's cycle when its agent sends (syn) (default)")
    pace.add_argument("--realtime", action="store_true", help="run 50 cycles a second")
    serve.add_argument("--digits", type=int, choices=(2, 3), default=2, help="decimals of perceptors (default: 2)")
    serve.add_argument("--seed", type=int, help="seed of vision and beam noise (default: random)")
    serve.add_argument("--no-noise", action="store_true", help="disable noise in vision and beams")
    serve.add_argument("--max-agents", type=int, default=64)
    serve.add_argument("--max-connections", type=int, default=512)
    serve.add_argument("--script-path", help=argparse.SUPPRESS)  # an option of the real server, ignored here
    serve.add_argument("--quiet", action="store_true", help="log warnings only")
    serve.set_defaults(run=_serve)
    reap = commands.add_parser("reap", help="remove server containers on this Docker engine whose owner has died")
    reap.add_argument(
        "--min-age", type=_seconds, default=30.0, metavar="SECONDS", help="ignore younger ones (default: 30)"
    )
    reap.set_defaults(run=_reap)
    launcher = commands.add_parser(
        "launcher",
        help="start servers' containers for workers, which have no access to the container engine",
        description="Runs in a container of the engine that DOCKER_HOST names; see docs/how-to/sidecars.md.",
    )
    for server in ("rcssserver3d", "rcssservermj"):
        launcher.add_argument(f"--{server}", required=True, metavar="IMAGE", help=f"image of {server}")
    launcher.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    launcher.add_argument("--port", type=int, default=2380, help="default: %(default)s")
    launcher.set_defaults(run=_launcher)
    return parser


def _seconds(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 86_400.0:
        raise argparse.ArgumentTypeError(f"must be 0 to 86400 seconds, not {text}")
    return value


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code (2 for bad input)."""
    arguments = _parser().parse_args(argv)
    try:
        code: Any = arguments.run(arguments)
    except ValueError as error:
        sys.stderr.write(f"naosim: {error}\n")
        return 2
    return int(code)
