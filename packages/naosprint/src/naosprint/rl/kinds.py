"""The learning algorithms of this package, described without loading PyTorch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from naosprint.rl.learner import Learner, LearnerKind
from naosprint.rl.settings import CHARTS, METRICS, PPOSettings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from naosim.robots import Robot
    from naospec import LearnerSettings, TrainingSpec

    from naosprint.arrays import AnyArray
    from naosprint.rl.policy import Policy
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
        settings = PPOSettings.of(spec.algorithm)
        if settings.teacher:
            from naosprint.rl.distillation import DistillingPPO  # loads PyTorch

            return DistillingPPO(spec, environment)
        from naosprint.rl.imitation import ImitatingPPO
        from naosprint.rl.ppo import PPO

        return (ImitatingPPO if settings.imitation_steps else PPO)(spec, environment)

    def require(self, settings: LearnerSettings, robot: Robot, task: str) -> None:
        """Check that the teacher can teach; see :meth:`LearnerKind.require`."""
        teacher = PPOSettings.of(settings).teacher
        if teacher is not None:
            from naosprint.tasks.frozen import require_teacher  # loads compiled code

            require_teacher(teacher, robot, task)

    def load_policy(
        self,
        state: Mapping[str, AnyArray],
        settings: LearnerSettings,
        *,
        observations: Sequence[str],
        actions: Sequence[str],
    ) -> Policy:
        """Return the actor with the observations' statistics."""
        from naosprint.rl.policy import actor_of  # loads compiled code

        return actor_of(state, PPOSettings.of(settings), len(observations), len(actions))


PPO = PPOKind()
"""Entry ``ppo`` of the group ``naosprint.learners``."""
