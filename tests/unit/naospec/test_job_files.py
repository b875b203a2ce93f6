from __future__ import annotations

import os
from pathlib import Path

import pytest
from naospec.job_files import MAX_BYTES, JobFileError, load_job_file

YAML = "name: night\ntags: [a, b]\nspec:\n  preset: paper\n  learning_rate: 1e-4\n"
TOML = 'name = "night"\ntags = ["a", "b"]\n[spec]\npreset = "paper"\nlearning_rate = 1e-4\n'
JSON = '{"name": "night", "tags": ["a", "b"], "spec": {"preset": "paper", "learning_rate": 1e-4}}'


@pytest.mark.parametrize(("ending", "text"), [("yaml", YAML), ("yml", YAML), ("toml", TOML), ("json", JSON)])
def test_the_formats_say_the_same(tmp_path: Path, ending: str, text: str) -> None:
    path = tmp_path / f"job.{ending}"
    path.write_text(text)
    data = load_job_file(path)
    assert data["name"] == "night"
    assert data["tags"] == ["a", "b"]
    assert float(data["spec"]["learning_rate"]) == 1e-4


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("job.yaml", "spec: !!python/object/apply:os.system ['true']", "line 1"),
        ("job.yaml", "a: &x [1]\nb: *x\n", "aliases"),
        ("job.yaml", "spec:\n  seed: 1\n  seed: 2\n", "line 3: seed is given twice"),
        ("job.yaml", "spec: [1\n", "line"),
        ("job.yaml", "1: 2\n", "not a field name"),
        ("job.yaml", "- 1\n", "no fields"),
        ("job.yaml", "", "no fields"),
        ("job.yaml", "a: " + "[" * 60 + "]" * 60, "nested"),
        ("job.yaml", "a: " + "[" * 5000, "job.yaml"),
        ("job.toml", "spec = \n", "job.toml"),
        ("job.json", '{"a": 1, "a": 2}', "twice"),
        ("job.json", '{"a": NaN}', "NaN"),
        ("job.json", "[" * 100_000, "nested"),
        ("job.ini", "x", "no known suffix"),
    ],
)
def test_what_is_wrong_is_refused_in_words(tmp_path: Path, name: str, text: str, words: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(JobFileError) as caught:
        load_job_file(path)
    assert words in caught.value.message
    assert str(caught.value) == f"{caught.value.message}. {caught.value.fix}"


def test_a_file_that_grows_when_it_is_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    rows = ['a0: &a0 ["x", "x"]']
    rows += [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40)]
    path.write_text("\n".join(rows))
    with pytest.raises(JobFileError, match="aliases"):
        load_job_file(path)


def test_files_that_are_too_long_or_unreadable_are_refused(tmp_path: Path) -> None:
    long = tmp_path / "long.yaml"
    long.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(JobFileError, match="longer than"):
        load_job_file(long)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(JobFileError, match="UTF-8"):
        load_job_file(binary)
    with pytest.raises(JobFileError, match="No such file"):
        load_job_file(tmp_path / "missing.yaml")
    with pytest.raises(JobFileError, match="directory"):
        load_job_file(tmp_path)


def test_files_that_take_long_to_read_are_refused(tmp_path: Path) -> None:
    """A key of many parts, whose time and memory grow with their square, deep values, and pipes."""
    path = tmp_path / "job.toml"
    for text in (
        ".".join(["a"] * 40_000) + "=1",
        "[" + " . ".join(["'a'"] * 20_000) + "]",
        "a={" + "b." * 200 + "b=1}",
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(JobFileError, match="line 1: a key of more than 64 parts"):
            load_job_file(path)
    path.write_text("a=" + "[" * 50_000, encoding="utf-8")
    with pytest.raises(JobFileError, match="too deeply nested"):
        load_job_file(path)
    pipe = tmp_path / "pipe.yaml"
    os.mkfifo(pipe)
    with pytest.raises(JobFileError, match="not a regular file"):
        load_job_file(pipe)
