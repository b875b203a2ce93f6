"""Short names for the settings of a specification, and the fields of the flat form of earlier versions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from naospec import plugins
from naospec.sections import variants

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic.fields import FieldInfo

MOVED = {
    "preset": "algorithm.preset",
    "min_height": "task.min_height_m",
    "robot_type": "robot: use nao-0 to nao-4",
    "policy_averaging": "algorithm.ema_decay",
    "normalise_observations": "algorithm.normalize_observations",
    "normalise_rewards": "algorithm.normalize_rewards",
    "advantage_normalisation": "algorithm.advantage_normalization",
    "weight_initialisation": "algorithm.weight_initialization",
    "start_practice": "task.start_episode_fraction",
    "reward_scale": "task.reward_scale",
    "drift_penalty": "task.drift_penalty",
    "fall_penalty_m": "task.fall_penalty_m",
    "start_noise_deg": "task.start_noise_deg",
    "sensor_digits": "simulator.sensor_digits",
    "checkpoint_interval_steps": "runtime.checkpoint_interval_steps",
    "simulator_threads": "runtime.simulator_threads",
    "torch_threads": "runtime.learner_threads",
    "standby_servers": "runtime.standby_servers",
    "max_server_failures": "runtime.max_server_failures",
    **{
        name: f"algorithm.{name}"
        for name in (
            "n_envs",
            "n_steps",
            "batch_size",
            "n_epochs",
            "learning_rate",
            "learning_rate_schedule",
            "clip_range",
            "target_kl",
            "target_kl_final",
            "gamma",
            "final_gamma",
            "gamma_steps",
            "gae_lambda",
            "entropy_coefficient",
            "value_coefficient",
            "max_grad_norm",
            "adam_epsilon",
            "hidden_sizes",
            "symmetric_policy",
            "initial_log_std",
            "final_log_std",
            "log_std_steps",
            "observation_clip",
            "bootstrap_at_end",
        )
    },
}
"""Fields of the flat form of version 0.1, and where each is now."""

GROUPS = {
    "task": plugins.TASKS,
    "robot": plugins.ROBOTS,
    "simulator": plugins.SIMULATORS,
    "algorithm": plugins.LEARNERS,
}
"""Sections that plug-ins define, and their entry-point groups."""


@dataclass(frozen=True)
class Setting:
    """One setting of a specification under its short name.

    Attributes:
        name: short name, unique over all sections: ``learning_rate``, ``robot``.
        path: its path: ``("algorithm", "learning_rate")``, ``("robot", "name")``.
        info: its field.
        plugins: plug-ins that have it; empty if every specification has it.
        choices: names to choose from, for the sections' names.
    """

    name: str
    path: tuple[str, ...]
    info: FieldInfo
    plugins: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()


def settings() -> dict[str, Setting]:
    """Return every setting of a training's specification by short name, in the order of the sections.

    A setting's short name is its field's; where two sections have a field of the same name, the later one is prefixed
    with its section.
    """
    from naospec.specification import RuntimeSettings, TrainingSpec

    found: dict[str, Setting] = {}
    for section, group in GROUPS.items():
        names = plugins.names(group)
        owners: dict[str, list[str]] = {}
        infos: dict[str, FieldInfo] = {}
        for name, model, _ in variants(group):
            for field, info in model.model_fields.items():
                if name not in owners.setdefault(field, []):
                    owners[field].append(name)
                infos.setdefault(field, info)
        found[section] = Setting(section, (section, "name"), TrainingSpec.model_fields[section], choices=names)
        for field, info in infos.items():
            if field in ("name", "version"):
                continue
            short = field if field not in found else f"{section}_{field}"
            everyone = len(owners[field]) == len(names)
            found[short] = Setting(short, (section, field), info, () if everyone else tuple(owners[field]))
    for field in ("total_steps", "seed"):
        found[field] = Setting(field, (field,), TrainingSpec.model_fields[field])
    for field, info in RuntimeSettings.model_fields.items():
        found[field] = Setting(field, ("runtime", field), info)
    return found


def nest(values: Mapping[str, Any], base: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a specification's sections with ``values`` inserted, by short name or by path with dots.

    Args:
        values: ``{"learning_rate": 1e-4}`` or ``{"algorithm.learning_rate": 1e-4}``.
        base: specification to start from; it is not changed.

    Raises:
        KeyError: if a name is not a setting.
    """
    from naospec.sections import as_mapping

    known = settings()
    result: dict[str, Any] = {key: as_mapping(value) for key, value in (base or {}).items()}
    for name, value in values.items():
        if "." in name:
            path = tuple(name.split("."))
            if path[0] not in (*GROUPS, "runtime") or len(path) != 2:
                raise KeyError(name)
        elif name in known:
            path = known[name].path
        else:
            raise KeyError(name)
        if len(path) == 1:
            result[path[0]] = value
        else:
            section = result.get(path[0])
            result[path[0]] = {**(section if isinstance(section, dict) else {}), path[1]: value}
    return result
