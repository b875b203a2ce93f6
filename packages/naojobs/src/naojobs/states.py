"""The states of a job and the one table of allowed transitions."""

from __future__ import annotations

from enum import StrEnum


class JobState(StrEnum):
    """Where a job stands."""

    #: Waiting for a worker.
    QUEUED = "queued"
    #: Claimed by a worker, which fetches artifacts and starts the trainer.
    STARTING = "starting"
    #: The trainer runs.
    RUNNING = "running"
    #: A pause was requested; the worker is asked to write a checkpoint and stop.
    PAUSING = "pausing"
    #: Stopped with everything kept; `resume` queues it again.
    PAUSED = "paused"
    #: Training is over; the final policy is being judged.
    EVALUATING = "evaluating"
    #: Trained and evaluated.
    SUCCEEDED = "succeeded"
    #: Ended by an error, or lost by its workers too often; `retry` queues it again.
    FAILED = "failed"
    #: Ended at a user's request; `retry` queues it again.
    CANCELLED = "cancelled"


_S = JobState

#: From each state, the states it may turn into. Everything that changes a state goes through this table.
TRANSITIONS: dict[JobState, frozenset[JobState]] = {
    _S.QUEUED: frozenset({_S.STARTING, _S.PAUSED, _S.CANCELLED}),
    _S.STARTING: frozenset({_S.RUNNING, _S.EVALUATING, _S.PAUSING, _S.PAUSED, _S.QUEUED, _S.FAILED, _S.CANCELLED}),
    _S.RUNNING: frozenset({_S.EVALUATING, _S.SUCCEEDED, _S.PAUSING, _S.PAUSED, _S.QUEUED, _S.FAILED, _S.CANCELLED}),
    # A trainer may reach its last step while it is asked to pause: then there is nothing left to pause.
    _S.PAUSING: frozenset({_S.PAUSED, _S.EVALUATING, _S.SUCCEEDED, _S.FAILED, _S.CANCELLED}),
    _S.PAUSED: frozenset({_S.QUEUED, _S.CANCELLED}),
    _S.EVALUATING: frozenset({_S.SUCCEEDED, _S.QUEUED, _S.FAILED, _S.CANCELLED}),
    _S.SUCCEEDED: frozenset(),
    _S.FAILED: frozenset({_S.QUEUED}),
    _S.CANCELLED: frozenset({_S.QUEUED}),
}

#: States in which a worker holds a lease on the job.
LEASED: frozenset[JobState] = frozenset({_S.STARTING, _S.RUNNING, _S.PAUSING, _S.EVALUATING})
#: States in which nothing more happens unless somebody asks for it.
ENDED: frozenset[JobState] = frozenset({_S.SUCCEEDED, _S.FAILED, _S.CANCELLED})
#: States that count against an owner's quota.
OPEN: frozenset[JobState] = frozenset(JobState) - ENDED


def can_become(source: JobState, target: JobState) -> bool:
    """Tell whether a job in `source` may turn into `target`."""
    return target in TRANSITIONS[source]


def sources_of(target: JobState) -> frozenset[JobState]:
    """Return the states from which a job may turn into `target`."""
    return frozenset(source for source, targets in TRANSITIONS.items() if target in targets)


class EvaluationState(StrEnum):
    """Where an evaluation stands."""

    #: Waiting for a worker.
    QUEUED = "queued"
    #: Claimed by a worker.
    RUNNING = "running"
    #: Its figures and files are recorded.
    SUCCEEDED = "succeeded"
    #: Ended by an error.
    FAILED = "failed"


#: From each state of an evaluation, the states it may turn into.
EVALUATION_TRANSITIONS: dict[EvaluationState, frozenset[EvaluationState]] = {
    EvaluationState.QUEUED: frozenset({EvaluationState.RUNNING}),
    EvaluationState.RUNNING: frozenset(
        {EvaluationState.SUCCEEDED, EvaluationState.FAILED, EvaluationState.QUEUED},
    ),
    EvaluationState.SUCCEEDED: frozenset(),
    EvaluationState.FAILED: frozenset(),
}
