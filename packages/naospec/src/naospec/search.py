"""Specification of a search for settings: what to vary, what to optimize, how to sample and when to prune."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Scalar = bool | int | float | str | None
"""Value of a setting that a search can choose."""
MAX_VALUES = 1_000_000
"""Values of a range with steps."""
MAX_WHOLE = 2**53
"""Largest whole number, which samplers, whose numbers are doubles, can still tell from the next."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class _Range(_Model):
    type: str
    low: float = Field(description="Smallest value.")
    high: float = Field(description="Largest value.")
    log: bool = Field(default=False, description="Whether to sample on a logarithmic scale.")
    step: float | None = Field(default=None, gt=0, description="Distance between values; null for none.")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"high: expected a number above low ({self.low:g}), got {self.high:g}")
        if self.log and self.low <= 0:
            raise ValueError(f"low: a logarithmic range needs a positive lower end, got {self.low:g}; use log=false")
        if self.log and self.step is not None:
            raise ValueError("step: cannot be combined with log; leave one of them out")
        if self.step is not None and (self.high - self.low) / MAX_VALUES > self.step:
            raise ValueError(f"step: {self.step:g} makes more than {MAX_VALUES:,} values; use a larger step, or none")
        return self

    def ends(self) -> tuple[Any, ...]:
        """Return the values between which all others lie."""
        return self.low, self.high


class FloatRange(_Range):
    """Range of a number."""

    type: Literal["float"] = "float"


class IntRange(_Range):
    """Range of a whole number."""

    type: Literal["int"] = "int"
    low: int = Field(ge=-MAX_WHOLE, le=MAX_WHOLE, description="Smallest value.")
    high: int = Field(ge=-MAX_WHOLE, le=MAX_WHOLE, description="Largest value.")
    step: int | None = Field(default=None, ge=1, description="Distance between values; null for 1.")


class Choices(_Model):
    """Values to choose from."""

    type: Literal["choice"] = "choice"
    choices: list[Scalar | list[Scalar]] = Field(min_length=2, max_length=100, description="The values.")

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        if len({repr(choice) for choice in self.choices}) < len(self.choices):
            raise ValueError("choices: a value is given twice; give each once")
        return self

    def ends(self) -> tuple[Any, ...]:
        """Return all values."""
        return tuple(self.choices)


Parameter = Annotated[FloatRange | IntRange | Choices, Field(discriminator="type")]


class Objective(_Model):
    """Result to optimize."""

    metric: str = Field(
        min_length=1,
        max_length=100,
        description="Name of a result of the evaluation, or of a training metric where no evaluation has it.",
    )
    direction: Literal["maximize", "minimize"] | None = Field(
        default=None, description="Null for the direction that is better for this metric."
    )


class Pruning(_Model):
    """Rule that ends unpromising trials early."""

    name: Literal["none", "median", "asha"] = Field(
        default="none",
        description="none; median: worse than the median of earlier trials at the same step; asha: not among the best "
        "1/reduction_factor at a rung (asynchronous successive halving).",
    )
    metric: str | None = Field(
        default=None,
        max_length=100,
        description="Training metric to compare trials by; null for the objective if trainings report it, else reward.",
    )
    direction: Literal["maximize", "minimize"] | None = Field(
        default=None, description="Null for the direction that is better for this metric."
    )
    interval_steps: int | None = Field(
        default=None,
        ge=1,
        description="Environment steps between two comparisons; null for a twentieth of the training.",
    )
    warmup_intervals: int = Field(
        default=2, ge=0, le=1000, description="Intervals of each trial before the first comparison."
    )
    startup_trials: int = Field(
        default=4, ge=0, le=1000, description="Trials that have to end before `median` prunes any."
    )
    reduction_factor: int = Field(
        default=3, ge=2, le=16, description="`asha` keeps one of this many trials at each rung."
    )


class SearchSpec(_Model):
    """Search for the best settings of a training."""

    space: dict[str, Parameter] = Field(
        min_length=1,
        max_length=20,
        description="Settings to vary, by short name (learning_rate) or by path (algorithm.learning_rate).",
    )
    objectives: list[Objective] = Field(
        default_factory=list,
        max_length=4,
        description="What to optimize; empty for the task's most important result. Several give a Pareto front.",
    )
    sampler: Literal["tpe", "random", "population"] = Field(
        default="tpe",
        description="tpe (tree-structured Parzen estimator); random; population: population-based training, in which "
        "each trial after the first generation starts from the policy of an earlier one.",
    )
    population: int = Field(default=8, ge=4, le=100, description="Trials of one generation of sampler `population`.")
    startup_trials: int = Field(default=10, ge=1, le=1000, description="Random trials before `tpe` models the results.")
    seed: int = Field(default=0, ge=0, lt=2**31, description="Seed of the sampler.")
    pruning: Pruning = Field(default_factory=Pruning, description="When trials end early.")
    elsewhere: bool = Field(
        default=False,
        description="Whether clients take the trials (`naoctl study ask`), run them elsewhere and report the values of "
        "the objectives, whose names are then free; otherwise trials are jobs.",
    )
    trials: int = Field(default=20, ge=1, le=1000, description="Number of trials.")
    parallel: int = Field(default=2, ge=1, le=64, description="Trials that may wait or run at a time.")

    @model_validator(mode="after")
    def _one_objective_to_prune_by(self) -> Self:
        if self.pruning.name != "none" and len(self.objectives) > 1:
            raise ValueError("pruning: needs a single objective; use pruning none or one objective")
        names = [objective.metric for objective in self.objectives]
        if len(set(names)) < len(names):
            raise ValueError("objectives: a metric is given twice; give each once")
        return self

    @model_validator(mode="after")
    def _elsewhere(self) -> Self:
        if not self.elsewhere:
            return self
        if any(objective.direction is None for objective in self.objectives) or not self.objectives:
            raise ValueError("objectives: trials that run elsewhere need objectives with directions")
        if self.sampler == "population":
            raise ValueError("sampler: population continues from checkpoints of jobs; use tpe or random")
        if self.pruning.name != "none":
            raise ValueError("pruning: trials that run elsewhere report no progress; use pruning none")
        return self

    @model_validator(mode="after")
    def _generations(self) -> Self:
        if self.sampler != "population":
            return self
        if self.trials < 2 * self.population:
            raise ValueError(
                f"trials: expected two generations or more ({2 * self.population}), got {self.trials}; use more trials "
                "or a smaller population"
            )
        if len(self.objectives) > 1:
            raise ValueError("objectives: sampler population needs a single one")
        if self.pruning.name != "none":
            raise ValueError("pruning: sampler population replaces the worst by itself; use pruning none")
        return self
