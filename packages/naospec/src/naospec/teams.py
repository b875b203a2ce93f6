"""Teams as users name them: the example player with skills, or a folder with the command that starts an agent."""

from __future__ import annotations

import re
from dataclasses import dataclass

TEAM_FILE = "team.json"
EXAMPLE = "example"
"""Name of the team of the example player with bundled skills."""
SKILLS = {
    "walk": ("velocity", "t1-run-firm"),
    "kick": ("kick", "t1-kick-firm"),
    "keep": ("block", "t1-keeper"),
    "getup": ("getup", "t1-getup-robust"),
}
"""Skills of the example player: the task of its policy and the bundled policy that it is by default."""
ROBOT = "t1"
"""Robot of the example player."""
PLACEHOLDERS = ("python", "host", "port", "team", "number", "players")
MAX_PLAYERS, MAX_HALF_S = 7, 300
"""Players of a team, and seconds of a half, in the league's rule book."""
_MAX_WORDS = 100
_IMAGE = re.compile(r"[a-zA-Z0-9][\w.:/@-]{0,254}")
_COMMAND = '{"command": ["{python}", "player.py", "{host}", "{port}", "{team}", "{number}"]}'


@dataclass(frozen=True)
class TeamCommand:
    """What a ``team.json`` says.

    Attributes:
        command: what starts one agent, with `PLACEHOLDERS` in braces.
        reads: folders besides the team's own that its agents read.
        image: container image in which the command runs; without one it runs in the team's folder.
    """

    command: tuple[str, ...]
    reads: tuple[str, ...] = ()
    image: str | None = None


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


def team_command(found: object, where: str) -> TeamCommand:
    """Return what the content of a ``team.json`` says.

    Raises:
        ValueError: if it is malformed; the message begins with ``where`` and names what to write.
    """
    content = found if isinstance(found, dict) else {}
    command, reads, image = content.get("command"), content.get("reads", []), content.get("image")
    if not _are_words(command) or not command:
        raise ValueError(f"{where}: command: expected a list of texts, such as {_COMMAND}")
    if not _are_words(reads):
        raise ValueError(f"{where}: reads: expected a list of folders")
    unknown = sorted({name for word in command for name in re.findall(r"{(\w+)}", word)} - set(PLACEHOLDERS))
    if unknown:
        raise ValueError(f"{where}: command: no placeholder {', '.join(unknown)}; use {', '.join(PLACEHOLDERS)}")
    if image is not None:
        if not isinstance(image, str) or not _IMAGE.fullmatch(image):
            raise ValueError(f"{where}: image: expected the name of a container image, such as my-team:1")
        if reads:
            raise ValueError(f"{where}: reads: an image has its own files; leave it out")
        if any("{python}" in word for word in command):
            raise ValueError(f"{where}: command: {{python}} is of this machine; name the image's own, such as python3")
    return TeamCommand(tuple(command), tuple(reads), image)


def no_team_file(where: object) -> str:
    """Return that a folder or archive has no ``team.json``, and what to write."""
    return f"{where}: no {TEAM_FILE}; write one such as {_COMMAND}"


def _are_words(found: object) -> bool:
    return isinstance(found, list) and len(found) <= _MAX_WORDS and all(isinstance(word, str) for word in found)
