"""Settings of PPO, and what it reports."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from naospec import LearnerSettings, presets
from naospec.abilities import DEMONSTRATIONS
from naospec.metrics import Chart, Metric
from naospec.sections import PlainName
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

MAX_ROLLOUT_STEPS = 4_194_304
"""Most samples of one rollout: about 2 GB of memory."""


def _fast(field: str) -> Any:
    return presets.read("fast")["algorithm"][field]


class PPOSettings(LearnerSettings):
    """Settings of PPO; those left out take the preset's value."""

    batch_size: int = Field(
        default=_fast("batch_size"),
        ge=2,
        le=MAX_ROLLOUT_STEPS,
        title="Minibatch size",
        description="Samples per gradient step; must divide n_envs * n_steps.",
        json_schema_extra={"unit": "samples"},
    )
    n_epochs: int = Field(
        default=_fast("n_epochs"), ge=1, le=1000, title="Epochs", description="Passes over each rollout per update."
    )
    learning_rate: float = Field(
        default=_fast("learning_rate"), gt=0.0, le=0.1, title="Learning rate", description="Step size of Adam."
    )
    learning_rate_schedule: Literal["constant", "linear", "adaptive"] = Field(
        default=_fast("learning_rate_schedule"),
        title="Learning-rate schedule",
        description="Keep the learning rate, lower it linearly to zero over total_steps, or adapt it to target_kl.",
    )
    clip_range: float = Field(
        default=_fast("clip_range"),
        gt=0.0,
        lt=1.0,
        title="Clip range",
        description="Clip parameter of the PPO objective.",
    )
    target_kl: float | None = Field(
        default=_fast("target_kl"),
        gt=0.0,
        le=10.0,
        title="Target KL",
        description="End an update early when the approximate KL divergence exceeds 1.5 times this; null disables it.",
    )
    target_kl_final: float | None = Field(
        default=_fast("target_kl_final"),
        gt=0.0,
        le=10.0,
        title="Final target KL",
        description="Target KL at the end of the training, approached linearly over total_steps; null keeps target_kl.",
        json_schema_extra={"with": ["target_kl"]},
    )
    gamma: float = Field(
        default=_fast("gamma"), gt=0.0, le=1.0, title="Discount", description="Discount factor per step."
    )
    final_gamma: float | None = Field(
        default=_fast("final_gamma"),
        gt=0.0,
        le=1.0,
        title="Final discount",
        description="If set, the discount factor from gamma_steps on.",
    )
    gamma_steps: int = Field(
        default=_fast("gamma_steps"),
        ge=0,
        le=10_000_000_000,
        title="Discount steps",
        description="Steps after which final_gamma holds.",
        json_schema_extra={"with": ["final_gamma"]},
    )
    gae_lambda: float = Field(
        default=_fast("gae_lambda"), ge=0.0, le=1.0, title="GAE lambda", description="Lambda of the advantage estimate."
    )
    entropy_coefficient: float = Field(
        default=_fast("entropy_coefficient"),
        ge=0.0,
        le=10.0,
        title="Entropy coefficient",
        description="Weight of the entropy bonus in the loss.",
    )
    value_coefficient: float = Field(
        default=_fast("value_coefficient"),
        ge=0.0,
        le=1000.0,
        title="Value coefficient",
        description="Weight of the value loss in the loss.",
    )
    max_grad_norm: float | None = Field(
        default=_fast("max_grad_norm"),
        gt=0.0,
        le=1e6,
        title="Gradient norm limit",
        description="Gradients with a larger norm are scaled down to it; null disables the limit.",
    )
    adam_epsilon: float = Field(
        default=_fast("adam_epsilon"), gt=0.0, le=1.0, title="Adam epsilon", description="Epsilon of Adam."
    )
    advantage_normalization: Literal["minibatch", "rollout", "none"] = Field(
        default=_fast("advantage_normalization"),
        title="Advantage normalization",
        description="Standardize advantages over each minibatch, over the whole rollout, or not at all.",
    )
    hidden_sizes: tuple[Annotated[int, Field(ge=1, le=4096)], ...] = Field(
        default=tuple(_fast("hidden_sizes")),
        min_length=1,
        max_length=8,
        title="Hidden layers",
        description=(
            "Units of each hidden tanh layer, for actor and critic alike. A training that starts from a policy can "
            "have wider layers."
        ),
    )
    weight_initialization: Literal["orthogonal", "unit_norm"] = Field(
        default=_fast("weight_initialization"),
        title="Weight initialization",
        description="Orthogonal matrices, or Gaussian weights scaled so that each unit's incoming weights have norm 1.",
    )
    symmetric_policy: bool = Field(
        default=_fast("symmetric_policy"),
        title="Symmetric policy",
        description="Tie the weights so that a mirrored observation gives the mirrored action.",
    )
    initial_log_std: float = Field(
        default=_fast("initial_log_std"),
        ge=-10.0,
        le=2.0,
        title="Initial log-std",
        description="Logarithm of the initial standard deviation of the actions. A training that starts from a policy, "
        "such as a later stage, keeps that of the policy unless final_log_std is set.",
    )
    final_log_std: float | None = Field(
        default=_fast("final_log_std"),
        ge=-10.0,
        le=2.0,
        title="Final log-std",
        description="If set, log-std is not learned but changes linearly from initial_log_std to this.",
    )
    log_std_steps: int | None = Field(
        default=_fast("log_std_steps"),
        ge=1,
        le=10_000_000_000,
        title="Log-std steps",
        description="Steps after which log-std is final_log_std; null stands for total_steps.",
        json_schema_extra={"with": ["final_log_std"]},
    )
    ema_decay: float = Field(
        default=_fast("ema_decay"),
        ge=0.0,
        lt=1.0,
        title="EMA decay",
        description="Decay per update of the weights' moving average, which checkpoints contain; 0: no averaging.",
    )
    critic_observations: bool = Field(
        default=False,
        title="Privileged critic",
        description="The critic also observes what a policy cannot: the torso's true height and velocity, the friction "
        "of the floor, gravity and delay. It is needed in training only, so a policy acts and is exported as before.",
    )
    normalize_observations: bool = Field(
        default=_fast("normalize_observations"),
        title="Normalize observations",
        description="Standardize each observation by its running mean and variance.",
    )
    observation_clip: float = Field(
        default=_fast("observation_clip"),
        gt=0.0,
        le=1e6,
        title="Observation clip",
        description="Largest magnitude of a normalized observation.",
        json_schema_extra={"with": ["normalize_observations"]},
    )
    normalize_rewards: bool = Field(
        default=_fast("normalize_rewards"),
        title="Normalize rewards",
        description="Divide rewards by the running standard deviation of the discounted return.",
    )
    bootstrap_at_end: bool = Field(
        default=_fast("bootstrap_at_end"),
        title="Bootstrap at the end",
        description="Where an episode ends without a failure, estimate the value of the next state. Tasks that "
        "are over then, such as a kick, have none.",
    )

    imitation_steps: int = Field(
        default=0,
        ge=0,
        le=10_000_000_000,
        title="Imitation steps",
        description="Steps at the beginning in which the policy learns the actions that the task or a teacher "
        "demonstrates, and the critic their value.",
        json_schema_extra={"unit": "steps", "needs": DEMONSTRATIONS},
    )
    teacher: PlainName | None = Field(
        default=None,
        title="Teacher",
        description="Bundled policy of the same robot and task that demonstrates its actions during the imitation. It "
        "sees what the critic sees, so a policy can learn to do without what only a simulator knows.",
        json_schema_extra={"provides": DEMONSTRATIONS},
    )
    compiled_update: bool = Field(
        default=True,
        title="Compiled update",
        description="Compute actions and gradients by compiled kernels, not by PyTorch; the last digits differ.",
    )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.symmetric_policy and any(width % 2 for width in self.hidden_sizes):
            raise PydanticCustomError(
                "hidden_sizes",
                "hidden_sizes: expected even widths for a symmetric policy, got {sizes}; "
                "use even widths or symmetric_policy=false",
                {"sizes": list(self.hidden_sizes)},
            )
        if self.learning_rate_schedule == "adaptive" and self.target_kl is None:
            raise PydanticCustomError(
                "target_kl", "target_kl: an adaptive learning rate needs one; set target_kl, for example 0.01"
            )
        if self.teacher is not None and not (self.imitation_steps and self.critic_observations):
            raise PydanticCustomError(
                "teacher",
                "teacher: needs imitation_steps above 0, during which it is imitated, and critic_observations=true, "
                "so that it sees all that it observes",
            )
        rollout = self.rollout_steps
        if rollout > MAX_ROLLOUT_STEPS:
            raise PydanticCustomError(
                "n_steps",
                "n_steps: one rollout of n_envs * n_steps = {rollout} samples is more than {most}; "
                "lower n_envs or n_steps",
                {"rollout": rollout, "most": MAX_ROLLOUT_STEPS},
            )
        if rollout % self.batch_size:
            raise PydanticCustomError(
                "batch_size",
                "batch_size: {size} does not divide n_envs * n_steps = {envs} * {steps} = {rollout}; "
                "use a divisor, for example {divisor}",
                {
                    "size": self.batch_size,
                    "envs": self.n_envs,
                    "steps": self.n_steps,
                    "rollout": rollout,
                    "divisor": _nearest_divisor(rollout, self.batch_size),
                },
            )
        return self

    def policy_shape(self) -> dict[str, Any]:
        """Return the settings that the policy has to have, too, from which a training with these starts.

        A policy that treats left and right alike can stop doing so; another one could begin to only as another policy.
        """
        shape: dict[str, Any] = {"normalize_observations": self.normalize_observations}
        return {**shape, "symmetric_policy": True} if self.symmetric_policy else shape

    def misfit(self, start: LearnerSettings) -> tuple[str, Any, Any] | None:
        """Return the first setting that differs; see :meth:`LearnerSettings.misfit`. Layers can be wider than there."""
        sizes: tuple[int, ...] = getattr(start, "hidden_sizes", ())
        if len(sizes) != len(self.hidden_sizes) or any(
            ours < theirs for ours, theirs in zip(self.hidden_sizes, sizes, strict=True)
        ):
            return "hidden_sizes", list(sizes), list(self.hidden_sizes)
        return super().misfit(start)


