"""What specifications use of robots, simulators, tasks and learners; the classes that plug-ins inherit from have more.

A package above this one finds a plug-in as what it is there: ``naosim.robots.get``, ``naosim.kinds.get``,
``naosprint.tasks.get`` and ``naosprint.rl.learner.get``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol, TypeVar

from pydantic import BaseModel

from naospec.metrics import Metric, Presentation

Array = TypeVar("Array")
Settings = TypeVar("Settings", bound=BaseModel)


class PerceptorContract(Protocol):
    """One perceptor of a robot."""

    @property
    def name(self) -> str:
        """How settings refer to it."""


class RobotContract(Protocol):
    """A robot."""

    @property
    def name(self) -> str:
        """How specifications refer to it."""

    @property
    def family(self) -> str:
        """Name that robots of the same kind share."""

    @property
    def parameters(self) -> BaseModel:
        """Its settings."""

    @property
    def perceptors(self) -> Iterable[PerceptorContract]:
        """What it perceives."""

    def with_parameters(self, values: Mapping[str, object]) -> RobotContract:
        """Return this robot with other settings."""

    def describe(self) -> dict[str, object]:
        """Return a description for user interfaces."""


class SimulatorContract(Protocol):
    """A simulator."""

    name: str
    summary: str

    def supports(self, robot: RobotContract) -> bool:
        """Return whether it can run this robot."""

    def refusal(self, robot: RobotContract, scene: object) -> str:
        """Return why it cannot open this scene; empty if it can."""

    def abilities(self, robot: RobotContract) -> Iterable[object]:
        """Return what it can do with a robot that it supports."""

    def parameters(self, robot: RobotContract) -> type[BaseModel]:
        """Return the settings that it takes for this robot."""

    def max_robots(self) -> int | None:
        """Return the most robots that this machine can run; None without a limit."""

    def unavailable(self, robot: RobotContract, environment: Mapping[str, str]) -> str:
        """Return why this machine cannot run a robot that it supports; empty if it can."""


class PolicyContract(Protocol):
    """A trained policy."""

    def act(self, observations: Array) -> Array:
        """Return (n, A) actions for (n, D) raw observations, arrays of the same type."""


class LearnerContract(Protocol):
    """A learning algorithm."""

    name: str
    metrics: Sequence[Metric]
    Parameters: type[BaseModel]

    def load_policy(
        self, state: Mapping[str, object], settings: BaseModel, *, observations: Sequence[str], actions: Sequence[str]
    ) -> PolicyContract:
        """Return a trained policy."""

    def require(self, settings: BaseModel, robot: RobotContract, task: str) -> None:
        """Check what the settings name against robot and task."""

    def describe(self) -> dict[str, object]:
        """Return a description for user interfaces."""


class TaskContract(Protocol):
    """A task; the class itself is the plug-in."""

    name: str
    summary: str
    version: int
    scene: object
    needs: Iterable[object]
    metrics: Sequence[Metric]
    results: Sequence[Metric]
    presentation: Presentation
    Parameters: type[BaseModel]

    def supports(self, robot: RobotContract) -> bool:
        """Return whether this robot can do the task."""

    def demonstrates(self, robot: RobotContract) -> bool:
        """Return whether it shows actions to this robot."""

    def resolve(self, parameters: Settings, robot: RobotContract) -> Settings:
        """Return the settings with those that depend on the robot filled in."""

    def describe(self) -> dict[str, object]:
        """Return a description for user interfaces."""
