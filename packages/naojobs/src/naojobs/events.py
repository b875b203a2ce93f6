"""What can happen to a job: every kind of event, with what it means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class EventKind:
    """Describe one kind of event."""

    #: When it is recorded, for people.
    meaning: str
    #: Names in the event's `data`, for programs; some may be missing.
    data: tuple[str, ...] = ()


#: Every kind of event. The kinds named like a state say that the job has entered it.
EVENT_KINDS: Mapping[str, EventKind] = MappingProxyType(
    {
        "queued": EventKind(
            "The job waits for a worker: it was submitted, resumed, retried, given back or lost by a worker.",
            ("owner", "reason", "failures"),
        ),
        "doorbell_failed": EventKind("The broker took no message; the job waits and is announced again.", ("error",)),
        "claimed": EventKind("A worker has taken the job.", ("worker",)),
        "initial_policy": EventKind(
            "The training starts from another job's policy.", ("job_id", "checkpoint_id", "step")
        ),
        "checkpoint_unusable": EventKind(
            "A checkpoint is missing or damaged; the one before it is tried.", ("checkpoint_id", "step")
        ),
        "started": EventKind(
            "The trainer starts at step 0; `checkpoint_id` is null.", ("step", "checkpoint_id", "dropped_metrics")
        ),
        "resumed": EventKind(
            "The trainer goes on from a checkpoint; figures beyond its step are dropped.",
            ("step", "checkpoint_id", "dropped_metrics"),
        ),
        "running": EventKind("The training has begun."),
        "checkpoint": EventKind("A checkpoint lies in the store.", ("checkpoint_id", "step")),
        "pause_requested": EventKind("A user asked for a pause; the worker saves a checkpoint and stops."),
        "paused": EventKind("The job is paused.", ("reason", "failures")),
        "cancel_requested": EventKind("A user asked for the end of the job; its worker stops."),
        "cancelled": EventKind("The job has ended at a user's request.", ("reason", "failures")),
        "evaluating": EventKind("The training is over; its policy is being judged."),
        "evaluation": EventKind(
            "An evaluation was asked for, has succeeded or has failed.", ("evaluation_id", "state")
        ),
        "succeeded": EventKind("The job has ended as it should."),
        "failed": EventKind(
            "The job has ended by an error, or was lost too often.", ("exit", "kind", "reason", "failures")
        ),
    }
)
