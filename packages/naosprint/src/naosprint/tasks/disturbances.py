"""Disturbances of the ideal world, to train robust policies and to test robustness."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from naosim.simulator import BALL, Variation

from naosprint.tasks.disturbance_settings import BallNoiseSettings, DisturbanceSettings
from naosprint.tasks.observations import ObservationBlock
from naosprint.terms import source
from naosprint.terms.randomness import add_normal, normal, uniform

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosim.simulator import Simulator
    from naospec import TaskSettings

    from naosprint.arrays import AnyArray, BoolArray, FloatArray, IntArray

_STREAM = 0xD157
_BALL_STREAM = 64  # after those of the perceptors in NOISE
_NEAREST_BALL_M = 0.1

NOISE = {
    "joint_angles": 0.5,
    "joint_speeds": 5.0,
    "torso_quat": 0.005,
    "torso_pos": 0.005,
    "gyro": 5.0,
    "accel": 0.5,
}
"""Standard deviations at ``sensor_noise`` 1: degrees, deg/s, entries of a quaternion, metres, deg/s, m/s^2."""


_KINDS = ("pushes", "bodies", "friction", "stiffness", "delay", "noise")


class Disturbances:
    """The disturbances of n robots.

    Args:
        settings: of the task; those of `DisturbanceSettings` and `BallNoiseSettings`, each if it has them, say what to
            disturb, and how much.
        simulator: the robots.
        seed: seed of all draws.
        streams: (n,) whose random numbers each robot gets, see ``World.streams``; by default its own.

    Attributes:
        arrays: what the next step depends on; part of checkpoints.
        count: (n,) steps that each robot has been disturbed in, which number its draws.

    Raises:
        ValueError: if the simulator cannot do it; the message names the setting.
    """

    def __init__(
        self, settings: TaskSettings, simulator: Simulator, seed: int, streams: IntArray | None = None
    ) -> None:
        self._ball_noise_m = settings.ball_noise_m if isinstance(settings, BallNoiseSettings) else 0.0
        if self._ball_noise_m and BALL not in simulator.perceptors:
            raise ValueError(
                f"task.ball_noise_m: robot {simulator.robot.name} perceives no ball; give the task a scene with a ball"
            )
        if not isinstance(settings, DisturbanceSettings):
            settings = DisturbanceSettings(name=settings.name)
        self._settings = settings
        self._simulator = simulator
        self._seed = seed
        self._streams = np.arange(simulator.n) if streams is None else streams
        n, joints = simulator.n, len(simulator.robot.joints)
        self.count: IntArray = np.zeros(n, dtype=np.int64)
        self._least, self._most = settings.extra_delay, settings.extra_delay_max or settings.extra_delay
        some = settings.undisturbed_fraction > 0.0 or settings.disturbance_probability < 1.0
        self._drawn = self._most > self._least or (self._most > 0 and some)
        self._delay: IntArray = np.full(n, self._least)
        self._episode: IntArray = np.zeros(n, dtype=np.int64)
        self._waiting: FloatArray = np.zeros((self._most, n, joints))  # the latest command is the last
        self._disturbed: BoolArray = np.zeros(n, dtype=np.bool_)
        self._kinds: dict[str, BoolArray] = {kind: np.zeros(n, dtype=np.bool_) for kind in _KINDS}
        self._draw_disturbed(slice(0, n))
        self._noise = {
            name: NOISE[name] * settings.sensor_noise
            for name in simulator.perceptors
            if settings.sensor_noise and name in NOISE
        }
        self._world: FloatArray = np.ones((n, 2))  # factors of friction and gravity
        self._stiffness: FloatArray = np.ones((n, 1))  # factor of that of contacts
        self._acts: FloatArray = np.full((n, 1), float(self._least))  # the delay as an observation
        self._grows = settings.disturbance_growth > 0.0
        self._redraws = self._grows or settings.episode_worlds
        self._strength: FloatArray = np.full(n, 0.0 if self._grows else 1.0)
        self._drawn_at: FloatArray = np.stack(
            [np.zeros(n), self._strength], axis=1
        )  # episode and strength of the world
        self._counts = bool(settings.push_mps or self._noise or self._ball_noise_m)
        kept: tuple[tuple[str, AnyArray, bool], ...] = (
            ("count", self.count, self._counts),
            ("waiting", self._waiting, self._most > 0),
            ("delay", self._delay, self._drawn),
            ("acts", self._acts, self._drawn),
            ("episode", self._episode, self._drawn or self._redraws),
            ("drawn_at", self._drawn_at, self._redraws),
            ("strength", self._strength, self._grows),
        )
        self.arrays = {name: array for name, array, needed in kept if needed}
        self._softens = (settings.stiffness_min, settings.stiffness_max) != (1.0, 1.0)
        self._varies = bool(
            settings.mass_variation
            or settings.gain_variation
            or settings.centre_of_mass_m
            or self._softens
            or (settings.friction_min, settings.friction_max, settings.gravity_min) != (1, 1, 1)
        )
        if settings.push_mps:
            simulator.push(np.zeros((n, 2)), slice(0, n))

    def vary(self) -> None:
        """Draw bodies and ground of all robots, unless every episode has its own.

        States of other policies are recorded before, in the nominal world.
        """
        if not self._varies:
            return
        settings, n = self._settings, self._simulator.n
        rng, rows = np.random.default_rng([_STREAM, self._seed]), np.flatnonzero(self._disturbed)
        self._world[rows, 1] = np.linspace(settings.gravity_min, 1.0, n)[rows]
        if not self._redraws:
            drawn = rng.uniform(settings.friction_min, settings.friction_max, n)[rows]
            self._world[rows, 0] = np.where(self._kinds["friction"][rows], drawn, 1.0)
            self._draw_stiffness(rows, rng)
            self._simulator.vary([self._variation(row) for row in rows.tolist()], rng, rows)

    def draw_by_episode(self, rows: IntArray) -> None:
        """Give robots the random numbers of the episodes in their streams, as the first after the beginning."""
        self.count[rows] = 0
        self._episode[rows] = 0
        self._strength[rows] = 0.0 if self._grows else 1.0
        self._drawn_at[rows] = np.stack([self._episode[rows], self._strength[rows]], axis=1)
        self._draw_disturbed(rows)
        if self._varies:
            self._draw_worlds(rows, first=True)

    def _draw_stiffness(self, rows: IntArray, rng: np.random.Generator) -> None:
        """Draw how soft the contacts of the robots ``rows`` are: as often below as above the middle factor."""
        if self._softens:
            low, high = np.log(self._settings.stiffness_min), np.log(self._settings.stiffness_max)
            factors = np.exp(rng.uniform(low, high, len(rows)))
            self._stiffness[rows, 0] = np.where(self._kinds["stiffness"][rows], factors, 1.0)

    def _variation(self, row: int) -> Variation:
        """Return how a robot differs from the nominal one; an undisturbed one does not."""
        settings, strength = self._settings, float(self._drawn_at[row, 1] * self._kinds["bodies"][row])
        friction, gravity = self._world[row].tolist()
        return Variation(
            masses=settings.mass_variation * strength,
            gains=settings.gain_variation * strength,
            centre_m=settings.centre_of_mass_m * strength,
            friction=friction,
            gravity=gravity,
            stiffness=float(self._stiffness[row, 0]),
        )

    def _draw_disturbed(self, rows: slice | IntArray) -> None:
        """Draw which of the robots ``rows`` are disturbed at all, and by what."""
        settings, streams = self._settings, self._streams[rows]
        chance = uniform(self._seed + _STREAM - 1, streams, np.zeros_like(streams), 1)[:, 0]
        self._disturbed[rows] = chance >= settings.undisturbed_fraction
        parts = uniform(self._seed + _STREAM - 3, streams, np.zeros_like(streams), len(_KINDS))
        for kind, part in zip(_KINDS, parts.T, strict=True):
            self._kinds[kind][rows] = self._disturbed[rows] & (part < settings.disturbance_probability)

    def grow(self, rows: IntArray, ran: BoolArray, failed: BoolArray) -> None:
        """Change how strong the robots ``rows`` are disturbed, and draw the worlds of their next episodes.

        Args:
            rows: (k,) robots whose next episodes begin.
            ran: (k,) whether they have run an episode that counts.
            failed: (k,) whether it failed, or did not do what the task asks for.
        """
        if not self._redraws:
            return
        growth = self._settings.disturbance_growth
        change = np.where(ran, np.where(failed, -growth, growth), 0.0)
        self._strength[rows] = np.clip(self._strength[rows] + change, 0.0, 1.0)
        self._drawn_at[rows] = np.stack([self._episode[rows], self._strength[rows]], axis=1)
        if self._varies:
            self._draw_worlds(rows[self._disturbed[rows]])

    def _draw_worlds(self, rows: IntArray, *, first: bool = False) -> None:
        """Draw bodies and ground of the robots ``rows`` for their present episodes, or for the first of a seed."""
        settings = self._settings
        for row in rows.tolist():
            episode, strength = self._drawn_at[row].tolist()
            number = [] if first else [int(episode)]
            rng = np.random.default_rng([_STREAM, self._seed, int(self._streams[row]), *number])
            friction = float(rng.uniform(settings.friction_min, settings.friction_max))
            self._world[row, 0] = 1.0 + strength * (friction - 1.0) * self._kinds["friction"][row]
            if first:
                gravity = float(rng.uniform(settings.gravity_min, 1.0))
                self._world[row, 1] = gravity if self._disturbed[row] else 1.0
            self._draw_stiffness(np.array([row]), rng)
            self._stiffness[row] **= strength
            self._simulator.vary([self._variation(row)], rng, np.array([row]))

    def restore(self, arrays: Mapping[str, AnyArray]) -> None:
        """Continue from the ``arrays`` of a checkpoint."""
        for name, array in self.arrays.items():
            array[:] = arrays[name]
        if self._redraws and self._varies:
            self._draw_worlds(np.flatnonzero(self._disturbed))

    def begin(self, rows: IntArray) -> None:
        """Discard the commands of earlier episodes of the robots ``rows``, and draw the delay of the new ones."""
        self.hold(rows, self._simulator.robot.nominal)
        if self._drawn or self._redraws:
            self._episode[rows] += 1
        if self._drawn:
            part = uniform(self._seed + _STREAM - 2, self._streams[rows], self._episode[rows], 1)[:, 0]
            most = self._least + self._strength[rows] * (self._most - self._least)
            drawn = self._least + (part * (most + 1 - self._least)).astype(np.int64)
            self._delay[rows] = np.where(self._kinds["delay"][rows], drawn, 0)
            self._acts[rows, 0] = self._delay[rows]

    def hold(self, rows: IntArray, targets_rad: FloatArray) -> None:
        """Set the (k, J) or (J,) targets that act until the first delayed commands of new episodes of ``rows`` do."""
        if len(self._waiting):
            self._waiting[:, rows] = targets_rad

    @property
    def strength(self) -> float | None:
        """Mean strength of the disturbances from 0 to 1, if it grows."""
        return float(self._strength[self._disturbed].mean()) if self._grows and self._disturbed.any() else None

    @property
    def moves_motors(self) -> bool:
        """Whether noise on joint angles reaches the motors."""
        return "joint_angles" in self._noise and self._simulator.motors_follow_perceptors

    def critic_blocks(self) -> Sequence[ObservationBlock]:
        """Return what disturbs the robots, for critics: factors of friction, gravity and stiffness, and the delay."""
        named = (
            (("friction", "gravity"), self._world, self._varies),
            (("contact_stiffness",), self._stiffness, self._softens),
            (("extra_delay",), self._acts, self._most > 0),
        )
        return [ObservationBlock(names, source(array)) for names, array, needed in named if needed]

    def delayed(self, targets_rad: FloatArray, rows: slice) -> FloatArray:
        """Return the (k, J) targets that act now, and keep the new ones for later."""
        if not len(self._waiting):
            return targets_rad
        delay = self._delay[rows]
        k = np.arange(len(delay))
        acting = np.where((delay > 0)[:, None], self._waiting[:, rows][-delay, k], targets_rad)
        self._waiting[:-1, rows] = self._waiting[1:, rows]
        self._waiting[-1, rows] = targets_rad
        return acting

    def apply(self, rows: slice) -> None:
        """Push some of the robots ``rows`` after a step, and add noise to what they perceive."""
        settings = self._settings
        if not self._counts:
            return
        self.count[rows] += 1
        streams, counts, noisy = self._streams[rows], self.count[rows], self._kinds["noise"][rows]
        if settings.push_mps:
            chance, turn, part = uniform(self._seed + _STREAM, streams, counts, 3).T
            pushed = self._kinds["pushes"][rows] & (chance < 1.0 / settings.push_steps)
            direction, size = np.pi * (2.0 * turn - 1.0), settings.push_mps * part * pushed * self._strength[rows]
            if pushed.any():
                self._simulator.push(np.stack([size * np.cos(direction), size * np.sin(direction)], axis=1), rows)
        for number, (name, deviation) in enumerate(self._noise.items(), 1):
            deviations, seed = deviation * self._strength[rows], self._seed + _STREAM + number
            add_normal(self._simulator.perceptors[name][rows], deviations, noisy, seed, streams, counts)
        if self._ball_noise_m:
            # a report is a distance and two angles, which are off by less the farther the ball is; NaN: none
            report = self._simulator.perceptors[BALL][rows]
            noise = normal(self._seed + _STREAM + _BALL_STREAM, streams[noisy], counts[noisy], 3)
            off = self._ball_noise_m * self._strength[rows][noisy, None] * noise
            off[:, 1:] = np.degrees(off[:, 1:] / np.maximum(report[noisy, :1], _NEAREST_BALL_M))
            report[noisy] += off
