"""Measure cycles per second through rcssserver3d's protocol: the cost of the client compared with draining the ports.

    python benchmarks/protocol/run.py [--servers 2] [--cycles 2000] [--program rcssserver3d]

Every server walks in place under a sine gait, so that poses change and frames are of their usual size. Three clients
take turns with the same servers: `drained` sends commands, and reads and drops the messages of both ports; `truth` is
`naosim.simspark.RemoteBatch`, every message and frame parsed; `agent only` reads and drops those of the agent port
only.
"""

from __future__ import annotations

import argparse
import json
import selectors
import socket
import statistics
import sys
import time

import numpy as np
from naosim.launchers import Address, ProcessLauncher
from naosim.robots import nao_model
from naosim.simspark import RCSSSERVER3D, RemoteBatch, embedded_launcher, protocol
from naosprint.programs import integer, run_program

MODEL = nao_model.model(0)


def gait(cycle: int) -> np.ndarray:
    """Return (joints,) speeds in rad/s of a walk in place."""
    speeds = np.zeros(len(MODEL.joints))
    wave = np.cos(2 * np.pi * cycle / 20)
    for name, gain in (("llj3", 2.0), ("llj4", -4.0), ("llj5", 2.0), ("rlj3", -2.0), ("rlj4", 4.0), ("rlj5", -2.0)):
        speeds[MODEL.joint_index[name]] = gain * wave
    return speeds


def text(cycle: int) -> bytes:
    """Return the same as a framed agent message."""
    speeds = gait(cycle)
    words = "".join(f"({j.effector} {s:.5f})" for j, s in zip(MODEL.joints, speeds, strict=True))
    return protocol.frame(f"{words}(syn)".encode())


MESSAGES = [text(k) for k in range(20)]


class Drain:
    """Play one robot on each server and read only the length of messages."""

    def __init__(self, servers: list[Address], *, monitor: bool) -> None:
        self.agents, self.monitors = [], []
        self.counts: dict[socket.socket, int] = {}
        self.buffers: dict[socket.socket, bytes] = {}
        self.selector = selectors.DefaultSelector()
        for server in servers:
            if monitor:
                self.monitors.append(self._open(server.host, server.monitor_port))
            self.agents.append(self._open(server.host, server.agent_port))
        for greeting in (b"(scene rsg/agent/nao/nao.rsg)", b"(init (unum 1)(teamname naosim))", b"(syn)", b"(syn)"):
            self._round([protocol.frame(greeting)] * len(servers), frames=False)
        time.sleep(0.2)  # frames of the greeting
        for monitor_socket in self.monitors:
            self._read(monitor_socket)

    def _open(self, host: str, port: int) -> socket.socket:
        opened = socket.create_connection((host, port))
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        opened.setblocking(False)
        self.counts[opened], self.buffers[opened] = 0, b""
        self.selector.register(opened, selectors.EVENT_READ)
        return opened

    def _read(self, source: socket.socket) -> None:
        try:
            data = self.buffers[source] + source.recv(1 << 18)
        except BlockingIOError:
            return
        at = 0
        while len(data) - at >= 4 and len(data) - at >= 4 + (size := int.from_bytes(data[at : at + 4], "big")):
            at += 4 + size
            self.counts[source] += 1
        self.buffers[source] = data[at:]

    def _round(self, messages: list[bytes], *, frames: bool) -> None:
        goals = {source: self.counts[source] + 1 for source in self.agents + (self.monitors if frames else [])}
        for agent, message in zip(self.agents, messages, strict=True):
            agent.sendall(message)
        while any(self.counts[source] < goal for source, goal in goals.items()):
            for key, _ in self.selector.select():
                self._read(key.fileobj)  # type: ignore[arg-type]

    def step(self, cycle: int) -> None:
        """Run one cycle on all servers."""
        self._round([MESSAGES[cycle % 20]] * len(self.agents), frames=True)

    def close(self) -> None:
        """Leave."""
        for opened in self.counts:
            opened.close()


class Batch:
    """Play one robot on each server with the client under test."""

    def __init__(self, servers: list[Address]) -> None:
        self.remote = RemoteBatch(servers)
        self.speeds = [np.tile(gait(k), (len(servers), 1)) for k in range(20)]

    def step(self, cycle: int) -> None:
        """Run one cycle on all servers."""
        self.remote.step(self.speeds[cycle % 20])

    def close(self) -> None:
        """Leave."""
        if self.remote.failed.any():
            raise RuntimeError(self.remote.reason(int(np.argmax(self.remote.failed))))
        self.remote.close()


def rate(client: Drain | Batch, servers: int, cycles: int) -> tuple[float, float]:
    """Return cycles/s of all servers together, and the client's own CPU time a cycle and server, microseconds."""
    for k in range(100):
        client.step(k)
    begin, used = time.perf_counter(), time.process_time()
    for k in range(cycles):
        client.step(k)
    wall, used = time.perf_counter() - begin, time.process_time() - used
    return servers * cycles / wall, 1e6 * used / (servers * cycles)


def wait(server: Address) -> None:
    """Wait until a server listens."""
    for port in (server.agent_port, server.monitor_port):
        for _ in range(1000):
            try:
                socket.create_connection((server.host, port)).close()
                break
            except OSError:
                time.sleep(0.02)


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--servers", type=integer(), default=2)
    parser.add_argument("--cycles", type=integer(), default=2000)
    parser.add_argument("--rounds", type=integer(), default=3, help="the median round counts")
    parser.add_argument("--program", help="default: naosim serve")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    launcher = ProcessLauncher(RCSSSERVER3D, (arguments.program,)) if arguments.program else embedded_launcher()
    rates: dict[str, list[float]] = {"agent only": [], "drained": [], "truth": []}
    costs: dict[str, list[float]] = {name: [] for name in rates}
    for _ in range(arguments.rounds):
        for name, found in rates.items():
            handles = [launcher.start() for _ in range(arguments.servers)]
            try:
                servers = [handle.address for handle in handles]
                for server in servers:
                    wait(server)
                client = Batch(servers) if name == "truth" else Drain(servers, monitor=name == "drained")
                speed, cost = rate(client, arguments.servers, arguments.cycles)
                found.append(speed)
                costs[name].append(cost)
                client.close()
            finally:
                for handle in handles:
                    handle.stop()
    speeds = {name: statistics.median(found) for name, found in rates.items()}
    cpu = {name: statistics.median(found) for name, found in costs.items()}
    share = speeds["truth"] / speeds["drained"]
    if arguments.json:
        result = {"servers": arguments.servers, "cycles_per_s": speeds, "client_us": cpu, "truth_over_drained": share}
        json.dump(result | {"rounds": rates}, sys.stdout, indent=2)
        return
    for name, value in speeds.items():
        print(f"{name:<12}{value:>9,.0f} cycles/s, client {cpu[name]:5.0f} us of CPU a cycle")
    print(f"truth / drained {share:.0%}")


if __name__ == "__main__":
    run_program(main)
