"""Assignments that a worker writes for its child processes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from naojobs.checkpoints import CheckpointRef
from naojobs.leases import EvaluationClaim, JobClaim, Lease, MatchClaim
from naospec import EvaluationSpec, TrainingSpec
from pydantic import BaseModel, ConfigDict

ASSIGNMENT_FILE = "assignment.json"


class _Assignment(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    def write(self, workdir: Path) -> None:
        """Store the assignment in ``workdir``."""
        (workdir / ASSIGNMENT_FILE).write_text(self.model_dump_json(), encoding="utf-8")

    @classmethod
    def read(cls, workdir: Path) -> Self:
        """Return the assignment in ``workdir``."""
        return cls.model_validate_json((workdir / ASSIGNMENT_FILE).read_text(encoding="utf-8"))


class TrainingAssignment(_Assignment):
    """Attempt at a job: train, then evaluate."""

    kind: Literal["training"] = "training"
    lease: Lease
    spec: TrainingSpec
    evaluation: EvaluationSpec | None
    initial_policy: CheckpointRef | None
    bundled_policy: str | None = None

    @classmethod
    def from_claim(cls, claim: JobClaim) -> Self:
        """Return the assignment for a claim; the child itself finds out where to resume."""
        return cls(
            lease=claim.lease,
            spec=claim.spec,
            evaluation=claim.evaluation,
            initial_policy=claim.initial_policy,
            bundled_policy=claim.bundled_policy,
        )


class EvaluationAssignment(_Assignment):
    """Attempt at an evaluation that a user requested."""

    kind: Literal["evaluation"] = "evaluation"
    claim: EvaluationClaim


class MatchAssignment(_Assignment):
    """Attempt at a match."""

    kind: Literal["match"] = "match"
    claim: MatchClaim
