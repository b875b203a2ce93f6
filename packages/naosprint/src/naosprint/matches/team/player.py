"""A soccer player on rcssservermj: kicks the ball at the goal, keeps its own, gets up after falls. Needs only NumPy.

    python player.py HOST PORT TEAM NUMBER [PLAYERS]

Beside this file are the exported skills walk.npz, kick.npz, keep.npz and getup.npz and runner.py, which runs them. The
player uses nothing but what its robot sees, feels and hears from teammates. Everything is in metres, radians and
seconds on the team's own field: the team plays in the direction of +x, whatever side it has.
"""

import base64
import re
import select
import socket
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
from runner import Runner, wrapped

CYCLE_S = 0.02
GOAL, POST = np.array([27.5, 0.0]), np.array([0.0, 1.83])  # the opponents'; ours is at -GOAL
NARROW, BEFORE_GOAL = np.radians(17), np.array([24.0, 0.0])  # a goal that looks narrower is missed: to this place
PASS_M, ROLL_M = 8.5, 3.0  # below this kicks are soft and go straighter; how much farther than the goal they go
CIRCLE_M = 5.5  # nearer than this to the ball, the referee takes opponents of a free kick off the field
HOMES = {
    1: (-25.0, 0.0),
    2: (-1.2, 0.0),
    3: (-3.0, 3.0),
    4: (-3.0, -3.0),
    5: (-10.0, 8.0),
    6: (-10.0, -8.0),
    7: (-14.0, 1.5),
}
FASTEST_MPS, KICKED_MPS = 12.0, 1.5  # speed of a ball that no referee moves, and change of speed by a kick
LYING_M, UPRIGHT = 0.45, 0.6  # height of the torso, upward part of its z axis
KICK_AHEAD_M, KICK_ASIDE_M, KICK_AIM = (0.38, 0.85), 0.2, np.radians(15)
NEAR_AIM = np.radians(25)  # turned to the aim as far as this, the striker walks straight to the ball
KICK_CYCLES, STAND_CYCLES, SEARCH_S = 130, 15, 1.0
KEEPER_M, KEEP_CYCLES, CALM_CYCLES = 1.0, 400, 50  # how far before its goal the keeper waits
SHOT_MPS, SHOT_S, WIDE_M = 1.0, 4.0, 2.5  # a ball as fast, which is at the goal line as soon and no farther aside
AT_GOAL_M, FACES = (2.0, 2.5), np.radians(45)  # the keeper's place and direction in which it can keep
BEHIND_M = 0.75  # how far behind the ball the striker turns to it
AROUND, AROUND_STEP = 0.35, 0.9  # this far from right behind it, the striker walks around it, by so much at a time
BRAKE_MPS2, BRAKE_BEFORE_M = 1.5, 0.6  # how the walker slows down, and how far before a point it is done
SIDESTEP_M, SIDESTEP_M_PER_RAD = 0.7, 0.5  # nearer than this, and farther for what is left to turn, it sidesteps
WALK_PER_S, TURN_PER_S, STEP_BACK_MPS = 1.5, 2.5, 0.4  # speeds for distances and angles to go, and backward
LOOK_DOWN, LOOK_AHEAD = 0.6, 0.25  # pitch of the head
TOUCHED, TAKEN_M = 200.0, 2.0  # cost of touching the ball twice; who takes a set piece is at most so far from the ball
SAY_CYCLES, SAYS = 20, struct.Struct("<Bhhhhb")  # who, own place and that of the ball in cm, age of the latter in 0.1 s
ROOM_M, WARNING_M = 0.9, 1.8  # how far from others the player walks, and from what distance on it makes a detour

NUMBER = r"(-?[\d.]+(?:e-?\d+)?)"
JOINT = re.compile(rf"\(HJ \(n (\w+)\)\(ax {NUMBER}\)\(vx {NUMBER}\)\)")
TORSO = re.compile(r"\(n torso_(?:quat|pos|gyro)\) ?\((?:q|p|rt) ([^)]*)\)")
BALL = re.compile(rf"\(B \(pol {NUMBER} {NUMBER} {NUMBER}\)\)")
ROBOT = re.compile(rf"\(P \(team ([^)]*)\) ?\(id (\d+)\) ?\(head \(pol {NUMBER} {NUMBER} {NUMBER}\)\)")
HEARD = re.compile(r"\(-?\d+ ([A-Za-z0-9+/]{14}==)\)")
GAME = re.compile(r"\(pm (\w+)\)(?:\(tl ([^)]*)\))?(?:\(tr ([^)]*)\))?")


