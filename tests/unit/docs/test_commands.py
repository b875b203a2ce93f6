"""Commands, options, files and services in the documents exist."""

from __future__ import annotations

import argparse
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import yaml
from naojobs.__main__ import _parser as naojobs_parser
from naosim.cli import _parser as naosim_parser
from naosprint.__main__ import _parser as naosprint_parser

from . import documents
from .documents import ROOT, Command

COMMANDS = documents.commands()

SYSTEM = {
    "export",
    "restic",
    "rm",
    "pg_dump",
    "pg_restore",
    "cat",
    "cp",
    "scp",
    "mkdir",
    "chmod",
    "echo",
    "git",
    "source",
    "curl",
    "apt-get",
    "ssh",
    "pip",
    "rcssservermj",
    "sbatch",
}
"""Programs of the system, whose arguments are not checked."""

OURS = tuple(f"{ROOT / folder}{os.sep}" for folder in ("benchmarks", "docs", "tests", "tools"))
"""Folders without a package, whose modules lie beside the programs that import them."""

COMPOSE = {"up", "down", "exec", "ps", "build", "logs", "stop", "run", "pull"}
"""Commands of `docker compose` that the documents use."""


class ComposeLoader(yaml.SafeLoader):
    """Loader of compose files, which have a tag that takes back what another file sets."""


ComposeLoader.add_constructor("!reset", lambda *_: None)


def check_naoctl(words: list[str]) -> None:
    name, command = "naoctl", documents.naoctl()
    while hasattr(command, "commands"):
        if command.invoke_without_command and (not words or words[0].startswith("-")):
            break
        name = words.pop(0)
        if name == "--url":  # in front of the command
            words.pop(0)
            continue
        if name not in command.commands and hasattr(command, "default"):
            words, name = [name, *words], command.default
        assert name in command.commands, f"naoctl has no command {name}"
        command = command.commands[name]
    command.make_context(name, words)


