"""Teams: a folder with ``team.json``, which names the command that starts one agent."""

from __future__ import annotations

import json
import re
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import naopolicies
from naospec.files import read_json

from naosprint.export.skill import write_skill
from naosprint.rl.policy import NetworkPolicy, load_policy

if TYPE_CHECKING:
    from collections.abc import Mapping

TEAM_FILE = "team.json"
EXAMPLE = "example"
"""Name of the team of the example player with bundled skills."""
SKILLS = {"walk": ("velocity", "t1-run"), "kick": ("kick", "t1-kick"), "getup": ("getup", "t1-getup-robust")}
"""Skills of the example player: the task of its policy and the bundled policy that it is by default."""
PLACEHOLDERS = ("python", "host", "port", "team", "number", "players")
_PLAYER = Path(__file__).with_name("team")
_MAX_FILE_BYTES, _MAX_WORDS = 100_000, 100


@dataclass(frozen=True)
class Team:
    """A team.

    Attributes:
        folder: its files, the working directory of its agents.
        command: what starts one agent, with placeholders `PLACEHOLDERS` in braces.
        reads: folders besides its own that its agents may read.
    """

    folder: Path
    command: tuple[str, ...]
    reads: tuple[str, ...] = ()

    def agent(self, **values: object) -> list[str]:
        """Return the command of one agent."""
        words = []
        for word in self.command:
            for name, value in {"python": sys.executable, **values}.items():
                word = word.replace("{" + name + "}", str(value))
            words.append(word)
        return words


def read_team(folder: Path) -> Team:
    """Read the team of a folder.

    Raises:
        ValueError: if ``team.json`` is missing or malformed; the message names the folder and what to write.
    """
    file = folder / TEAM_FILE
    example = '{"command": ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}"]}'
    try:
        found = read_json(file, _MAX_FILE_BYTES)
    except FileNotFoundError:
        raise ValueError(f"{folder}: no {TEAM_FILE}; write one such as {example}") from None
    command = found.get("command") if isinstance(found, dict) else None
    reads = found.get("reads", []) if isinstance(found, dict) else []
    if not _are_words(command) or not command:
        raise ValueError(f"{file}: command: expected a list of texts, such as {example}")
    if not _are_words(reads):
        raise ValueError(f"{file}: reads: expected a list of folders")
    unknown = {name for word in command for name in re.findall(r"{(\w+)}", word)} - set(PLACEHOLDERS)
    if unknown:
        raise ValueError(f"{file}: command: no placeholder {', '.join(sorted(unknown))}; use {', '.join(PLACEHOLDERS)}")
    return Team(folder.resolve(), tuple(command), tuple(reads))


def _are_words(found: Any) -> bool:
    return isinstance(found, list) and len(found) <= _MAX_WORDS and all(isinstance(word, str) for word in found)


def skills_of(text: str) -> dict[str, str]:
    """Return the policies by skill of ``example`` or ``example:walk=REFERENCE,kick=REFERENCE``.

    Raises:
        ValueError: for another skill or text.
    """
    name, _, rest = text.partition(":")
    skills = {skill: bundled for skill, (_, bundled) in SKILLS.items()}
    for part in filter(None, rest.split(",")):
        skill, equals, reference = part.partition("=")
        if name != EXAMPLE or skill not in SKILLS or not equals or not reference:
            raise ValueError(f"team {text!r}: {part!r}: expected one of {', '.join(SKILLS)}, '=' and a policy")
        skills[skill] = reference
    return skills


def find_team(text: str, scratch: Path) -> Team:
    """Return the team that a user names.

    Args:
        text: a folder, or ``example`` with or without skills.
        scratch: where an example team is written.

    Raises:
        ValueError: if there is no such team.
    """
    if text.partition(":")[0] == EXAMPLE:
        references = skills_of(text)
        return write_example(scratch, {skill: naopolicies.resolve(each) for skill, each in references.items()})
    folder = Path(text)
    if not folder.is_dir():
        raise ValueError(f"team {text!r}: no such folder; name one with a {TEAM_FILE}, or {EXAMPLE!r}")
    return read_team(folder)


def write_example(folder: Path, checkpoints: Mapping[str, Path]) -> Team:
    """Write the example player with its skills to a folder, and return the team.

    Args:
        folder: where to write; created if need be.
        checkpoints: folder of a checkpoint by skill, one for each of `SKILLS`.

    Raises:
        ValueError: if a policy has another task than its skill, or is not a T1's.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for skill, (task, _) in SKILLS.items():
        policy, manifest = load_policy(checkpoints[skill])
        spec = manifest.stage_spec
        if spec.task.name != task or spec.robot.name != "t1" or not isinstance(policy, NetworkPolicy):
            raise ValueError(
                f"skill {skill}: expected a T1's policy of task {task}, got one of task {spec.task.name} "
                f"for robot {spec.robot.name}"
            )
        with tempfile.TemporaryDirectory() as scratch:
            files = {path.name: path for path in write_skill(policy, manifest, Path(scratch))}
            for name, copy in (("policy.npz", f"{skill}.npz"), ("runner.py", "runner.py"), ("terms.py", "terms.py")):
                shutil.copyfile(files[name], folder / copy)
    for path in sorted(_PLAYER.glob("*.py")):
        shutil.copyfile(path, folder / path.name)
    command = ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}", "{players}"]
    (folder / TEAM_FILE).write_text(json.dumps({"command": command}) + "\n", encoding="utf-8")
    return read_team(folder)
