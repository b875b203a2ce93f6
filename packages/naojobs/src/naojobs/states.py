"""States of work (trainings, evaluations and matches) and the one table of allowed transitions."""

from __future__ import annotations

from enum import StrEnum


class WorkState(StrEnum):
    """State of work; only a job can be paused, and `evaluating`."""

    QUEUED = "queued"
    """Waiting for a worker."""
    STARTING = "starting"
    """Claimed by a worker, which fetches artifacts and starts the child process."""
    RUNNING = "running"
    """The child process trains, or runs the episodes of an evaluation or the games of a match."""
    PAUSING = "pausing"
    """A pause was requested; the worker is asked to write a checkpoint and stop."""
    PAUSED = "paused"
    """Stopped with all results kept; `resume` queues it again."""
    EVALUATING = "evaluating"
    """Training is over; the final policy is being evaluated."""
    SUCCEEDED = "succeeded"
    """Finished, with all results recorded."""
    FAILED = "failed"
    """Ended by an error, by a time limit, or after too many lost attempts; `retry` queues a job again."""
    CANCELLED = "cancelled"
    """Ended at a user's request; `retry` queues a job again."""


_S = WorkState

TRANSITIONS: dict[WorkState, frozenset[WorkState]] = {
    # Work whose stored specification cannot be read fails without a worker.
    _S.QUEUED: frozenset({_S.STARTING, _S.PAUSED, _S.FAILED, _S.CANCELLED}),
    _S.STARTING: frozenset({_S.RUNNING, _S.EVALUATING, _S.PAUSING, _S.PAUSED, _S.QUEUED, _S.FAILED, _S.CANCELLED}),
    _S.RUNNING: frozenset({_S.EVALUATING, _S.SUCCEEDED, _S.PAUSING, _S.PAUSED, _S.QUEUED, _S.FAILED, _S.CANCELLED}),
    # A training may reach its last step after a pause was requested: then there is nothing to pause.
    _S.PAUSING: frozenset({_S.PAUSED, _S.EVALUATING, _S.SUCCEEDED, _S.FAILED, _S.CANCELLED}),
    _S.PAUSED: frozenset({_S.QUEUED, _S.CANCELLED}),
    _S.EVALUATING: frozenset({_S.SUCCEEDED, _S.QUEUED, _S.FAILED, _S.CANCELLED}),
    _S.SUCCEEDED: frozenset(),
    _S.FAILED: frozenset({_S.QUEUED}),
    _S.CANCELLED: frozenset({_S.QUEUED}),
}
"""From each state, the states that may follow. Every change of a state is checked against this table."""

LEASED: frozenset[WorkState] = frozenset({_S.STARTING, _S.RUNNING, _S.PAUSING, _S.EVALUATING})
"""States in which a worker holds a lease."""
ENDED: frozenset[WorkState] = frozenset({_S.SUCCEEDED, _S.FAILED, _S.CANCELLED})
"""States that only a user's request changes."""
OPEN: frozenset[WorkState] = frozenset(WorkState) - ENDED
"""States that count against an owner's quota."""
EVALUATION_STATES: frozenset[WorkState] = frozenset(WorkState) - {_S.PAUSING, _S.PAUSED, _S.EVALUATING}
"""States that an evaluation or a match can have."""


def can_become(source: WorkState, target: WorkState) -> bool:
    """Return whether the table allows a change from `source` to `target`."""
    return target in TRANSITIONS[source]