def check_make(words: list[str]) -> None:
    targets = set(re.findall(r"^([a-z0-9]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    wanted = {word for word in words if "=" not in word}
    assert wanted and wanted <= targets, f"make has no target {wanted - targets}"


def check_python(words: list[str]) -> None:
    modules = {"naosprint": naosprint_parser, "naosim": naosim_parser, "naojobs": naojobs_parser}
    if words[0] == "-m":
        options = modules[words[1]]().parse_args(words[2:])
        checkpoint = getattr(options, "checkpoint", None)
        if isinstance(checkpoint, str) and "/" in checkpoint:
            assert re.fullmatch("(step|checkpoint)-[0-9]{12}", Path(checkpoint).name), f"{checkpoint}: no checkpoint"
    else:
        assert (ROOT / words[0]).is_file(), f"there is no {words[0]}"
        source = (ROOT / words[0]).read_text(encoding="utf-8")
        if "ArgumentParser(" in source:
            check_program(ROOT / words[0], words[1:])
        else:
            compile(source, words[0], "exec")


def check_program(program: Path, words: list[str]) -> None:
    """Run a program as far as it has parsed its arguments, where nothing is loaded but what is installed."""
    parse_args = argparse.ArgumentParser.parse_args

    class ParsedError(Exception): ...

    def parse(parser: argparse.ArgumentParser, *arguments: Any) -> None:
        parse_args(parser, *arguments)
        raise ParsedError

    def ours() -> set[str]:
        files = {name: str(getattr(module, "__file__", "")) for name, module in sys.modules.items()}
        return {name for name, file in files.items() if name.split(".")[0] == "tests" or file.startswith(OURS)}

    with pytest.MonkeyPatch.context() as patch, mock.patch.dict(os.environ), pytest.raises(ParsedError):
        patch.setattr(sys, "argv", [str(program), *words])
        patch.setattr(
            sys, "path", [str(program.parent), *(place for place in sys.path if place not in ("", str(ROOT)))]
        )
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        for name in ours():
            patch.delitem(sys.modules, name)
        try:
            runpy.run_path(str(program), run_name="__main__")
        finally:
            for name in ours():
                del sys.modules[name]


def check_torchrun(words: list[str]) -> None:
    place = words.index("-m")
    assert set(words[:place:2]) <= {"--nnodes", "--node-rank", "--nproc-per-node", "--master-addr"}
    check_python(words[place:])


def check_docker(words: list[str]) -> None:
    if words[0] == "build":
        file = words[words.index("-f") + 1] if "-f" in words else f"{words[-1]}/Dockerfile"
        assert (ROOT / file).is_file(), f"there is no {file}"
        assert (ROOT / words[-1]).is_dir(), f"there is no folder {words[-1]}"
        return
    assert words.pop(0) == "compose"
    files, profiles = [], []
    while words[0].startswith("-"):
        flag, value = words.pop(0), words.pop(0)
        {"-f": files, "--file": files, "--profile": profiles, "--env-file": []}[flag].append(value)
    if words[0] == "...":
        words.pop(0)
    verb = words.pop(0)
    assert verb in COMPOSE, f"docker compose {verb}"
    read = [
        yaml.load((ROOT / file).read_text(encoding="utf-8"), ComposeLoader) for file in files or ["docker-compose.yml"]
    ]
    services = {name for document in read for name in document["services"]}
    known = {
        profile for document in read for one in document["services"].values() for profile in one.get("profiles", ())
    }
    assert set(profiles) <= known | {"*"}, f"no profile {set(profiles) - known}"
    if verb in {"exec", "run"}:
        service = next(word for word in words if not word.startswith("-"))
        assert service in services, f"no service {service}"
        inner = words[words.index(service) + 1 :]
        if inner[0] == "python":
            check_python(inner[1:])
    elif verb in {"build", "logs", "stop", "pull"}:
        named = {word for word in words if not word.startswith("-")}
        assert named <= services, f"no service {named - services}"


CHECKS: dict[str, Callable[[list[str]], None]] = {
    "naoctl": check_naoctl,
    "make": check_make,
    "python": check_python,
    "docker": check_docker,
    "torchrun": check_torchrun,
    "naosim": lambda words: check_python(["-m", "naosim", *words]),
}


@pytest.mark.parametrize("command", [*COMMANDS, *documents.commands_in_text()], ids=str)
def test_every_command_in_the_documents_is_right(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    program, words = Path(command.words[0]), list(command.words[1:])
    if program.parts[:1] in {("deploy",), ("services",), ("tests",)} or program.suffix == ".sh":
        assert os.access(ROOT / program, os.X_OK), f"{program} cannot be run"
        return
    if program.name in SYSTEM:
        return
    assert program.name in CHECKS, f"{program.name}: add a check for it, or name it a program of the system"
    try:
        CHECKS[program.name](words)
    except SystemExit:  # argparse has printed the reason
        pytest.fail(capsys.readouterr().err)


def test_every_program_states_how_it_is_called() -> None:
    stated = {command.words[1] for command in documents.commands_in_text()}
    programs = {
        str(path.relative_to(ROOT)) for path in documents.PROGRAMS if "ArgumentParser(" in path.read_text("utf-8")
    }
    assert programs <= stated


def test_the_documents_speak_of_most_things() -> None:
    used = {(Path(command.words[0]).name, command.words[1] if len(command.words) > 1 else "") for command in COMMANDS}
    assert {("naoctl", name) for name in ("submit", "pause", "resume", "retry", "export", "compare", "token")} <= used
    assert {("make", name) for name in ("demo", "test", "check", "install", "docs")} <= used
    assert {("deploy/backup", "/backups/2026-01-31")} <= {tuple(command.words[:2]) for command in COMMANDS}


def test_commands_in_the_text_exist() -> None:
    known = documents.naoctl().commands
    for path in documents.DOCUMENTS:
        for name in re.findall(r"`naoctl ([a-z]+)", path.read_text(encoding="utf-8")):
            assert name in known, f"{path.name}: naoctl {name}"
    targets = re.findall(r"`make ([a-z]+)", "".join(path.read_text(encoding="utf-8") for path in documents.DOCUMENTS))
    check_make(targets)


def test_scripts_that_documents_name_are_shell_without_mistakes() -> None:
    for name in ("backup", "restore", "new-env"):
        subprocess.run(["sh", "-n", ROOT / "deploy" / name], check=True, timeout=20)


@pytest.mark.parametrize("name", ["own-task.md"])
def test_python_in_the_documents_runs(name: str, tmp_path: Path) -> None:
    # the first blocks are the package, which test_extending.py and an integration test run
    texts = [text for text in documents.blocks(ROOT / "docs" / "how-to" / name, "python") if "import" in text][1:]
    assert len(texts) == 3
    for number, text in enumerate(texts):
        path = tmp_path / f"example_{number}.py"
        path.write_text(text)
        runpy.run_path(str(path))


def test_the_tests_that_prove_the_security_promises_exist() -> None:
    """`tests/file.py::test_one`, and `::test_another` of the same file, in the table's last column."""
    rows = [row for row in (ROOT / "SECURITY.md").read_text(encoding="utf-8").splitlines() if row.startswith("| ")]
    assert len(rows) > 30
    for row in rows[1:]:
        named = re.findall(r"`(tests/[^`:]+)?(?:::(\w+))?`", row.rsplit("|", 2)[1])
        file = ""
        for path, test in named:
            file = path or file
            assert (ROOT / file).exists(), row
            assert not test or f"def {test}(" in (ROOT / file).read_text(encoding="utf-8"), f"{file}: {test}"


def test_source_files_that_documents_name_exist() -> None:
    """Such as ``naosprint/rl/ppo.py``, below any folder of the repository."""
    named = re.compile(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|yaml|cpp|hpp|js|sh))`")
    sources = [
        str(path.relative_to(ROOT))
        for part in ("packages", "services", "docs", "benchmarks", "deploy", "tools", "tests")
        for path in (ROOT / part).rglob("*.*")
    ]
    missing = [
        f"{document.relative_to(ROOT)}: {name}"
        for document in [*documents.DOCUMENTS, *sorted((ROOT / "benchmarks").rglob("*.md"))]
        for name in named.findall(document.read_text())
        if not any(path == name or path.endswith(f"/{name}") for path in sources)
    ]
    assert not missing, missing
