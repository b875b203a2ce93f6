"""Use the engine without any task: two NAOs hold a pose that bends their knees."""

import numpy as np
from naosim import kinds, robots
from naosim.simulator import Starts

robot = robots.get("nao-0")
kind = kinds.get("embedded")
simulator = kind.open(robot, 2, kind.parameters(robot)())
simulator.load_starts(Starts(robot.nominal[None], (0.0, 0.0)))
simulator.start(np.arange(2), np.array([0, 0]))
pose = robot.nominal.copy()
for name, degrees in (("hip_pitch", 20), ("knee_pitch", -40), ("ankle_pitch", 20)):
    pose[[i for i, joint in enumerate(robot.joint_names) if joint.endswith(name)]] += np.deg2rad(degrees)
for _ in range(50):
    simulator.step(np.tile(pose, (2, 1)))
print(f"torso at {simulator.truth.torso_position[0, 2]:.2f} m after 1 s; perceptors: {', '.join(simulator.perceptors)}")
simulator.close()
