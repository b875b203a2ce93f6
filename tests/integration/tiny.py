"""A very short training, for tests and benchmarks of the service."""

from __future__ import annotations

from typing import Any

TINY: dict[str, Any] = {
    "task": "sprint2",
    "n_envs": 2,
    "n_steps": 8,
    "batch_size": 16,
    "n_epochs": 1,
    "hidden_sizes": (4,),
    "simulator_threads": 1,
    "learner_threads": 1,
}
"""Settings by short name: the smallest network, two robots."""

ROLLOUT = TINY["n_envs"] * TINY["n_steps"]
"""Steps between two updates."""
