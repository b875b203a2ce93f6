"""A crawler of two joints in some 60 lines: a custom simulator, from robot to entry point."""

from __future__ import annotations

import numpy as np
from naosim.robots import JointDescription, PerceptorDescription, Robot, Shape
from naosim.simulator import DEFAULT_OPTIONS, PLAIN, STEP_S, Simulator, SimulatorKind, Truth

JOINTS = (
    JointDescription("hip", "hip", "centre", "hip", -1.0, 1.0, max_speed=5.0),
    JointDescription("knee", "knee", "centre", "knee", -1.0, 1.0, max_speed=5.0),
)

CRAWLER = Robot(
    name="crawler",
    family="toy",
    title="Crawler",
    joints=JOINTS,
    nominal_rad={},
    standing_height_m=0.3,
    front_axis=0,
    perceptors=(PerceptorDescription("joint_angles", 2, "deg", "in joint order"),),
    load_shapes=lambda: (Shape("torso", "box", (0.3, 0.2, 0.1)),),
)


class CrawlerSimulator(Simulator):
    """Crawlers that push themselves forward: a hip that turns back moves the torso while the knee is stretched."""

    def __init__(self, robot, n):
        super().__init__(robot, n)
        self.state = np.zeros((n, 6))  # hip, knee (rad), x, y, height (m), heading (rad)
        self.starts = np.zeros((0, 6))
        self.perceptors = {"joint_angles": np.zeros((n, 2))}
        self.truth = Truth(np.zeros((n, 3)), np.zeros((n, 3, 3)))
        self.sense()

    def step_async(self, targets_rad, rows, active=None):
        self.require_open()
        moved = np.arange(rows.start, rows.stop)[slice(None) if active is None else active]
        state, wanted = self.state[moved], targets_rad[moved - rows.start]
        turned = np.clip(wanted - state[:, :2], -5.0 * STEP_S, 5.0 * STEP_S)
        stride = -0.3 * turned[:, 0] / (1.0 + np.exp(-10.0 * state[:, 1]))
        state[:, :2] += turned
        state[:, 2] += stride * np.cos(state[:, 5])
        state[:, 3] += stride * np.sin(state[:, 5])
        state[:, 4] = 0.3 * np.cos(state[:, 1])
        self.state[moved] = state

    def step_wait(self, rows):
        self.require_open()
        self.sense()

    def load_starts(self, starts):
        self.require_open()
        if starts.orientations is not None:
            raise ValueError("starts: crawlers start upright; leave orientations out")
        place = [*starts.position_m, self.robot.standing_height_m, starts.heading_rad]
        self.starts = np.column_stack([starts.poses_rad, np.tile(place, (len(starts), 1))])

    def start(self, rows, starts, following=None):
        self.require_open()
        self.require_starts(starts, len(self.starts))
        self.state[rows] = self.starts[starts]
        self.sense()

    def sense(self):
        self.perceptors["joint_angles"][:] = np.rad2deg(self.state[:, :2])
        self.truth.torso_position[:] = self.state[:, 2:5]
        cosine, sine = np.cos(self.state[:, 5]), np.sin(self.state[:, 5])
        self.truth.torso_rotation[:] = np.eye(3)
        self.truth.torso_rotation[:, :2, :2] = np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)

    def bodies(self):
        half = self.state[:, 5] / 2.0
        still = np.zeros(self.n)
        turned = np.column_stack([np.cos(half), still, still, np.sin(half)])
        return np.concatenate([self.state[:, 2:5], turned], axis=1)[:, None]

    def snapshot(self):
        return self.state.copy().view(np.uint8)

    def restore(self, state):
        self.state[:] = state.view(np.float64)
        self.sense()


class Crawlers(SimulatorKind):
    """The entry point ``crawling = "toy_simulator:CRAWLING"`` of the group ``naosim.simulators``."""

    name = "crawling"
    summary = "Crawlers of two joints."

    def supports(self, robot):
        return robot.family == "toy"

    def open(self, robot, n, parameters, options=DEFAULT_OPTIONS, scene=PLAIN):
        self.require_scene(robot, scene)
        return CrawlerSimulator(robot, n)


CRAWLING = Crawlers()
