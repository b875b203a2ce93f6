"""A half on a server whose time does not pass."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from naosim.launchers import Address
from naosprint.matches.agents import AgentProcess, Limits
from naosprint.matches.endpoints import AgentEndpoints
from naosprint.matches.game import GameSettings, ServerFailedError, _Half
from naosprint.matches.stream import PLAY_MODES, Frame
from naosprint.matches.teams import Team


class Times:
    """A monitor with frames of some times."""

    def __init__(self, *times_s: float) -> None:
        self._times_s = iter(times_s)

    def next(self, _deadline: float) -> Frame:
        return Frame(time_s=next(self._times_s), clock_s=0.0, mode=0, score=(0, 0), ball_m=np.zeros(3), bodies={})


@pytest.mark.parametrize(
    ("times_s", "frames"),
    [([0.04, 0.08, 0.08, 0.12], 4), ([0.04, *[0.08] * 99, 0.12], 101), ([8.0, 0.02], 1), ([0.04, *[0.08] * 110], 102)],
    ids=["passes", "stands shortly", "goes back", "stands"],
)
def test_a_half_ends_when_its_servers_time_stands_still_or_goes_back(
    times_s: list[float], frames: int, tmp_path: Path
) -> None:
    team = Team(tmp_path, ("true",))
    half = _Half((team, team), ("a", "b"), 0, 0, GameSettings(), (0, 0), has_to_come=True)
    monitor = cast("Any", Times(*times_s))
    endpoints = AgentEndpoints(Address("127.0.0.1", 9, 10), {("left", 1): False})
    try:
        for _ in range(frames):
            half._next(monitor, endpoints, 1.0)
        if frames < len(times_s):
            with pytest.raises(ServerFailedError, match=f"its time is {times_s[frames]:g} s after {max(times_s):g} s"):
                half._next(monitor, endpoints, 1.0)
    finally:
        endpoints.close()


def test_a_player_that_never_came_was_not_dropped(tmp_path: Path) -> None:
    """Its agent runs, and has not connected."""
    team, player = Team(tmp_path, ("sleep", "600")), ("left", 1)
    half = _Half((team, team), ("a", "b"), 0, 0, GameSettings(start_s=2.0), (0, 0), has_to_come=True)
    half._endpoints = endpoints = AgentEndpoints(Address("127.0.0.1", 9, 10), {player: False})
    half._agents[player] = agent = AgentProcess(team, *player, 1, endpoints.address(player), Limits())
    frame = Frame(0.04, 0.0, PLAY_MODES.index("PlayOn"), (0, 0), np.zeros(3), {})
    try:
        half._look(frame)
        assert [each["reason"] for each in half._lost] == ["did not enter the field in 2 s"]
        assert not agent.alive()
    finally:
        agent.stop()
        endpoints.close()
