"""Assignments that a worker writes for its child processes: what was claimed, with the lease."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

from naojobs.leases import Claim, EvaluationClaim, JobClaim, Lease, MatchClaim
from pydantic import TypeAdapter

ASSIGNMENT_FILE = "assignment.json"

C = TypeVar("C", JobClaim, EvaluationClaim, MatchClaim)


def write_assignment(claim: Claim, workdir: Path) -> None:
    """Store what an attempt is to do in ``workdir``."""
    (workdir / ASSIGNMENT_FILE).write_bytes(TypeAdapter(type(claim)).dump_json(claim))


def read_assignment(kind: type[C], workdir: Path) -> C:
    """Return what the attempt in ``workdir`` is to do; the child itself finds out where to resume."""
    return TypeAdapter(kind).validate_json((workdir / ASSIGNMENT_FILE).read_bytes())


def read_lease(workdir: Path) -> Lease:
    """Return the lease of the attempt in ``workdir``."""
    return TypeAdapter(Lease).validate_python(json.loads((workdir / ASSIGNMENT_FILE).read_bytes())["lease"])
