"""Run a T1 from point to point on a rcssservermj with a policy of task velocity; stand up after falls with another.

python play_t1.py run.npz [--getup getup.npz] [--tumble] [--targets 10] [--seed 0] [--host 127.0.0.1]
    [--team naosprint] [--number 2] [--ports 60000 60001] [--record cycles.npz]

NumPy alone; the messages and the policy's arrays are those of run_policy_t1.py beside it.
"""

import argparse
import select
import socket
import sys

import numpy as np
from run_policy_t1 import PolicyAgent, enter, read, receive, require_seen, require_start, send

START_X = -5.0
ARRIVED_M, FASTEST_MPS, TURN_RAD_S, PATIENCE_S = 0.4, 1.5, 1.0, 60.0
LYING, STANDING, UPRIGHT = 0.6, 0.88, 0.94  # of the standing height; upward component of the torso's z axis
TUMBLE_CYCLES, REST_CYCLES, REST_DEG = 50, 100, 30.0
GETUP_CYCLES, HOLD_CYCLES = 250, 25


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Player(PolicyAgent):
    """A robot that follows commands: forward and sideways speed in m/s, turn rate in rad/s."""

    def begin(self):
        super().begin()
        self.give((0.0, 0.0, 0.0))

    @property
    def yaw(self):
        return np.arctan2(self.rotation[1, 0], self.rotation[0, 0])

    def give(self, command):
        """Follow a new command; the path and the heading that count begin here."""
        self.asked, self.heading, self.offset = np.array(command), self.yaw, 0.0

    def perceive(self, message):
        before = self.place
        super().perceive(message)
        if hasattr(self, "asked"):
            moved = self.place - before
            self.offset += np.cos(self.heading) * moved[1] - np.sin(self.heading) * moved[0]
            self.offset -= self.asked[1] * self.cycle_s
            self.heading += self.asked[2] * self.cycle_s

    def seen(self):
        error = self.yaw - self.heading
        seen = super().seen() | dict(zip(("command_forward", "command_sideways", "command_turn"), self.asked))
        path = {"line_offset": np.clip(self.offset, -0.5, 0.5)}
        return seen | path | {"heading_sin": np.sin(error), "heading_cos": np.cos(error)}

    def steer(self, target):
        """Turn to a target, and run the faster the better it lies ahead."""
        way = target - self.place[:2]
        bearing = wrapped(np.arctan2(way[1], way[0]) - self.yaw)
        speed = min(FASTEST_MPS, max(0.5, np.hypot(*way))) * max(0.0, np.cos(bearing)) ** 2
        self.give((speed, 0.0, np.clip(1.5 * bearing, -TURN_RAD_S, TURN_RAD_S)))


class Riser(PolicyAgent):
    """A robot that gets up; it observes the time since it began."""

    def begin(self):
        super().begin()
        self.held, self.stood_s = 0, None

    @property
    def stands(self):
        return self.place[2] > STANDING * self.standing_height_m and self.rotation[2, 2] > UPRIGHT

    def perceive(self, message):
        super().perceive(message)
        if hasattr(self, "held"):
            self.held = self.held + 1 if self.stands else 0
            if self.held == HOLD_CYCLES and self.stood_s is None:
                self.stood_s = (self.cycles - HOLD_CYCLES + 1) * self.cycle_s

    def seen(self):
        time = min(self.cycles * self.cycle_s / 4, 1)
        waves = (("sin", np.sin), ("cos", np.cos))
        return (
            super().seen()
            | {f"time_{name}_{k}": f(np.pi * k * time) for name, f in waves for k in range(1, 7)}
            | {"time": time}
        )


