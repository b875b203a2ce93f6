"""Metrics that every training reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from naospec.metrics import EPISODE_METRICS, Metric

from naosprint import tasks
from naosprint.rl.learner import learner_kind

if TYPE_CHECKING:
    from naospec import TrainingSpec

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


def columns(spec: TrainingSpec) -> tuple[Metric, ...]:
    """Return the columns of a training's metrics, in order."""
    kind = learner_kind(spec.algorithm.name)
    live = [metric for metric in tasks.get(spec.task.name).metrics if metric.live]
    return (*PROGRESS, *EPISODE_METRICS, *live, *kind.metrics, *ENGINES, *PACE)
