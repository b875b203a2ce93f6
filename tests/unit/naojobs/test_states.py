"""The table of transitions."""

from __future__ import annotations

from naojobs.states import ENDED, LEASED, OPEN, TRANSITIONS, WorkState, can_become


def test_every_state_has_its_row() -> None:
    assert set(TRANSITIONS) == set(WorkState)


def test_every_state_can_be_reached_and_every_open_one_left() -> None:
    reached = {WorkState.QUEUED}
    while (new := reached.union(*(TRANSITIONS[state] for state in reached))) != reached:
        reached = new
    assert reached == set(WorkState)
    for state in OPEN:
        assert WorkState.CANCELLED in TRANSITIONS[state], f"{state} must be cancellable"


def test_what_a_worker_holds_can_be_taken_back_or_ended() -> None:
    for state in LEASED - {WorkState.PAUSING}:
        assert can_become(state, WorkState.QUEUED), f"a lost worker in {state}"
        assert can_become(state, WorkState.FAILED)
    assert can_become(WorkState.PAUSING, WorkState.PAUSED)


def test_only_the_queue_leads_to_a_worker() -> None:
    assert [state for state in WorkState if can_become(state, WorkState.STARTING)] == [WorkState.QUEUED]


def test_success_is_final_and_no_state_leads_to_itself() -> None:
    assert TRANSITIONS[WorkState.SUCCEEDED] == frozenset()
    assert not any(can_become(state, state) for state in WorkState)


def test_ended_leased_and_open_fit_together() -> None:
    assert not ENDED & LEASED
    assert LEASED < OPEN
    assert set(WorkState) == ENDED | OPEN
