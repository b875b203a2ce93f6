"""Kinds of events in the history of a job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class EventKind:
    """Kind of event."""

    meaning: str
    """When it is recorded."""
    data: tuple[str, ...] = ()
    """Names in the event's `data`; some may be missing."""


EVENT_KINDS: Mapping[str, EventKind] = MappingProxyType(
    {
        "queued": EventKind(
            "The job waits for a worker: it was submitted, resumed, retried, or requeued after an attempt.",
            ("owner", "reason", "failures", "delay_s"),
        ),
        "notification_failed": EventKind(
            "The broker did not accept the wake-up message; the job waits until a free worker polls.", ("error",)
        ),
        "claimed": EventKind("A worker has taken the job.", ("worker",)),
        "initial_policy": EventKind(
            "The training starts from the policy of another job, or from a bundled one.",
            ("job_id", "checkpoint_id", "step", "policy"),
        ),
        "registered": EventKind("A checkpoint is a version of a policy.", ("policy", "checkpoint_id", "step")),
        "checkpoint_unusable": EventKind(
            "A checkpoint is missing or damaged; the one before it is tried.", ("checkpoint_id", "step")
        ),
        "metrics_unusable": EventKind(
            "Metrics that waited on a worker's disk are damaged; the checkpoint with them is used.", ("step",)
        ),
        "started": EventKind("The training starts at step 0; `checkpoint_id` is null.", ("step", "checkpoint_id")),
        "resumed": EventKind(
            "The training resumes from a checkpoint; metrics beyond its step stay until the next checkpoint. "
            "`checkpoint_id` is null for one that has not reached the store yet.",
            ("step", "checkpoint_id"),
        ),
        "running": EventKind("The training has begun."),
        "stalled": EventKind("The training has made no step for `NAOSPRINT_WORKER_STALL_WARN_S` seconds."),
        "recovered": EventKind("A stalled training makes steps again."),
        "checkpoint": EventKind("A checkpoint is in the store.", ("checkpoint_id", "step")),
        "pause_requested": EventKind("A user requested a pause; the worker saves a checkpoint and stops."),
        "priority": EventKind("A user changed the job's priority.", ("priority",)),
        "requeue_requested": EventKind(
            "The worker saves a checkpoint and requeues the job: urgent work waits, or the worker is drained. `for` is "
            "the id of urgent work of the same owner, and is left out otherwise.",
            ("for",),
        ),
        "software_changed": EventKind(
            "This attempt runs with other versions of packages than the one before.", ("before",)
        ),
        "paused": EventKind("The job is paused.", ("reason", "failures")),
        "cancel_requested": EventKind("A user requested the end of the job; its worker stops."),
        "cancelled": EventKind("The job has ended at a user's request.", ("reason", "failures")),
        "evaluating": EventKind("The training is over; its policy is being evaluated."),
        "evaluation": EventKind(
            "An evaluation has a new state, or its end was requested.",
            ("evaluation_id", "state", "reason", "failures", "delay_s"),
        ),
        "succeeded": EventKind("The job has ended with all results recorded."),
        "failed": EventKind(
            "The job has ended by an error or after too many lost attempts.", ("exit", "kind", "reason", "failures")
        ),
    }
)
"""Every kind of event. A kind named like a state is recorded when the job enters it."""
