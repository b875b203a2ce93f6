"""Run an exported policy of a T1 or K1 on rcssservermj, alone or among other robots; needs only NumPy.

python run_policy_t1.py policy.npz [host [agent port [monitor port [team [number [y of the lane]]]]]]
"""

import re
import select
import socket
import sys

import numpy as np

START_X, NOISE_DEG = -14.0, 2.0  # own half; a symmetric policy does not run from a perfectly symmetric start pose


class Runner:
    """Convert a server's messages to observations, and observations to commands."""

    def __init__(self, path, lane=0.0, side=1.0):  # side -1: the right team, whose field is turned by 180 degrees
        self.__dict__.update(np.load(path))
        self.field, self.lane, self.place, self.cycles = np.diag([side, side, 1]), lane, np.zeros(3), 0

    def perceive(self, message):
        """Store a message: joints in degrees and degrees per second, torso in the team's own field."""
        felt = re.findall(r"\((?:HJ|GYR|quat|pos) \(n (\w+)\)(.*?)\)\)", message)
        felt = {name: np.array(re.sub("[^-0-9. ]", "", text).split(), float) for name, text in felt}
        self.joints = np.array([felt["q_" + name.replace("e", "j")] for name in self.effector_names]).T
        self.gyro, cross = np.radians(felt["torso_gyro"]), np.cross(np.eye(3), felt["torso_quat"][1:])
        self.rotation = self.field @ (np.eye(3) + 2 * (felt["torso_quat"][0] * cross + cross @ cross))
        before, self.place, self.cycles = self.place, self.field @ felt["torso_pos"], self.cycles + 1
        self.velocity = self.rotation.T @ (self.place - before) / self.cycle_s

    def begin(self):
        """Begin an episode, without observations of earlier steps."""
        self.cycles, self.velocity, self.action = 0, np.zeros(3), np.zeros(len(self.action_names))

    def seen(self):
        """Return what can be observed; every number has a name."""
        seen = {"height": self.place[2], "line_offset": self.place[1] - self.lane}
        seen["heading_sin"], seen["heading_cos"] = self.rotation[1::-1, 0] / np.hypot(*self.rotation[:2, 0])
        for name, vector in ("gravity_", self.rotation[2]), ("gyro_", self.gyro), ("velocity_", self.velocity):
            seen.update(zip((name + axis for axis in "xyz"), vector))
        for name, values in zip(("", "speed_", "action_"), (*np.radians(self.joints) @ self.joint_view.T, self.action)):
            seen.update(zip((name + joint for joint in self.action_names), values))
        return seen

    def observe(self):
        return np.array([*map(self.seen().__getitem__, self.observation_names)])

    def act(self, observation):
        """Return the joints' target angles in radians."""
        values = np.clip((observation - self.mean) * self.scale, -self.clip, self.clip)
        for i in range(self.layers):
            values = getattr(self, f"weights_{i}") @ (np.tanh(values) if i else values) + getattr(self, f"bias_{i}")
        self.action = np.clip(values, -1, 1)
        return np.clip(self.middle_rad + self.reach_rad @ self.action, self.low_rad, self.high_rad)

    def command(self, targets):
        """Command all joints: one that was never commanded has a target from uninitialised memory."""
        joints = zip(self.effector_names, np.degrees(targets), self.kp, self.kd)
        return "".join(f"({name} {target:.4f} 0 {kp} {kd} 0)" for name, target, kp, kd in joints)


def send(port, text):
    port.sendall(len(text).to_bytes(4, "big") + text.encode())


def receive(port):
    size = port.recv(4, socket.MSG_WAITALL) or sys.exit("connection closed: is the robot's number taken?")
    return port.recv(int.from_bytes(size, "big"), socket.MSG_WAITALL).decode()


def main(path, host="127.0.0.1", agent_port=60000, monitor_port=60001, team="naosprint", number=2, lane=0.0):
    monitor, agent = (socket.create_connection((host, int(port))) for port in (monitor_port, agent_port))
    receive(monitor)  # a robot that enters before the first cycle would kill the server
    send(agent, f"(init {np.load(path)['model']} {team} {number})")
    runner = Runner(path, float(lane), -1.0 if f"(tr {team})" in receive(agent) else 1.0)
    send(monitor, "(ball (pos 25 16 0.11)(vel 0 0 0))")  # and so would a K1 that touches the ball

    def step(targets, beam=""):
        send(agent, beam + runner.command(targets))
        runner.perceive(receive(agent))
        while select.select([agent], [], [], 0)[0]:  # late in real time: the newest message counts
            runner.perceive(receive(agent))

    runner.start_pose_rad += np.radians(NOISE_DEG) * np.random.default_rng(0).uniform(-1, 1, len(runner.joint_names))
    for cycle in range(6 + runner.settling_cycles):
        step(runner.start_pose_rad, f"(beam {START_X} {runner.field[1, 1] * runner.lane} 0)" if cycle == 5 else "")
    monitor.shutdown(socket.SHUT_WR)  # closed with unread frames, it would be reset, which kills the server
    runner.begin()
    while runner.place[2] > 0.6 * runner.standing_height_m and runner.place[0] < -START_X and runner.cycles < 3000:
        step(runner.act(runner.observe()))
    agent.close()
    monitor.close()
    print(f"{runner.place[0] - START_X:.2f} m in {runner.cycles * runner.cycle_s:.2f} s")


if __name__ == "__main__":
    main(*sys.argv[1:])
