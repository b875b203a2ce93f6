"""Run the sprint task for n robots at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naosprint.actuation import CYCLE_S, Actuation
from naosprint.observation import Observer
from naosprint.simulator import open_simulator
from naosprint.starts import draw_start_poses

if TYPE_CHECKING:
    from collections.abc import Mapping

    from naospec import Task, TrainingSpec

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray
    from naosprint.simulator import Simulator

TRAINING_STARTS = 256
"""Start poses that training draws from, where there is start noise."""


PRACTICE_STEPS = 100
"""Steps after which episodes of environments that practise starts are cut off: by then the robot is at full speed."""


class SprintBatch:
    """Run the sprint task for n robots at once, without a Python loop over them.

    Robots are started by :meth:`restart` and stepped together; a robot whose episode is over stays where it is told
    to by the ``active`` mask until it is restarted.

    Attributes:
        observations: (n, D) the latest observations.
        rewards: (n,) rewards of the last step, ``reward_scale`` times these metres: forward displacement of the torso,
            less ``drift_penalty`` times how much farther it is now from the straight line, less ``fall_penalty_m`` at
            a fall.
        terminated: (n,) whether the last step ended the episode: fallen, arrived, or at the task's horizon.
        truncated: (n,) whether the last step cut the episode off: by a time limit, which is no part of the task, at
            the end of a practised start, or because the robot was lost with its server.
        lost: (n,) whether the last step lost the robot; its observation and position are those before the step.
        fallen: (n,) whether the torso sank below the minimum height.
        arrived: (n,) whether the torso passed the finish line without having fallen.
        steps: (n,) steps of the episode so far.
        practises: (n,) whether the environment's episodes are cut off after ``PRACTICE_STEPS``, to practise starts.
        displacement: (n,) metres the torso has come forward since the start.
    """

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        *,
        robot_type: int,
        fall_height_m: float,
        reward_scale: float = 1.0,
        drift_penalty: float = 0.0,
        fall_penalty_m: float = 0.0,
    ) -> None:
        n = simulator.n
        self.n = n
        self.simulator = simulator
        self.task = task
        self.actuation = Actuation(simulator.model)
        self.observer = Observer(n, self.actuation, robot_type)
        self.fall_height_m = fall_height_m
        self.reward_scale = reward_scale
        self.drift_penalty = drift_penalty
        self.fall_penalty_m = fall_penalty_m
        self.rewards: FloatArray = np.zeros(n)
        self.terminated: BoolArray = np.zeros(n, dtype=np.bool_)
        self.truncated: BoolArray = np.zeros(n, dtype=np.bool_)
        self.lost: BoolArray = np.zeros(n, dtype=np.bool_)
        self.fallen: BoolArray = np.zeros(n, dtype=np.bool_)
        self.arrived: BoolArray = np.zeros(n, dtype=np.bool_)
        self.steps: IntArray = np.zeros(n, dtype=np.int64)
        self.practises: BoolArray = np.zeros(n, dtype=np.bool_)
        self._x: FloatArray = np.zeros(n)
        self._start_x: FloatArray = np.zeros(n)
        self._aside: FloatArray = np.zeros(n)  # distance from the line straight ahead of the start, metres

    @property
    def observations(self) -> FloatArray:
        """The latest (n, D) observations."""
        return self.observer.observations

    @property
    def displacement(self) -> FloatArray:
        """Metres that each torso has come forward since its start."""
        return self._x - self._start_x

    def load_starts(self, poses_rad: FloatArray) -> None:
        """Make (k, J) start poses known.

        Raises:
            ValueError: if a robot settles below the minimum height, so that no episode could begin.
        """
        self.simulator.load_starts(poses_rad)
        self.restart(np.arange(min(self.n, len(poses_rad))), np.arange(min(self.n, len(poses_rad))))
        height = self.simulator.truth.torso_position[: min(self.n, len(poses_rad)), 2]
        lowest = float(height.min())
        if not lowest > self.fall_height_m:
            raise ValueError(
                f"min_height: {self.fall_height_m:g} m is not below the torso's height in the start pose, "
                f"{lowest:.3f} m; choose a smaller min_height"
            )

    def restart(self, rows: IntArray, starts: IntArray, following: IntArray | None = None) -> None:
        """Begin a new episode with the robots ``rows`` from the start poses ``starts``; leave the others alone.

        Args:
            rows: (k,) robots.
            starts: (k,) start poses.
            following: (k,) the start poses of the episodes after these, where they are known already.
        """
        if not len(rows):
            return
        self.simulator.start(rows, starts, following)
        truth = self.simulator.truth
        self.observer.begin(rows, self.simulator.perceptors, truth)
        x = truth.torso_position[rows, 0]
        self._x[rows] = x
        self._start_x[rows] = x
        self._aside[rows] = np.abs(truth.torso_position[rows, 1] - self.task.start_y_m)
        self.steps[rows] = 0
        self.fallen[rows] = False

    def step(self, actions: FloatArray, active: BoolArray | None = None) -> FloatArray:
        """Take one step of 20 ms with every active robot.

        Args:
            actions: (n, A) target angles in [-1, 1] of each joint's range.
            active: (n,) robots to step; None for all. What the attributes say of the others means nothing.

        Returns:
            (n, D) observations after the step, the last of an episode included; overwritten by the next call.
        """
        simulator = self.simulator
        targets = self.actuation.targets(actions)
        simulator.step(self.actuation.speeds(targets, simulator.perceptors.joint_angles), active)
        self._take_in(slice(0, self.n))
        return self.observer.observations

    def send(self, actions: FloatArray, group: slice) -> None:
        """Begin a step of one of the simulator's groups with (k, A) actions; :meth:`receive` finishes it."""
        simulator = self.simulator
        targets = self.actuation.targets(actions)
        simulator.send(self.actuation.speeds(targets, simulator.perceptors.joint_angles[group]), group)

    def receive(self, group: slice) -> None:
        """Finish the step that :meth:`send` has begun: the group's rows of all attributes are those after it."""
        self.simulator.receive(group)
        self._take_in(group)

    def _take_in(self, rows: slice) -> None:
        """Bring the robots of ``rows`` up to what the simulator says after a step."""
        simulator, task = self.simulator, self.task
        lost = simulator.lost[rows]
        gone = np.flatnonzero(lost) + rows.start
        last_seen = self.observer.observations[gone]
        truth = simulator.truth
        self.observer.update(simulator.perceptors, truth, rows)
        position = truth.torso_position[rows]
        x = position[:, 0].copy()
        aside = np.abs(position[:, 1] - task.start_y_m)
        if len(gone):
            # what a server said while it broke down is no ground to learn from
            self.observer.observations[gone] = last_seen
            x[lost], aside[lost] = self._x[gone], self._aside[gone]
        fallen = (position[:, 2] < self.fall_height_m) & ~lost
        gain = x - self._x[rows] - self.drift_penalty * (aside - self._aside[rows]) - self.fall_penalty_m * fallen
        self.rewards[rows] = gain * self.reward_scale
        self._x[rows], self._aside[rows] = x, aside
        arrived = np.zeros_like(fallen) if task.finish_x_m is None else (x > task.finish_x_m) & ~fallen & ~lost
        self.lost[rows], self.fallen[rows], self.arrived[rows] = lost, fallen, arrived
        self.steps[rows] += 1
        over = fallen | arrived
        late = self.steps[rows] >= task.max_steps
        if task.horizon_is_terminal:
            terminated = (over | late) & ~lost
            truncated = lost
        else:
            terminated = over
            truncated = (late & ~over) | lost
        practised = self.practises[rows] & (self.steps[rows] >= PRACTICE_STEPS) & ~terminated
        self.terminated[rows], self.truncated[rows] = terminated, truncated | practised

    def elapsed_s(self) -> FloatArray:
        """Return the time each episode has lasted, in seconds."""
        return self.steps.astype(np.float64) * CYCLE_S

    def state(self) -> dict[str, AnyArray]:
        """Return everything that the next step depends on, the simulator's state included where it can tell."""
        state: dict[str, AnyArray] = {f"observer.{key}": value for key, value in self.observer.state().items()}
        state["steps"] = self.steps.copy()
        state["x"] = self._x.copy()
        state["start_x"] = self._start_x.copy()
        state["aside"] = self._aside.copy()
        snapshot = self.simulator.snapshot()
        if snapshot is not None:
            state["simulator"] = snapshot
        return state

    def load_state(self, state: Mapping[str, AnyArray]) -> None:
        """Take over what :meth:`state` returned; the starts must have been loaded before."""
        prefix = "observer."
        self.observer.load_state({key[len(prefix) :]: state[key] for key in state if key.startswith(prefix)})
        self.steps = np.array(state["steps"], dtype=np.int64)
        self._x = np.array(state["x"], dtype=np.float64)
        self._start_x = np.array(state["start_x"], dtype=np.float64)
        self._aside = np.array(state["aside"], dtype=np.float64)
        self.simulator.restore(np.array(state["simulator"], dtype=np.uint8))

    def close(self) -> None:
        """Close the simulator."""
        self.simulator.close()


