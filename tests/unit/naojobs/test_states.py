"""The table of transitions."""

from __future__ import annotations

from naojobs.states import ENDED, LEASED, OPEN, TRANSITIONS, JobState, can_become, sources_of


def test_every_state_has_its_row() -> None:
    assert set(TRANSITIONS) == set(JobState)


def test_every_state_can_be_reached_and_every_open_one_left() -> None:
    reached = {JobState.QUEUED}
    while (new := reached.union(*(TRANSITIONS[state] for state in reached))) != reached:
        reached = new
    assert reached == set(JobState)
    for state in OPEN:
        assert JobState.CANCELLED in TRANSITIONS[state], f"{state} must be cancellable"


def test_what_a_worker_holds_can_be_taken_back_or_ended() -> None:
    for state in LEASED - {JobState.PAUSING}:
        assert can_become(state, JobState.QUEUED), f"a lost worker in {state}"
        assert can_become(state, JobState.FAILED)
    assert can_become(JobState.PAUSING, JobState.PAUSED)


def test_only_the_queue_leads_to_a_worker() -> None:
    assert sources_of(JobState.STARTING) == {JobState.QUEUED}


def test_success_is_final_and_no_state_leads_to_itself() -> None:
    assert TRANSITIONS[JobState.SUCCEEDED] == frozenset()
    assert not any(can_become(state, state) for state in JobState)


def test_ended_leased_and_open_fit_together() -> None:
    assert not ENDED & LEASED
    assert LEASED < OPEN
    assert set(JobState) == ENDED | OPEN
