"""The compose files and .env.example agree, and no secret has a default."""

from __future__ import annotations

import re
import stat
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[3]
PASSED_ON = re.compile(r"^ +(NAOSPRINT_[A-Z_]+):$", re.MULTILINE)
"""A variable of a container that has its value, if any, from the settings."""
VARIABLE = re.compile(r"(?<!\$)\$\{([A-Z0-9_]+)(?::([?-])([^}]*))?\}")
EXAMPLE = re.compile(r"^(# )?([A-Z0-9_]+)=(.*)$", re.MULTILINE)


def used() -> dict[str, set[tuple[str, str]]]:
    """Return the variables of the service's compose files with what stands behind each."""
    found: dict[str, set[tuple[str, str]]] = {}
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in ("docker-compose.yml", "deploy/sidecars.yml")]
    for name, operator, text in VARIABLE.findall("".join(texts)):
        found.setdefault(name, set()).add((operator, text))
    for name in PASSED_ON.findall("".join(texts)):
        found.setdefault(name, set()).add(("-", ""))
    return found


def documented() -> dict[str, tuple[bool, str]]:
    """Return the variables of .env.example: whether each is a comment, and its value."""
    text = (ROOT / ".env.example").read_text(encoding="utf-8")
    found = {name: (bool(comment), value) for comment, name, value in EXAMPLE.findall(text)}
    assert found.pop("COMPOSE_PROFILES") == (True, "")  # compose reads it itself
    return found


def test_every_setting_is_documented_with_its_default() -> None:
    assert used().keys() == documented().keys()
    for name, ways in used().items():
        is_comment, value = documented()[name]
        required = any(operator == "?" for operator, _ in ways)
        assert is_comment is not required
        defaults = {text for operator, text in ways if operator == "-"}
        assert defaults == (set() if required else {value}), name


def test_secrets_are_required_and_have_no_default() -> None:
    secrets = {name for name in used() if re.search(r"PASSWORD|SECRET|KEY", name)}
    assert len(secrets) >= 5
    for name in secrets:
        assert documented()[name] == (False, "")


def test_new_env_fills_in_secrets_of_its_own_and_keeps_a_file_that_is_there(tmp_path: Path) -> None:
    made = [tmp_path / "a.env", tmp_path / "b.env"]
    for path in made:
        subprocess.run([ROOT / "deploy" / "new-env", path], check=True, timeout=20)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    values = [
        value
        for path in made
        for _, _, value in EXAMPLE.findall(path.read_text())
        if re.fullmatch("[0-9a-f]{48}", value)
    ]
    assert len(values) == len(set(values)) == 2 * sum(1 for comment, _ in documented().values() if not comment)
    before = made[0].read_text()
    again = subprocess.run([ROOT / "deploy" / "new-env", made[0]], capture_output=True, text=True, timeout=20)
    assert again.returncode == 1 and "exists already" in again.stderr
    assert made[0].read_text() == before


def test_new_env_adds_the_secrets_that_a_file_lacks_and_changes_none(tmp_path: Path) -> None:
    path = tmp_path / "a.env"
    path.write_text("POSTGRES_PASSWORD=\nWORKERS=2\nS3_ACCESS_KEY_ID=mine")  # an empty one, a last line without its end
    subprocess.run([ROOT / "deploy" / "new-env", "--add", path], check=True, timeout=20)
    lines = path.read_text().splitlines()
    assert lines[1:3] == ["WORKERS=2", "S3_ACCESS_KEY_ID=mine"]
    added = dict(line.split("=") for line in lines[3:])
    assert added.keys() == {name for name, (comment, _) in documented().items() if not comment} - {"S3_ACCESS_KEY_ID"}
    assert all(re.fullmatch("[0-9a-f]{48}", value) for value in added.values())
    subprocess.run([ROOT / "deploy" / "new-env", "--add", path], check=True, timeout=20)
    assert path.read_text().splitlines() == lines
