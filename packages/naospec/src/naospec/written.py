"""What a user writes of a training, and how it is resolved: by preset, task, robot and defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from naospec import plugins, presets
from naospec.fields import DEFAULTS, Stage
from naospec.flat import GROUPS, nest
from naospec.sections import Section, as_mapping, is_built_in, section_models
from naospec.settings import DEFAULT_PRESET


@dataclass(frozen=True)
class WrittenSpec:
    """What a user wrote: any of the sections and settings; ``TrainingSpec.model_validate`` resolves it.

    Attributes:
        content: settings by name; a section is a name, or a mapping with ``name`` and settings.
    """

    content: Mapping[str, Any]

    def with_settings(self, chosen: Mapping[str, Any]) -> WrittenSpec:
        """Return it with other settings, by path: ``algorithm.learning_rate``, or by name.

        Raises:
            KeyError: if a specification has no such setting.
        """
        return WrittenSpec(nest(chosen, dict(self.content)))

    def resolved(self) -> dict[str, Any]:
        """Return the content with everything that was left out, as far as the plug-ins' names are valid."""
        content = dict(self.content)
        for section, name in DEFAULTS.items():
            value = as_mapping(content.get(section) if content.get(section) is not None else {})
            content[section] = {"name": name, **value} if isinstance(value, dict) else value
        robot, task = (_plugin(name, content[name]) for name in ("robot", "task"))
        family = None if robot is None else plugins.load(plugins.ROBOTS, robot).family
        _add_preset(content, family)
        if task is not None and content["task"].get("version") is None:
            content["task"] = {**content["task"], "version": plugins.load(plugins.TASKS, task).version}
        if task is not None and robot is not None:
            content["task"] = _resolved_task(content["task"], task, robot, content["robot"])
        total = _steps_of(content.get("stages"))
        return {"total_steps": total, **content} if total else content


def preset_values(model: type[Section], preset: str, section: str, family: str | None) -> dict[str, Any]:
    """Return what a preset sets in a section with this model: not what a plug-in's model declares itself."""
    values = presets.values(preset, section, family)
    return {name: values[name] for name in values if name in model.model_fields and is_built_in(model, name)}


def _add_preset(content: dict[str, Any], family: str | None) -> None:
    """Fill in the preset's values where the plug-ins of the sections have such settings."""
    algorithm = content["algorithm"]
    preset = algorithm.get("preset", DEFAULT_PRESET) if isinstance(algorithm, dict) else None
    if not isinstance(preset, str) or preset not in presets.names():
        return
    for section in presets.SECTIONS:
        plugin = _plugin(section, content[section])
        if plugin is not None:
            values = preset_values(section_models(GROUPS[section], plugin), preset, section, family)
            content[section] = {**values, **content[section]}


def _plugin(section: str, value: object) -> str | None:
    """Return the name of the plug-in that a section names, or None if validation will fail."""
    name = value.get("name") if isinstance(value, dict) else None
    return name if isinstance(name, str) and name in plugins.names(GROUPS[section]) else None


def _resolved_task(given: dict[str, Any], task: str, robot: str, robot_settings: Mapping[str, Any]) -> Any:
    """Return a task's settings with those filled in that depend on the robot; as they are if either is not valid."""
    try:
        settings = section_models(plugins.TASKS, task).model_validate(given)
        configured = plugins.load(plugins.ROBOTS, robot).with_parameters(robot_settings)
    except ValidationError:
        return given  # the fields' own validation names what is wrong
    return plugins.load(plugins.TASKS, task).resolve(settings, configured)


def _steps_of(stages: object) -> int | None:
    """Return the steps of all stages; None if there are none, or validation will fail."""
    if not isinstance(stages, list | tuple) or not all(isinstance(stage, dict | Stage) for stage in stages):
        return None
    total = 0
    for stage in stages:
        steps = stage.get("steps") if isinstance(stage, dict) else stage.steps
        if not isinstance(steps, int) or steps <= 0:
            return None
        total += steps
    return total or None