def tumble(robot, step, rng):
    """Throw a robot over by random angles, and let it come to rest with limbs at random."""
    while robot.place[2] > LYING * robot.standing_height_m:
        wild, limbs = rng.uniform(robot.low_rad, robot.high_rad), rng.uniform(-1, 1, len(robot.low_rad))
        rest = np.clip(robot.start_pose_rad + np.radians(REST_DEG) * limbs, robot.low_rad, robot.high_rad)
        for cycle in range(TUMBLE_CYCLES + REST_CYCLES):
            step(robot, wild if cycle < TUMBLE_CYCLES else rest)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="exported policy of task velocity")
    parser.add_argument("--getup", help="exported policy of task getup")
    parser.add_argument("--tumble", action="store_true", help="throw the robot over before each target; needs --getup")
    parser.add_argument("--targets", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--team", default="naosprint")
    parser.add_argument("--number", type=int, default=2)
    parser.add_argument("--ports", type=int, nargs=2, default=(60000, 60001), metavar=("AGENT", "MONITOR"))
    parser.add_argument("--record", help="file for what the robot perceived of itself in each cycle")
    options = parser.parse_args(arguments)
    if options.tumble and not options.getup:
        parser.error("--tumble needs --getup, the policy that stands the robot up again")
    cycles, policy = [], read(options.run)
    if "command_forward" not in policy["observation_names"]:
        sys.exit(f"no run: {options.run}: follows no commands; a policy of task velocity is needed")
    if options.getup and read(options.getup)["model"] != policy["model"]:
        sys.exit(f"no run: {options.getup}: not for the robot of {options.run}")
    agent, monitor, side = enter(options.host, *options.ports, policy["model"], options.team, options.number)
    player = Player(options.run, side=side)
    getup = Riser(options.getup, side=side) if options.getup else None
    clock, falls, attempts = 0.0, 0, 0

    def step(who, targets, beam=""):
        nonlocal clock
        send(agent, beam + who.command(targets))
        while True:
            message = receive(agent)
            for each in filter(None, (player, getup)):
                each.perceive(message)
            clock += player.cycle_s
            cycles.append((player.place, player.rotation, np.radians(player.joints[0])))
            if not select.select([agent], [], [], 0)[0]:
                return

    for cycle in range(6 + player.settling_cycles):
        step(player, player.start_pose_rad, f"(beam {START_X} 0 0)" if cycle == 5 else "")
    monitor.shutdown(socket.SHUT_WR)  # closed with unread frames, it would be reset, which kills the server
    require_start(player, START_X, 0.0)
    player.begin()
    require_seen(player)
    rng, thrown = np.random.default_rng(options.seed), np.random.default_rng(options.seed)
    results = []
    for number, target in enumerate(rng.uniform((-12, -8), (12, 8), (options.targets, 2)), start=1):
        began, start = clock, player.place[:2].copy()
        standing = 0
        if options.tumble:
            tumble(player, step, thrown)
        while standing < 50 and clock < began + PATIENCE_S:
            if player.place[2] < LYING * player.standing_height_m:
                falls += 1
                if getup is None:
                    agent.close()
                    monitor.close()
                    raise SystemExit(f"the robot fell on the way to target {number}; --getup can stand it up")
                getup.begin()
                while getup.cycles < GETUP_CYCLES and getup.held < HOLD_CYCLES:
                    step(getup, getup.act(getup.observe()))
                attempts += 1
                player.begin()
            error = np.hypot(*(target - player.place[:2]))
            if error < ARRIVED_M or standing:
                if not standing:
                    player.give((0.0, 0.0, 0.0))
                standing += 1
            elif player.cycles % 5 == 0:
                player.steer(target)
            step(player, player.act(player.observe()))
        way, seconds = np.hypot(*(target - start)), clock - began
        results.append((standing >= 50, error))
        place = f"({target[0]:5.1f}, {target[1]:5.1f})"
        state = "reached" if standing >= 50 else "missed"
        print(f"{number:2}  {place}  {way:5.1f} m  {seconds:5.1f} s  {state}, {error:.2f} m away")
    agent.close()
    monitor.close()
    if options.record:
        np.savez(options.record, **dict(zip(("positions", "rotations", "angles"), map(np.array, zip(*cycles)))))
    reached = sum(good for good, _ in results)
    print(f"{reached} of {len(results)} targets reached, {falls} falls, {attempts} attempts to get up, {clock:.0f} s")
    return 0 if reached == len(results) else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError) as error:
        sys.exit(f"no run: {error}")