def turned(angle):
    """Return the unit vector of a direction."""
    return np.array([np.cos(angle), np.sin(angle)])


def angle_of(way):
    """Return the direction of a vector."""
    return np.arctan2(way[1], way[0])


class Memory:
    """What the robot perceives and remembers."""

    def __init__(self, team, number, camera):
        self.team, self.number, self.camera = team, number, camera
        self.side, self.now, self.ball_at, self.robots = 0, 0.0, -1e9, {}
        self.sign = zlib.crc32(team.encode()) & 0xF0  # in the messages of the team, beside the number
        self.ball, self.seen, self.velocity, self.mode = np.zeros(2), None, np.zeros(2), "BeforeKickOff"

    def perceive(self, message, names):
        """Read one message of the server."""
        self.now += CYCLE_S
        game = GAME.search(message)
        self.mode, left = game[1], game[2]
        self.side = 1.0 if left == self.team else -1.0
        field = np.array([self.side, self.side, 1.0])
        joints = {name: (float(angle), float(speed)) for name, angle, speed in JOINT.findall(message)}
        self.angles, self.speeds = np.array([joints[name] for name in names]).T
        values = [np.array(text.split(), float) for text in TORSO.findall(message)]
        self.quaternion, self.position, self.gyro = values
        self.position = field * self.position
        if self.side < 0:  # turned by 180 degrees about z: (0, 0, 0, 1) times q
            w, x, y, z = self.quaternion
            self.quaternion = np.array([-z, -y, x, w])
        w, x, y, z = self.quaternion
        self.yaw = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        self.up = 1 - 2 * (x * x + y * y)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        self.rotation = np.eye(3) + 2 * (w * cross + cross @ cross)
        self.see(message)
        self.hear(message)

    def hear(self, message):
        """Note what teammates say of themselves, and of the ball if it was not seen here lately."""
        for text in HEARD.findall(message):
            who, x, y, ball_x, ball_y, age = SAYS.unpack(base64.b64decode(text))
            if who & 0xF0 == self.sign and who & 0xF != self.number:
                self.robots[True, who & 0xF] = (np.array([x, y]) / 100, self.now)
                if 0 <= age / 10 < self.now - self.ball_at - 0.5:
                    self.ball, self.ball_at = np.array([ball_x, ball_y]) / 100, self.now - age / 10
                    self.velocity = np.zeros(2)

    def say(self):
        """Return the message to the teammates."""
        age = min(127, round(10 * (self.now - self.ball_at)))
        places = np.clip(np.rint(100 * np.concatenate([self.position[:2], self.ball])), -9999, 9999).astype(int)
        data = SAYS.pack(self.sign | self.number, *map(int, places), age if age < 127 else -1)
        return f"(SPK say 100 {base64.b64encode(data).decode()})"

    def see(self, message):
        """Note where ball and robots are."""
        ball = BALL.search(message)
        self.seen = None if ball is None else np.array(ball.groups(), float)
        if self.seen is not None:
            place, since = self.in_field(self.seen), self.now - self.ball_at
            velocity = (place - self.ball) / max(since, CYCLE_S)
            if since < 0.3 and np.hypot(*velocity) < FASTEST_MPS:
                change = velocity - self.velocity  # noise, or a kick
                self.velocity = self.velocity + (0.3 if np.hypot(*change) < KICKED_MPS else 1.0) * change
            else:  # another moment, or the referee has moved it
                self.velocity = np.zeros(2)
            self.ball, self.ball_at = place, self.now
        for team, number, *polar in ROBOT.findall(message):
            self.robots[team == self.team, int(number)] = (self.in_field(np.array(polar, float)), self.now)

    def in_field(self, polar):
        """Return where something is that the camera sees at (distance, azimuth, elevation in degrees)."""
        yaw, pitch = np.radians(self.angles[:2])
        distance, azimuth, elevation = polar + np.copysign(0.005, polar)  # the server truncates
        azimuth, elevation = np.radians([azimuth, elevation])
        level = distance * np.cos(elevation)
        seen = np.array([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)])
        (c, s), (d, z) = (np.cos(yaw), np.sin(yaw)), (np.cos(pitch), np.sin(pitch))
        turn, nod = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([[d, 0, z], [0, 1, 0], [-z, 0, d]])
        at_yaw, at_pitch, at_camera = self.camera
        in_torso = at_yaw + turn @ (at_pitch + nod @ (at_camera + seen))
        return self.position[:2] + (self.rotation @ in_torso)[:2]

    def mates(self, age_s=3.0):
        """Return where teammates were seen lately, by number."""
        return {number: place for (own, number), (place, at) in self.robots.items() if own and self.now - at < age_s}

    def others(self, age_s=1.0):
        """Return where other robots of both teams are."""
        return [place for place, at in self.robots.values() if self.now - at < age_s]

    @property
    def ours(self):
        """1 if a set piece is ours, -1 if it is theirs, 0 while the ball is in play."""
        for name, side in (("left", 1.0), ("right", -1.0)):
            if self.mode.lower().endswith("_" + name) and not self.mode.startswith("Goal_"):
                return self.side * side
        return 0.0


