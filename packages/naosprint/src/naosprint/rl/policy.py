"""Trained policies, which give the same actions, to the bit, on every x86-64 processor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from naosim.robots.actuation import Actuation

from naosprint.rl.checkpoint import MANIFEST, POLICY, CheckpointError, Manifest, read_file, read_manifest
from naosprint.rl.forward import Forward
from naosprint.rl.normalization import EPSILON

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from naosprint.arrays import AnyArray, Float32Array, FloatArray
    from naosprint.tasks.randomness import Normals


@dataclass(frozen=True)
class Policy:
    """Function from raw observations to actions: standardize, clip, tanh layers, linear layer.

    Attributes:
        mean: (D,) subtracted from observations.
        scale: (D,) observations are multiplied by it then.
        clip: largest magnitude of a standardized observation; infinite where they are not standardized.
        layers: weights (out, in) and bias (out,) of each layer; tanh follows each but the last.
        log_std: (A,) logarithm of the standard deviation with which training explored.
    """

    mean: FloatArray
    scale: FloatArray
    clip: float
    layers: tuple[tuple[Float32Array, Float32Array], ...]
    log_std: Float32Array

    @cached_property
    def _forward(self) -> Forward:
        return Forward(self.layers)

    def standardize(self, observations: FloatArray) -> Float32Array:
        """Return (n, D) raw observations as the network sees them."""
        scaled = (observations - self.mean) * self.scale
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32, order="C")

    def act(self, observations: FloatArray, rng: np.random.Generator | Normals | None = None) -> FloatArray:
        """Return (n, A) actions in [-1, 1] for (n, D) raw observations: the mean, or a draw if given a generator."""
        actions = self._forward(self.standardize(observations))
        if rng is not None:
            # NumPy's own exponential differs between instruction sets.
            spread = np.array([math.exp(value) for value in self.log_std], np.float32)
            actions = actions + spread * rng.standard_normal(actions.shape, dtype=np.float32)
        unit: FloatArray = np.clip(actions, -1.0, 1.0).astype(np.float64)
        return unit


def load_policy(directory: Path) -> tuple[Policy, Manifest]:
    """Load the policy of the checkpoint in ``directory``, and the checkpoint's manifest.

    Raises:
        CheckpointError: if the checkpoint is damaged or its arrays do not fit its manifest.
    """
    manifest = read_manifest(directory)
    arrays = read_file(directory, manifest, POLICY)
    try:
        policy = _build(arrays, manifest)
    except KeyError as error:
        raise CheckpointError(f"{directory / POLICY}: array {error.args[0]!r} is missing") from None
    robot = manifest.stage_spec.robot_description
    if manifest.actions != Actuation(robot).names:
        raise CheckpointError(f"{directory / MANIFEST}: actions: not the joints of robot {robot.name}")
    return policy, manifest


def _build(arrays: Mapping[str, AnyArray], manifest: Manifest) -> Policy:
    spec = manifest.stage_spec
    sizes = (len(manifest.observations), *spec.algorithm.hidden_sizes, len(manifest.actions))

    def take(name: str, shape: tuple[int, ...], kind: type[np.floating]) -> AnyArray:
        array = arrays[name]
        if array.shape != shape or array.dtype != kind or not np.isfinite(array.astype(np.float64)).all():
            raise CheckpointError(f"{POLICY}: array {name!r} is not {list(shape)} finite numbers")
        return array

    layers = []
    for i in range(len(sizes) - 1):
        last = i == len(sizes) - 2
        name = "action_net" if last else f"mlp_extractor.policy_net.{2 * i}"
        weights = take(f"{name}.weight", (sizes[i + 1], sizes[i]), np.float32).astype(np.float32)
        layers.append((weights, take(f"{name}.bias", (sizes[i + 1],), np.float32).astype(np.float32)))
    log_std = take("log_std", (sizes[-1],), np.float32).astype(np.float32)
    if spec.algorithm.normalize_observations:
        mean = take("observation_mean", sizes[:1], np.float64).astype(np.float64)
        variance = take("observation_variance", sizes[:1], np.float64).astype(np.float64)
        scale, clip = 1.0 / np.sqrt(np.maximum(variance, 0.0) + EPSILON), spec.algorithm.observation_clip
    else:
        mean, scale, clip = np.zeros(sizes[0]), np.ones(sizes[0]), np.inf
    return Policy(mean, scale, clip, tuple(layers), log_std)
