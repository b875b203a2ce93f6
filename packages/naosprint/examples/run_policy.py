"""Run an exported policy on rcssserver3d in sync mode, as the only robot; needs only NumPy.

python run_policy.py policy.npz [host [agent port [monitor port]]]
"""

import re
import select
import socket
import sys
import zipfile

import numpy as np

FALLEN_M = 0.25
# where the robot starts, metres, the direction it faces: +x, and how far it runs
START, YAW_DEG, LENGTH = (-14.0, 0.0), -90.0, 28.0


def require(path):
    """End the program unless a file is the policy of a NAO that it can run."""
    with open(path, "rb") as file:
        arrays = dict(np.load(path)) if zipfile.is_zipfile(file) else {}
    if "robot_type" not in arrays:
        sys.exit(f"no run: {path}: not the policy.npz of a NAO, which `naosprint export` writes")
    if "onboard_landmarks" in arrays:
        sys.exit(f"no run: {path}: observes what the robot senses, not where it is; use the exported skill")


class PolicyAgent:
    """Convert a server's messages to observations, and observations to joint speeds."""

    def __init__(self, path):
        self.__dict__.update(np.load(path), features=None, past=[])

    def perceive(self, message):
        """Store the joint angles in degrees, gyro, accelerometer, and centre and force of left and right foot."""
        felt = re.findall(r"\((\w+) \(n (\w+)\)(.*?)\)\)", message)
        felt = {tag + name: np.array(re.sub("[^-0-9. ]", "", text).split(), float) for tag, name, text in felt}
        self.angles = np.array([felt["HJ" + name][0] for name in self.joint_names])
        self.felt = [np.radians(felt["GYRtorso"]), felt["ACCtorso"], *(felt.get(f"FRP{s}f", np.zeros(6)) for s in "lr")]

    def centre_of_mass(self):
        turn, at = [np.eye(3)] * len(self.body_mass), np.zeros((len(self.body_mass), 3))
        for joint, body, parent, offset, anchor, axis in self.chain:
            angle, cross = np.radians(self.angles[joint]), np.cross(np.eye(3), axis)
            turn[body] = turn[parent] @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
            at[body] = at[parent] + turn[parent] @ offset - turn[body] @ anchor
        return self.body_mass @ at / self.body_mass.sum()

    def observe(self, message, torso):
        """Return the observation: `message` is the agent port's, `torso` the robot's (4, 4) pose on the field, now."""
        self.perceive(message)
        joints, place = self.joint_view @ np.radians(self.angles), [np.arctan2(torso[1, 1], torso[0, 1]), torso[2, 3]]
        now = np.concatenate([joints, place, self.centre_of_mass(), *self.felt])
        loaded = np.array([self.felt[3][3:].any(), self.felt[2][3:].any()])
        if self.features is None:
            self.features, self.loaded, self.steps, self.counters = now, loaded, -1, np.array([-1, -1])
            self.position = torso[:2, 3]
        rates = now - self.features
        rates[len(joints)] = (rates[len(joints)] + np.pi) % (2 * np.pi) - np.pi
        self.steps, self.counters = self.steps + 1, np.where(loaded & ~self.loaded, 0, self.counters + 1)
        self.features, self.loaded = now, loaded
        velocity = (torso[:2, 3] - self.position) / self.cycle_s if self.sees_velocity else []
        self.position = torso[:2, 3]
        seen = np.concatenate([[self.steps], np.append(now, rates)[self.observation_index], self.counters, velocity])
        self.past = [seen, *(self.past or [seen] * 99)[:98]]  # the latest first; steps before the first are like it
        return np.concatenate(self.past[: len(self.mean) // len(seen)])

    def act(self, observation):
        """Return the joints' target angles in radians, in the server's order and with its signs."""
        values = np.clip((observation - self.mean) * self.scale, -self.clip, self.clip)
        for i, kind in enumerate(self.activations):
            values = getattr(self, f"weights_{i}") @ values + getattr(self, f"bias_{i}")
            values = {"tanh": np.tanh(values), "relu": np.maximum(values, 0), "linear": values}[str(kind)]
        return np.clip(self.middle_rad + self.reach_rad @ np.clip(values, -1, 1), self.low_rad, self.high_rad)

    def command(self, targets):
        speeds = np.clip(self.gain * (targets - np.radians(self.angles)), -self.max_speed, self.max_speed)
        return "".join(f"({name} {speed:.5f})" for name, speed in zip(self.effector_names, speeds)) + "(syn)"


def torso_pose(scene):
    """Return the (4, 4) pose of the robot's torso in a full scene graph, None for an incremental one."""
    if scene.count("naobody") > 1:
        sys.exit("no run: other robots are on the field, and the scene has no names; run alone")
    # the last matrix before the mesh turns the mesh, the one before it is the torso's, column after column
    before = re.findall(r"SLT ([^)]+)\)", scene.partition("naobody")[0])
    return np.array(before[-2].split(), float).reshape(4, 4).T if "naobody" in scene else None


def ask(port, text):
    data = text.encode()
    port.sendall(len(data).to_bytes(4, "big") + data)
    return receive(port)


def receive(port):
    size = int.from_bytes(port.recv(4, socket.MSG_WAITALL), "big")
    data = port.recv(size, socket.MSG_WAITALL) if size else b""
    if not size or len(data) < size:
        raise ConnectionError("the server closed the connection")
    return data.decode()


def enter(agent, robot_type):
    """Enter the field as number 1 of team A; return the first message and the side, Left or Right."""
    try:
        ask(agent, f"(scene rsg/agent/nao/nao_hetero.rsg {robot_type})(syn)")
        message = ask(agent, "(init (unum 1)(teamname A))(syn)")
        for _ in range(5):
            side = re.search(r"\(team (left|right)\)", message)
            if side:
                return message, side[1].capitalize()
            message = ask(agent, "(syn)")
    except ConnectionError:
        pass
    sys.exit("no run: refused: is number 1 of team A taken, or are two other teams on the field?")


def main(path, host="127.0.0.1", agent_port=3100, monitor_port=3200):
    require(path)
    runner = PolicyAgent(path)
    agent, monitor = (socket.create_connection((host, int(port))) for port in (agent_port, monitor_port))
    message, side = enter(agent, runner.robot_type)
    torso, (x, y), z = None, START, runner.standing_height_m + runner.drop_m
    ask(monitor, f"(playMode PlayOn)(ball (pos 14 9 0.05))(agent (unum 1)(team {side})(move {x} {y} {z} {YAW_DEG}))")
    for _ in range(20):
        if not select.select([monitor], [], [], 0.2)[0]:
            break
        receive(monitor)
    else:
        sys.exit("no run: the server runs in real time; start it in sync mode")

    def step(targets):
        nonlocal message, torso
        # a full scene is requested one cycle ahead
        message, torso = ask(agent, runner.command(targets)), torso_pose(ask(monitor, "(reqfullstate)"))

    # a symmetric policy does not run from a perfectly symmetric start, which training never has
    pose = runner.start_pose_rad + np.radians(np.random.default_rng(0).uniform(-2, 2, len(runner.start_pose_rad)))
    for _ in range(2 + runner.settling_cycles):
        runner.perceive(message)
        step(pose)
    start, cycle = torso[:3, 3], 0
    if np.hypot(*(start[:2] - START)) > 0.5 or start[2] < FALLEN_M:
        at = "({:.1f}, {:.1f}, {:.2f})".format(*start)
        sys.exit(f"no run: the robot is at {at}, not upright at {START}: the server did not follow the monitor's move")
    while torso[2, 3] > FALLEN_M and torso[0, 3] < start[0] + LENGTH and cycle < 3000:
        step(runner.act(runner.observe(message, torso)))
        cycle += 1
    seconds, metres = cycle * runner.cycle_s, torso[0, 3] - start[0]
    print(f"{metres:.2f} m in {seconds:.2f} s: {metres / seconds:.2f} m/s")


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 5 or sys.argv[1] in ("-h", "--help"):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(f"no run: {error}")
