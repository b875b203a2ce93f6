"""Check of a job's recorded history against the table of transitions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from naojobs.states import LEASED, WorkState, can_become

_ENTERS = {"claimed": WorkState.STARTING, "pause_requested": WorkState.PAUSING, **{str(s): s for s in WorkState}}
"""Kinds of events that are not named after the state that they enter."""


def states_of(kinds: Iterable[str]) -> Iterator[WorkState]:
    """Yield the states that a job's events, given by kind in the order of their ids, have entered."""
    return (_ENTERS[kind] for kind in kinds if kind in _ENTERS)


def violations(kinds: Iterable[str]) -> list[str]:
    """Return what is wrong in a job's history: changes that the table does not allow, and requests to cancel ignored.

    Args:
        kinds: kinds of all events of the job in the order of their ids.
    """
    found = []
    state: WorkState | None = None
    cancelling = False
    for kind in kinds:
        cancelling = cancelling or kind == "cancel_requested"
        if kind not in _ENTERS:
            continue
        before, state = state, _ENTERS[kind]
        if before is not None and not can_become(before, state):
            found.append(f"{before} became {state}")
        if cancelling and state not in LEASED:
            if state is not WorkState.CANCELLED:
                found.append(f"a cancelled job became {state}")
            cancelling = False
    return found
