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
    "the message says",
    "what there is.",
    "what goes in and out",
    "all told",
    "seen to",
    "dealt with",
    "deals with",
    "sees to",
    "in the box",
    "others alone",
    "was told",
    "told to",
    "told apart",
    "took nobody",
    "comes along",
    "not finite any more",
    "of so many",
    "that are there stay",
    "need another look",
    '"""let ',
    "/** let ",
    "doorbell",
)
WORDS = (
    "anew",
    "whoever",
    "judges?",
    "judged",
    "judgements?",
    "percepts?",
    "(is|are|was|were) away",
    "(go|goes|went) on (from|behind|elsewhere)",
    "speaks? of",
    "lies? (below|there)",
    "gave? back",
    "knows? (no|nothing|neither)",
    "says? (which|why|how|otherwise)",
    "tells? (of|whether|which|how)",
    "is no (job|evaluation|setting|part|json|data|policy)",
)
"""Regular expressions of words that the project's glossary replaces."""

BRITISH = (
    r"\b(\w*colours?|(kilo|milli|centi)?metres?|neighbour\w*|behaviours?|licences?|for ever|analysed?|"
    r"(optim|normal|initial|random|serial|minim|maxim)is(e|ed|er|es))\b"
)
"""Spellings that have an American form, which the documents use."""


def sources() -> list[Path]:
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", ROOT / "CHANGELOG.md"]
    for folder in ("packages", "services", "docs", "deploy", "benchmarks", "tools", "tests"):
        for suffix in ("py", "cpp", "hpp", "js", "html", "md", "yml"):
            found += (ROOT / folder).rglob(f"*.{suffix}")
    return [
        path for path in found if path != Path(__file__) and not {"vendor", "node_modules", "build"} & set(path.parts)
    ]


def joined(paths: list[Path]) -> str:
    return re.sub(r"\s+", " ", "\n".join(path.read_text(encoding="utf-8") for path in paths)).lower()


@pytest.fixture(scope="module")
def text() -> str:
    return joined(sources())


@pytest.mark.parametrize("phrase", PHRASES)
def test_a_phrase_is_gone(text: str, phrase: str) -> None:
    assert phrase.lower() not in text


def test_the_glossarys_words_are_gone(text: str) -> None:
    used = re.finditer(rf"(?<!there )\b({'|'.join(WORDS)})\b", text)
    assert [text[max(0, match.start() - 40) : match.end() + 40] for match in used] == []


def test_attributes_are_described_below_them() -> None:
    """Not by comments above, so that there is one dialect, which tools read."""
    comment = re.compile(r"^\s*#: ", re.MULTILINE)
    assert [str(path) for path in sources() if path.suffix == ".py" and comment.search(path.read_text("utf-8"))] == []


def test_the_documents_have_american_spelling() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "mkdocs.yml", *(ROOT / "docs").rglob("*.md")]
    found = {match[0] for match in re.finditer(BRITISH, joined(pages))}
    assert not found
