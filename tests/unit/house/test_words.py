"""Phrases of earlier versions that are not plain technical English."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PHRASES = (
    "give their worker free",
    "what they were told differently",
    "not once it is asked for",
    "already and right",
    "that a worker has drawn",
    "the last so many",
    "how the running one is",
    "stack trouble",
    "is no field of",
    "is no state",
    "holds no seed",
    "The key came before",
    "wants a token",
    "has not the scope",
    "Heard of",
    "Works on: nothing",
    "Departs from the preset",
    "an evaluation was asked for",
    "The middle one of",
    "preset and seed name it",
    "Judge it anew",
    "tell the world how it goes",
    "Is the truth of",
    "at a size that networks like",
    "there is nothing at this address",
    "stands there twice",
    "Keep everything to itself",
)


def sources() -> list[Path]:
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", ROOT / "CHANGELOG.md"]
    for folder in ("packages", "services", "docs"):
        for suffix in ("py", "js", "html", "md"):
            found += [path for path in (ROOT / folder).rglob(f"*.{suffix}") if "vendor" not in path.parts]
    return found


@pytest.fixture(scope="module")
def text() -> str:
    return re.sub(r"\s+", " ", "\n".join(path.read_text(encoding="utf-8") for path in sources()))


@pytest.mark.parametrize("phrase", PHRASES)
def test_a_phrase_is_gone(text: str, phrase: str) -> None:
    assert phrase.lower() not in text.lower()