METRICS: tuple[Metric, ...] = (
    Metric("policy_loss", "Policy loss", "", "PPO's clipped objective, negated, mean of the update's minibatches.", 4),
    Metric("value_loss", "Value loss", "", "Squared error of the critic, mean of the update's minibatches.", 4),
    Metric(
        "approx_kl",
        "KL divergence",
        "nat",
        "Estimated KL divergence of the last epoch's policy from the one that collected.",
        4,
    ),
    Metric("clip_fraction", "Clip fraction", "%", "Fraction of samples whose probability ratio was clipped.", 1),
    Metric(
        "explained_variance",
        "Explained variance",
        "",
        "Fraction of the returns' variance that the critic predicted.",
        3,
    ),
    Metric("action_std", "Action std", "", "Standard deviation of the exploration noise, mean of all joints.", 3),
    Metric("entropy", "Entropy", "nat", "Entropy of the policy's action distribution.", 2),
    Metric("learning_rate", "Learning rate", "", "Adam's step size in this update.", 6),
)
"""Metrics of every update."""

CHARTS: tuple[Chart, ...] = (
    Chart("KL divergence", ("approx_kl",)),
    Chart("Learning rate", ("learning_rate",)),
    Chart("Losses", ("policy_loss", "value_loss")),
    Chart("Explained variance", ("explained_variance",)),
    Chart("Exploration", ("action_std",)),
    Chart("Clip fraction", ("clip_fraction",)),
)
"""Charts of these metrics."""


def _nearest_divisor(number: int, wanted: int) -> int:
    """Return the divisor of ``number``, at least 2, whose ratio to ``wanted`` is closest to one."""
    divisors = {d for low in range(1, int(number**0.5) + 1) if number % low == 0 for d in (low, number // low)}
    return min((d for d in divisors if d >= 2), key=lambda d: max(d / wanted, wanted / d))
