"""Settings that every plug-in of a kind has, and those of running; plug-ins add their own."""

from __future__ import annotations

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator

from naospec import presets
from naospec.sections import Section

DEFAULT_PRESET = "fast"


class TaskSettings(Section):
    """Settings that every task has; a task adds its own.

    A section also records the version of the task that it was written for.
    """

    version: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        title="Task version",
        description="Version of the task; left out: the installed one.",
    )
    reward_scale: float = Field(
        default=100.0,
        ge=1e-6,
        le=1e6,
        title="Reward scale",
        description="Factor of the sum of all reward terms.",
    )
    start_noise_deg: float = Field(
        default=2.0,
        ge=0.0,
        le=20.0,
        title="Start noise",
        description="Each joint of the start pose is offset by up to this angle, drawn for each start.",
        json_schema_extra={"unit": "deg"},
    )
    start_episode_fraction: float = Field(
        default=0.0,
        ge=0.0,
        le=0.9,
        title="Short-episode fraction",
        description="Fraction of the environments whose episodes are truncated after two seconds, to train the start.",
    )
    history_steps: int = Field(
        default=0,
        ge=0,
        le=10,
        title="History",
        description="Earlier steps that a policy observes besides the present one, actions included: enough to tell "
        "how late its commands act, or how slippery the floor is.",
        json_schema_extra={"unit": "steps"},
    )

    def for_evaluation(self) -> Self:
        """Return the settings for episodes of evaluations; the same by default."""
        return self


class SimulatorSettings(Section):
    """Settings that change what a simulator computes; a simulator adds its own for each family of robots."""

    def for_evaluation(self) -> Self:
        """Return the settings with which policies that were trained with these are evaluated."""
        return self


class LearnerSettings(Section):
    """Settings that every learning algorithm has; an algorithm adds its own."""

    preset: str = Field(
        default=DEFAULT_PRESET,
        title="Preset",
        description="Preset of every setting that is left out.",
        json_schema_extra={"enum": list(presets.names())},
    )
    n_envs: int = Field(
        default=128, ge=1, le=4096, title="Environments", description="Robots that are simulated in parallel."
    )
    n_steps: int = Field(
        default=64,
        ge=2,
        le=1_048_576,
        title="Steps per rollout",
        description="Steps of each environment between two updates of the policy.",
        json_schema_extra={"unit": "steps"},
    )

    @field_validator("preset")
    @classmethod
    def _known_preset(cls, value: str) -> str:
        presets.read(value)
        return value

    @property
    def rollout_steps(self) -> int:
        """Samples of one rollout: environments times steps of each."""
        return self.n_envs * self.n_steps

    def policy_shape(self) -> dict[str, Any]:
        """Return the settings that the policy has to have, too, from which a training with these starts."""
        return {}

    def misfit(self, start: LearnerSettings) -> tuple[str, Any, Any] | None:
        """Return why a training cannot start from the policy of one with the settings ``start``; None if it can.

        That is the first setting of :meth:`policy_shape` that differs: its name, its value there, and that of these.
        """
        there = start.policy_shape()
        for name, ours in self.policy_shape().items():
            theirs = there.get(name, getattr(start, name, None))
            if theirs != ours:
                return name, theirs, ours
        return None


class RuntimeSettings(BaseModel):
    """Settings that change how fast a training runs and how it handles faults, but not what it learns."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    simulator_threads: int = Field(
        default=2, ge=1, le=256, title="Simulator threads", description="Threads that step the embedded simulator."
    )
    learner_threads: int = Field(
        default=2, ge=1, le=256, title="Learner threads", description="Threads of the learner."
    )
    checkpoint_interval_steps: int = Field(
        default=1_000_000,
        ge=1,
        title="Checkpoint interval",
        description="Save a checkpoint at the first update after every this many steps, and at the end.",
        json_schema_extra={"unit": "steps"},
    )
    standby_servers: bool = Field(
        default=True,
        title="Standby servers",
        description=(
            "Servers only: give every environment a second server, which prepares its next start while the robot runs "
            "on the first. Without it all robots wait whenever one starts."
        ),
    )
    max_server_failures: int = Field(
        default=20,
        ge=0,
        le=1_000_000,
        title="Server failures allowed",
        description="Servers only: servers that may fail and be replaced; one more ends the training.",
    )
