"""Run an exported policy of a T1 or K1 on rcssservermj, alone or among other robots; needs only NumPy.

python run_policy_t1.py policy.npz [host [agent port [monitor port [team [number [y of the lane]]]]]]
"""

import re
import select
import socket
import sys
import zipfile

import numpy as np

START_X, LENGTH = -14.0, 28.0
NOISE_DEG = 2.0  # a symmetric policy does not run from a perfectly symmetric start pose
BEAM_MODES = "BeforeKickOff", "Goal_Left", "Goal_Right"


def read(path):
    """Return the arrays of a policy; end the program if they are not those of a T1's or K1's."""
    with open(path, "rb") as file:
        arrays = dict(np.load(path)) if zipfile.is_zipfile(file) else {}
    if "model" not in arrays:
        sys.exit(f"no run: {path}: not the policy.npz of a T1 or K1, which `naosprint export` writes")
    return arrays


class PolicyAgent:
    """Convert a server's messages to observations, and observations to commands."""

    def __init__(self, path, lane=0.0, side=1.0):  # side -1: the right team, whose field is turned by 180 degrees
        self.__dict__.update(np.load(path))
        self.field, self.lane, self.place, self.cycles = np.diag([side, side, 1]), lane, np.zeros(3), 0

    def perceive(self, message):
        """Store a message: joints in degrees and degrees per second, torso in the team's own field."""
        self.play_mode = re.search(r"\(pm (\w+)\)", message)[1]
        felt = re.findall(r"\((?:HJ|GYR|quat|pos) \(n (\w+)\)(.*?)\)\)", message)
        felt = {name: np.array(re.sub("[^-0-9. ]", "", text).split(), float) for name, text in felt}
        self.joints = np.array([felt["q_" + name.replace("e", "j")] for name in self.effector_names]).T
        self.gyro, cross = np.radians(felt["torso_gyro"]), np.cross(np.eye(3), felt["torso_quat"][1:])
        self.rotation = self.field @ (np.eye(3) + 2 * (felt["torso_quat"][0] * cross + cross @ cross))
        before, self.place, self.cycles = self.place, self.field @ felt["torso_pos"], self.cycles + 1
        self.velocity = self.rotation.T @ (self.place - before) / self.cycle_s

    def begin(self):
        """Begin an episode, without observations of earlier steps."""
        self.cycles, self.past, self.velocity, self.action = 0, [], np.zeros(3), np.zeros(len(self.action_names))

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
        self.past = [self.seen(), *self.past[:99]]  # the latest first; steps before an episode are like its first
        names = (name.partition("_ago") for name in self.observation_names)
        return np.array([self.past[min(int(ago or 0), len(self.past) - 1)][name] for name, _, ago in names])

    def act(self, observation):
        """Return the joints' target angles in radians."""
        values = np.clip((observation - self.mean) * self.scale, -self.clip, self.clip)
        for i, kind in enumerate(self.activations):
            values = getattr(self, f"weights_{i}") @ values + getattr(self, f"bias_{i}")
            values = {"tanh": np.tanh(values), "relu": np.maximum(values, 0), "linear": values}[str(kind)]
        self.action = np.clip(values, -1, 1)
        return np.clip(self.middle_rad + self.reach_rad @ self.action, self.low_rad, self.high_rad)

    def command(self, targets):
        """Command all joints: one that was never commanded has a target from uninitialised memory."""
        joints = zip(self.effector_names, np.degrees(targets), self.kp, self.kd)
        return "".join(f"({name} {target:.4f} 0 {kp} {kd} 0)" for name, target, kp, kd in joints)


def send(port, text):
    data = text.encode()
    port.sendall(len(data).to_bytes(4, "big") + data)


def receive(port):
    size = int.from_bytes(port.recv(4, socket.MSG_WAITALL), "big")
    data = port.recv(size, socket.MSG_WAITALL) if size else b""
    if not size or len(data) < size:
        raise ConnectionError("the server closed the connection")
    return data.decode()


def enter(host, agent_port, monitor_port, model, team, number):
    """Enter the field and put the ball aside; return both connections, and 1.0 on the left side, -1.0 on the right."""
    if not re.fullmatch(r"[^\s()]+", team):
        sys.exit(f"no run: team {team!r}: a name without spaces and parentheses is needed")
    monitor, agent = (socket.create_connection((host, int(port))) for port in (monitor_port, agent_port))
    receive(monitor)  # a robot that enters before the first cycle would kill the server
    try:
        send(agent, f"(init {model} {team} {number})")
        reply = receive(agent)
    except ConnectionError:
        sys.exit(f"no run: refused: is number {number} of team {team} taken, or are two other teams on the field?")
    send(monitor, "(ball (pos 25 16 0.11)(vel 0 0 0))")  # and so would a K1 that touches the ball
    return agent, monitor, -1.0 if f"(tr {team})" in reply else 1.0


def require_start(runner, x, y):
    """End the program unless the robot stands where it was beamed to."""
    away, standing = np.hypot(*(runner.place[:2] - (x, y))), runner.place[2] > 0.6 * runner.standing_height_m
    if runner.play_mode not in BEAM_MODES or away > 0.5 or not standing:
        place, state = "({:.1f}, {:.1f})".format(*runner.place[:2]), "stands" if standing else "lies"
        sys.exit(
            f"no run: the robot {state} at {place}, not at ({x:.1f}, {y:.1f}), in play mode {runner.play_mode}; "
            f"it can be beamed in {', '.join(BEAM_MODES)}"
        )


def require_seen(runner):
    """End the program if the policy observes what this program does not compute, such as a command or a ball."""
    if unseen := {name.partition("_ago")[0] for name in runner.observation_names} - runner.seen().keys():
        sys.exit(f"no run: the policy observes {', '.join(sorted(unseen)[:3])}, which this program does not compute")


def main(path, host="127.0.0.1", agent_port=60000, monitor_port=60001, team="naosprint", number=2, lane=0.0):
    agent, monitor, side = enter(host, agent_port, monitor_port, read(path)["model"], team, number)
    runner = PolicyAgent(path, float(lane), side)

    def step(targets, beam=""):
        send(agent, beam + runner.command(targets))
        runner.perceive(receive(agent))
        while select.select([agent], [], [], 0)[0]:  # late in real time: the newest message counts
            runner.perceive(receive(agent))

    runner.start_pose_rad += np.radians(NOISE_DEG) * np.random.default_rng(0).uniform(-1, 1, len(runner.joint_names))
    for cycle in range(6 + runner.settling_cycles):
        step(runner.start_pose_rad, f"(beam {START_X} {runner.field[1, 1] * runner.lane} 0)" if cycle == 5 else "")
    monitor.shutdown(socket.SHUT_WR)  # closed with unread frames, it would be reset, which kills the server
    require_start(runner, START_X, runner.lane)
    runner.begin()
    require_seen(runner)
    start, lowest = runner.place[0], 0.6 * runner.standing_height_m
    while runner.place[2] > lowest and runner.place[0] < start + LENGTH and runner.cycles < 3000:
        step(runner.act(runner.observe()))
    agent.close()
    monitor.close()
    print(f"{runner.place[0] - start:.2f} m in {runner.cycles * runner.cycle_s:.2f} s")


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 8 or sys.argv[1] in ("-h", "--help"):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(f"no run: {error}")
