"""Descriptions of metrics, from which every list, chart, table and report is made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from math import isfinite
from typing import Any, Literal, TypeVar

Better = Literal["higher", "lower"]


@dataclass(frozen=True)
class Metric:
    """One number per episode, or per update of the learner.

    Attributes:
        name: its key in metrics rows and evaluations.
        title: name for users.
        unit: unit; empty for a number without one, ``%`` for a fraction shown in percent.
        description: one sentence.
        digits: decimals to show.
        better: which direction is better, if one is.
        kind: ``mean`` for a number per episode; ``rate`` for a yes or no per episode.
        live: whether trainings report it; otherwise only evaluations do.
        families: families of the robots that have it; None for all.
    """

    name: str
    title: str
    unit: str = ""
    description: str = ""
    digits: int = 2
    better: Better | None = None
    kind: Literal["mean", "rate"] = "mean"
    live: bool = True
    families: tuple[str, ...] | None = None


EPISODE_METRICS: tuple[Metric, ...] = (
    Metric("reward", "Reward", "", "Sum of an episode's rewards."),
    Metric("episode_length", "Episode length", "steps", "Length of an episode.", 0),
)
"""Metrics of an episode that every task has."""

PROGRESS: tuple[Metric, ...] = (
    Metric("step", "Steps", "steps", "Environment steps since the start of the job.", 0),
    Metric("time_s", "Training time", "s", "Time spent training, over all attempts.", 0),
    Metric("episodes", "Episodes", "", "Episodes finished since the start of the job.", 0),
    Metric("stage", "Stage", "", "Number of the stage, from 1; only trainings with several stages.", 0),
    Metric(
        "disturbance_strength",
        "Strength of disturbances",
        "%",
        "Mean strength that disturbances have grown to (task.disturbance_growth); only trainings in which they grow.",
        0,
        kind="rate",
    ),
    Metric(
        "task_growth",
        "Growth of the task",
        "%",
        "How far what the task asks for has grown, as the range of commands (task.command_growth); only trainings in "
        "which it grows.",
        0,
        kind="rate",
    ),
)
"""Metrics of a training's progress."""

PACE: tuple[Metric, ...] = (
    Metric(
        "steps_per_s", "Steps per second", "1/s", "Environment steps a second in this update, learning included.", 0
    ),
    Metric("collect_s", "Collection time", "s", "Time that collecting the rollout took.", 3),
    Metric(
        "simulator_s", "Simulator time", "s", "Part of the collection time in which it waited for the simulator.", 3
    ),
    Metric("learn_s", "Update time", "s", "Time that updating the policy took.", 3),
    Metric("eta_s", "Time left", "s", "Time that the rest of the training takes at the mean pace of this attempt.", 0),
    Metric(
        "cpus", "Processors", "", "Processors that the training used on average, with its servers; workers only.", 1
    ),
    Metric("memory_mb", "Memory", "MiB", "Memory of the training, with its servers; workers only.", 0),
    Metric("server_failures", "Server failures", "", "Servers that failed and were replaced; servers only.", 0),
    Metric(
        "left_to_mujoco",
        "Left to MuJoCo",
        "substeps",
        "Substeps of 5 ms that the fast engine left to MuJoCo's mj_step, in this attempt; T1 and K1 only.",
        0,
    ),
)
"""Metrics of a training's speed and of what it uses."""

ENGINES: tuple[Metric, ...] = tuple(
    Metric(
        f"{name}_engine_reward",
        f"Reward on the {name} engine",
        "",
        f"Mean reward per step of 8 episodes of at most 4 s without exploration, on the engine of {name}s; at "
        "checkpoints of trainings on engine fast, at most 3 % of the time.",
        4,
        "higher",
    )
    for name in ("training", "evaluation")
)
"""Rewards of one policy on both engines: the same but for chance, unless there is a gap between the engines."""


