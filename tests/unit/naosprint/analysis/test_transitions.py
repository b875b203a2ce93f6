"""Transitions between skills: states in which skills end, skills entered from them, and the matrix."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from naosim.mujoco.embedded import MujocoSimulator
from naosim.mujoco.settings import BoosterEmbeddedParameters
from naosim.robots import configured
from naosprint.__main__ import main
from naosprint.analysis.transitions import LYING, Cell, Skill, matrix, skills, table
from naosprint.tasks.handover import record, record_lying
from naosprint.tasks.kick import Kick
from naosprint.tasks.velocity import Velocity

FAST = BoosterEmbeddedParameters(engine="fast")


def skill(name: str) -> Skill:
    return next(each for each in skills("t1") if each.name == name)


def simulator_of(each: Skill, n: int, task: type[Kick | Velocity]) -> MujocoSimulator:
    return MujocoSimulator(configured(each.spec.robot), n, FAST, scene=task.scene)


def test_the_states_of_a_kick_are_those_in_which_it_ends() -> None:
    kick = skill("kick")
    simulator = simulator_of(kick, 8, Kick)
    states = record(simulator, kick.acting, Kick, kick.task_settings, 8, 3)
    assert 4 <= len(states) <= 8
    apart = np.abs(states.actions[:, None] - states.actions[None]).max(axis=2) + np.eye(len(states))
    assert apart.min() > 1e-3
    simulator.close()


def test_fallen_robots_lie() -> None:
    walk = skill("walk")
    simulator = simulator_of(walk, 4, Velocity)
    pushed = walk.task_settings.model_copy(update={"push_mps": 4.0, "push_steps": 25})
    states = record_lying(simulator, walk.acting, Velocity, pushed, 4, 0)
    assert len(states) > 0
    assert states.motion.torso_m[:, 2].max() < 0.5 * simulator.robot.standing_height_m
    simulator.close()


def test_a_matrix_has_a_cell_for_every_two_skills() -> None:
    members = [skill(name) for name in ("walk", "kick", "getup")]
    cells = list(matrix(members, count=8, engine="fast", threads=1))
    assert [(cell.before, cell.after) for cell in cells] == [
        ("walk", "walk"), ("walk", "kick"), ("kick", "walk"), ("kick", "kick"), ("getup", "walk"), ("getup", "kick"),
        (LYING, "getup"),
    ]  # fmt: skip
    by_name = {(cell.before, cell.after): cell for cell in cells}
    for pair in (("walk", "walk"), ("kick", "walk"), ("getup", "walk"), ("walk", "kick")):
        assert by_name[pair].succeeded >= 0.75 * by_name[pair].count, pair
    assert all(cell.succeeded <= cell.upright <= cell.count for cell in cells)
    assert list(matrix(members[:1], count=8, engine="fast", threads=1)) == cells[:1]  # whatever else is in it


def test_a_dribble_is_interrupted_and_entered() -> None:
    """Its own starts are states of a walker, and it lasts until another skill is chosen."""
    members = [skill(name) for name in ("walk", "dribble")]
    cells = {(cell.before, cell.after): cell for cell in matrix(members, count=8, engine="fast", threads=1)}
    assert cells["dribble", "walk"].succeeded >= 4
    assert cells["walk", "dribble"].upright >= 4


def test_a_keeper_is_entered_from_a_walk_and_left_after_its_shot() -> None:
    members = [skill(name) for name in ("walk", "block")]
    cells = {(cell.before, cell.after): cell for cell in matrix(members, count=16, engine="fast", threads=1)}
    assert cells["walk", "block"].succeeded >= 8
    assert cells["block", "walk"].count >= 8  # after saves; others are goals, with which an episode ends
    assert cells["block", "walk"].upright >= cells["block", "walk"].count - 2


def test_who_does_not_follow_the_command_has_not_succeeded() -> None:
    """A walker stays upright whose command is faster than it can go."""
    fast = Skill("fast", "t1-run", {**skill("walk").settings, "forward_min_mps": 3.4, "forward_max_mps": 3.4})
    slow = skill("walk")
    cells = {(cell.before, cell.after): cell for cell in matrix([slow, fast], count=4, engine="fast", threads=1)}
    assert cells["walk", "walk"].succeeded == 4
    assert cells["walk", "fast"].succeeded == 0


def test_the_table_leaves_open_what_was_not_tried() -> None:
    cells = [Cell("walk", "kick", 3, 4, 4), Cell("walk", "walk", 4, 4, 4), Cell(LYING, "getup", 1, 1, 4)]
    assert table(cells) == (
        ["from \\ to", "kick", "walk", "getup"],
        [["walk", "75", "100", ""], [LYING, "", "", "25"]],
    )
    assert cells[0].to_dict()["interval"][0] < 0.75 < cells[0].to_dict()["interval"][1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robot", "nao-0"], "--robot: nao-0 has no bundled policy for task velocity, which connects skills"),
        (["--only", "fly"], "--only: fly: unknown; choose among stand, walk"),
        (["--policy", "kick"], "--policy: 'kick': write a task and a policy, for example kick=t1-kick"),
        (["--policy", "kick=t1-run"], "t1-run: no bundled policy of robot t1 for task kick; there are: t1-kick"),
        (["--transitions", "0"], "--transitions: must be between 1 and 100,000"),
    ],
)
def test_the_command_says_what_to_write(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["handover", *arguments]) == 1
    assert message in capsys.readouterr().err


def test_the_command_prints_and_writes_the_matrix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = tmp_path / "matrix.json"
    arguments = ["--only", "walk", "--transitions", "4", "--engine", "fast", "--threads", "1", "--output", str(written)]
    assert main(["handover", *arguments]) == 0
    assert "from \\ to" in capsys.readouterr().out
    found = json.loads(written.read_text(encoding="utf-8"))
    assert (found["policies"], found["cells"][0]["count"]) == ({"walk": "t1-run"}, 4)
