"""Short names for the settings of a specification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from naospec import plugins
from naospec.fields import TrainingFields
from naospec.sections import as_mapping, variants
from naospec.settings import RuntimeSettings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic.fields import FieldInfo

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
        found[section] = Setting(section, (section, "name"), TrainingFields.model_fields[section], choices=names)
        for field, info in infos.items():
            if field in ("name", "version"):
                continue
            short = field if field not in found else f"{section}_{field}"
            everyone = len(owners[field]) == len(names)
            found[short] = Setting(short, (section, field), info, () if everyone else tuple(owners[field]))
    for field in ("total_steps", "seed"):
        found[field] = Setting(field, (field,), TrainingFields.model_fields[field])
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
