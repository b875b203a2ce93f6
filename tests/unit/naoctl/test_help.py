"""Help texts: what ``--help`` shows at 80 columns, ``--help-all``, ``naoctl spec``, and the pager."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest
from naoctl.cli import build_app, main
from naoctl.commands.spec import complete_field, settings_by_section
from naoctl.commands.submit import COMMON_EVALUATION_SETTINGS, COMMON_SETTINGS
from naoctl.specflags import flag_name, training_settings
from typer.main import get_command
from typer.testing import CliRunner

PROGRAM = Path(sys.executable).parent / "naoctl"


def help_of(*words: str) -> str:
    environment = {"COLUMNS": "80", "LINES": "50", "TERM": "dumb"}
    done = CliRunner().invoke(build_app(words[0] if words else None), list(words), env=environment)
    assert done.exit_code == 0, done.output
    return done.stdout


def commands() -> list[tuple[str, ...]]:
    group = get_command(build_app())
    found: list[tuple[str, ...]] = [()]
    for name, command in group.commands.items():
        found.append((name,))
        found += [(name, inner) for inner in getattr(command, "commands", {})]
    return found


def test_submit_help_shows_the_ten_settings_that_people_use() -> None:
    text = help_of("submit", "--help")
    shown = {flag_name(name) for name in COMMON_SETTINGS} | {
        flag_name(name, "eval_") for name in COMMON_EVALUATION_SETTINGS
    }
    assert len(shown) == 10
    every = {flag_name(name) for name in training_settings()}
    listed = set(re.findall(r"^  (?:-\w, )?(?:--steps, )?(--[\w-]+)", text, re.MULTILINE))
    assert listed & (every | {"--eval-episodes"}) == shown
    assert len(text.splitlines()) < 60
    assert "--help-all" in text


def test_help_all_shows_every_setting() -> None:
    text = help_of("submit", "--help-all")
    for name in training_settings():
        assert re.search(rf"{flag_name(name)}\b", text), name
    for heading in ("Task:", "Algorithm (left out: the preset's value):", "Runtime:", "Evaluation:"):
        assert heading in text


@pytest.mark.parametrize("words", [*commands(), ("submit", "--help-all"), ("spec",)], ids=" ".join)
def test_nothing_is_cut_off_at_80_columns(words: tuple[str, ...]) -> None:
    if words != ("spec",) and "--help-all" not in words:
        words = (*words, "--help")
    text = help_of(*words) if words != ("spec",) else terminal("spec", "simulator")
    assert "…" not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    command = get_command(build_app(words[0] if words else None))
    for word in words:
        command = getattr(command, "commands", {}).get(word, command)
    for parameter in command.params:
        if words[-1] == "--help" and not getattr(parameter, "hidden", False) and parameter.name != "help":
            for flag in getattr(parameter, "opts", ()):
                assert flag in text or not flag.startswith("-"), flag


@pytest.mark.parametrize("group", ["policies", "match", "team", "study", "token", "webhook", "workers", "mirror"])
def test_a_group_shows_whole_summaries_and_its_help_without_a_command(
    group: str, capsys: pytest.CaptureFixture[str]
) -> None:
    usage, *lines = help_of(group, "--help").splitlines()
    assert "COMMAND" in usage
    assert not [line for line in lines if line.rstrip().endswith("...")]
    if group != "workers":  # that lists them
        with pytest.raises(SystemExit):
            main([group])
        assert capsys.readouterr().err.splitlines()[0] == usage


def terminal(*words: str, lines: int = 200, keys: bytes = b"") -> str:
    """Run the program on a terminal of 80 columns and return what it shows."""
    environment = {**os.environ, "COLUMNS": "80", "LINES": str(lines), "TERM": "xterm", "PAGER": "less"}
    leader, follower = pty.openpty()
    process = subprocess.Popen([PROGRAM, *words], env=environment, stdin=follower, stdout=follower, stderr=follower)
    os.close(follower)
    shown, sent = b"", False
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if not select.select([leader], [], [], 0.2)[0]:
            if keys and not sent and shown:
                os.write(leader, keys)
                sent = True
            if process.poll() is not None:
                break
            continue
        try:
            data = os.read(leader, 65536)
        except OSError:  # the program has ended
            break
        shown += data
    assert process.wait(30) == 0
    os.close(leader)
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.decode()).replace("\r", "")


def test_a_text_longer_than_the_terminal_is_paged() -> None:
    shown = terminal("submit", "--help-all", lines=20, keys=b"q")
    assert "Usage: naoctl submit" in shown
    assert "--max-server-failures" not in shown, "the pager shows the first page and waits for a key"
    assert "--max-server-failures" in terminal("submit", "--help-all", lines=1000)


def test_spec_explains_one_setting() -> None:
    (described,) = json.loads(help_of("spec", "learning-rate", "--json"))
    assert described["path"] == "spec.algorithm.learning_rate"
    assert described["flag"] == "--learning-rate"
    assert described["bounds"] == "above 0 and at most 0.1"
    assert described["defaults"]["fast"] == 0.0005
    assert described["defaults"]["paper"] == 0.0001
    text = help_of("spec", "algorithm.learning_rate")
    assert "Step size of Adam." in text and "0.0001 (preset paper)" in text


def test_spec_lists_a_group_and_every_setting() -> None:
    assert "checkpoint_interval_steps" in help_of("spec", "runtime")
    listed = {item["name"] for item in json.loads(help_of("spec", "--json"))}
    assert listed >= training_settings().keys() | {"eval_episodes", "eval_confidence"}
    for settings in settings_by_section().values():
        assert settings
    assert complete_field("learning") == ["learning_rate", "learning_rate_schedule"]


def test_every_setting_can_be_explained() -> None:
    for item in json.loads(help_of("spec", "--json")):
        assert item["description"], item["name"]
        assert item["defaults"], item["name"]
        assert "-" not in item["defaults"].values(), item["name"]


def test_an_unknown_setting_is_refused() -> None:
    done = subprocess.run([PROGRAM, "spec", "learning_rat"], check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert "`naoctl spec` lists the settings" in done.stderr
