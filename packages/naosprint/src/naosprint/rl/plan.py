"""The plan of a training: its segments in order, computed from the specification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from naospec import TrainingSpec

_SEED_STEP = 1000
"""Difference of the seeds of two candidates."""


@dataclass(frozen=True, slots=True)
class Segment:
    """Part of a training in which one learner trains one policy.

    Attributes:
        spec: its settings, as those of a training without stages; ``spec.planned_steps`` is its length.
        first_step: steps of the training before it.
        stage: number of its stage, from 0.
        candidate: number among the segments of its stage, from 0. Each starts from the policy that the first one starts
            from, and after the last one the best policy of them continues.
        candidates: number of segments of its stage.
        labels: what metrics state of it.
        title: which part of the training it is, in words; empty if it is the whole.
    """

    spec: TrainingSpec
    first_step: int
    stage: int
    candidate: int
    candidates: int
    labels: dict[str, float]
    title: str

    @property
    def is_last_candidate(self) -> bool:
        """Whether no further candidate of its stage follows."""
        return self.candidate + 1 == self.candidates

    @property
    def end(self) -> int:
        """Steps of the training after it."""
        return self.first_step + self.spec.planned_steps


def plan(spec: TrainingSpec) -> tuple[Segment, ...]:
    """Return the segments of a training.

    The first candidate of a stage has the stage's seed; each further one adds 1,000.
    """
    found: list[Segment] = []
    for number, stage_spec in enumerate(spec.stage_specs):
        count = spec.stages[number].candidates if spec.stages else 1
        for candidate in range(count):
            labels, words = {}, ""
            if spec.stages:
                labels["stage"] = float(number + 1)
                words = f", stage {number + 1} of {len(spec.stages)}"
            if count > 1:
                labels["candidate"] = float(candidate + 1)
                words += f", candidate {candidate + 1} of {count}"
            seed = (stage_spec.seed + _SEED_STEP * candidate) % 2**31
            own = stage_spec if candidate == 0 else stage_spec.model_copy(update={"seed": seed})
            first = found[-1].end if found else 0
            found.append(Segment(own, first, number, candidate, count, labels, words))
    return tuple(found)


def position(segments: tuple[Segment, ...], stage: int, trained: int, steps: int) -> tuple[int, bool]:
    """Return where a training continues from a checkpoint.

    Args:
        segments: its plan.
        stage: number of the checkpoint's stage.
        trained: complete candidates of this stage.
        steps: the checkpoint's steps.

    Returns:
        The index of the segment, and whether it begins there: the checkpoint is the end of the one before.
    """
    here = [index for index, segment in enumerate(segments) if segment.stage == stage]
    index = here[min(trained, len(here) - 1)]
    if steps >= segments[index].end and index + 1 < len(segments):
        return index + 1, True
    return index, 0 < trained < len(here) and steps == segments[index].first_step
