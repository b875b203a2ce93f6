"""Try the behavior with the team code as it is: beam, take the start pose, run until the robot falls or has run 28 m.

python -m behaviors.custom.Naosprint.play --port 3100 --monitor-port 3200

The server must run in sync mode. By default orientation and height come from the monitor port, as in training; with
--localization from the team's localization.
"""

import argparse
import re
import select
import socket
import sys

import numpy as np
from agent.Base_Agent import Base_Agent
from behaviors.custom.Naosprint.Naosprint import FALLEN_M, Naosprint

START_X, LENGTH, LIMIT_S = -14.0, 28.0, 60.0


class MonitorPort:
    """Connection to the monitor port that asks for the scene in every cycle."""

    def __init__(self, host, port):
        self.socket, self.pose = socket.create_connection((host, port)), None
        self.turned = np.eye(4)  # on the right side the team's field is the server's turned by 180 degrees

    def receive(self):
        """Read one message; keep the torso's pose (4, 4) on the team's field if it has the whole scene."""
        size = int.from_bytes(self.socket.recv(4, socket.MSG_WAITALL), "big")
        data = self.socket.recv(size, socket.MSG_WAITALL) if size else b""
        if not size or len(data) < size:
            raise ConnectionError("the server closed the connection")
        scene = data.decode()
        if scene.count("naobody") > 1:
            sys.exit("no run: other robots are on the field, and the scene has no names; run alone")
        if "naobody" in scene:
            # The last matrix before the mesh turns the mesh; the one before it is the torso's, by columns.
            matrices = re.findall(r"SLT ([^)]+)\)", scene.partition("naobody")[0])
            self.pose = self.turned @ np.array(matrices[-2].split(), float).reshape(4, 4).T

    def catch_up(self):
        """Read all that has come: a server greets a monitor with several messages, at once or in its next cycle."""
        for _ in range(20):
            if not select.select([self.socket], [], [], 0.2)[0]:
                return
            self.receive()
        sys.exit("no run: the server runs in real time; start it in sync mode")

    def ask(self):
        """Request the whole scene of the next cycle, and read that of this one."""
        text = b"(reqfullstate)"
        self.socket.sendall(len(text).to_bytes(4, "big") + text)
        self.receive()

    def truth(self):
        """Return the torso's yaw in radians, its height and its position (2,) in metres."""
        return np.arctan2(self.pose[1, 1], self.pose[0, 1]), self.pose[2, 3], self.pose[:2, 3]


def main():
    """Read the options and run; a run that did not happen ends with one sentence and status 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=3100)
    parser.add_argument("--monitor-port", type=int, default=3200)
    parser.add_argument("--team", default="naosprint")
    parser.add_argument("--localization", action="store_true", help="use the team's localization")
    options = parser.parse_args()
    try:
        run(options)
    except OSError as error:
        sys.exit(f"no run: {error}")
    except SystemExit as ended:  # the team code ends with status 0 when the server refuses it or closes the connection
        sys.exit(ended.code or f"no run: the team code ended; is number 1 of team {options.team} taken?")


def run(options):
    """Run once; print the distance and the time."""
    if not re.fullmatch(r"[!-'*-~]+", options.team):
        sys.exit(f"no run: --team {options.team!r}: the server takes printable ASCII without spaces and parentheses")
    robot_type = int(np.load(__file__.replace("play.py", "policy.npz"))["robot_type"])
    agent = Base_Agent(
        options.host, options.port, options.monitor_port, 1, robot_type, options.team, False, False, False, False
    )
    skill = Naosprint(agent)
    agent.behavior.behaviors["Naosprint"] = (skill.description, skill.auto_head, skill.execute, skill.is_ready)
    monitor, robot = MonitorPort(options.host, options.monitor_port), agent.world.robot
    if not agent.world.team_side_is_left:
        monitor.turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    if not options.localization:
        skill.pose = monitor.truth
    agent.scom.unofficial_set_play_mode("PlayOn")
    agent.scom.unofficial_move_ball((14, 9, 0.05))
    agent.scom.unofficial_beam((START_X, 0, skill.runner.standing_height_m + skill.runner.drop_m), 0)
    settled, cycle = 2 + int(skill.runner.settling_cycles), 0

    def step():
        agent.scom.commit_and_send(robot.get_command())
        agent.scom.receive()

    skill.hold()
    step()
    monitor.catch_up()
    while True:
        if cycle == settled:
            start, (x, y, z) = monitor.pose[0, 3], monitor.pose[:3, 3]
            if np.hypot(x - START_X, y) > 0.5 or z < FALLEN_M:
                sys.exit(
                    f"no run: the robot is at ({x:.1f}, {y:.1f}, {z:.2f}), not upright at ({START_X}, 0): the server "
                    "did not follow the monitor's move"
                )
        seconds = (cycle - settled) * float(skill.runner.cycle_s)
        if cycle < settled:
            skill.hold()
        elif monitor.pose[2, 3] < FALLEN_M or monitor.pose[0, 3] > start + LENGTH or seconds > LIMIT_S:
            break
        else:
            agent.behavior.execute("Naosprint", 0.0)
        step()
        monitor.ask()
        cycle += 1
    x, z = monitor.pose[0, 3], monitor.pose[2, 3]
    print(f"{x - start:.2f} m in {seconds:.2f} s, {'fallen' if z < FALLEN_M else 'upright'}")


if __name__ == "__main__":
    main()
