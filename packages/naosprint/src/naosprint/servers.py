"""Run robots on rcssserver3d servers, one server each."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from naosim import ProcessLauncher, RemoteBatch
from naosim.launcher_docker import ContainerSettings, DockerLauncher

from naosprint.actuation import Actuation
from naosprint.kinematics import body_states
from naosprint.starts import DROP_M, RUNNING_YAW_DEG, SETTLING_CYCLES

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from naosim.launcher import Launcher
    from naosim.robots import RobotModel
    from naospec import Task

    from naosprint.arrays import BoolArray, FloatArray, IntArray
    from naosprint.simulator import Perceptors

PROGRAM_VARIABLE = "NAOSPRINT_SIMSERVER"
"""Environment variable that names the server's program; ``embedded`` stands for ``naosim serve``, ``docker:IMAGE`` for
a container of that image."""

NETWORK_VARIABLE = "NAOSPRINT_SIMSERVER_NETWORK"
"""Environment variable that names the containers' Docker network; without it they publish ports on the loopback."""

LABELS_VARIABLE = "NAOSPRINT_SIMSERVER_LABELS"
"""Environment variable with labels for containers, ``key=value,key=value``, for example of the job they serve."""

DEFAULT_PROGRAM = "rcssserver3d"

SERVERS_PER_CORE = 4
"""More servers than this a core only wait for each other."""

DOCKER_PREFIX = "docker:"
_REPLY_TIMEOUT_S = 10.0
_START_TIMEOUT_S = 30.0
_DIGITS = (2, 3)


def server_launcher(digits: int | None = 2) -> Launcher:
    """Return the launcher of the program that :data:`PROGRAM_VARIABLE` names.

    Args:
        digits: decimals that ``naosim serve`` is to send; another program has its own.

    Raises:
        FileNotFoundError: if there is no such program; the message names the variable.
        OSError: if containers are asked for and no Docker engine answers.
        ValueError: if no server can send so many digits, or a variable is malformed.
    """
    program = os.environ.get(PROGRAM_VARIABLE) or DEFAULT_PROGRAM
    if digits not in _DIGITS:
        raise ValueError(f"sensor_digits: servers send 2 or 3 decimals, not all; use 2 or 3, not {digits}")
    if program == "embedded":
        return ProcessLauncher.embedded("--digits", str(digits))
    if program.startswith(DOCKER_PREFIX):
        return _container_launcher(program.removeprefix(DOCKER_PREFIX))
    try:
        return ProcessLauncher((program,))
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{PROGRAM_VARIABLE}: there is no program {program!r} to run; install rcssserver3d, set {PROGRAM_VARIABLE} "
            "to its path, to 'docker:IMAGE' for containers, or to 'embedded' for the server that comes with naosim"
        ) from None


def reap_servers(program: str) -> int:
    """Remove server containers whose owner has died; return how many.

    Args:
        program: what :data:`PROGRAM_VARIABLE` may say; only containers need this, local servers end with their owner.

    Raises:
        OSError: if no Docker engine answers.
    """
    if not program.startswith(DOCKER_PREFIX):
        return 0
    return DockerLauncher(ContainerSettings(program.removeprefix(DOCKER_PREFIX))).reap()


def _container_launcher(image: str) -> DockerLauncher:
    labels: dict[str, str] = {}
    for word in filter(None, os.environ.get(LABELS_VARIABLE, "").split(",")):
        key, separator, value = word.partition("=")
        if not separator or not key.strip():
            raise ValueError(f"{LABELS_VARIABLE}: must be key=value,key=value, not {word!r}")
        labels[key.strip()] = value.strip()
    if not image:
        raise ValueError(f"{PROGRAM_VARIABLE}: name the image after 'docker:'")
    network = os.environ.get(NETWORK_VARIABLE) or None
    return DockerLauncher(ContainerSettings(image, labels=labels, network=network))


def most_servers() -> int:
    """Return how many servers are started at most on this machine."""
    return SERVERS_PER_CORE * (os.cpu_count() or 1)


def require_servers(n: int) -> None:
    """Check that this machine can carry n servers.

    Raises:
        ValueError: if it cannot; the message says what to set.
    """
    most = most_servers()
    if n > most:
        raise ValueError(
            f"n_envs: {n} environments on rcssserver3d are as many servers, and this machine with {os.cpu_count()} "
            f"cores carries at most {most}; set n_envs to {most} or less, batch_size to a divisor of n_envs * n_steps"
        )


