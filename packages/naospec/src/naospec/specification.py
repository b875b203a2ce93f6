"""What a training and an evaluation are, in every detail that decides their outcome."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from naospec.presets import PRESETS, PresetName
from naospec.robots import STANDING_HEIGHT_M
from naospec.tasks import TASKS, Task, task

SimulatorName = Literal["embedded", "rcssserver3d"]

MAX_ROLLOUT_STEPS = 4_194_304
"""Most samples of one rollout (``n_envs * n_steps``): about 2 GB of memory."""


class _Specification(BaseModel):
    """Share what every specification has: it is frozen, knows no extra fields and has a digest."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, protected_namespaces=())

    def canonical_json(self) -> str:
        """Return the one JSON text that equal specifications share: sorted keys, no blanks."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), allow_nan=False)

    def digest(self) -> str:
        """Return the SHA-256 of the canonical JSON as 64 hexadecimal digits."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()


def _fast(field: str) -> Any:
    return PRESETS["fast"][field]


class TrainingSpec(_Specification):
    """Say what to train and how: everything that the weights depend on, and how fast to get there.

    Fields left out take the value of the preset, so ``TrainingSpec(preset="paper")`` is the paper's table II and
    ``TrainingSpec(preset="paper", clip_range=0.2)`` departs from it in one field.
    """

    task: str = Field(
        default="sprint1",
        title="Task",
        description="Sprint task to learn.",
        json_schema_extra={"enum": list(TASKS)},
    )
    min_height: float | None = Field(
        default=None,
        gt=0.0,
        title="Minimum torso height",
        description="Torso height in metres below which an episode ends as a fall; left out: the task's own.",
        json_schema_extra={"unit": "m"},
    )
    robot_type: int = Field(
        default=0,
        ge=0,
        le=4,
        title="Robot type",
        description="NAO type of the league: 0 standard, 1 and 3 longer limbs, 2 fast ankles, 4 toes.",
    )
    simulator: SimulatorName = Field(
        default="embedded",
        title="Simulator",
        description="Where the robot runs: the embedded engine, or one rcssserver3d per environment.",
    )
    preset: PresetName = Field(
        default="fast",
        title="Preset",
        description="Source of every learning setting that is left out.",
    )
    total_steps: int = Field(
        default=10_000_000,
        ge=1,
        le=10_000_000_000,
        title="Total steps",
        description="Environment steps to train for; rounded up to whole rollouts.",
        json_schema_extra={"unit": "steps"},
    )
    seed: int = Field(
        default=0,
        ge=0,
        le=2**31 - 1,
        title="Seed",
        description="Seed of initial weights, exploration, minibatches and starts.",
    )

    n_envs: int = Field(
        default=_fast("n_envs"), ge=1, le=4096, title="Environments", description="Robots that run side by side."
    )
    n_steps: int = Field(
        default=_fast("n_steps"),
        ge=2,
        le=1_048_576,
        title="Steps per rollout",
        description="Steps of each environment between two updates of the policy.",
        json_schema_extra={"unit": "steps"},
    )
    batch_size: int = Field(
        default=_fast("batch_size"),
        ge=2,
        title="Minibatch size",
        description="Samples per gradient step; must divide n_envs * n_steps.",
        json_schema_extra={"unit": "samples"},
    )
    n_epochs: int = Field(
        default=_fast("n_epochs"), ge=1, le=1000, title="Epochs", description="Passes over each rollout per update."
    )
    learning_rate: float = Field(
        default=_fast("learning_rate"), gt=0.0, le=1.0, title="Learning rate", description="Step size of Adam."
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
        title="Target KL",
        description="End an update early when the approximate KL divergence passes 1.5 times this; null: never.",
    )
    target_kl_final: float | None = Field(
        default=_fast("target_kl_final"),
        gt=0.0,
        title="Final target KL",
        description="Target KL at the end of the training, approached linearly over total_steps; null: no change.",
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
        default=_fast("gamma_steps"), ge=0, title="Discount steps", description="Steps after which final_gamma holds."
    )
    gae_lambda: float = Field(
        default=_fast("gae_lambda"), ge=0.0, le=1.0, title="GAE lambda", description="Lambda of the advantage estimate."
    )
    entropy_coefficient: float = Field(
        default=_fast("entropy_coefficient"),
        ge=0.0,
        title="Entropy coefficient",
        description="Weight of the entropy bonus in the loss.",
    )
    value_coefficient: float = Field(
        default=_fast("value_coefficient"),
        ge=0.0,
        title="Value coefficient",
        description="Weight of the value loss in the loss.",
    )
    max_grad_norm: float | None = Field(
        default=_fast("max_grad_norm"),
        gt=0.0,
        title="Gradient norm limit",
        description="Longest gradient; longer ones are scaled down; null: no limit.",
    )
    adam_epsilon: float = Field(
        default=_fast("adam_epsilon"), gt=0.0, le=1.0, title="Adam epsilon", description="Epsilon of Adam."
    )
    advantage_normalisation: Literal["minibatch", "rollout", "none"] = Field(
        default=_fast("advantage_normalisation"),
        title="Advantage normalisation",
        description="Standardise advantages over each minibatch, over the whole rollout, or not at all.",
    )
    hidden_sizes: tuple[Annotated[int, Field(ge=1, le=4096)], ...] = Field(
        default=_fast("hidden_sizes"),
        max_length=8,
        title="Hidden layers",
        description="Units of each hidden tanh layer, for actor and critic alike.",
    )
    weight_initialisation: Literal["orthogonal", "unit_norm"] = Field(
        default=_fast("weight_initialisation"),
        title="Weight initialisation",
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
        description="Logarithm of the initial standard deviation of the actions.",
    )
    final_log_std: float | None = Field(
        default=_fast("final_log_std"),
        ge=-10.0,
        le=2.0,
        title="Final log-std",
        description="If set, log-std is not learnt but goes straight from initial_log_std to this, and stays there.",
    )
    log_std_steps: int | None = Field(
        default=_fast("log_std_steps"),
        ge=1,
        title="Log-std steps",
        description="Steps after which log-std is final_log_std; null: at the end of the training.",
    )
    policy_averaging: float = Field(
        default=_fast("policy_averaging"),
        ge=0.0,
        lt=1.0,
        title="Policy averaging",
        description="Decay per update of the running mean of the weights that checkpoints hold; 0: the latest weights.",
    )
    normalise_observations: bool = Field(
        default=_fast("normalise_observations"),
        title="Normalise observations",
        description="Standardise each observation by its running mean and variance.",
    )
    observation_clip: float = Field(
        default=_fast("observation_clip"),
        gt=0.0,
        title="Observation clip",
        description="Largest magnitude of a normalised observation.",
    )
    normalise_rewards: bool = Field(
        default=_fast("normalise_rewards"),
        title="Normalise rewards",
        description="Divide rewards by the running standard deviation of the discounted return.",
    )
    bootstrap_at_end: bool = Field(
        default=_fast("bootstrap_at_end"),
        title="Bootstrap at the end",
        description="Where an episode ends by anything but a fall, estimate what would have followed.",
    )
    reward_scale: float = Field(
        default=_fast("reward_scale"),
        gt=0.0,
        title="Reward scale",
        description="Reward per metre of forward displacement.",
        json_schema_extra={"unit": "1/m"},
    )
    drift_penalty: float = Field(
        default=_fast("drift_penalty"),
        ge=0.0,
        le=10.0,
        title="Drift penalty",
        description="Reward lost per metre away from the line straight ahead, as a share of that for a metre forward.",
    )
    fall_penalty_m: float = Field(
        default=_fast("fall_penalty_m"),
        ge=0.0,
        le=100.0,
        title="Fall penalty",
        description="Reward lost at a fall, as that of so many metres forward.",
        json_schema_extra={"unit": "m"},
    )

    start_practice: float = Field(
        default=_fast("start_practice"),
        ge=0.0,
        le=0.9,
        title="Start practice",
        description="Share of the environments that practise starts: their episodes are cut off after two seconds.",
    )
    start_noise_deg: float = Field(
        default=2.0,
        ge=0.0,
        le=20.0,
        title="Start noise",
        description="Each joint of the start pose is moved by up to this angle, drawn anew for each start.",
        json_schema_extra={"unit": "deg"},
    )
    sensor_digits: Literal[2, 3] | None = Field(
        default=2,
        title="Sensor digits",
        description="Decimals that perceptors carry: 2 as in the league, 3 as some servers do, null for all.",
    )
    checkpoint_interval_steps: int = Field(
        default=1_000_000,
        ge=1,
        title="Checkpoint interval",
        description="Save a checkpoint at the first update after every so many steps, and at the end.",
        json_schema_extra={"unit": "steps"},
    )
    simulator_threads: int = Field(
        default=2, ge=1, le=256, title="Simulator threads", description="Threads that step the embedded engine."
    )
    torch_threads: int = Field(default=2, ge=1, le=256, title="Learner threads", description="Threads of the learner.")
    standby_servers: bool = Field(
        default=True,
        title="Standby servers",
        description=(
            "rcssserver3d only: give every environment a second server, which prepares its next start while the robot "
            "runs on the first. Without it all robots wait whenever one starts."
        ),
    )
    max_server_failures: int = Field(
        default=20,
        ge=0,
        le=1_000_000,
        title="Server failures allowed",
        description=(
            "rcssserver3d only: servers that may fail and be replaced over the whole run; one more ends the training."
        ),
    )

    @classmethod
    def from_preset(cls, preset: PresetName, **overrides: Any) -> Self:
        """Build the specification of ``preset`` with ``overrides`` by field name.

        Raises:
            pydantic.ValidationError: if the preset is unknown or a field does not fit.
        """
        return cls.model_validate({**overrides, "preset": preset})

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, data: Any) -> Any:
        """Fill in what the preset and the task decide; leave bad values to the field validators."""
        if not isinstance(data, dict):
            return data
        filled = dict(data)
        preset = filled.get("preset", "fast")
        if isinstance(preset, str) and preset in PRESETS:
            filled = {**PRESETS[preset], **filled}
        name = filled.get("task", "sprint1")
        if filled.get("min_height") is None and isinstance(name, str) and name in TASKS:
            filled["min_height"] = TASKS[name].min_height_m
        return filled

    @field_validator("task")
    @classmethod
    def _known_task(cls, value: str) -> str:
        return task(value).name

    @model_validator(mode="after")
    def _possible(self) -> Self:
        standing = STANDING_HEIGHT_M[self.robot_type]
        if self.fall_height_m >= standing:
            raise ValueError(
                f"min_height: {self.fall_height_m:g} m is not below the standing height of robot type "
                f"{self.robot_type}, {standing:.3f} m; choose a smaller min_height"
            )
        if self.symmetric_policy and any(width % 2 for width in self.hidden_sizes):
            raise ValueError(
                f"hidden_sizes: a symmetric policy needs layers of even width, not {list(self.hidden_sizes)}; "
                "choose even widths or symmetric_policy = false"
            )
        if self.learning_rate_schedule == "adaptive" and self.target_kl is None:
            raise ValueError("target_kl: an adaptive learning rate needs one; set target_kl, for example 0.01")
        rollout = self.rollout_steps
        if rollout > MAX_ROLLOUT_STEPS:
            raise ValueError(
                f"n_steps: one rollout of n_envs * n_steps = {rollout} samples is more than {MAX_ROLLOUT_STEPS}; "
                "lower n_envs or n_steps"
            )
        if rollout % self.batch_size:
            raise ValueError(
                f"batch_size: {self.batch_size} does not divide n_envs * n_steps = {self.n_envs} * {self.n_steps} "
                f"= {rollout}; choose a divisor, for example {_nearest_divisor(rollout, self.batch_size)}"
            )
        return self

    @property
    def fall_height_m(self) -> float:
        """Torso height in metres below which an episode ends as a fall."""
        if self.min_height is None:  # only reachable through model_construct, which skips validation
            raise ValueError("min_height: missing; build the specification through its constructor")
        return self.min_height

    @property
    def task_definition(self) -> Task:
        """The task that ``task`` names."""
        return task(self.task)

    @property
    def rollout_steps(self) -> int:
        """Samples of one rollout: environments times steps of each."""
        return self.n_envs * self.n_steps

    @property
    def planned_steps(self) -> int:
        """Steps that the training really takes: ``total_steps`` rounded up to whole rollouts."""
        return -(-self.total_steps // self.rollout_steps) * self.rollout_steps

    def departures(self) -> dict[str, Any]:
        """Return the learning settings that differ from those of the preset, by field name."""
        preset = PRESETS[self.preset]
        return {name: getattr(self, name) for name, value in preset.items() if getattr(self, name) != value}


class EvaluationSpec(_Specification):
    """Say how a policy is judged."""

    episodes: int = Field(default=1000, ge=1, le=1_000_000, title="Episodes", description="Episodes to run.")
    seed: int = Field(
        default=0, ge=0, le=2**31 - 1, title="Seed", description="Seed of the starts and of the bootstrap intervals."
    )
    task: str = Field(
        default="sprint1",
        title="Task",
        description="Task whose end conditions the episodes follow.",
        json_schema_extra={"enum": list(TASKS)},
    )
    deterministic: bool = Field(
        default=True, title="Deterministic", description="Take the mean action, rather than draw one from the policy."
    )
    start_noise_deg: float = Field(
        default=2.0,
        ge=0.0,
        le=20.0,
        title="Start noise",
        description="Each joint of the start pose is moved by up to this angle, drawn anew for each episode.",
        json_schema_extra={"unit": "deg"},
    )
    simulator: SimulatorName | None = Field(
        default=None, title="Simulator", description="Where the episodes run; null: where the policy was trained."
    )
    n_envs: int = Field(
        default=128,
        ge=1,
        le=4096,
        title="Environments",
        description="Episodes that run side by side; on rcssserver3d at most four a core.",
    )
    trajectories: int = Field(
        default=100,
        ge=0,
        le=10_000,
        title="Trajectories",
        description="Episodes whose path is kept, counted from the first.",
    )
    confidence: float = Field(
        default=0.95, gt=0.0, lt=1.0, title="Confidence", description="Level of all confidence intervals."
    )
    bootstrap_resamples: int = Field(
        default=2000,
        ge=100,
        le=100_000,
        title="Bootstrap resamples",
        description="Resamples behind each bootstrap interval.",
    )

    @field_validator("task")
    @classmethod
    def _known_task(cls, value: str) -> str:
        return task(value).name


def _nearest_divisor(number: int, wish: int) -> int:
    """Return the divisor of ``number``, at least 2, whose ratio to ``wish`` is closest to one."""
    divisors = {d for low in range(1, int(number**0.5) + 1) if number % low == 0 for d in (low, number // low)}
    return min((d for d in divisors if d >= 2), key=lambda d: max(d / wish, wish / d))
