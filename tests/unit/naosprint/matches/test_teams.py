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
        write_example(tmp_path, {skill: naopolicies.resolve(name) for skill, name in bundled.items()})


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
