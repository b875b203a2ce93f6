"""Recorded evaluations and trainings, each run in a subprocess: ``python runs.py evaluations`` prints JSON.

The subprocess runs in :func:`pinned_environment`, which selects the same floating-point kernels on every x86-64 machine
with AVX2. The regression tests call evaluate, train and their specifications only in this module.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from naosprint.threads import COMMON_KERNELS

EPISODES, FEW_EPISODES = 25, 4
TOTAL_STEPS = 40_000
TIMING_COLUMNS = ("time_s", "steps_per_s", "collect_s", "simulator_s", "learn_s", "eta_s")

_PINNED = {**COMMON_KERNELS, "PYTHONHASHSEED": "0"}

_UNPINNED_PREFIXES = ("OPENBLAS_", "MKL_", "OMP_", "GOMP_", "KMP_", "ONEDNN_", "DNNL_", "ATEN_", "NPY_", "TORCH_")


def pinned_environment() -> dict[str, str]:
    """Return the environment of this process, with settings that fix the floating-point kernels."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(_UNPINNED_PREFIXES)}
    return {**inherited, **_PINNED}


def run(kind: str) -> dict[str, Any]:
    """Run one of ``KINDS`` in a pinned subprocess and return its results, with the ``platform`` that computed them.

    Raises:
        RuntimeError: if the subprocess fails; the message ends with its standard error.
    """
    return run_script(Path(__file__), kind)


