"""Short names for the settings of a specification."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from naospec import plugins
from naospec.fields import DEFAULTS, TrainingFields
from naospec.sections import as_mapping, is_built_in, variants
from naospec.settings import RuntimeSettings

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

    from naospec.sections import Section

GROUPS = {
    "task": plugins.TASKS,
    "robot": plugins.ROBOTS,
    "simulator": plugins.SIMULATORS,
    "algorithm": plugins.LEARNERS,
}
"""Sections that plug-ins define, and their entry-point groups."""

OPTIONS = frozenset(
    (
        *("as_json", "checkpoint", "ctx", "dry_run", "elsewhere", "evaluate", "evaluation", "file", "from"),
        *("from_policy", "grid", "help", "help_all", "json", "key", "name", "not_before", "objective", "parallel"),
        *("parent", "policy", "population", "priority", "prune", "prune_metric", "recipe", "resume", "sampler"),
        *("sampler_seed", "seeds", "space", "spec", "steps", "tag", "trials", "watch", "workdir"),
    )
)
"""What `naosprint train`, `naoctl submit` and `naoctl tune` call their own arguments and options."""


@dataclass(frozen=True)
class Setting:
    """One setting of a specification under its short name.

    Attributes:
        name: short name, unique over all sections: ``learning_rate``, ``robot``.
        path: its path: ``("algorithm", "learning_rate")``, ``("robot", "name")``.
        info: its field.
        plugins: plug-ins that have it; empty if every specification has it.
        choices: names to choose from, for the sections' names.
        declared: fields of plug-ins that declare it themselves, by plug-in; ``info`` is the first of them, or the
            project's.
    """

    name: str
    path: tuple[str, ...]
    info: FieldInfo
    plugins: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    declared: Mapping[str, FieldInfo] = field(default_factory=dict)

    @property
    def is_switch(self) -> bool:
        """Whether it is true or false in every plug-in that has it."""
        return all(info.annotation is bool for info in (self.info, *self.declared.values()))

    def declarations(self) -> list[Setting]:
        """Return it once for each way in which plug-ins declare it, with these plug-ins."""
        found: dict[str, Setting] = {}
        for plugin in self.plugins:
            info = self.declared.get(plugin, self.info)
            way = repr((info.annotation, info.metadata, info.title, info.description, info.json_schema_extra))
            owners = (*found[way].plugins, plugin) if way in found else (plugin,)
            found[way] = replace(self, info=info, plugins=owners, declared={})
        return list(found.values()) or [self]


def settings() -> dict[str, Setting]:
    """Return every setting of a training's specification by short name, in the order of the sections.

    A setting's short name is its field's. Where it is taken, a plug-in's own setting is prefixed with its section, as
    ``task_learning_rate``: names of this project keep their meaning, and so do options of commands.
    """
    offered = {section: list(variants(group)) for section, group in GROUPS.items()}
    fields = {section: _fields(models) for section, models in offered.items()}
    outer: dict[tuple[str, ...], FieldInfo] = {
        (name,): TrainingFields.model_fields[name] for name in ("total_steps", "seed")
    } | {("runtime", name): info for name, info in RuntimeSettings.model_fields.items()}
    short: dict[str, tuple[str, ...]] = {section: (section, "name") for section in GROUPS}
    short |= {path[-1]: path for path in outer}
    for built_in in (True, False):
        # tasks come last: what an algorithm calls by a name is what it means in most trainings
        for section in reversed(GROUPS):
            for each in fields[section].values():
                if each.built_in is built_in:
                    short[_unused(each.name, section, short, built_in=built_in)] = (section, each.name)
    names = {path: name for name, path in short.items()}
    found: dict[str, Setting] = {}
    for section, models in offered.items():
        choices = tuple(dict.fromkeys(plugin for plugin, _, _ in models))
        found[section] = Setting(section, (section, "name"), TrainingFields.model_fields[section], choices=choices)
        for each in fields[section].values():
            name, everyone = names[section, each.name], len(each.plugins) == len(choices)
            owners = () if everyone else tuple(each.plugins)
            found[name] = Setting(name, (section, each.name), each.info, owners, declared=each.declared)
    return found | {names[path]: Setting(names[path], path, info) for path, info in outer.items()}


def as_chosen(known: Mapping[str, Setting], spec: Mapping[str, Any]) -> dict[str, Setting]:
    """Return settings as the plug-ins that a specification names declare them; several may have one of the same name.

    Args:
        known: settings by short name.
        spec: specification as a user wrote it.
    """
    sections = {section: as_mapping(spec.get(section)) for section in GROUPS}
    names = DEFAULTS | {key: section["name"] for key, section in sections.items() if _has_name(section)}
    return {
        name: replace(setting, info=setting.declared.get(names.get(setting.path[0], ""), setting.info))
        for name, setting in known.items()
    }


def _has_name(section: object) -> bool:
    return isinstance(section, dict) and isinstance(section.get("name"), str)


def settings_of(model: type[BaseModel], *, leave_out: Iterable[str] = ()) -> dict[str, Setting]:
    """Return the fields of a specification without sections as settings, by name."""
    skipped = set(leave_out)
    return {name: Setting(name, (name,), info) for name, info in model.model_fields.items() if name not in skipped}


@dataclass
class _Field:
    """A setting of some plug-ins of a section; its description is the project's, if the project declares it."""

    name: str
    info: FieldInfo
    built_in: bool
    plugins: list[str] = field(default_factory=list)
    declared: dict[str, FieldInfo] = field(default_factory=dict)


def _fields(models: Iterable[tuple[str, type[Section], tuple[str, ...]]]) -> dict[str, _Field]:
    """Return the settings of a section by name, without those that every section has."""
    found: dict[str, _Field] = {}
    for plugin, model, _ in models:
        for name, info in model.model_fields.items():
            if name in ("name", "version"):
                continue
            built_in = is_built_in(model, name)
            known = found.setdefault(name, _Field(name, info, built_in))
            if built_in and not known.built_in:
                known.info, known.built_in = info, True
            if not built_in:
                known.declared.setdefault(plugin, info)
            if plugin not in known.plugins:
                known.plugins.append(plugin)
    return found


def _unused(field: str, section: str, short: Mapping[str, tuple[str, ...]], *, built_in: bool) -> str:
    """Return a field's name, after its section's if something else has the name already."""
    name = field
    # flags of an evaluation's settings begin with eval_
    while name in short or (not built_in and (name in OPTIONS or name.startswith("eval_"))):
        name = f"{section}_{name}"
    return name


def nest(values: Mapping[str, Any], base: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a specification's sections with ``values`` inserted, by short name or by path with dots.

    Another seed moves those of the stages along, so that every stage of a recipe has another one, too.

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
        if path == ("seed",):
            result |= _moved_seeds(result, value)
        if len(path) == 1:
            result[path[0]] = value
        else:
            section = result.get(path[0])
            result[path[0]] = {**(section if isinstance(section, dict) else {}), path[1]: value}
    return result


def _moved_seeds(spec: Mapping[str, Any], seed: object) -> dict[str, Any]:
    """Return the stages with their own seeds as far from ``seed`` as they are from the specification's."""
    before, stages = spec.get("seed", 0), spec.get("stages")
    if type(seed) is not int or type(before) is not int or not isinstance(stages, list | tuple):
        return {}
    own = [isinstance(stage, dict) and type(stage.get("seed")) is int for stage in stages]
    return {
        "stages": [
            {**stage, "seed": (stage["seed"] + seed - before) % 2**31} if has_seed else stage
            for stage, has_seed in zip(stages, own, strict=True)
        ]
    }
