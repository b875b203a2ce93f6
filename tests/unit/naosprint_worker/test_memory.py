"""A worker's children share the memory of its container; the files of their attempts count, too."""

from __future__ import annotations

import math
from pathlib import Path

import psutil
import pytest
from naojobs.models import WorkKind
from naosprint_worker.memory import MIB, MemoryBudget, container_limit


def own() -> int:
    """Return the memory of this process, which other tests have made larger."""
    return int(psutil.Process().memory_info().rss)


@pytest.mark.parametrize(
    ("name", "text", "limit"),
    [
        ("memory.max", "268435456\n", 256 * MIB),
        ("memory.max", "max\n", math.inf),
        ("memory/memory.limit_in_bytes", "268435456\n", 256 * MIB),
        ("memory/memory.limit_in_bytes", "9223372036854771712\n", math.inf),
    ],
)
def test_limit_of_the_container(tmp_path: Path, name: str, text: str, limit: float) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    assert container_limit(tmp_path) == limit


def test_no_container_has_no_limit(tmp_path: Path) -> None:
    assert container_limit(tmp_path) == math.inf


def test_files_in_memory_count(tmp_path: Path) -> None:
    """Any file system's used space is counted in the same way as that of a tmpfs."""
    without, counted = MemoryBudget(1e15), MemoryBudget(1e15, tmp_path)
    assert counted.used_bytes() - without.used_bytes() > 100 * MIB


def test_largest_training_ends_when_there_is_no_evaluation() -> None:
    budget = MemoryBudget(own() + 2000 * MIB)
    with budget.share(WorkKind.JOB) as one, budget.share(WorkKind.JOB) as other:
        assert not one.must_end(900 * MIB)
        assert budget.has_room()
        assert other.must_end(1300 * MIB)
        assert other.crowded
        assert not one.must_end(900 * MIB)
        assert not budget.has_room()
    assert budget.victim() is None


def test_one_child_alone_is_not_crowded() -> None:
    budget = MemoryBudget(own() + 100 * MIB)
    with budget.share(WorkKind.EVALUATION) as only:
        assert only.must_end(200 * MIB)
        assert not only.crowded
