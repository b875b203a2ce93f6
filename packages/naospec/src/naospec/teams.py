"""Teams as users name them: the example player with skills, or a folder with the command that starts an agent."""

from __future__ import annotations

import re

TEAM_FILE = "team.json"
EXAMPLE = "example"
"""Name of the team of the example player with bundled skills."""
SKILLS = {"walk": ("velocity", "t1-run"), "kick": ("kick", "t1-kick"), "getup": ("getup", "t1-getup-robust")}
"""Skills of the example player: the task of its policy and the bundled policy that it is by default."""
ROBOT = "t1"
"""Robot of the example player."""
PLACEHOLDERS = ("python", "host", "port", "team", "number", "players")
MAX_PLAYERS, MAX_HALF_S = 7, 300
"""Players of a team, and seconds of a half, in the league's rule book."""
_MAX_WORDS = 100
_COMMAND = '{"command": ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}"]}'


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


def example_name(skills: dict[str, str]) -> str:
    """Return the shortest text of which `skills_of` returns these skills."""
    others = [f"{skill}={skills[skill]}" for skill, (_, bundled) in SKILLS.items() if skills[skill] != bundled]
    return f"{EXAMPLE}:{','.join(others)}" if others else EXAMPLE


def team_command(found: object, where: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the command of a ``team.json``, and the folders besides its own that the agents read.

    Raises:
        ValueError: if it is malformed; the message begins with ``where`` and names what to write.
    """
    command = found.get("command") if isinstance(found, dict) else None
    reads = found.get("reads", []) if isinstance(found, dict) else []
    if not _are_words(command) or not command:
        raise ValueError(f"{where}: command: expected a list of texts, such as {_COMMAND}")
    if not _are_words(reads):
        raise ValueError(f"{where}: reads: expected a list of folders")
    unknown = sorted({name for word in command for name in re.findall(r"{(\w+)}", word)} - set(PLACEHOLDERS))
    if unknown:
        raise ValueError(f"{where}: command: no placeholder {', '.join(unknown)}; use {', '.join(PLACEHOLDERS)}")
    return tuple(command), tuple(reads)


def no_team_file(where: object) -> str:
    """Return that a folder or archive has no ``team.json``, and what to write."""
    return f"{where}: no {TEAM_FILE}; write one such as {_COMMAND}"


def _are_words(found: object) -> bool:
    return isinstance(found, list) and len(found) <= _MAX_WORDS and all(isinstance(word, str) for word in found)
