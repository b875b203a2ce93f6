"""Try the skill with the team code as it is: beam, take the start pose, run until the robot falls or has run 28 m.

python -m mujococodebase.skills.naosprint.play --port 60000 --monitor-port 60001
"""

import argparse
import re
import socket
import sys

import numpy as np
from mujococodebase.agent import Agent
from mujococodebase.robot import Robot
from mujococodebase.skills.naosprint.skill import FALLEN, Naosprint

START_X, LENGTH, LIMIT_S = -14.0, 28.0, 60.0


class K1(Robot):
    """Booster K1, with the effectors of the policy."""

    name = "K1"
    ROBOT_MOTORS = ()


class Runs:
    """What the agent decides: to beam, to stand, to run."""

    def __init__(self, agent, skill, lane):
        self.agent, self.skill, self.lane, self.cycle = agent, skill, lane, 0
        self.settled = 6 + int(skill.runner.settling_cycles)

    def update_current_behavior(self):
        """Do what is next."""
        self.cycle += 1
        if self.cycle == 5:
            # the server does not turn y for the team on the right side
            y = self.lane if self.agent.world.is_left_team else -self.lane
            self.agent.server.commit_beam((START_X, y), 0)
        if self.cycle <= self.settled:
            self.skill.hold()
        else:
            self.agent.skills_manager.execute("Naosprint", orientation=0.0, lane=(START_X, self.lane))
        self.agent.robot.commit_motor_targets_pd()

    @property
    def seconds(self):
        """Seconds since the start of the run."""
        return (self.cycle - self.settled) * float(self.skill.runner.cycle_s)


def main():
    """Read the options and run; a run that did not happen ends with one sentence and status 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=60000)
    parser.add_argument("--monitor-port", type=int, help="to move the ball away, which a K1 must not touch")
    parser.add_argument("--team", default="naosprint")
    parser.add_argument("--number", type=int, default=2)
    parser.add_argument("--lane", type=float, default=0.0, help="y of the line to run along, in meters")
    options = parser.parse_args()
    try:
        run(options)
    except ConnectionResetError:
        sys.exit(
            f"no run: the server closed the connection: is number {options.number} of team {options.team} taken, are "
            "two other teams on the field, or has the server ended?"
        )
    except OSError as error:
        sys.exit(f"no run: {error}")


def run(options):
    """Run once; print the distance and the time."""
    if not re.fullmatch(r"[!-'*-~]+", options.team):
        sys.exit(f"no run: --team {options.team!r}: the team code sends ASCII without spaces and parentheses only")
    if options.monitor_port:
        with socket.create_connection((options.host, options.monitor_port)) as monitor:
            monitor.recv(1)  # the server's first cycle
            text = b"(ball (pos 25 16 0.11)(vel 0 0 0))"
            monitor.sendall(len(text).to_bytes(4, "big") + text)
            monitor.shutdown(socket.SHUT_WR)
            while monitor.recv(1 << 16):  # closed with unread frames, it would be reset, which kills the server
                pass
    agent = Agent(options.team, options.number, options.host, options.port)
    skill = Naosprint(agent)
    if str(skill.runner.model) != agent.robot.name:
        K1.ROBOT_MOTORS = tuple(skill.effectors)
        agent.robot = K1(agent)
    agent.skills_manager.skills["Naosprint"] = skill
    agent.decision_maker = runs = Runs(agent, skill, options.lane)
    agent.server.connect()
    agent.server.send_immediate(f"(init {agent.robot.name} {options.team} {options.number})")
    fallen = FALLEN * skill.runner.standing_height_m
    while True:
        agent.server.receive()
        agent.world.update()
        x, y, z = agent.world.global_position
        if runs.cycle == runs.settled:
            start = x
            if np.hypot(x - START_X, y - options.lane) > 0.5 or z < fallen:
                sys.exit(
                    f"no run: the robot is at ({x:.1f}, {y:.1f}, {z:.2f}), not upright at ({START_X}, {options.lane}); "
                    "the server lets robots beam before kick-off and after a goal only"
                )
        if runs.seconds > 0 and (z < fallen or x > start + LENGTH):
            break
        if runs.seconds > LIMIT_S:
            break
        runs.update_current_behavior()
        agent.server.send()
    state = "fallen" if z < fallen else "upright"
    print(f"{x - start:.2f} m in {runs.seconds:.2f} s, {state}")


if __name__ == "__main__":
    main()
