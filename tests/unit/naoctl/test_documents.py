"""What the documents tell people to type exists and is right."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

from naoctl.cli import build_app
from naoctl.commands.submit import make_body
from naoctl.errors import ExitCode
from naoctl.jobfile import load_job_file
from naosprint_api.schemas import JobCreate
from typer.main import get_command

ROOT = Path(__file__).parents[3]
DOCUMENTS = [ROOT / "README.md", ROOT / "docs" / "tutorial.md"]


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    found = []
    for path in DOCUMENTS:
        for block in blocks(path, "sh"):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words and words[0].endswith("naoctl"):
                    found.append(shlex.join(words[1:]))
    return found


def test_every_command_in_the_documents_exists() -> None:
    program = get_command(build_app())
    for line in commands():
        words, name, command = shlex.split(line), "naoctl", program
        while hasattr(command, "commands"):
            name = words.pop(0)
            assert name in command.commands, f"naoctl {line}"
            command = command.commands[name]
        command.make_context(name, words)


def test_the_documents_use_most_commands() -> None:
    names = {line.split()[0] for line in commands()}
    assert {"up", "submit", "logs", "download", "eval", "compare", "cancel", "token", "list"} <= names


def test_the_curl_example_is_a_job() -> None:
    (text,) = (block for block in blocks(DOCUMENTS[0], "sh") if "curl -X POST" in block)
    body = re.search(r"-d '(.*?)'", text, re.DOTALL)
    assert body is not None
    assert JobCreate.model_validate(json.loads(body[1])).spec.total_steps == 3_000_000


def test_the_job_file_of_the_tutorial_is_a_job(tmp_path: Path) -> None:
    (text,) = blocks(DOCUMENTS[1], "yaml")
    path = tmp_path / "night.yaml"
    path.write_text(text)
    job = JobCreate.model_validate(make_body(load_job_file(path), {"seed": "3"}, {}))
    assert (job.name, job.spec.algorithm.preset, job.spec.seed) == ("night", "paper", 3)


def test_the_documents_know_every_exit_code() -> None:
    table = DOCUMENTS[1].read_text(encoding="utf-8")
    numbers = {int(number) for row in re.findall(r"^\| ([\d, ]+) \|", table, re.MULTILINE) for number in row.split(",")}
    assert numbers == {int(code) for code in ExitCode}
