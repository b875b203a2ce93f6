"""Names of the teams of stored matches."""

from __future__ import annotations

import pytest
from naojobs.teams import present_name
from naospec.teams import EXAMPLE, skills_of

USUAL = skills_of(EXAMPLE)


@pytest.mark.parametrize(
    ("name", "policies", "present"),
    [
        ("my-team", {}, "my-team"),
        ("example", USUAL, "example"),
        ("example", {**USUAL, "walk": "t1-run"}, "example:walk=t1-run"),
        ("example:walk=t1-run", {**USUAL, "walk": "t1-run", "kick": "t1-kick"}, "example:walk=t1-run,kick=t1-kick"),
        (f"example:walk={USUAL['walk']}", USUAL, "example"),
        ("example:keep=mine@2", {**USUAL, "keep": "ckpt_1"}, "example:keep=mine@2"),
        ("example:juggle=mine@2", {**USUAL, "juggle": "ckpt_1"}, "example:juggle=mine@2"),  # of a newer version
    ],
)
def test_a_stored_team_is_named_by_the_policies_that_it_had(name: str, policies: dict[str, str], present: str) -> None:
    assert present_name(name, policies) == present
