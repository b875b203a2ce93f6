"""Read the documents: their code blocks, and the commands in these."""

from __future__ import annotations

import ast
import re
import shlex
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from naoctl.cli import build_app
from typer.main import get_command

ROOT = Path(__file__).parents[3]
PROGRAMS = [path for folder in ("benchmarks", "docs", "tools") for path in sorted((ROOT / folder).rglob("*.py"))]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

_BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\w+)\n(?P<text>.*?)^(?P=indent)```", re.MULTILINE | re.DOTALL)
_CALL = re.compile(
    r"(?:^ {4}|(?P<code>`))(?:[A-Z_]+=\S+ |sudo )*"
    r"(?P<program>python -m \w+|naoctl|naosprint|naosim|(?P<python>[\w./]*python )?(?P<path>[\w./-]+\.py))"
    r"(?P<words>(?:\s(?(code)[^`]*|(?:[^#\n]*\\\n)*[^#\n]*))?)(?:(?(code)`)|$)",
    re.MULTILINE,
)
"""A command in code within a line, or in a line of an indented block with those that continue it."""
_HERE = re.compile(r"<<'?(?P<end>\w+)'?\n.*?^(?P=end)$", re.MULTILINE | re.DOTALL)
_SUBSTITUTION = re.compile(r"\$\((.*?)\)")
_ASSIGNMENT = re.compile(r"[A-Z][A-Z0-9_]*=.*")


@cache
def naoctl() -> Any:
    """Return the command line with all commands."""
    return get_command(build_app())


@dataclass(frozen=True)
class Command:
    """One command of a document, without the variables set in front of it."""

    document: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.document}: {shlex.join(self.words)}"


def blocks(path: Path, language: str) -> list[str]:
    """Return the code blocks of a language."""
    found = []
    for match in _BLOCK.finditer(path.read_text(encoding="utf-8")):
        if match["language"] == language:
            lines = match["text"].splitlines()
            found.append("\n".join(line.removeprefix(match["indent"]) for line in lines) + "\n")
    return found


def commands() -> list[Command]:
    """Return every command of every shell block, split at `&&`, without output redirections."""
    found = []
    for path in DOCUMENTS:
        for block in blocks(path, "sh"):
            text = _HERE.sub("\n", block).replace("\\\n", " ")
            lines = [*_SUBSTITUTION.findall(text), *_SUBSTITUTION.sub("VALUE", text).splitlines()]
            for line in lines:
                for words in _simple(line):
                    while words and _ASSIGNMENT.fullmatch(words[0]):
                        words.pop(0)
                    if words:
                        found.append(Command(path.relative_to(ROOT).as_posix(), tuple(words)))
    return found


def commands_in_text() -> list[Command]:
    """Return the commands outside of shell blocks that run a program or have options, with all optional words."""
    found = []
    for path in [*DOCUMENTS, *sorted((ROOT / "benchmarks").rglob("*.md")), *PROGRAMS]:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".py":
            text = ast.get_docstring(ast.parse(text), clean=False) or ""
        for match in _CALL.finditer(text):
            words = re.sub(r"[\[\]\\]|\.\.\.", " ", match["words"])
            if match["path"]:
                folder = path.parent if (path.parent / match["path"]).is_file() else ROOT
                program = f"python {(folder / match['path']).relative_to(ROOT)}"
                is_command = match["python"] or (words and folder / match["path"] in PROGRAMS)
            else:
                program = re.sub("^naosprint", "python -m naosprint", match["program"])
                is_command = re.search(r"--(?!help|install)[a-z]", words)
            if is_command:
                found.append(Command(path.relative_to(ROOT).as_posix(), tuple(shlex.split(f"{program} {words}"))))
    return list(dict.fromkeys(found))


def _simple(line: str) -> list[list[str]]:
    lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;<>")
    lexer.whitespace_split = True
    lexer.commenters = "#"
    parts: list[list[str]] = [[]]
    skip = False
    for word in lexer:
        if set(word) <= set("&|;"):
            parts.append([])
        elif set(word) <= set("<>"):
            skip = True  # a file follows
        elif skip:
            skip = False
        else:
            parts[-1].append(word)
    return [part for part in parts if part]
