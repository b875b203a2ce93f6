"""PPO after imitation: the actor learns the actions that a task demonstrates, and then from its own rewards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from naosprint.rl.gradients import Samples, gaussian_entropy
from naosprint.rl.ppo import PPO, explained_variance

if TYPE_CHECKING:
    from collections.abc import Callable

    from naospec import TrainingSpec

    from naosprint.arrays import Float32Array, FloatArray
    from naosprint.rl.rollout import TrainingEnvironment

_RATE, _LEAST_RATE = 1e-3, 0.05
"""Adam's step size at the beginning of the imitation, and the least share of it."""


class ImitatingPPO(PPO):
    """PPO whose first ``imitation_steps`` fit the actor's means to the demonstrations, and the critic to the returns.

    The demonstrations lead a share of the environments that goes down to none, so that the policy learns from the
    states of a good motion first and from its own at last (Ross et al., 2011). The learning rate falls with it.

    Attributes:
        demonstrations: (T, n, A) actions that the task would have taken in the rollout; (0, n, A) after the imitation.

    Raises:
        ValueError: if the task demonstrates nothing.
    """

    def __init__(self, spec: TrainingSpec, environment: TrainingEnvironment) -> None:
        super().__init__(spec, environment)
        self._require_demonstrations()
        self.demonstrations: Float32Array = self.rollout.actions[:0]

    def _require_demonstrations(self) -> None:
        if self.environment.environment.task.demonstration(slice(0, 1)) is None:
            raise ValueError(
                f"algorithm.imitation_steps: task {self.spec.task.name} demonstrates nothing to robot "
                f"{self.spec.robot.name}; use 0"
            )

    def _demonstrated(self, group: slice) -> FloatArray | None:
        """Return the (k, A) actions to imitate in the next step of a group; called once a step."""
        return self.environment.environment.task.demonstration(group)

    def _left(self) -> float:
        """Return the share of the imitation that is still to come: 1 at its beginning, 0 after it."""
        steps: int = self.settings.imitation_steps
        return max(0.0, 1.0 - self.steps / steps)

    def collect(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Collect one rollout; see :meth:`Learner.collect`."""
        actions = self.rollout.actions
        self.demonstrations = np.zeros_like(actions if self._left() else actions[:0])
        return super().collect(stop)

    def _act(self, seen: Float32Array, noise: Float32Array, out: Float32Array, step: int, group: slice) -> None:
        """Take the policy's actions, or those of the demonstration with its noise where that leads."""
        super()._act(seen, noise, out, step, group)
        if len(self.demonstrations):
            shown = self.demonstrations[step, group]
            shown[:] = self._demonstrated(group)
            led = max(0, round(self._left() * self.environment.n) - group.start)
            out[:led] = (shown + noise)[:led]

    def update(self) -> dict[str, float]:
        """Improve the policy with the rollout; see :meth:`Learner.update`."""
        if not len(self.demonstrations):
            return super().update()
        self.normalizer.merge(self.processes)
        settings, rollout = self.settings, self.rollout
        # the step that the rollout has ended at counts
        rate = self._optimizer.lr = _RATE * max(_LEAST_RATE, self._left())
        observations, returns = rollout.flat("observations"), rollout.flat("returns")
        shown = torch.from_numpy(self.demonstrations.reshape(-1, self.environment.n_actions))
        parameters = list(self.policy.parameters())
        samples = self._losses.prepare(Samples(observations, shown, returns, returns, returns))
        losses: list[tuple[float, ...]] = []
        batch_size = settings.batch_size // self.processes.size
        for _ in range(settings.n_epochs):
            order = torch.randperm(len(returns), generator=self.generator)
            for first in range(0, len(returns), batch_size):
                chosen = order[first : first + batch_size]
                losses.append(self._mean_of_processes(parameters, self._losses.imitation(samples, chosen)))
                self._require_finite(losses[-1], 0.0)
                self._optimizer.step()
        self._n_passes += settings.n_epochs
        self._update_average()
        if not self._left():
            # PPO's gradients have another scale
            self._optimizer.state.clear()
            self._averaged = 0
        self.updates += 1
        policy_loss, value_loss = np.mean(losses, axis=0).tolist()
        return {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "approx_kl": 0.0,
            "clip_fraction": 0.0,
            "explained_variance": explained_variance(rollout.values, rollout.returns),
            "action_std": float(self.policy.log_std.detach().exp().mean()),
            "entropy": float(gaussian_entropy(self.policy.log_std.detach())),
            "learning_rate": rate,
        }