def run_script(script: Path, *arguments: str) -> dict[str, Any]:
    """Run a Python script in a pinned subprocess and return the JSON that it prints.

    Raises:
        RuntimeError: if the subprocess fails; the message ends with its standard error.
    """
    command = [sys.executable, str(script), *arguments]
    done = subprocess.run(command, env=pinned_environment(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{script.name} {' '.join(arguments)}: exit status {done.returncode}\n{done.stderr}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def evaluations() -> dict[str, Any]:
    """Evaluate each bundled policy on the task that it was trained for."""
    import naopolicies
    from naospec import EvaluationSpec
    from naosprint import tasks
    from naosprint.analysis.evaluation import evaluate
    from naosprint.rl.policy import load_policy

    found = {}
    for name in naopolicies.names():
        folder = naopolicies.folder(name)
        trained = load_policy(folder)[1].spec
        sprint = "distance_m" in [metric.name for metric in tasks.get(trained.task.name).metrics]
        spec = EvaluationSpec(task=trained.task.name, episodes=EPISODES if sprint else FEW_EPISODES, seed=0)
        evaluation = evaluate(folder, spec)
        summary = (recorded_form if sprint else plain_form)(evaluation.summary)
        replay = evaluation.replay
        found[name] = {
            "summary": summary,
            "trajectories": hashes(vars(evaluation.trajectories)),
            "replay": hashes(
                {
                    "positions": replay.positions,
                    "rotations": replay.rotations,
                    "foot_forces": replay.foot_forces,
                }
            ),
        }
    return found


def plain_form(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results of an evaluation of any task."""
    kept = ("name", "value", "sd", "count", "interval")
    return {
        "checkpoint": {"step": summary["checkpoint"]["step"]},
        "server_failures": summary["server_failures"],
        "episodes": summary["episodes"],
        "results": [{key: result[key] for key in kept if key in result} for result in summary["results"]],
    }


def recorded_form(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results of an evaluation of a sprint in the form in which they were recorded."""
    results = {result["name"]: result for result in summary["results"]}

    def spread(result: Mapping[str, Any]) -> dict[str, Any]:
        old = {"mean": "value", "sd": "sd", "min": "low", "max": "high", "ci": "interval"}
        return {"episodes": result["episodes"], **{name: result[new] for name, new in old.items()}}

    def share(name: str) -> dict[str, Any]:
        result = results[name]
        return {"count": result["count"], "rate": result["value"], "ci": result["interval"]}

    def challenge() -> dict[str, Any]:
        return {
            "score": spread(results["run_challenge_score"]),
            "speed_mps": spread(results["run_challenge_speed_mps"]),
            "off_ground": spread(results["run_challenge_flight_share"]),
            "falls": share("run_challenge_fall_rate"),
        }

    nao = "low_at_end" in results
    table = summary["tables"][0]
    paper, everyone = (column["results"] for column in table["columns"])
    return {
        "checkpoint": {"step": summary["checkpoint"]["step"]},
        "server_failures": summary["server_failures"],
        "episodes": summary["episodes"],
        "distance_m": spread(results["distance_m"]),
        "speed_mps": spread(results["speed_mps"]),
        "steps": spread(results["episode_length"]),
        "falls": share("fall_rate"),
        "arrivals": share("arrival_rate"),
        "time_limits": share("time_limit_rate"),
        "paper": {
            "top_speed_mps": results["top_speed_mps"]["value"],
            "top_speed_sd_mps": results["top_speed_mps"]["sd"],
            "fastest_episode_mps": results["fastest_mps"]["value"],
            "deviation_deg": {
                "mean": results["deviation_deg"]["value"],
                "sd": results["deviation_deg"]["sd"],
            },
            **({"low_at_end": share("low_at_end")} if nao else {}),
        },
        "speed_by_line": [
            {"line_m": line, "paper": spread(first), "all": spread(second)}
            for line, first, second in zip(table["at"], paper, everyone, strict=True)
        ],
        "both_feet_off_ground": spread(results["flight_share"]),
        **({"run_challenge": challenge()} if nao else {}),
    }


def training(name: str) -> dict[str, Any]:
    """Train briefly: with a preset and PyTorch's gradients, or, as ``compiled``, preset fast with the kernel's."""
    from naospec import TrainingSpec
    from naosprint.rl.checkpoint import read_arrays
    from naosprint.rl.runner import train

    class LastRow:
        """Reporter that keeps the last row of metrics."""

        row: dict[str, float]

        def metrics(self, row: dict[str, float]) -> None:
            self.row = row

        def checkpoint(self, path: Path, step: int) -> None:
            pass

        def log(self, level: str, message: str) -> None:
            pass

    spec = TrainingSpec.model_validate(
        {
            "algorithm": {"preset": "fast" if name == "compiled" else name, "compiled_update": name == "compiled"},
            "total_steps": TOTAL_STEPS,
            "seed": 0,
            "runtime": {"simulator_threads": 1, "learner_threads": 1},
        }
    )
    reporter = LastRow()
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = train(spec, workdir=Path(folder), reporter=reporter).checkpoint
        policy, learner, environment = (
            hashes(read_arrays(checkpoint / f"{name}.npz")) for name in ("policy", "learner", "environment")
        )
    return {
        "metrics": {name: value for name, value in reporter.row.items() if name not in TIMING_COLUMNS},
        "policy": policy,
        # sorted hashes, because arrays of these files may be renamed as long as their contents stay
        "learner": sorted(learner.values()),
        "environment": sorted(environment.values()),
    }


def hashes(arrays: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 of type, shape and bytes of each array."""
    import numpy as np

    found = {}
    for name, array in arrays.items():
        digest = hashlib.sha256(f"{array.dtype.str}{list(array.shape)}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
        found[name] = digest.hexdigest()
    return found


def platform() -> dict[str, str]:
    """Return the hashes of small computations: machines with equal hashes compute equal results."""
    import math

    import numpy as np
    import torch

    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    observations = rng.standard_normal((128, 70), dtype=np.float32)
    weights = rng.standard_normal((128, 70), dtype=np.float32) / 8
    wide = rng.standard_normal((1000,))
    probes = {
        "numpy_matmul": observations @ weights.T,
        "numpy_matmul_19_rows": observations[:19] @ weights[:64].T,
        "numpy_float32": np.concatenate([np.tanh(observations), np.exp(observations)]),
        "numpy_float64": np.stack(
            [wide.cumsum(), np.exp(wide), np.sin(wide), np.cos(wide), np.tanh(wide), np.arctan2(wide, wide[::-1])]
        ),
        "numpy_sums": np.array([wide.sum(), wide.std(), float(observations.sum()), float(np.var(observations))]),
        "libm": np.array([f(x) for x in wide.tolist() for f in (math.sin, math.cos, math.atan, math.exp)]),
        "numpy_rng": rng.standard_normal(1000),
    }
    for name, rows in (("few", 19), ("many", 128), ("minibatch", 2048)):
        inputs = torch.from_numpy(rng.standard_normal((rows, 70), dtype=np.float32))
        layer = torch.nn.Linear(70, 128)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weights))
            layer.bias.copy_(torch.from_numpy(weights[:, 0].copy()))
        loss = torch.tanh(layer(inputs)).square().mean()
        loss.backward()
        probes[f"torch_linear_{name}"] = torch.cat(
            [layer.weight.grad.flatten(), layer.bias.grad, loss.detach().reshape(1)]
        ).numpy()
        adam = torch.optim.Adam(layer.parameters(), lr=1e-3, eps=1e-5, fused=True)
        adam.step()
        probes[f"adam_{name}"] = layer.weight.detach().numpy()
    generator = torch.Generator()
    generator.manual_seed(0)
    noise = torch.randn((64, 128, 22), generator=generator)
    probes["torch_rng"] = noise.numpy()
    probes["torch_sums"] = torch.stack([noise.sum(), noise.mean(), noise.std(), noise.exp().mean()]).numpy()
    probes["torch_qr"] = torch.linalg.qr(noise[0])[0].numpy()
    return hashes(probes)


def verification() -> dict[str, Any]:
    """Train the last steps of each bundled policy that has a checkpoint for it; return which arrays differ."""
    import naopolicies
    from naosprint.rl.verification import last_two, verify

    folders = {name: naopolicies.folder(name) for name in naopolicies.names()}
    kept = {name: folder for name, folder in folders.items() if (folder / naopolicies.EARLIER).is_dir()}
    return {name: list(verify(*last_two(folder)).differing) for name, folder in kept.items()}


KINDS = {
    "verification": verification,
    "evaluations": evaluations,
    "training-fast": partial(training, "fast"),
    "training-paper": partial(training, "paper"),
    "training-compiled": partial(training, "compiled"),
}

if __name__ == "__main__":
    from naosprint.threads import quiet_openmp

    quiet_openmp()
    sys.stdout.write(json.dumps({"platform": platform(), "results": KINDS[sys.argv[1]]()}, allow_nan=False))
