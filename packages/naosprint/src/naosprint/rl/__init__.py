"""Learning: environments, PPO, checkpoints, and the runner."""

from __future__ import annotations
