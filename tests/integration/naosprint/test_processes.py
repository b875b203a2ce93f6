"""One training in several processes, started as torchrun and Slurm do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from naosprint.rl.checkpoint import read_file, verify_checkpoint

from tests.ports import reserved_port

SHAPE = ("--n-envs", "8", "--n-steps", "32", "--batch-size", "64", "--hidden-sizes", "8")
LONG = ("--total-steps", "100000000", "--checkpoint-interval-steps", "256")


class Team:
    """Starts the processes of trainings, and ends those that are left."""

    def __init__(self) -> None:
        self.started: list[subprocess.Popen[str]] = []

    def start(self, *arguments: str | Path, size: int = 2) -> list[subprocess.Popen[str]]:
        """Start a training in `size` processes."""
        port = str(reserved_port())
        command = [sys.executable, "-m", "naosprint", "train", *map(str, arguments), "--preset", "fast", *SHAPE]
        team = []
        for rank in range(size):
            place = {"RANK": str(rank), "WORLD_SIZE": str(size), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
            environment = {**os.environ, **(place if size > 1 else {}), "COLUMNS": "200"}
            process = subprocess.Popen(
                command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            team.append(process)
            self.started.append(process)
        return team

    def run(self, *arguments: str | Path, size: int = 2) -> Path:
        """Train to the end and return the last checkpoint."""
        team = self.start(*arguments, size=size)
        said = [process.communicate(timeout=90) for process in team]
        assert [process.returncode for process in team] == [0] * size, said
        assert [out for out, _ in said[1:]] == [""] * (size - 1), "only the first process reports"
        status, _, path = said[0][0].split()
        assert status == "finished"
        return Path(path)


@pytest.fixture
def team() -> Iterator[Team]:
    team = Team()
    yield team
    for process in team.started:
        process.kill()
        process.communicate()


def files(checkpoint: Path) -> dict[str, dict[str, np.ndarray]]:
    manifest = verify_checkpoint(checkpoint)
    return {name: read_file(checkpoint, manifest, name) for name in manifest.files}


def test_the_same_seed_has_the_same_result_resumed_or_not(team: Team, tmp_path: Path) -> None:
    """Another number of processes continues with new episodes."""
    whole = team.run(tmp_path / "whole", "--total-steps", "1024")
    half = team.run(tmp_path / "half", "--total-steps", "512")
    resumed = team.run(tmp_path / "resumed", "--total-steps", "1024", "--resume", half)
    assert verify_checkpoint(whole).processes == 2
    assert verify_checkpoint(whole).steps == 1024
    ours, theirs = files(whole), files(resumed)
    assert ours.keys() == theirs.keys() == {"policy.npz", "learner.npz", "environment.npz", "process-1.npz"}
    for name, arrays in ours.items():
        for key, array in arrays.items():
            np.testing.assert_array_equal(array, theirs[name][key], err_msg=f"{name}: {key}")
    first, second = ours["environment.npz"], ours["process-1.npz"]
    assert len(first["environment.steps"]) == 4, "each process has its share of the environments"
    assert not np.array_equal(first["environment.observer.observations"], second["environment.observer.observations"])
    assert not np.array_equal(ours["learner.npz"]["normalizer.returns"], second["normalizer.returns"])
    alone = team.run(tmp_path / "alone", "--total-steps", "1024", "--resume", half, size=1)
    assert verify_checkpoint(alone).processes == 1
    assert verify_checkpoint(alone).steps == 1024
    assert verify_checkpoint(team.run(tmp_path / "again", "--total-steps", "1536", "--resume", alone)).processes == 2


def test_what_has_grown_in_a_curriculum_stays_with_another_number_of_processes(team: Team, tmp_path: Path) -> None:
    """Robots that only stand for two seconds succeed once in four updates; the next begins new episodes."""
    grows = ("--disturbance-growth", "0.5", "--sensor-noise", "0.01", "--start-episode-fraction", "0.9")
    stands = ("--learning-rate", "1e-9", "--initial-log-std", "-10")
    before = team.run(tmp_path / "before", "--total-steps", "1024", *grows, *stands)
    for size in (1, 4):
        folder = tmp_path / f"{size}"
        team.run(folder, "--total-steps", "1280", "--resume", before, size=size)
        (row,) = map(json.loads, (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines())
        assert row["disturbance_strength"] == 0.5


def test_a_lost_process_ends_the_others_and_its_checkpoints_remain(team: Team, tmp_path: Path) -> None:
    first, second = team.start(tmp_path, *LONG)
    assert first.stderr is not None
    for line in first.stderr:
        if "checkpoint at 1,024 steps" in line:
            break
    second.kill()
    _, said = first.communicate(timeout=30)
    assert first.returncode == 1
    assert "another process of this training has ended or does not answer" in said
    newest = max(tmp_path.glob("step-*"))
    assert verify_checkpoint(newest).steps >= 1024
    assert not list(tmp_path.glob(".*partial"))


def test_what_cannot_be_divided_is_refused(team: Team, tmp_path: Path) -> None:
    for process in team.start(tmp_path, "--total-steps", "512", size=3):
        _, said = process.communicate(timeout=60)
        assert process.returncode != 0
        assert "n_envs: 8 cannot be divided among 3 processes; use a multiple of it" in said


GRADIENTS = """
import sys
import numpy as np, torch
from naosprint.rl.processes import connected

rows = torch.from_numpy(np.random.default_rng(0).normal(size=(64, 5)))
layer = torch.nn.Linear(5, 3).double()
torch.nn.init.constant_(layer.weight, 0.3)
torch.nn.init.constant_(layer.bias, -0.1)

def gradients(rows):
    layer.zero_grad()
    layer(rows).tanh().square().mean().backward()
    return [parameter.grad for parameter in layer.parameters()]

whole = [gradient.clone() for gradient in gradients(rows)]
with connected() as processes:
    own = gradients(rows.chunk(processes.size)[processes.rank])
    assert not torch.allclose(own[0], whole[0])
    processes.average(own)
    assert all(torch.allclose(ours, theirs, rtol=1e-12) for ours, theirs in zip(own, whole)), (own, whole)
    assert processes.sum(np.array([1.0, processes.rank])).tolist() == [2.0, 1.0]
    parts = processes.gather({"rank": np.full(3 + processes.rank, processes.rank)})
    assert [part["rank"].tolist() for part in parts] == ([[0] * 3, [1] * 4] if processes.rank == 0 else [])
"""


def test_the_mean_of_all_shares_is_the_gradient_of_the_minibatch(team: Team) -> None:
    port = str(reserved_port())
    for rank in "01":
        place = {"RANK": rank, "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        team.started.append(
            subprocess.Popen(
                [sys.executable, "-c", GRADIENTS], env={**os.environ, **place}, stderr=subprocess.PIPE, text=True
            )
        )
    for process in team.started:
        _, said = process.communicate(timeout=60)
        assert process.returncode == 0, said
