"""Teams: a folder with ``team.json``, which names the command that starts one agent."""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import naopolicies
from naospec.files import read_json, together, write_whole
from naospec.teams import EXAMPLE, ROBOT, SKILLS, TEAM_FILE, no_team_file, skills_of, team_command

from naosprint.export.skill import write_skill
from naosprint.rl.policy import NetworkPolicy, load_policy

if TYPE_CHECKING:
    from collections.abc import Mapping

_PLAYER = Path(__file__).with_name("team")
_MAX_FILE_BYTES = 100_000


@dataclass(frozen=True)
class Team:
    """A team.

    Attributes:
        folder: its files, the working directory of its agents.
        command: what starts one agent, with placeholders `PLACEHOLDERS` in braces.
        reads: folders besides its own that its agents may read.
        image: container image in which the command runs; without one it runs in the folder.
    """

    folder: Path
    command: tuple[str, ...]
    reads: tuple[str, ...] = ()
    image: str | None = None

    def agent(self, **values: object) -> list[str]:
        """Return the command of one agent."""
        words = []
        for word in self.command:
            for name, value in {"python": sys.executable, **values}.items():
                word = word.replace("{" + name + "}", str(value))
            words.append(word)
        return words

    def digest(self) -> str:
        """Return the SHA-256 of its command and its files, whatever their folder; compiled files do not count."""
        digest = hashlib.sha256(json.dumps([self.command, sorted(self.reads), self.image]).encode())
        for path in sorted(self.folder.rglob("*")):
            if path.is_file() and path.parent.name != "__pycache__":
                digest.update(json.dumps(path.relative_to(self.folder).as_posix()).encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()


def read_team(folder: Path) -> Team:
    """Read the team of a folder.

    Raises:
        ValueError: if ``team.json`` is missing or malformed; the message names the folder and what to write.
    """
    file = folder / TEAM_FILE
    try:
        found = read_json(file, _MAX_FILE_BYTES)
    except FileNotFoundError:
        raise ValueError(no_team_file(folder)) from None
    team = team_command(found, str(file))
    return Team(folder.resolve(), team.command, team.reads, team.image)


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
    found = []
    for skill, (task, _) in SKILLS.items():
        policy, manifest = load_policy(checkpoints[skill])
        spec = manifest.stage_spec
        if spec.task.name != task or spec.robot.name != ROBOT or not isinstance(policy, NetworkPolicy):
            raise ValueError(
                f"skill {skill}: expected a T1's policy of task {task}, got one of task {spec.task.name} "
                f"for robot {spec.robot.name}"
            )
        found.append((skill, policy, manifest))
    folder.mkdir(parents=True, exist_ok=True)
    copies: dict[str, bytes] = {}
    for skill, policy, manifest in found:
        with tempfile.TemporaryDirectory() as scratch:
            files = {path.name: path for path in write_skill(policy, manifest, Path(scratch))}
            for name, copy in (("policy.npz", f"{skill}.npz"), ("runner.py", "runner.py"), ("terms.py", "terms.py")):
                copies[copy] = files[name].read_bytes()
    copies |= {path.name: path.read_bytes() for path in sorted(_PLAYER.glob("*.py"))}
    command = ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}", "{players}"]
    copies[TEAM_FILE] = json.dumps({"command": command}).encode() + b"\n"
    with together():
        for name, data in copies.items():
            write_whole(folder / name, data)
    return read_team(folder)
