"""Run an exported policy on a rcssserver3d over TCP, with NumPy alone: python run_policy.py policy.npz [host [ports]].

The server has to run in sync mode (agentSyncMode). Nobody else may be on the field.
"""

# ruff: noqa: ANN001, ANN201, ANN202, ANN204, B905, D101, D102, D103, T201
from __future__ import annotations

import re
import select
import socket
import struct
import sys

import numpy as np


class Port:
    def __init__(self, host, port):
        self.socket = socket.create_connection((host, int(port)))

    def send(self, text):
        self.socket.sendall(struct.pack(">I", len(text)) + text.encode())

    def receive(self):
        size = struct.unpack(">I", self.socket.recv(4, socket.MSG_WAITALL))[0]
        return self.socket.recv(size, socket.MSG_WAITALL).decode()

    def drain(self):
        while select.select([self.socket], [], [], 0.2)[0]:
            self.receive()


class Runner:
    """Turn the server's messages into observations, and those into joint speeds."""

    def __init__(self, path):
        self.p = dict(np.load(path))
        self.angles = np.zeros(len(self.p["joint_names"]))  # degrees, the server's signs
        self.loaded, self.counters, self.steps, self.features = np.zeros(2, bool), np.zeros(2), 0, None

    def perceive(self, message):
        joints = dict(re.findall(r"\(HJ \(n (\w+)\) *\(ax ([^)]+)\)\)", message))
        self.angles = np.array([float(joints[name]) for name in self.p["joint_names"]])
        feet = {n: c + " " + f for n, c, f in re.findall(r"\(FRP \(n (\w+)\) *\(c ([^)]+)\) *\(f ([^)]+)\)\)", message)}
        gyro, accel = re.search(r"\(rt ([^)]+)\)", message)[1], re.search(r"\(a ([^)]+)\)", message)[1]
        return [np.array(t.split(), float) for t in (gyro, accel, feet.get("lf", "0 " * 6), feet.get("rf", "0 " * 6))]

    def centre_of_mass(self):
        p = self.p
        turn, at = np.tile(np.eye(3), (len(p["body_mass"]), 1, 1)), np.zeros((len(p["body_mass"]), 3))
        chain = zip(*(p["chain_" + name] for name in ("joint", "body", "parent", "anchor", "axis")))
        for joint, body, parent, anchor, axis in chain:
            angle, cross = np.radians(self.angles[joint]), np.cross(np.eye(3), axis)
            turn[body] = turn[parent] @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
            hinge = p["body_offset"][body] - p["body_offset"][parent] + anchor
            at[body] = at[parent] + turn[parent] @ hinge - turn[body] @ anchor
        return p["body_mass"] @ at / p["body_mass"].sum()

    def observe(self, message, torso):
        """message: of the agent port; torso: (4, 4) world pose, current. Returns the observation."""
        gyro, accel, left, right = self.perceive(message)
        joints = np.radians(self.angles[self.p["action_index"]]) * self.p["action_sign"]
        yaw, height = np.arctan2(torso[1, 1], torso[0, 1]), torso[2, 3]
        blocks = [joints, [yaw], [height], self.centre_of_mass(), np.radians(gyro), accel]
        blocks += [left[:3], left[3:], right[:3], right[3:]]
        now, loaded = np.concatenate(blocks), np.array([right[3:].any(), left[3:].any()])
        rates = np.zeros(len(now)) if self.features is None else now - self.features
        rates[len(joints)] = (rates[len(joints)] + np.pi) % (2 * np.pi) - np.pi
        if self.features is not None:
            self.steps, self.counters = self.steps + 1, np.where(loaded & ~self.loaded, 0, self.counters + 1)
        self.features, self.loaded = now, loaded
        ends = np.cumsum([len(block) for block in blocks])[:-1]
        pairs = zip(np.split(now, ends), np.split(rates, ends))
        return np.concatenate([[self.steps], *(part for pair in pairs for part in pair), self.counters])

    def act(self, observation):
        """Return the target angles in radians, the server's order and signs."""
        p, hidden = self.p, np.clip((observation - self.p["mean"]) * self.p["scale"], -self.p["clip"], self.p["clip"])
        for i in range(p["layers"]):
            hidden = p[f"weights_{i}"] @ (np.tanh(hidden) if i else hidden) + p[f"bias_{i}"]
        targets, share = np.zeros(len(self.angles)), (np.clip(hidden, -1, 1) + 1) / 2
        targets[p["action_index"]] = (p["low_rad"] + share * (p["high_rad"] - p["low_rad"])) * p["action_sign"]
        return targets

    def command(self, targets):
        speeds = self.p["gain"] * (targets - np.radians(self.angles))
        speeds = np.clip(speeds, -self.p["max_speed"], self.p["max_speed"])
        return "".join(f"({name} {speed:.5f})" for name, speed in zip(self.p["effector_names"], speeds)) + "(syn)"


def torso_pose(scene):
    """Return the (4, 4) pose of the robot's torso in a full scene graph, None in one of changes alone."""
    before = re.findall(r"SLT ([^)]+)\)", scene.partition("naobody")[0])
    # the last matrix before the mesh turns the mesh, the one before it is the torso's, column after column
    return np.array(before[-2].split(), float).reshape(4, 4).T if "naobody" in scene else None


def main(path, host="127.0.0.1", agent_port="3100", monitor_port="3200"):
    runner, agent, monitor = Runner(path), Port(host, agent_port), Port(host, monitor_port)

    def cycle(command):
        monitor.send("(reqfullstate)")
        agent.send(command)
        return agent.receive(), torso_pose(monitor.receive())

    for greeting in (f"(scene rsg/agent/nao/nao_hetero.rsg {runner.p['robot_type']})", "(init (unum 1)(teamname A))"):
        agent.send(greeting + "(syn)")
        agent.receive()
    x, y, z, yaw = runner.p["start"]
    monitor.send(f"(playMode PlayOn)(ball (pos 14 9 0.05))(agent (unum 1)(team Left)(move {x} {y} {z} {yaw}))")
    monitor.drain()
    # a symmetric policy does not run from a perfectly symmetric start, which no training begins with
    pose = runner.p["start_pose_rad"] + np.radians(np.random.default_rng(0).uniform(-2, 2, len(runner.angles)))
    for _ in range(2 + int(runner.p["settling_cycles"])):
        message, torso = cycle(runner.command(pose))
        runner.perceive(message)
    begin = torso[0, 3]
    while torso[2, 3] > 0.25 and torso[0, 3] < 14 and runner.steps < 3000:
        message, torso = cycle(runner.command(runner.act(runner.observe(message, torso))))
    seconds = (runner.steps + 1) * runner.p["cycle_s"]
    print(f"{torso[0, 3] - begin:.2f} m in {seconds:.2f} s: {(torso[0, 3] - begin) / seconds:.2f} m/s")


if __name__ == "__main__":
    main(*sys.argv[1:])