@dataclass(frozen=True)
class Reference:
    """A value to compare a metric with, for example a published result.

    Attributes:
        metric: name of the metric.
        value: in the metric's unit.
        title: name for users.
        families: families of the robots that it applies to; None for all.
    """

    metric: str
    value: float
    title: str
    families: tuple[str, ...] | None = None


OfRobots = TypeVar("OfRobots", Metric, Reference)


def for_family(family: str, known: Iterable[OfRobots]) -> tuple[OfRobots, ...]:
    """Return the metrics or references that robots of this family have."""
    return tuple(each for each in known if each.families is None or family in each.families)


@dataclass(frozen=True)
class Chart:
    """Metrics that belong in one plot over the steps of a training."""

    title: str
    metrics: tuple[str, ...]


@dataclass(frozen=True)
class FieldLine:
    """A line across the field, drawn in replays and plots of paths.

    Attributes:
        x_m: world x, metres.
        title: name for users.
    """

    x_m: float
    title: str


@dataclass(frozen=True)
class Presentation:
    """Where the metrics of a task are shown.

    Attributes:
        skill: what the task teaches, for users; tasks with the same one are listed together. Empty for the task's name.
        charts: learning curves, the most important first.
        listed: live metrics in lists of jobs, the most important first.
        headline: results of an evaluation on cards and in summaries, the most important first.
        references: values to compare with.
        lines: lines to draw across the field.
        repeats: whether the motion repeats, as strides do; otherwise reports show its beginning.
    """

    skill: str = ""
    charts: tuple[Chart, ...] = ()
    listed: tuple[str, ...] = ()
    headline: tuple[str, ...] = ()
    references: tuple[Reference, ...] = ()
    lines: tuple[FieldLine, ...] = ()
    repeats: bool = True


@dataclass(frozen=True)
class Result:
    """One result of an evaluation, with all that is needed to show it.

    Attributes:
        metric: what it is.
        value: mean or rate; None if no episode supports it.
        sd: standard deviation over the episodes.
        interval: confidence interval of the mean or rate.
        low: smallest value of an episode.
        high: largest value of an episode.
        count: number of episodes for which a ``rate`` is true.
        episodes: number of episodes that it is based on.
    """

    metric: Metric
    value: float | None
    sd: float | None = None
    interval: tuple[float, float] | None = None
    low: float | None = None
    high: float | None = None
    count: int | None = None
    episodes: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object; a number that is not finite becomes None."""
        document = asdict(self)
        metric = document.pop("metric")
        del metric["live"], metric["families"]
        for name in ("value", "sd", "low", "high"):
            document[name] = _finite(document[name])
        bounds = [_finite(bound) for bound in self.interval or (None,)]
        document["interval"] = None if None in bounds else bounds
        return {**metric, **document}


@dataclass(frozen=True)
class ResultTable:
    """Results that vary with one quantity, for example the speed from each of several start lines.

    Attributes:
        name: key.
        title: name for users.
        description: one sentence.
        axis: the quantity.
        at: its values.
        columns: results by column, one for each value.
    """

    name: str
    title: str
    description: str
    axis: Metric
    at: tuple[float, ...]
    columns: dict[str, tuple[Result, ...]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object."""
        return {
            "name": self.name,
            "title": self.title,
            "description": self.description,
            "axis": {"title": self.axis.title, "unit": self.axis.unit, "digits": self.axis.digits},
            "at": list(self.at),
            "columns": [
                {"title": title, "results": [result.to_json() for result in results]}
                for title, results in self.columns.items()
            ],
        }


def _finite(value: float | None) -> float | None:
    return None if value is None or not isfinite(value) else float(value)


def format_value(metric: Metric, value: float | None) -> str:
    """Return a value with its unit as users see it: ``4.03 m/s``, ``0.4 %``, ``-`` if there is none.

    What is rounded to zero has no sign.
    """
    if value is None:
        return "-"
    if metric.unit == "%":
        return f"{100.0 * value:z.{metric.digits}f} %"
    if metric.unit == "°":
        return f"{value:z.{metric.digits}f}°"
    return f"{value:z,.{metric.digits}f} {metric.unit}".rstrip()
