"""Trained policies, which give the same actions, to the bit, on every x86-64 processor."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from naosim import robots
from naosim.robots.actuation import Actuation

from naosprint.rl.checkpoint import MANIFEST, POLICY, CheckpointError, Manifest, read_file, read_manifest
from naosprint.rl.forward import Forward
from naosprint.rl.learner import learner_kind
from naosprint.rl.normalization import EPSILON

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from naosprint.arrays import AnyArray, Float32Array, FloatArray
    from naosprint.rl.settings import PPOSettings
    from naosprint.terms.randomness import Normals

Real = TypeVar("Real", bound="np.floating[Any]")


class Policy(ABC):
    """Function from raw observations to actions, as a learner gives it back."""

    @abstractmethod
    def act(self, observations: FloatArray, rng: np.random.Generator | Normals | None = None) -> FloatArray:
        """Return (n, A) actions in [-1, 1] for (n, D) raw observations: the best ones, or draws if given a generator.

        Each row depends on its own observations only.

        Raises:
            ValueError: if the policy has no distribution to draw from.
        """


@dataclass(frozen=True)
class NetworkPolicy(Policy):
    """Policy that every format of export supports: standardize, clip, hidden layers, linear layer.

    Attributes:
        mean: (D,) subtracted from observations.
        scale: (D,) observations are multiplied by it then.
        clip: largest magnitude of a standardized observation; infinite where they are not standardized.
        layers: weights (out, in) and bias (out,) of each layer, in single precision, in which policies act.
        log_std: (A,) logarithm of the standard deviation with which training explored; None: no draws.
        activation: what follows each layer but the last.
        squashed: whether tanh follows the last layer; otherwise its outputs are clipped.
    """

    mean: FloatArray
    scale: FloatArray
    clip: float
    layers: tuple[tuple[Float32Array, Float32Array], ...]
    log_std: Float32Array | None = None
    activation: Literal["tanh", "relu"] = "tanh"
    squashed: bool = False

    def __post_init__(self) -> None:
        """Convert the arrays to the types in which every format of export computes; NumPy's default is double.

        Raises:
            ValueError: if a number is not finite in that precision.
        """
        layers = [
            (_finite(f"weights of layer {i}", weights, np.float32), _finite(f"bias of layer {i}", bias, np.float32))
            for i, (weights, bias) in enumerate(self.layers)
        ]
        object.__setattr__(self, "layers", tuple(layers))
        for name in ("mean", "scale"):
            object.__setattr__(self, name, _finite(name, getattr(self, name), np.float64))
        if self.log_std is not None:
            object.__setattr__(self, "log_std", _finite("log_std", self.log_std, np.float32))

    @property
    def n_actions(self) -> int:
        """Number of actions."""
        return len(self.layers[-1][1])

    @property
    def activations(self) -> tuple[str, ...]:
        """What follows each layer: ``tanh``, ``relu`` or ``linear``."""
        return (self.activation,) * (len(self.layers) - 1) + ("tanh" if self.squashed else "linear",)

    @cached_property
    def _forward(self) -> Callable[[Float32Array], Float32Array]:
        if self.activation == "tanh" and not self.squashed:
            return Forward(self.layers)
        # the kernel applies tanh between two layers; an identity after a layer makes it the last function
        parts: list[Callable[[Float32Array], Float32Array]] = []
        for (weights, bias), function in zip(self.layers, self.activations, strict=True):
            n = len(bias)
            identity = [(np.eye(n, dtype=np.float32), np.zeros(n, np.float32))] if function == "tanh" else []
            parts.append(Forward([(weights, bias), *identity]))
            if function == "relu":
                parts.append(lambda values: np.maximum(values, np.float32(0.0)))
        return lambda values: reduce(lambda inner, part: part(inner), parts, values)

    def standardize(self, observations: FloatArray) -> Float32Array:
        """Return (n, D) raw observations as the network sees them."""
        scaled = (observations - self.mean) * self.scale
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32, order="C")

    def act(self, observations: FloatArray, rng: np.random.Generator | Normals | None = None) -> FloatArray:
        """Return (n, A) actions in [-1, 1] for (n, D) raw observations: the mean, or a draw if given a generator."""
        actions = self._forward(self.standardize(observations))
        if rng is not None:
            if self.log_std is None:
                raise ValueError("deterministic: this policy has no distribution to draw from; use deterministic=true")
            # NumPy's own exponential differs between instruction sets.
            spread = np.array([math.exp(value) for value in self.log_std], np.float32)
            actions = actions + spread * rng.standard_normal(actions.shape, dtype=np.float32)
        unit: FloatArray = np.clip(actions, -1.0, 1.0).astype(np.float64)
        return unit


def _finite(name: str, array: AnyArray, kind: type[Real]) -> NDArray[Real]:
    """Return an array of a network in the type that policies have; the same array if it has that type."""
    with np.errstate(over="ignore"):
        converted = np.asarray(array, dtype=kind)
    if not np.isfinite(converted).all():
        raise ValueError(f"{name}: expected numbers that are finite in {kind.__name__}; check the arrays of the policy")
    return converted


def load_policy(directory: Path) -> tuple[Policy, Manifest]:
    """Load the policy of the checkpoint in ``directory``, and the checkpoint's manifest.

    Raises:
        CheckpointError: if the checkpoint is damaged or its arrays do not fit its manifest.
    """
    manifest = read_manifest(directory)
    arrays = read_file(directory, manifest, POLICY)
    settings = manifest.stage_spec.algorithm
    kind = learner_kind(settings.name)
    try:
        policy = kind.load_policy(arrays, settings, observations=manifest.observations, actions=manifest.actions)
    except KeyError as error:
        raise CheckpointError(f"{directory / POLICY}: array {error.args[0]!r} is missing") from None
    except ValueError as error:
        raise CheckpointError(f"{directory / POLICY}: {error}") from error
    robot = robots.configured(manifest.stage_spec.robot)
    if manifest.actions != Actuation(robot).names:
        raise CheckpointError(f"{directory / MANIFEST}: actions: not the joints of robot {robot.name}")
    return policy, manifest


def take(state: Mapping[str, AnyArray], name: str, shape: Sequence[int], kind: type[Real]) -> NDArray[Real]:
    """Return an array of a policy's state after checking it.

    Raises:
        KeyError: if it is missing.
        ValueError: if it has another shape or type, or numbers that are not finite.
    """
    array = state[name]
    if array.shape != tuple(shape) or array.dtype != kind or not np.isfinite(array.astype(np.float64)).all():
        raise ValueError(f"array {name!r} is not {list(shape)} finite numbers")
    return array.astype(kind)


def actor_of(
    state: Mapping[str, AnyArray], settings: PPOSettings, n_observations: int, n_actions: int
) -> NetworkPolicy:
    """Return the actor of PPO's networks, whose arrays have stable-baselines3's names."""
    sizes = (n_observations, *settings.hidden_sizes, n_actions)
    layers = []
    for i in range(len(sizes) - 1):
        last = i == len(sizes) - 2
        name = "action_net" if last else f"mlp_extractor.policy_net.{2 * i}"
        weights = take(state, f"{name}.weight", (sizes[i + 1], sizes[i]), np.float32)
        layers.append((weights, take(state, f"{name}.bias", (sizes[i + 1],), np.float32)))
    log_std = take(state, "log_std", (n_actions,), np.float32)
    if settings.normalize_observations:
        mean = take(state, "observation_mean", sizes[:1], np.float64)
        variance = take(state, "observation_variance", sizes[:1], np.float64)
        scale, clip = 1.0 / np.sqrt(np.maximum(variance, 0.0) + EPSILON), settings.observation_clip
    else:
        mean, scale, clip = np.zeros(n_observations), np.ones(n_observations), np.inf
    return NetworkPolicy(mean, scale, clip, tuple(layers), log_std)
