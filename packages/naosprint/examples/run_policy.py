"""Run an exported policy on a rcssserver3d in sync mode, alone on its field, with NumPy alone.

python run_policy.py policy.npz [host [agent port [monitor port]]]
"""

# ruff: noqa: ANN001, ANN201, ANN202, ANN204, B905, D102, D103, T201
from __future__ import annotations

import re
import select
import socket
import struct
import sys

import numpy as np


class Runner:
    """Turn a server's messages into observations, and those into joint speeds."""

    def __init__(self, path):
        self.p = dict(np.load(path))
        self.loaded, self.counters, self.steps, self.features = np.zeros(2, bool), np.zeros(2), 0, None

    def perceive(self, message):
        """Keep the joints' angles, degrees with the server's signs; return gyro, accelerometer, left and right foot."""
        joints, feet = (dict(re.findall(rf"\({tag} \(n (\w+)\) *(.*?)\)\)", message)) for tag in ("HJ", "FRP"))
        self.angles = np.array([float(joints[name].split()[1]) for name in self.p["joint_names"]])
        texts = [re.search(rf"\({tag} ([^)]+)\)", message)[1] for tag in ("rt", "a")]
        texts += [re.sub("[^-0-9. ]", "", feet.get(name, "0 " * 6)) for name in ("lf", "rf")]
        return [np.array(text.split(), float) for text in texts]

    def centre_of_mass(self):
        p, turn, at = self.p, [np.eye(3)] * len(self.p["body_mass"]), np.zeros((len(self.p["body_mass"]), 3))
        chain = zip(*(p["chain_" + name] for name in ("joint", "body", "parent", "anchor", "axis")))
        for joint, body, parent, anchor, axis in chain:
            angle, cross = np.radians(self.angles[joint]), np.cross(np.eye(3), axis)
            turn[body] = turn[parent] @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
            hinge = p["body_offset"][body] - p["body_offset"][parent] + anchor
            at[body] = at[parent] + turn[parent] @ hinge - turn[body] @ anchor
        return p["body_mass"] @ at / p["body_mass"].sum()

    def observe(self, message, torso):
        """Return the observation: `message` is the agent port's, `torso` the robot's (4, 4) pose on the field, now."""
        gyro, accel, left, right = self.perceive(message)
        joints = np.radians(self.angles[self.p["action_index"]]) * self.p["action_sign"]
        heading, height = [np.arctan2(torso[1, 1], torso[0, 1])], [torso[2, 3]]
        blocks = [joints, heading, height, self.centre_of_mass(), np.radians(gyro), accel]
        blocks += [left[:3], left[3:], right[:3], right[3:]]
        now, loaded = np.concatenate(blocks), np.array([right[3:].any(), left[3:].any()])
        rates = np.zeros(len(now)) if self.features is None else now - self.features
        rates[len(joints)] = (rates[len(joints)] + np.pi) % (2 * np.pi) - np.pi
        if self.features is not None:
            self.steps, self.counters = self.steps + 1, np.where(loaded & ~self.loaded, 0, self.counters + 1)
        self.features, self.loaded, ends = now, loaded, np.cumsum([len(block) for block in blocks])[:-1]
        pairs = zip(np.split(now, ends), np.split(rates, ends))
        return np.concatenate([[self.steps], *(part for pair in pairs for part in pair), self.counters])

    def act(self, observation):
        """Return the joints' target angles in radians, in the server's order and with its signs."""
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
    # the last matrix before the mesh turns the mesh, the one before it is the torso's, column after column
    before = re.findall(r"SLT ([^)]+)\)", scene.partition("naobody")[0])
    return np.array(before[-2].split(), float).reshape(4, 4).T if "naobody" in scene else None


def send(port, text):
    port.sendall(struct.pack(">I", len(text)) + text.encode())


def receive(port):
    return port.recv(struct.unpack(">I", port.recv(4, socket.MSG_WAITALL))[0], socket.MSG_WAITALL).decode()


def main(path, host="127.0.0.1", agent_port=3100, monitor_port=3200):
    runner = Runner(path)
    agent, monitor = (socket.create_connection((host, int(port))) for port in (agent_port, monitor_port))

    def cycle(command):
        send(monitor, "(reqfullstate)")
        send(agent, command)
        return receive(agent), torso_pose(receive(monitor))

    for greeting in (f"(scene rsg/agent/nao/nao_hetero.rsg {runner.p['robot_type']})", "(init (unum 1)(teamname A))"):
        send(agent, greeting + "(syn)")
        runner.perceive(receive(agent)) if "init" in greeting else receive(agent)
    place = "{} {} {} {}".format(*runner.p["start"])
    send(monitor, f"(playMode PlayOn)(ball (pos 14 9 0.05))(agent (unum 1)(team Left)(move {place}))")
    while select.select([monitor], [], [], 0.2)[0]:
        receive(monitor)
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