def open_training_batch(spec: TrainingSpec) -> tuple[SprintBatch, int]:
    """Open the environments that ``spec`` asks for, with its start poses loaded.

    Returns:
        The environments and the number of start poses.
    """
    batch = open_batch(
        spec,
        spec.n_envs,
        task=spec.task_definition,
        threads=spec.simulator_threads,
        standby_servers=spec.standby_servers,
    )
    batch.practises[: round(spec.start_practice * spec.n_envs)] = True
    poses = draw_start_poses(batch.actuation, TRAINING_STARTS, spec.start_noise_deg, spec.seed)
    try:
        batch.load_starts(poses)
    except BaseException:
        batch.close()
        raise
    return batch, len(poses)


def open_batch(spec: TrainingSpec, n: int, *, task: Task, threads: int, standby_servers: bool = False) -> SprintBatch:
    """Open n environments with the robot, the sensors and the limits of ``spec``, and no start poses yet."""
    simulator = open_simulator(
        spec.simulator,
        n,
        robot_type=spec.robot_type,
        task=task,
        threads=threads,
        digits=spec.sensor_digits,
        max_server_failures=spec.max_server_failures,
        standby_servers=standby_servers,
    )
    return SprintBatch(
        simulator,
        task,
        robot_type=spec.robot_type,
        fall_height_m=spec.fall_height_m,
        reward_scale=spec.reward_scale,
        drift_penalty=spec.drift_penalty,
        fall_penalty_m=spec.fall_penalty_m,
    )