class Player:
    """One player: decides every cycle what its robot does, and which skill does it."""

    def __init__(self, folder, team, number, players):
        self.number, self.players = number, players
        skills = ("walk", "kick", "keep", "getup")
        self.walk, self.kick, self.keep, self.getup = (Runner(folder / f"{name}.npz") for name in skills)
        names = [name.replace("e", "j") for name in map(str, self.walk.effector_names)]
        self.joints = ["q_" + name for name in names]
        self.world = Memory(team, number, self.kick.camera_m)
        self.active, self.command, self.since, self.stood = self.walk, np.zeros(3), 0, 0
        self.rest, self.mode, self.taker, self.taken_at = 0, "", None, -1e9
        self.settling, self.cycles, self.calm = 0, 2 * number, 0
        self.searched, self.turn = -1, 1.0

    # --- what to do -----------------------------------------------------------------------------------------------

    def decide(self):
        """Return the text that answers the latest message."""
        world, beam = self.world, ""
        self.cycles += 1
        if self.players > 1 and self.cycles % SAY_CYCLES == 0:
            beam = world.say()
        if world.mode != self.mode:
            self.note_set_piece()
            self.beams = 2 if world.mode in ("BeforeKickOff", "Goal_Left", "Goal_Right") else 0
            self.mode = world.mode
        if self.beams and world.now > 0.1:
            self.beams -= 1
            x, y = self.home()
            beam += f"(beam {x:.2f} {world.side * y:.2f} 0)"
            self.settling = int(self.walk.settling_cycles)
        if self.settling:
            self.settling -= 1
            self.change(self.walk)  # which begins from this pose
            self.rest = STAND_CYCLES
            return beam + self.commands(self.walk, self.walk.start_targets)
        lies = world.position[2] < LYING_M or world.up < UPRIGHT
        if self.active is self.getup:
            self.stood = self.stood + 1 if world.position[2] > 0.58 and world.up > 0.94 else 0
            if self.stood > 20 or (self.since > 260 and not lies):
                self.change(self.walk)
                self.rest = STAND_CYCLES
            elif self.since > 260:
                self.change(self.getup)
        elif lies and not self.beams:
            self.change(self.getup)
        elif self.active is self.kick and (self.kick.kicked or self.since > KICK_CYCLES):
            self.change(self.walk, after=self.kick)
            self.rest = STAND_CYCLES
        elif self.active is self.keep and self.shot_is_over():
            self.change(self.walk, after=self.keep)
            self.rest = STAND_CYCLES
        elif self.active is self.walk and self.rest == 0:
            self.play()
        return beam + self.act()

    def change(self, skill, **after):
        """Continue with another skill, in mid-step if it comes after one that walks."""
        last = after.pop("after", None)
        handed = {} if last is None else {"action": last.action, "position": last.position}
        skill.begin(**handed, **after)
        self.active, self.since, self.stood, self.command = skill, 0, 0, np.zeros(3)

    def play(self):
        """Choose the role and what it does now."""
        world = self.world
        if self.mode in ("BeforeKickOff", "Goal_Left", "Goal_Right", "GameOver"):
            self.command = np.zeros(3)
        elif world.now - world.ball_at > SEARCH_S:
            self.search()
        elif self.number == 1 and self.players > 1 and self.shot_comes():
            self.calm = 0
            self.change(self.keep, after=self.walk, target=-GOAL)
        elif world.ours < 0:
            self.keep_away()
        elif self.is_striker():
            self.strike()
        elif self.number == 1:
            self.keep_goal()
        else:
            self.support()

    def is_striker(self):
        """Return whether this player goes to the ball: the nearest does, the keeper only near its goal."""
        world = self.world
        own = self.cost(self.number, world.position[:2])
        return own < TOUCHED / 2 and all(own <= self.cost(number, place) for number, place in world.mates().items())

    def cost(self, number, place):
        """Return how far a player of the team is from kicking the ball."""
        world = self.world
        ahead = world.ball + 0.5 * world.velocity
        behind = ahead - BEHIND_M * turned(self.aim())
        cost = np.hypot(*(behind - place)) - (0.5 if number == self.number else 0.0)
        if number == 1 and self.players > 1 and np.hypot(*(world.ball + GOAL)) > 9.0:
            cost += TOUCHED
        if number == self.taker and world.now - self.taken_at < 12.0:
            cost += TOUCHED  # who takes a set piece must not be the next to touch the ball
        return cost

    def note_set_piece(self):
        """Note which player has taken our set piece; none has if its time ran out first."""
        world = self.world
        self.taker = None
        if (
            self.world.mode == "PlayOn"
            and self.mode.lower().rsplit("_", 1)[-1] in ("left", "right")
            and self.players > 1
        ):
            own = (world.side > 0) == self.mode.lower().endswith("left")
            places = {**world.mates(), self.number: world.position[:2]}
            if own and not self.mode.startswith("Goal_"):
                apart = {number: np.hypot(*(place - world.ball)) for number, place in places.items()}
                nearest = min(apart, key=apart.__getitem__)
                if apart[nearest] < TAKEN_M:
                    self.taker, self.taken_at = nearest, world.now

    def home(self):
        """Return where the player stands at a kick-off."""
        x, y = HOMES[self.number if self.players > 1 else 2]
        theirs = self.world.mode == ("Goal_Left" if self.world.side > 0 else "Goal_Right")
        before = self.world.mode == "BeforeKickOff" and self.world.side < 0
        return (min(x, -CIRCLE_M - 1.0), y) if theirs or before else (x, y)

    # --- roles ----------------------------------------------------------------------------------------------------

    def aim(self):
        """Return the direction in which the ball should go."""
        return angle_of(self.shot())

    def shot(self):
        """Return the way that the ball should go: through the middle of the goal, or before it."""
        ball = np.minimum(self.world.ball, GOAL[0] - 0.2)
        right, left = angle_of(GOAL - POST - ball), angle_of(GOAL + POST - ball)
        if left - right < NARROW and ball[0] > 20.0:
            return BEFORE_GOAL - ball
        return (np.hypot(*(GOAL - ball)) + ROLL_M) * turned((left + right) / 2)

    def strike(self):
        """Walk behind the ball and kick it."""
        world = self.world
        aim, ball = self.aim(), world.ball + 0.25 * world.velocity
        way = ball - world.position[:2]
        ahead, aside = self.along(world.yaw, way)
        off = wrapped(aim - world.yaw)
        fresh = world.now - world.ball_at < 0.1 and np.hypot(*world.velocity) < 1.5
        ready = KICK_AHEAD_M[0] < ahead < KICK_AHEAD_M[1] and abs(aside) < KICK_ASIDE_M and abs(off) < KICK_AIM
        if ready and fresh and np.hypot(*self.command[:2]) < 1.2:
            far = np.hypot(*self.shot())  # a strong kick has no limit
            self.change(self.kick, after=self.walk, target=(aim, far if far < PASS_M else np.inf))
            return
        # where the robot is around the ball: 0 behind it, seen in the direction of the aim
        around = wrapped(angle_of(-way) - aim - np.pi)
        if abs(around) < AROUND and abs(off) < NEAR_AIM and KICK_AHEAD_M[0] < ahead < 1.2:
            self.go(ball - 0.45 * turned(aim), aim, slowest=0.35)
        else:  # around the ball by a part of the way at a time
            rest = np.sign(around) * max(0.0, abs(around) - AROUND_STEP)
            target = ball - BEHIND_M * turned(aim + rest)
            self.go(target, aim if np.hypot(*(target - world.position[:2])) < 1.0 else None)

    def support(self):
        """Stay behind the ball, ready to be the next striker."""
        world = self.world
        aside = 3.0 if self.number % 2 else -3.0
        target = world.ball + np.array([-4.0, aside])
        self.go(np.clip(target, (-24.0, -16.0), (20.0, 16.0)), angle_of(world.ball - world.position[:2]), near=0.6)

    def keep_goal(self):
        """Stand between the ball and the goal, and face halfway to the ball: steps to the side have to stop it."""
        world = self.world
        way = world.ball + GOAL
        target = -GOAL + min(KEEPER_M, 0.3 * np.hypot(*way)) * way / max(np.hypot(*way), 0.1)
        self.go(target, 0.5 * angle_of(way), near=0.3)

    def shot_comes(self):
        """Return whether the ball comes fast to the goal, and the keeper stands before it."""
        world = self.world
        to_line, place = world.ball[0] + GOAL[0], np.abs(world.position[:2] + GOAL)
        comes = to_line > 0 and -world.velocity[0] > max(SHOT_MPS, to_line / SHOT_S) and world.now - world.ball_at < 0.1
        if not comes or (place > AT_GOAL_M).any() or abs(world.yaw) > FACES:
            return False
        return abs(world.ball[1] - world.velocity[1] * to_line / world.velocity[0]) < WIDE_M

    def shot_is_over(self):
        """Return whether the ball has not come nearer for a while."""
        world = self.world
        seen = world.now - world.ball_at < 0.1
        comes = seen and -world.velocity[0] > 0.3 and world.ball[0] > -GOAL[0]
        self.calm = 0 if comes else self.calm + 1
        return self.calm >= CALM_CYCLES or self.since > KEEP_CYCLES

    def keep_away(self):
        """Stay where the referee leaves opponents of a set piece on the field."""
        world = self.world
        if self.number == 1 and self.players > 1:
            self.keep_goal()
            return
        spread = -0.8 * self.home()[1]
        away = angle_of(-GOAL - world.ball)
        target = world.ball + (CIRCLE_M + 1.0) * turned(away) + spread * turned(away + np.pi / 2)
        if self.mode.startswith("KickOff"):
            target[0] = min(target[0], -1.0)
        self.go(np.clip(target, (-26.0, -17.0), (26.0, 17.0)), angle_of(world.ball - world.position[:2]), near=0.6)

    def search(self):
        """Turn on the spot until the ball is in view: first to where it was, and on in the same direction."""
        if self.cycles > self.searched + 1:
            bearing = wrapped(angle_of(self.world.ball - self.world.position[:2]) - self.world.yaw)
            self.turn = 1.0 if bearing >= 0 else -1.0
        self.searched = self.cycles
        self.walk_at(0.0, 0.0, np.copysign(np.inf, self.turn))

    # --- walking --------------------------------------------------------------------------------------------------

    def go(self, target, heading=None, near=0.12, slowest=-STEP_BACK_MPS):
        """Walk to a point: turned ahead from afar, and near it in any direction with the given heading."""
        world = self.world
        way = self.around(target - world.position[:2])
        distance = np.hypot(*way)
        bearing = wrapped(angle_of(way) - world.yaw)
        off = 0.0 if heading is None else wrapped(heading - world.yaw)
        if distance < near and heading is not None and abs(off) < 0.3:
            self.command = np.zeros(3)
        elif heading is None or distance > SIDESTEP_M + SIDESTEP_M_PER_RAD * abs(off):
            speed = max(0.5, np.sqrt(2 * BRAKE_MPS2 * max(0.0, distance - BRAKE_BEFORE_M)))
            self.walk_at(speed * max(0.0, np.cos(bearing)) ** 2, 0.0, TURN_PER_S * bearing)
        else:
            ahead, aside = self.along(world.yaw, way)
            self.walk_at(max(WALK_PER_S * ahead, slowest), WALK_PER_S * aside, TURN_PER_S * off)

    def walk_at(self, forward, sideways, turn):
        """Walk at a velocity in m/s and rad/s, or at the part of it that lies in the walker's range, an ellipsoid."""
        velocity = np.array([forward, sideways, turn])
        low, high = np.minimum(self.walk.command_low, (-STEP_BACK_MPS, 0.0, 0.0)), self.walk.command_high
        velocity = np.clip(velocity, low, high)
        share = np.linalg.norm(velocity / np.maximum(np.where(velocity < 0.0, -low, high), 1e-6))
        self.command = velocity / max(1.0, share)

    def around(self, way):
        """Return a way that passes by the first robot that stands in it."""
        reach, course = np.hypot(*way), angle_of(way)
        blocks = []
        for place in self.world.others():
            ahead, aside = self.along(course, place - self.world.position[:2])
            if 0.0 < ahead < min(WARNING_M, reach) and abs(aside) < ROOM_M:
                blocks.append((ahead, aside))
        if not blocks or reach < 0.8:
            return way
        ahead, aside = min(blocks)
        past = aside - np.copysign(ROOM_M, aside)  # on the shorter side of it
        return max(ahead, 0.5) * turned(course) + past * turned(course + np.pi / 2)

    @staticmethod
    def along(heading, way):
        """Return a vector's part along a heading and to the left of it."""
        cosine, sine = np.cos(heading), np.sin(heading)
        return cosine * way[0] + sine * way[1], cosine * way[1] - sine * way[0]

    # --- acting ---------------------------------------------------------------------------------------------------

    def act(self):
        """Return the commands of all joints by the active skill; the head follows the ball."""
        world, skill = self.world, self.active
        self.since, self.rest = self.since + 1, max(0, self.rest - 1)
        more = {}
        if skill is self.walk and (self.since % 5 == 1 or not self.command.any()):
            self.sent = self.command
        if skill is self.walk:
            more["command"] = self.sent
        elif skill in (self.kick, self.keep):
            more["ball"] = world.seen
        seen = skill.observe(world.position, world.quaternion, world.gyro, world.angles, world.speeds, **more)
        targets = skill.act(seen)
        if skill is not self.getup:
            targets[:2] = self.look()
        return self.commands(skill, targets)

    @staticmethod
    def commands(skill, targets):
        """Return the text that sets the joints' target angles with the gains of a skill."""
        joints = zip(map(str, skill.effector_names), np.degrees(targets), skill.kp, skill.kd)
        return "".join(f"({name} {target:.3f} 0 {kp:g} {kd:g} 0)" for name, target, kp, kd in joints)

    def look(self):
        """Return yaw and pitch of the head: to the ball, or around if it is not in view."""
        world = self.world
        if self.active in (self.kick, self.keep):
            return 0.0, LOOK_DOWN
        way = world.ball - world.position[:2]
        if world.now - world.ball_at > 0.5:
            return 1.2 * np.sin(3.0 * world.now), LOOK_AHEAD
        bearing = wrapped(angle_of(way) - world.yaw)
        return np.clip(bearing, -1.2, 1.2), LOOK_DOWN if np.hypot(*way) < 2.5 else LOOK_AHEAD


def receive(server):
    """Return the next message."""
    size = int.from_bytes(server.recv(4, socket.MSG_WAITALL), "big")
    data = server.recv(size, socket.MSG_WAITALL) if size else b""
    if not size or len(data) < size:
        raise ConnectionError("the server closed the connection")
    return data.decode()


def send(server, text):
    """Send a message."""
    data = text.encode()
    server.sendall(len(data).to_bytes(4, "big") + data)


def main(host, port, team, number, players="1"):
    """Play until the server ends the game."""
    player = Player(Path(__file__).parent, team, int(number), int(players))
    server = socket.create_connection((host, int(port)))
    server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    send(server, f"(init {player.walk.model} {team} {number})")
    try:
        while True:
            player.world.perceive(receive(server), player.joints)
            while select.select([server], [], [], 0)[0]:  # late in real time: the newest message counts
                player.world.perceive(receive(server), player.joints)
            send(server, player.decide())
    except ConnectionError:
        return


if __name__ == "__main__":
    main(*sys.argv[1:])
