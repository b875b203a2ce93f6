"""The plan of a training: its segments in order, computed from the specification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from naospec import TrainingSpec


@dataclass(frozen=True, slots=True)
class Segment:
    """Part of a training in which one learner trains one policy: a stage, or the whole without stages.

    Attributes:
        spec: its settings, as those of a training without stages; ``spec.planned_steps`` is its length.
        stage: number of its stage, from 0.
        first_step: steps of the training before it.
        labels: what metrics state of it.
        title: which part of the training it is, in words; empty if it is the whole.
    """

    spec: TrainingSpec
    stage: int
    first_step: int
    labels: dict[str, float]
    title: str

    @property
    def end(self) -> int:
        """Steps of the training after it."""
        return self.first_step + self.spec.planned_steps


def plan(spec: TrainingSpec) -> tuple[Segment, ...]:
    """Return the segments of a training."""
    found: list[Segment] = []
    for number, stage_spec in enumerate(spec.stage_specs):
        labels, title = {}, ""
        if spec.stages:
            labels = {"stage": float(number + 1)}
            title = f", stage {number + 1} of {len(spec.stages)}"
        found.append(Segment(stage_spec, number, found[-1].end if found else 0, labels, title))
    return tuple(found)
