"""Results of a policy under disturbances, and the ranges of them within which it keeps on its feet.

For each disturbance the strength is searched up to which few enough episodes fail: first the most severe one, then by
halving the grid of strengths, as if failures grew with it. Every point that was run is kept with its interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from naospec import EvaluationSpec

from naosprint.analysis.evaluation import evaluate
from naosprint.analysis.results import by_name, headline
from naosprint.rl.checkpoint import read_manifest
from naosprint.tasks.statistics import wilson

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from naospec import TaskSettings

CONFIDENCE = 0.95
"""Level of the intervals."""

SEED = 4242
"""Seed of all episodes."""


@dataclass(frozen=True)
class Disturbance:
    """One way in which a world differs from the ideal one.

    Attributes:
        name: how users refer to it.
        title: what the strength is.
        unit: its unit.
        strengths: from none to the most severe.
        settings: the task's settings for a strength.
    """

    name: str
    title: str
    unit: str
    strengths: tuple[float, ...]
    settings: Callable[[float], dict[str, Any]]


def _grid(first: float, last: float, count: int) -> tuple[float, ...]:
    return tuple(round(first + (last - first) * k / count, 6) for k in range(count + 1))


def _friction(factor: float) -> dict[str, Any]:
    return {"friction_min": factor, "friction_max": factor}


DISTURBANCES = (
    Disturbance("pushes", "Pushes, every 2 s", "m/s", _grid(0.0, 3.0, 30), lambda v: {"push_mps": v}),
    Disturbance("masses", "Masses differ by", "", _grid(0.0, 0.5, 20), lambda v: {"mass_variation": v}),
    Disturbance("slippery", "Friction times", "", _grid(1.0, 0.1, 18), _friction),
    Disturbance("rough", "Friction times", "", _grid(1.0, 3.0, 20), _friction),
    Disturbance("delay", "Delay", "steps", _grid(0.0, 5.0, 5), lambda v: {"extra_delay": int(v)}),
    Disturbance("noise", "Sensor noise", "", _grid(0.0, 5.0, 25), lambda v: {"sensor_noise": v}),
)
"""The disturbances that can be examined."""

BY_NAME = {disturbance.name: disturbance for disturbance in DISTURBANCES}
"""Disturbances by name."""


_SINGLE: dict[str, dict[str, Any]] = {
    "pushes of up to 1 m/s every 2 s": {"push_mps": 1.0, "push_steps": 100},
    "masses of bodies up to 10 % different": {"mass_variation": 0.1},
    "friction times 0.6": _friction(0.6),
    "20 ms more delay": {"extra_delay": 1},
    "sensor noise (0.5 degrees, 5 deg/s, 5 mm)": {"sensor_noise": 1.0},
}

CONDITIONS: dict[str, dict[str, Any]] = {
    "none": {},
    **_SINGLE,
    "friction times 1.4": _friction(1.4),
    "1 cm of noise on the ball": {"ball_noise_m": 0.01},
    "the first five at once": {key: value for settings in _SINGLE.values() for key, value in settings.items()},
}
"""Settings of the task by the name of a condition under which policies are compared."""


@dataclass(frozen=True)
class Point:
    """Episodes at one strength.

    Attributes:
        strength: of the disturbance.
        failures: share of episodes that failed.
        low, high: interval of that share.
    """

    strength: float
    failures: float
    low: float
    high: float


@dataclass(frozen=True)
class Range:
    """What was found for one disturbance.

    Attributes:
        disturbance: which.
        reached: most severe strength with few enough failures; None if there are too many even without it.
        complete: whether that is the most severe one of all, so that the true range may be wider.
        points: what was run, from none to the most severe.
        impossible: why the task or the robot's simulator cannot do it; empty if they can.
        missing: whether it is the task that lacks the setting.
    """

    disturbance: Disturbance
    reached: float | None
    complete: bool
    points: tuple[Point, ...]
    impossible: str = ""
    missing: bool = False

    def text(self) -> str:
        """Return the range for readers."""
        if self.missing:
            return "not a setting of this task"
        if self.impossible:
            return "not possible in this simulator"
        if self.reached is None:
            return "too many fail even without it"
        if self.reached == self.disturbance.strengths[0]:
            return "none"
        unit = f" {self.disturbance.unit}" if self.disturbance.unit else ""
        return f"{self.disturbance.strengths[0]:g} to {self.reached:g}{unit}" + (" and more" if self.complete else "")

    def to_dict(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            "disturbance": self.disturbance.name,
            "title": self.disturbance.title,
            "unit": self.disturbance.unit,
            "reached": self.reached,
            "complete": self.complete,
            "text": self.text(),
            "points": [[point.strength, point.failures, point.low, point.high] for point in self.points],
            "impossible": self.impossible,
        }


def ranges(
    checkpoint: Path,
    *,
    episodes: int = 100,
    most_failures: float = 0.05,
    names: Sequence[str] = tuple(BY_NAME),
    threads: int = 2,
    on_point: Callable[[Disturbance, Point], None] = lambda disturbance, point: None,
) -> list[Range]:
    """Search the range of each disturbance.

    Args:
        checkpoint: the policy.
        episodes: episodes at each strength.
        most_failures: share of episodes that may fail.
        names: of the disturbances.
        threads: threads of the simulator.
        on_point: called after each strength.

    Raises:
        ValueError: if the task measures neither falls nor success.
    """
    found = []
    for disturbance in (BY_NAME[name] for name in names):
        points: dict[int, Point] = {}

        def passes(k: int, disturbance: Disturbance = disturbance, points: dict[int, Point] = points) -> bool:
            points[k] = _run(checkpoint, disturbance, disturbance.strengths[k], episodes, threads)
            on_point(disturbance, points[k])
            return points[k].failures <= most_failures

        last = len(disturbance.strengths) - 1
        reached: int | None
        try:
            if passes(last):
                reached = last
            elif not passes(0):
                reached = None
            else:
                reached, failing = 0, last
                while failing - reached > 1:
                    middle = (reached + failing) // 2
                    reached, failing = (middle, failing) if passes(middle) else (reached, middle)
        except _ImpossibleError as error:
            found.append(Range(disturbance, None, False, (), str(error), isinstance(error, _MissingError)))
            continue
        ordered = tuple(points[k] for k in sorted(points))
        strength = None if reached is None else disturbance.strengths[reached]
        found.append(Range(disturbance, strength, reached == last, ordered))
    return found


def conditions(
    checkpoint: Path,
    *,
    episodes: int = 100,
    threads: int = 2,
    on_condition: Callable[[str], None] = lambda condition: None,
) -> list[dict[str, Any]]:
    """Return the headline results under each of `CONDITIONS` that the task has and the robot's simulator can do.

    Args:
        checkpoint: the policy.
        episodes: episodes under each condition.
        threads: threads of the simulator.
        on_condition: called before each condition.
    """
    found, task = [], read_manifest(checkpoint).stage_spec.task
    for name, settings in CONDITIONS.items():
        if _missing(task, settings):
            continue  # the task has no ball, for example
        on_condition(name)
        try:
            summary = _evaluated(checkpoint, settings, episodes, threads)
        except _ImpossibleError:
            continue
        found.append({"disturbance": name, "results": headline(summary)})
    return found


class _ImpossibleError(Exception):
    """Disturbance that the simulator refuses."""


class _MissingError(_ImpossibleError):
    """Disturbance whose settings the task does not have."""


def _missing(task: TaskSettings, settings: Iterable[str]) -> list[str]:
    """Return the settings that a task does not have; it need not inherit `DisturbanceSettings`."""
    return sorted(set(settings) - type(task).model_fields.keys())


def _evaluated(checkpoint: Path, settings: dict[str, Any], episodes: int, threads: int) -> dict[str, Any]:
    """Return the summary of episodes with these settings of the task, the world ideal otherwise."""
    trained = read_manifest(checkpoint).stage_spec.task
    if missing := _missing(trained, settings):
        raise _MissingError(f"task {trained.name} has no setting {', '.join(missing)}")
    task = {"name": trained.name, **settings}
    spec = EvaluationSpec(episodes=episodes, seed=SEED, trajectories=1, bootstrap_resamples=100, task=task)
    try:
        return evaluate(checkpoint, spec, threads=threads).summary
    except ValueError as error:
        if not any(name in str(error) for name in settings):
            raise
        raise _ImpossibleError(str(error)) from error


def _run(checkpoint: Path, disturbance: Disturbance, strength: float, episodes: int, threads: int) -> Point:
    """Run episodes at one strength, the others ideal."""
    results = by_name(_evaluated(checkpoint, disturbance.settings(strength), episodes, threads))
    if "fall_rate" in results:
        failures = float(results["fall_rate"]["value"])
    elif "success_rate" in results:
        failures = 1.0 - float(results["success_rate"]["value"])
    else:
        raise ValueError("task: measures neither fall_rate nor success_rate; examine needs one of them")
    low, high = wilson(round(failures * episodes), episodes, CONFIDENCE)
    return Point(strength, failures, low, high)
