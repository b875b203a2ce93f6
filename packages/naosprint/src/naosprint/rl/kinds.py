"""The learning algorithms of this package, described without loading PyTorch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from naosprint.rl.learner import Learner, LearnerKind
from naosprint.rl.settings import CHARTS, METRICS, PPOSettings

if TYPE_CHECKING:
    from naospec import TrainingSpec

    from naosprint.rl.rollout import TrainingEnvironment


class PPOKind(LearnerKind):
    """Proximal policy optimization (Schulman et al., 2017)."""

    name = "ppo"
    summary = "Proximal policy optimization with a Gaussian policy."
    Parameters = PPOSettings
    metrics = METRICS
    charts = CHARTS
    several_processes = True

    def open(self, spec: TrainingSpec, environment: TrainingEnvironment) -> Learner:
        """Return a new learner for these environments."""
        from naosprint.rl.ppo import PPO  # loads PyTorch

        return PPO(spec, environment)


PPO = PPOKind()
"""Entry ``ppo`` of the group ``naosprint.learners``."""