class RemoteTruth:
    """Where n robots are, as the servers' monitor ports show it.

    A torso's pose is as exact as the server sends it: coordinates change in steps of 0.005 (metres, matrix elements),
    unless every cycle asks for the full scene.
    """

    def __init__(self, remote: RemoteBatch) -> None:
        self._remote = remote

    @property
    def torso_position(self) -> FloatArray:
        """Return (n, 3) positions in metres, world frame."""
        return self._remote.truth.torso_position

    @property
    def torso_rotation(self) -> FloatArray:
        """Return (n, 3, 3) rotations from the torso's frame into the world's."""
        return self._remote.truth.torso_rotation

    @property
    def bodies(self) -> FloatArray:
        """Return (n, B, 13) body states by forward kinematics from the perceived angles; velocities are NaN."""
        remote = self._remote
        truth = remote.truth
        return body_states(remote.model, truth.torso_position, truth.torso_rotation, remote.perceptors.joint_angles)


class RemoteSimulator:
    """Run n robots on as many rcssserver3d servers, all driven from this process.

    Every start is simulated: the robot is untangled in the air, put on the start line and held in its start pose for 60
    cycles. A robot whose server fails is marked in :attr:`lost`; its next start begins with a new server.

    Args:
        launcher: starts the servers.
        n: number of robots.
        robot_type: 0 to 4.
        task: says where the start line is.
        max_failures: so many servers may be replaced.
        exact: ask for the full scene in every cycle; much slower.

    Raises:
        naosim.ServerLostError: if a server does not start; the message says why.
    """

    def __init__(
        self, launcher: Launcher, n: int, *, robot_type: int, task: Task, max_failures: int, exact: bool = False
    ) -> None:
        self._remote = RemoteBatch(
            launcher,
            n,
            robot_type,
            team="naosprint",
            timeout_s=_REPLY_TIMEOUT_S,
            start_timeout_s=_START_TIMEOUT_S,
            max_failures=max_failures,
            exact=exact,
        )
        self.n = n
        self.model: RobotModel = self._remote.model
        self._actuation = Actuation(self.model)
        self._start_position = (task.start_x_m, task.start_y_m, self.model.standing_height + DROP_M)
        self._truth = RemoteTruth(self._remote)
        self._starts: FloatArray | None = None

    @property
    def perceptors(self) -> Perceptors:
        """What the robots perceive; valid until the next call."""
        return self._remote.perceptors

    @property
    def truth(self) -> RemoteTruth:
        """Where the robots are; valid until the next call."""
        return self._truth

    @property
    def lost(self) -> BoolArray:
        """Which robots have lost their server; they stand still until they are started again."""
        return self._remote.failed

    @property
    def failures(self) -> int:
        """How many servers have been replaced so far."""
        return self._remote.restarts

    def loss_reason(self, row: int) -> str:
        """Say why the robot ``row`` has lost its server; empty if it has not."""
        return self._remote.reason(row)

    def keep_alive(self) -> AbstractContextManager[None]:
        """Return a context in which servers do not drop their robots, however long nothing is stepped."""
        return self._remote.keep_alive()

    def load_starts(self, poses_rad: FloatArray) -> None:
        """Make (k, J) start poses known, in radians."""
        self._starts = np.array(poses_rad, dtype=np.float64)

    def start(self, rows: IntArray, starts: IntArray) -> None:
        """Put the robots ``rows`` on the start line, settled in the start poses ``starts``.

        Raises:
            naosim.ServerLostError: if more servers fail than are allowed, or a new one does not start.
        """
        if self._starts is None:
            raise RuntimeError("no start poses: call load_starts first")
        remote = self._remote
        poses = np.zeros((self.n, self._starts.shape[1]))
        poses[rows] = self._starts[starts]
        waiting = np.zeros(self.n, dtype=np.bool_)
        waiting[rows] = True
        while waiting.any():
            # only these: whoever else has lost its server has an episode to cut off first
            remote.replace(np.flatnonzero(waiting & remote.failed).tolist())
            remote.reset(waiting)
            remote.beam(np.array(self._start_position), RUNNING_YAW_DEG, waiting)
            for _ in range(SETTLING_CYCLES):
                remote.step(self._actuation.speeds(poses, remote.perceptors.joint_angles), waiting)
            waiting &= remote.failed

    def step(self, speeds: FloatArray, active: BoolArray | None = None) -> None:
        """Advance by one cycle with (n, J) joint speeds in rad/s; only the robots of the mask, where one is given."""
        self._remote.step(speeds, active)

    def snapshot(self) -> None:
        """Return None: a server cannot tell its whole state."""

    def restore(self, state: object) -> None:
        """Refuse: a server cannot go back.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("rcssserver3d cannot go back to a snapshot")

    def close(self) -> None:
        """Close all connections and stop the servers."""
        self._remote.close()
