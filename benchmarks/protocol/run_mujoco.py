"""Measure cycles per second of real rcssservermj servers: the cost of commands and of the client.

    python benchmarks/protocol/run_mujoco.py [--servers 1] [--robot t1] [--rounds 12] [--json FILE]

Three clients take turns with the same servers, whose robots sway on their feet. `syn` answers `(syn)` and drops all
messages; `drained` sends prepared commands for every joint except the head's and drops all messages; `driven` is
`naosim.mujoco.client.MujocoFleet`, which writes the same commands and reads every message. CPU time a cycle is that of
one server, all its threads, and of the client per server.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from naosim import robots
from naosim.mujoco.client import MujocoFleet
from naosim.mujoco.program import server_launcher
from naosim.robots import Robot
from naospec.json_text import json_text
from naosprint.programs import integer, run_program

CYCLES = 250
TICKS = os.sysconf("SC_CLK_TCK")


def server_cpu_s(fleet: MujocoFleet) -> float:
    """Return the CPU time of all servers."""
    leaders = {handle.pid for handle in fleet._handles}  # type: ignore[union-attr]
    total = 0
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[3]) in leaders:  # the session
                total += int(fields[11]) + int(fields[12])
    return total / TICKS


class Fleet(MujocoFleet):
    """The client, with a second handle on every agent port's socket."""

    def __init__(self, robot: Robot, n: int) -> None:
        self.agents: dict[int, socket.socket] = {}
        super().__init__(server_launcher(), robot, n)

    def _connect_port(self, row: int, host: str, port: int, deadline: float) -> socket.socket:
        connection = super()._connect_port(row, host, port, deadline)
        self.agents[row] = connection.dup()  # of both ports; the agent's comes last
        return connection


def exchange_raw(agents: list[socket.socket], message: bytes) -> None:
    """Send one framed message to all servers, then read and drop one from each."""
    for agent in agents:
        agent.sendall(message)
    for agent in agents:
        received(agent, int.from_bytes(received(agent, 4), "big"))


def received(agent: socket.socket, size: int) -> bytes:
    """Return so many bytes; a single read of the fleet's sockets waits for the server for a moment only."""
    data = b""
    while len(data) < size:
        with contextlib.suppress(BlockingIOError):
            if not (part := agent.recv(size - len(data), socket.MSG_WAITALL)):
                raise ConnectionError("the server has closed the connection")
            data += part
    return data


def framed(text: str) -> bytes:
    """Return a message behind its length."""
    return len(text).to_bytes(4, "big") + text.encode()


def commands(robot: Robot, targets: np.ndarray) -> bytes:
    """Return a message with a command for every joint that moves."""
    nodes = []
    for joint, target in zip(robot.joints, targets, strict=True):
        if joint.actuated:
            kp, kd = robot.parameters.gains(joint.name)  # type: ignore[attr-defined]
            nodes.append(f"({joint.effector} {round(float(np.degrees(target)), 4)} 0 {kp:g} {kd:g} 0)")
    return framed("".join(nodes))


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--servers", type=integer(), default=1)
    parser.add_argument("--robot", choices=("t1", "k1"), default="t1")
    parser.add_argument("--rounds", type=integer(), default=12)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    robot, n = robots.get(arguments.robot), arguments.servers
    fleet = Fleet(robot, n)
    agents = [fleet.agents[row] for row in range(n)]
    fleet._closing.set()  # the thread that keeps silent servers alive would disturb the others
    still = np.repeat(robot.nominal[None], n, axis=0)
    moved = np.array([joint.actuated for joint in robot.joints])
    sway = [still + 0.02 * moved * np.sin(0.1 * cycle + np.arange(len(robot.joints))) for cycle in range(63)]
    prepared, syn = [commands(robot, targets[0]) for targets in sway], framed("(syn)")
    clients: dict[str, Callable[[int], None]] = {
        "syn": lambda cycle: exchange_raw(agents, syn),
        "drained": lambda cycle: exchange_raw(agents, prepared[cycle % 63]),
        "driven": lambda cycle: fleet.step(sway[cycle % 63]),
    }
    results: dict[str, list[tuple[float, float, float]]] = {name: [] for name in clients}
    try:
        for turn in range(arguments.rounds + 1):
            for name, client in clients.items():
                fleet.run_motions({row: fleet.starting(row, robot.nominal, (-5.0, 0.0), 0.0, 60) for row in range(n)})
                cpu, own, began = server_cpu_s(fleet), time.process_time(), time.perf_counter()
                for cycle in range(CYCLES):
                    client(cycle)
                wall = time.perf_counter() - began
                if turn:  # the first round warms up
                    own_s, server_s = time.process_time() - own, server_cpu_s(fleet) - cpu
                    results[name].append((n * CYCLES / wall, server_s / n / CYCLES * 1e6, own_s / n / CYCLES * 1e6))
        assert not fleet.failed.any()
    finally:
        fleet.close()
    print(f"{n} x rcssservermj, {robot.name}\n{'client':<8}{'cycles/s':>10}{'server us':>11}{'client us':>11}")
    rows = {
        name: [statistics.median(column) for column in zip(*values, strict=True)] for name, values in results.items()
    }
    for name, (rate, server_us, client_us) in rows.items():
        print(f"{name:<8}{rate:>10,.0f}{server_us:>11,.0f}{client_us:>11,.0f}")
    ratios = {
        other: round(statistics.median(d[0] / o[0] for d, o in zip(results["driven"], results[other], strict=True)), 3)
        for other in ("drained", "syn")
    }
    print(", ".join(f"driven / {other}: {ratio:.1%}" for other, ratio in ratios.items()))
    if arguments.json is not None:
        keys = ("cycles_per_s", "server_us", "client_us")
        document = {name: dict(zip(keys, map(round, values), strict=True)) for name, values in rows.items()}
        settings = {"servers": n, "robot": robot.name}
        arguments.json.write_text(json_text(settings | document | {"driven_by": ratios}), encoding="utf-8")


if __name__ == "__main__":
    run_program(main)
