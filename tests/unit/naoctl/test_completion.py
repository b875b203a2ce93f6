"""Shell completion and output with names that a hostile user or service chose."""

from __future__ import annotations

import json
import os
import pty
import select
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from naoctl.cli import main
from naoctl.context import complete_job, completions

SAFE, IDENTIFIER = "evening-run_2", "job_01m7y0yae5d2d9p46g58mkcxxh"
HOSTILE = (
    "evening;touch X",
    "evening$(touch X)",
    "evening\\$(touch X)",
    "evening`touch X`",
    "evening'\ntouch X #",
    'evening") ; touch X; ("',
    "evening*",
    "evening:touch",
)
UNPRINTABLE = "a\x1b]0;x\x07\x9b2J\u202e\u2028\x7f\r\U000e0001b"


@pytest.fixture
def serve(server: Any, job: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that makes the service list jobs."""
    monkeypatch.setenv("NAOCTL_URL", server.url)

    def list_jobs(*jobs: dict[str, Any]) -> None:
        found = [job(**fields) for fields in jobs]
        server.on("GET", "/jobs")(lambda request: request.json({"items": found}))

    return list_jobs


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_that_a_shell_interprets_is_completed_by_its_id(name: str, serve: Callable[..., None]) -> None:
    """The safe name is offered as it is."""
    serve({"name": name}, {"name": SAFE, "id": "job_x;touch X"})
    assert complete_job("eve") == [SAFE]
    assert complete_job("") == [SAFE, "last", IDENTIFIER]


def test_other_completions_are_inert_too() -> None:
    """Names of plug-ins pass the same filter."""
    assert completions(["sprint1", "a b", "$(x)", "-x", "t1", "sprint1"], "") == ["sprint1", "t1"]


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_tab_runs_nothing(shell: str, serve: Callable[..., None], tmp_path: Path) -> None:
    """A real interactive shell completes `naoctl status eve`, and the line is run; all names begin like that."""
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    serve(*({"name": name} for name in HOSTILE), {"name": SAFE})
    folder = tmp_path / "home"
    folder.mkdir()
    # `naoctl status` itself is replaced: only the completion is the real program's
    commands = folder / "bin"
    commands.mkdir()
    naoctl = commands / "naoctl"
    naoctl.write_text(
        f'#!/bin/sh\nif test -z "$_NAOCTL_COMPLETE"; then echo "called with <$*>"; exit; fi\n'
        f'exec {sys.executable} -c "from naoctl.cli import main; main()" "$@"\n'
    )
    naoctl.chmod(0o755)
    environment = {**os.environ, "HOME": str(folder), "PATH": f"{commands}:{os.environ['PATH']}", "TERM": "dumb"}
    source = subprocess.run(
        [naoctl], env={**environment, "_NAOCTL_COMPLETE": f"source_{shell}"}, capture_output=True, text=True, check=True
    ).stdout
    (folder / "completion").write_text(source)
    start = {
        "bash": "bind 'set enable-bracketed-paste off'; . ./completion; PS1='rea''dy> '\n",
        "zsh": "autoload -U compinit; compinit -u; . ./completion; PS1='rea''dy> '\n",
    }[shell]
    flags = {"bash": ["--norc", "--noprofile", "-i"], "zsh": ["-f", "-i"]}[shell]
    with Terminal([program, *flags], folder, environment) as terminal:
        terminal.send(start, until="ready> ")
        terminal.send("naoctl status eve\t", until=SAFE.removeprefix("eve"))
        shown = terminal.send("\n", until=f"called with <status {SAFE}>")
    assert not (folder / "X").exists(), shown


class Terminal:
    """A program at a terminal."""

    def __init__(self, command: list[str], folder: Path, environment: dict[str, str]) -> None:
        self.master, slave = pty.openpty()
        self.process = subprocess.Popen(
            command, stdin=slave, stdout=slave, stderr=slave, cwd=folder, env=environment, start_new_session=True
        )
        os.close(slave)
        self.shown = ""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *exception: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)

    def send(self, text: str, until: str) -> str:
        """Type a text, wait until the program has shown another one, and return all that it has shown."""
        os.write(self.master, text.encode())
        seen = ""
        while until not in seen:
            ready, _, _ = select.select([self.master], [], [], 60.0)
            assert ready, f"no {until!r} in {seen!r}"
            seen += os.read(self.master, 4096).decode(errors="replace")
        self.shown += seen
        return self.shown


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    """Run the program; return its exit code and all that it wrote."""
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    shown = capsys.readouterr()
    return int(ended.value.code or 0), shown.out + shown.err


@pytest.mark.parametrize(
    "words",
    [("list",), ("list", "--json"), ("status", "last"), ("status", "last", "--json"), ("status", "nothing", "--json")],
)
def test_output_has_no_raw_control_characters(
    words: tuple[str, ...], serve: Callable[..., None], server: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not in tables, JSON or errors; JSON has them escaped."""
    hostile = {"name": UNPRINTABLE, "owner": UNPRINTABLE, "tags": [UNPRINTABLE], "waiting_reason": UNPRINTABLE}
    serve({**hostile, "id": f"job_{UNPRINTABLE}", "error": UNPRINTABLE, "state": "failed", "worker": UNPRINTABLE})
    _, shown = run(capsys, *words)
    assert all(character.isprintable() or character == "\n" for character in shown), ascii(shown)
    if "last" in words and "--json" in words:
        assert json.loads(shown)["name"] == UNPRINTABLE


@pytest.mark.parametrize("flags", [(), ("--json",)])
def test_errors_have_no_raw_control_characters(
    flags: tuple[str, ...], server: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the service: its words, the address that it moved to, and file names."""
    monkeypatch.setenv("NAOCTL_URL", server.url)
    for status, headers in ((409, {}), (302, {"location": "http://x/\x1b[2J"}), (429, {"retry_after": "\x1b[2J"})):
        server.on("GET", "/jobs")(lambda request, s=status, h=headers: request.problem(s, UNPRINTABLE, **h))
        code, shown = run(capsys, "status", "some", *flags)
        assert code != 0
        assert shown.rstrip("\n").isprintable(), ascii(shown)
