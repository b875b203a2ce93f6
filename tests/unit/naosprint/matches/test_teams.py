"""Teams, their files and the limits of their agents."""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path

import naopolicies
import pytest
from naosim.launchers import Address
from naospec.teams import skills_of
from naosprint.matches.agents import AgentProcess, Limits, cpu_by_session
from naosprint.matches.game import GameSettings
from naosprint.matches.match import log_name, own_folder
from naosprint.matches.teams import find_team, read_team, write_example


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no team.json; write one"),
        ({"command": "player"}, "command: expected a list of texts"),
        ({"command": []}, "command: expected a list of texts"),
        ({"command": ["player", "{side}"]}, "no placeholder side; use python, host"),
        ({"command": ["player"], "reads": 1}, "reads: expected a list"),
    ],
)
def test_a_malformed_team_is_refused_with_what_to_write(tmp_path: Path, content: object, message: str) -> None:
    if content is not None:
        (tmp_path / "team.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        read_team(tmp_path)


def test_an_example_names_its_skills(tmp_path: Path) -> None:
    assert skills_of("example:walk=t1-run-robust")["walk"] == "t1-run-robust"
    assert skills_of("example")["kick"] == "t1-kick"
    for wrong in ("example:fly=t1-run", "example:walk"):
        with pytest.raises(ValueError, match="expected one of walk, kick, keep, getup"):
            skills_of(wrong)
    with pytest.raises(ValueError, match="no such folder"):
        find_team(str(tmp_path / "none"), tmp_path)


def test_a_skill_of_another_task_is_refused(tmp_path: Path) -> None:
    bundled = {"walk": "t1-getup", "kick": "t1-kick", "getup": "t1-getup"}
    with pytest.raises(ValueError, match="skill walk: expected a T1's policy of task velocity, got one of task getup"):
        write_example(tmp_path / "team", {skill: naopolicies.resolve(name) for skill, name in bundled.items()})
    assert not (tmp_path / "team").exists()


def run_agent(folder: Path, program: str, **limits: int) -> tuple[AgentProcess, str]:
    """Run a program as an agent to its end; return it and how it ended."""
    (folder / "player.py").write_text(program)
    (folder / "team.json").write_text(json.dumps({"command": ["{python}", "player.py", "{port}", "{number}"]}))
    agent = AgentProcess(read_team(folder), "left", 3, 1, Address("127.0.0.1", 9, 10), Limits(**limits))
    pause = threading.Event()
    while agent.alive():
        agent.note_cpu(cpu_by_session())
        pause.wait(0.05)
    return agent, agent.describe()


def test_an_agent_gets_its_place_and_its_failure_has_words(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, "import sys; sys.exit(' '.join(sys.argv[1:]))")
    agent.stop()
    assert words == "exit code 1, output: ...9 3"
    assert {"cpu", "memory"} <= set(agent.enforced or ["cpu", "memory"])


def test_memory_and_processor_time_are_limited(tmp_path: Path) -> None:
    agent, words = run_agent(tmp_path, "bytearray(1 << 30)", memory_mb=256)
    agent.stop()
    assert "MemoryError" in words
    agent, words = run_agent(tmp_path, "while True: pass", cpu_s=1)
    agent.stop()
    assert words.startswith("exit code 1")
    assert agent.cpu_s <= 3.0


def test_files_and_network_are_limited_where_the_kernel_can(tmp_path: Path) -> None:
    program = """
import socket, sys
for what in (lambda: open("/proc/1/environ"), lambda: open("mark", "w"), lambda: open("/root/.profile")):
    try:
        what()
        print("open")
    except OSError as error:
        print(type(error).__name__)
try:
    socket.create_connection(("127.0.0.1", 10), 5)
except OSError as error:
    print(type(error).__name__)
sys.exit(1)
"""
    (tmp_path / "team").mkdir()
    agent, words = run_agent(tmp_path / "team", program)
    enforced = set()
    path = agent._report
    if path.exists():
        enforced = set(json.loads(path.read_text()))
    agent.stop()
    if "TCP" not in enforced:
        pytest.skip("this kernel has no Landlock with rules for TCP")
    assert words.count("PermissionError") == 4, words
    assert not (tmp_path / "team" / "mark").exists()
    assert sys.executable


def test_a_teams_digest_is_that_of_its_files(tmp_path: Path) -> None:
    """Wherever they are; compiled files, which appear while it plays, do not count."""
    for name in ("a", "b"):
        folder = tmp_path / name
        (folder / "parts").mkdir(parents=True)
        (folder / "team.json").write_text(json.dumps({"command": ["{python}", "player.py"]}))
        (folder / "parts" / "legs.py").write_text("left = 1")
    first, second = (read_team(tmp_path / name) for name in ("a", "b"))
    known = first.digest()
    assert second.digest() == known
    (tmp_path / "b" / "parts" / "__pycache__").mkdir()
    (tmp_path / "b" / "parts" / "__pycache__" / "legs.pyc").write_bytes(b"1")
    assert second.digest() == known
    (tmp_path / "b" / "parts" / "legs.py").rename(tmp_path / "b" / "legs.py")
    assert second.digest() != known
    (tmp_path / "a" / "team.json").write_text(json.dumps({"command": ["{python}", "player.py", "fast"]}))
    assert read_team(tmp_path / "a").digest() != known


def test_a_folder_has_the_games_of_one_match(tmp_path: Path) -> None:
    """Otherwise a new version of a team would have the results of the old one."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "team.json").write_text(json.dumps({"command": ["{python}", name]}))
    teams = (read_team(tmp_path / "a"), read_team(tmp_path / "b"))
    settings, logs = GameSettings(players=2, half_s=10.0), tmp_path / "logs"
    assert own_folder(logs, teams, settings) == 0
    assert own_folder(logs, (teams[1], teams[0]), settings) == 0, "nothing has been played"
    assert own_folder(logs, teams, settings) == 0
    (logs / log_name(1)).write_bytes(b"")
    assert own_folder(logs, teams, settings) == 1
    for others, what in (
        ((teams[1], teams[0]), "first team, second team"),
        (teams, "players, seconds"),
    ):
        other = settings if others != teams else GameSettings(players=3, half_s=20.0)
        with pytest.raises(ValueError, match=rf"logs: has 1 games of another match \({what}\); name another folder"):
            own_folder(logs, others, other)
    (tmp_path / "b" / "player.py").write_text("faster = True")
    with pytest.raises(ValueError, match=r"\(second team\)"):
        own_folder(logs, teams, settings)
    (logs / "match.json").unlink()
    with pytest.raises(ValueError, match="which one, is not known"):
        own_folder(logs, teams, settings)


@pytest.mark.parametrize("limits", [{"cpu_s": 0}, {"memory_mb": -1}])
def test_limits_are_positive(limits: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be at least 1"):
        Limits(**limits)
