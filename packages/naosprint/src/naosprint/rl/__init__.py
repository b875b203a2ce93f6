"""How robots learn: environments for learning, PPO, checkpoints, and the runner that ties them together."""

from __future__ import annotations
