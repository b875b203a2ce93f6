"""One training in several processes as a job of Slurm."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from naosprint.rl.checkpoint import read_manifest

from .conftest import Cluster

ROOT = Path(__file__).parents[3]
SMALL = (
    *("--preset", "fast", "--n-envs", "8", "--n-steps", "64", "--batch-size", "128", "--hidden-sizes", "16"),
    *("--simulator-threads", "1", "--learner-threads", "1", "--checkpoint-interval-steps", "5120"),
)


def test_a_training_that_is_queued_again_continues_also_with_other_processes(
    cluster: Cluster, tmp_path: Path, wait_for: Callable[..., Any]
) -> None:
    folder, log = tmp_path / "training", tmp_path / "log"

    def submit(ntasks: int, steps: int) -> str:
        script = str(ROOT / "deploy" / "slurm" / "training.sbatch")
        place = f"ALL,NAOSPRINT_PYTHON={sys.executable},MASTER_ADDR=127.0.0.1"
        options = [f"--ntasks={ntasks}", "--mem-per-cpu=800M", f"--export={place}", f"--output={log}"]
        return cluster.run(
            "sbatch", "--parsable", *options, script, str(folder), *SMALL, "--total-steps", str(steps)
        ).strip()

    def checkpoints() -> list[Path]:
        return sorted(folder.glob("step-*"))

    def said() -> str:
        return log.read_text() if log.exists() else ""

    job = submit(2, 204_800)
    wait_for(lambda: len(checkpoints()) >= 3, 120, "no checkpoint was saved")
    before = len(checkpoints())
    cluster.run("scontrol", "requeue", job)
    # Slurm delays a job that is queued again
    wait_for(lambda: "resumed at" in said(), 240, "it was not continued")
    assert len(checkpoints()) >= before
    wait_for(lambda: "finished 204800" in said(), 240, "it did not end")
    assert read_manifest(checkpoints()[-1]).processes == 2
    wait_for(lambda: job not in cluster.jobs(), 60, "the job did not end")

    submit(1, 225_280)
    wait_for(lambda: "finished 225280" in said(), 120, "it did not continue in one process")
    assert read_manifest(checkpoints()[-1]).processes == 1
