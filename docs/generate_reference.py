"""Write the reference pages from the code they describe, while mkdocs builds the site.

mkdocs.yml names this file as a hook. Pages are generated from the command lines' parsers, the pydantic models, the
OpenAPI document and the tables of events and metrics, so that none is outdated.
"""

from __future__ import annotations

import argparse
import html
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click
import typer.main
from naoctl.cli import EPILOG, build_app
from naoctl.help import reveal
from naojobs.events import EVENT_KINDS
from naojobs.settings import ServiceSettings
from naojobs.states import ENDED, LEASED, TRANSITIONS, WorkState
from naospec import EvaluationSpec, RuntimeSettings, Stage, TrainingSpec, flat, plugins, presets, recipes
from naospec.metrics import ENGINES, EPISODE_METRICS, PACE, PROGRESS
from naosprint_api.app import openapi_document
from naosprint_api.settings import ApiSettings
from naosprint_api.telemetry import Telemetry
from naosprint_worker.settings import WorkerSettings
from pydantic import BaseModel, create_model
from pydantic_core import PydanticUndefined

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).parents[1]
METHODS = ("get", "post", "put", "patch", "delete")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages to the site (a hook of mkdocs)."""
    from mkdocs.structure.files import File  # the pages themselves need no mkdocs

    for name, text in pages().items():
        files.append(File.generated(config, f"reference/{name}", content=text))
    return files


def pages() -> dict[str, str]:
    """Return every reference page by file name."""
    writers: dict[str, Callable[[], Iterable[str]]] = {
        "naoctl.md": _naoctl,
        "naosprint.md": _naosprint,
        "naosim.md": _naosim,
        "administration.md": _administration,
        "specification.md": _specification,
        "api.md": _api,
        "metrics.md": _metrics,
        "events.md": _events,
        "settings.md": _settings,
    }
    return {name: "\n".join(writer()) + "\n" for name, writer in writers.items()}


# Command lines


def _naoctl() -> Iterator[str]:
    program: Any = typer.main.get_command(build_app())  # typer has a click of its own
    yield "# naoctl"
    yield f"\n{_text(program.help)}\n"
    yield from _click_options(program, "naoctl")
    yield f"\n{_text(EPILOG)}"
    yield from _click_commands(program, "naoctl", level=2)


def _click_commands(group: click.Command, path: str, level: int) -> Iterator[str]:
    for name, command in sorted(getattr(group, "commands", {}).items()):
        if command.hidden:
            continue
        yield f"\n{'#' * level} {path} {name}\n"
        yield f"{_text(command.help)}\n"
        yield from _click_options(command, f"{path} {name}")
        yield from _click_commands(command, f"{path} {name}", level + 1)


def _click_options(command: click.Command, path: str) -> Iterator[str]:
    reveal(command)
    context = click.Context(command, info_name=path)
    usage = " ".join(command.collect_usage_pieces(context))
    yield f"```\n{path} {usage}\n```\n"
    rows = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None and "--help" not in parameter.opts:
            names, text = record
            rows.append((_code(names), _cell(text)))
    if rows:
        yield from _table(("Option", "Meaning"), rows)


def _naosprint() -> Iterator[str]:
    from naosprint.__main__ import _parser

    yield from _argparse("python -m naosprint", _parser(), skip_group="specification")
    yield "\n`train` takes every field of the [training](specification.md#training), `evaluate` every field of the"
    yield "[evaluation](specification.md#evaluation) as an option: `total_steps` is `--total-steps`. Values are written"
    yield "as for `naoctl submit`: `3M`, `64,64`, `none`; `--no-compiled-update` is `--compiled-update false`."


def _naosim() -> Iterator[str]:
    from naosim.cli import _parser

    yield from _argparse("naosim", _parser())


def _administration() -> Iterator[str]:
    from naojobs.__main__ import _parser

    yield from _argparse("python -m naojobs", _parser())


def _argparse(
    path: str,
    parser: argparse.ArgumentParser,
    *,
    skip_group: str | None = None,
    level: int = 1,
    about: str | None = None,
) -> Iterator[str]:
    parser.prog = path
    yield f"\n{'#' * level} {path}\n".lstrip("\n" if level == 1 else "")
    if text := parser.description or about:
        yield f"{_sentence(text)}\n"
    skipped = {
        action for group in parser._action_groups if group.title == skip_group for action in group._group_actions
    }
    shown = [a for a in parser._actions if a not in skipped and a.help != argparse.SUPPRESS and a.dest != "help"]
    plain = [action for action in shown if not isinstance(action, argparse._SubParsersAction)]
    if plain:
        formatter = argparse.HelpFormatter(prog=path, width=100)
        formatter.add_usage(None, plain, [], prefix="")
        yield f"```\n{formatter.format_help().strip()}\n```\n"
        yield from _table(("Option", "Meaning"), [_argument(action) for action in plain])
    for action in shown:
        if isinstance(action, argparse._SubParsersAction):
            helps = {choice.dest: choice.help for choice in action._choices_actions}
            for name, child in action.choices.items():
                yield from _argparse(
                    f"{path} {name}", child, skip_group=skip_group, level=level + 1, about=helps.get(name)
                )


def _argument(action: argparse.Action) -> tuple[str, str]:
    name = ", ".join(action.option_strings) or str(action.metavar or action.dest).upper()
    if action.option_strings and action.nargs != 0:
        name += f" {action.metavar or action.dest.upper()}"
    parts = [_cell((action.help or "") % {"default": action.default, "prog": ""})]
    if action.choices is not None:
        parts.append("one of " + ", ".join(_code(str(choice)) for choice in action.choices))
    if action.required and action.option_strings:
        parts.append("required")
    if action.option_strings and action.nargs != 0 and action.default is not None and "default" not in parts[0]:
        parts.append(f"default: {_code(str(action.default))}")
    return _code(name), "; ".join(part for part in parts if part)


# Specification


def _specification() -> Iterator[str]:
    yield "# Specification"
    yield "\nA job's `spec` and `evaluation`. The flags of `naoctl submit`, the options of `python -m naosprint` and"
    yield "the dashboard's form are these settings under their short names: `algorithm.learning_rate` is"
    yield "`--learning-rate`. An unknown setting is refused."
    yield "\n## Training\n"
    yield "A section is a mapping with the `name` of a plug-in and its settings, or the name alone. A setting that is"
    yield "left out takes the value of the [preset](#presets).\n"
    yield from _fields(TrainingSpec)
    for section, group in flat.GROUPS.items():
        yield f"\n### {section}\n"
        yield from _table(
            ("Name", "Meaning"), [(_code(name), _cell(_about(group, name))) for name in plugins.names(group)]
        )
        yield ""
        yield from _settings_of(section, set(plugins.names(group)))
    yield "\n### stages\n"
    yield from _fields(Stage)
    yield "\n### runtime\n"
    yield from _fields(RuntimeSettings)
    yield "\n## Evaluation\n"
    yield from _fields(EvaluationSpec)
    yield "\n## Presets\n"
    names = presets.names()
    for name in names:
        yield f"- `{name}`: {presets.summary(name)}"
    yield ""
    for family in (None, *sorted({family for name in names for family in presets.read(name).get("robots", {})})):
        values = {name: _preset_values(name, family) for name in names}
        paths = dict.fromkeys(path for one in values.values() for path in one)
        shown = [name for name in names if values[name]]
        if family is not None:
            yield f"\nFor robots of family {_code(family)}, in place of these:\n"
        rows = [
            (_code(path), *(_value(values[name][path]) if path in values[name] else "" for name in shown))
            for path in paths
        ]
        yield from _table(("Setting", *(_code(name) for name in shown)), rows)
    yield "\n## Recipes\n"
    yield "Tested jobs, for `naoctl submit --recipe NAME`.\n"
    yield from _table(
        ("Recipe", "Robot", "Task", "Starts from", "Steps", "Meaning"), [_recipe(name) for name in recipes.names()]
    )


def _about(group: str, name: str) -> str:
    """Return one line about a plug-in."""
    plugin: Any = plugins.load(plugins.Group[Any](group), name)
    return str(plugin.title if group == plugins.ROBOTS else plugin.summary)


def _settings_of(section: str, names: set[str]) -> Iterator[str]:
    """Write the settings of all plug-ins of a section, with the plug-ins that have each."""
    rows = []
    for setting in flat.settings().values():
        if setting.path[0] != section or len(setting.path) != 2 or setting.path[1] == "name":
            continue
        part = create_model("_", value=(cast(Any, setting.info.annotation), setting.info)).model_json_schema()
        field = part["properties"].get("value", {})
        unit = f" Unit: {field['unit']}." if "unit" in field else ""
        whose = ", ".join(_code(name) for name in setting.plugins) if set(setting.plugins) != names else ""
        meaning = _cell(f"{setting.info.description or ''}{unit}")
        rows.append((_code(setting.path[1]), _type(field), _value(setting.info.default), whose or "all", meaning))
    if rows:
        yield from _table(("Setting", "Values", "Default", "Of", "Meaning"), rows)


def _preset_values(name: str, family: str | None) -> dict[str, Any]:
    """Return what a preset sets by path; with a family, only what it sets for its robots in particular."""
    content = presets.read(name)
    content = content if family is None else content.get("robots", {}).get(family, {})
    return {
        f"{section}.{field}": value for section in presets.SECTIONS for field, value in content.get(section, {}).items()
    }


def _fields(model: type[BaseModel]) -> Iterator[str]:
    schema = model.model_json_schema()
    rows = []
    for name, field in model.model_fields.items():
        part = schema["properties"][name]
        unit = f" Unit: {part['unit']}." if "unit" in part else ""
        default = _value(part.get("default", field.default)) if not field.default_factory else "see below"
        rows.append((_code(name), _type(part), default, _cell(f"{field.description}{unit}")))
    yield from _table(("Field", "Values", "Default", "Meaning"), rows)


def _recipe(name: str) -> tuple[str, ...]:
    """Return the row of a recipe."""
    job = recipes.job(name)
    spec = TrainingSpec.model_validate(job["spec"])
    start = job.get("parent_policy")
    steps = f"{spec.planned_steps / 1e6:.1f} million"
    kind = (_code(spec.robot.name), _code(spec.task.name), _code(start) if start else "nothing", steps)
    return (_code(name), *kind, _cell(recipes.summary(name)))


def _type(part: dict[str, Any]) -> str:
    """Describe in words which values a JSON schema allows."""
    if "x-plugin-group" in part:
        return "section, or a name: " + ", ".join(
            dict.fromkeys(_value(option["properties"]["name"]["const"]) for option in part["oneOf"])
        )
    if "anyOf" in part:
        return " or ".join(_type(choice) for choice in part["anyOf"])
    if "$ref" in part:
        name = part["$ref"].rsplit("/", 1)[1]
        sections = {"Stage": "stages", "RuntimeSettings": "runtime"}  # which have headings of their own
        return f"[{name}](specification.md#{sections[name]})" if name in sections else f"[{name}](#{name.lower()})"
    if "const" in part:
        return _value(part["const"])
    if "enum" in part:
        return ", ".join(_value(value) for value in part["enum"])
    if part.get("type") == "array":
        return f"list of {_type(part.get('items', {}))}"
    kind = {"integer": "whole number", "string": "text", "boolean": "true, false", "null": "null"}.get(
        part.get("type", ""), part.get("type", "anything")
    )
    bounds = [
        f"{sign} {part[key]:,}" if abs(part[key]) >= 10_000 else f"{sign} {part[key]:g}"
        for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if key in part
    ]
    if "maxLength" in part:
        bounds.append(f"at most {part['maxLength']} characters")
    return " ".join([kind, ", ".join(bounds)]).strip()


# API


def _api() -> Iterator[str]:
    document = openapi_document()
    yield "# HTTP API"
    yield f"\n{_text(document['info']['description'])}"
    yield "\nA running service has this description at `/openapi.json`. Requests need `Authorization: Bearer TOKEN`."
    operations: dict[str, list[tuple[str, str, dict[str, Any]]]] = {}
    for path, item in document["paths"].items():
        for method in METHODS:
            if method in item:
                operations.setdefault(item[method]["tags"][0], []).append((method, path, item[method]))
    for tag, members in operations.items():
        yield f"\n## {tag.capitalize()}"
        for method, path, operation in members:
            yield f"\n### {method.upper()} {path}\n"
            yield f"{_text(operation['description'])}\n"
            yield from _operation(operation)
    yield "\n## Schemas"
    for name, schema in document["components"]["schemas"].items():
        yield f"\n### {name}\n"
        yield f"{_text(schema.get('description', ''))}\n"
        if "enum" in schema:
            yield "One of " + ", ".join(_value(value) for value in schema["enum"]) + "."
            continue
        required = set(schema.get("required", ()))
        yield from _table(
            ("Field", "Values", "Meaning"),
            [
                (
                    _code(field) + (" (required)" if field in required else ""),
                    _type(part),
                    _cell(part.get("description", part.get("title", ""))),
                )
                for field, part in schema.get("properties", {}).items()
            ],
        )


def _operation(operation: dict[str, Any]) -> Iterator[str]:
    parameters = [
        (
            _code(parameter["name"]) + (" (required)" if parameter.get("required") else ""),
            parameter["in"],
            _type(parameter["schema"]),
            _cell(parameter.get("description", "")),
        )
        for parameter in operation.get("parameters", ())
    ]
    if parameters:
        yield from _table(("Parameter", "In", "Values", "Meaning"), parameters)
        yield ""
    for content in operation.get("requestBody", {}).get("content", {}).values():
        yield f"Body: {_type(content['schema'])}\n"
    rows = []
    for status, response in operation["responses"].items():
        kinds = [_type(content.get("schema", {})) for content in response.get("content", {}).values()]
        rows.append((_code(status), _cell(response["description"]), ", ".join(kinds)))
    yield from _table(("Status", "Meaning", "Body"), rows)


# Metrics and events


def _metrics() -> Iterator[str]:
    yield "# Metrics"
    yield "\n## Of a training\n"
    yield "One row is written after every update of the policy. `GET /jobs/{job_id}/metrics`, the live stream, and the"
    yield "`metrics.jsonl` that `naoctl download` fetches and that a training without the service writes have these"
    yield "columns; a metric that has no value yet is missing.\n"
    tasks = [plugins.load(plugins.TASKS, name) for name in plugins.names(plugins.TASKS)]
    kinds = [plugins.load(plugins.LEARNERS, name) for name in plugins.names(plugins.LEARNERS)]
    groups = [
        ("Every training", (*PROGRESS, *EPISODE_METRICS, *ENGINES, *PACE)),
        *((f"Task {_code(task.name)}", [metric for metric in task.metrics if metric.live]) for task in tasks),
        *((f"Algorithm {_code(kind.name)}", kind.metrics) for kind in kinds),
    ]
    for title, metrics in groups:
        yield f"\n### {title}\n"
        rows = [(_code(metric.name), metric.unit, _cell(metric.description)) for metric in metrics]
        yield from _table(("Column", "Unit", "Meaning"), rows)
    yield "\n## Of the service\n"
    yield "`GET /metrics` answers in Prometheus's text format, to tokens with the scope `admin`.\n"
    table = [
        (_code(name), kind, ", ".join(_code(label) for label in labels), _cell(text))
        for name, kind, labels, text in Telemetry.catalogue()
    ]
    yield from _table(("Metric", "Kind", "Labels", "Meaning"), table)


def _events() -> Iterator[str]:
    yield "# Events and states"
    yield "\n## States of a job\n"
    documents = _attribute_comments(WorkState)
    yield from _table(
        ("State", "Meaning", "May become", ""),
        [
            (
                _code(state),
                documents[state.name],
                ", ".join(_code(target) for target in WorkState if target in TRANSITIONS[state]) or "nothing",
                "held by a worker" if state in LEASED else "ended" if state in ENDED else "",
            )
            for state in WorkState
        ],
    )
    yield "\n## Events\n"
    yield "What happened to a job, oldest first: `naoctl logs JOB`, `GET /jobs/{job_id}/events`, and `event` messages"
    yield "of the live stream. `data` contains fields for programs.\n"
    yield from _table(
        ("Kind", "When", "Data"),
        [
            (_code(kind), _cell(event.meaning), ", ".join(_code(name) for name in event.data))
            for kind, event in EVENT_KINDS.items()
        ],
    )
    yield "\n## Messages of the live streams\n"
    document = openapi_document()
    for path in ("/jobs/{job_id}/stream", "/jobs/stream"):
        yield f"### GET {path}\n\n{_text(document['paths'][path]['get']['description'])}\n"


def _attribute_comments(owner: type) -> dict[str, str]:
    """Return the texts of the docstrings below a class's members."""
    import ast
    import inspect
    import textwrap

    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for member, below in pairwise(tree.body):
        if isinstance(member, ast.Assign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            found[ast.unparse(member.targets[0])] = " ".join(str(below.value.value).split())
    return found


# Settings


def _settings() -> Iterator[str]:
    yield "# Settings"
    yield "\nEvery process reads its settings from environment variables. `docker-compose.yml` sets them from `.env`,"
    yield "whose variables `.env.example` lists; `naoctl up` sets them itself."
    sections: Sequence[tuple[str, type[BaseModel], type[BaseModel] | None]] = (
        ("Every process", ServiceSettings, None),
        ("API", ApiSettings, ServiceSettings),
        ("Worker", WorkerSettings, ServiceSettings),
    )
    for title, model, base in sections:
        yield f"\n## {title}\n"
        inherited = set(base.model_fields) if base else set()
        schema = model.model_json_schema()
        prefix = str(cast("dict[str, Any]", model.model_config)["env_prefix"])
        rows = []
        for name, field in model.model_fields.items():
            if name in inherited:
                continue
            default = (
                "required"
                if field.is_required()
                else "depends on the machine"
                if field.default is PydanticUndefined
                else _value(field.default)
            )
            values = _type(schema["properties"][name])
            rows.append((_code(f"{prefix}{name.upper()}"), values, default, _cell(field.description or "")))
        yield from _table(("Variable", "Values", "Default", "Meaning"), rows)
    yield "\n## Command line\n"
    yield from _table(("Variable", "Meaning"), [(_code(name), text) for name, text in _naoctl_variables()])


def _naoctl_variables() -> Iterator[tuple[str, str]]:
    seen = {}
    commands = [typer.main.get_command(build_app())]
    while commands:
        command = commands.pop()
        commands.extend(getattr(command, "commands", {}).values())
        for parameter in command.params:
            variable = getattr(parameter, "envvar", None)
            if isinstance(variable, str):
                seen[variable] = _cell(getattr(parameter, "help", "") or "")
    yield from sorted(seen.items())
    yield "NAOCTL_TOKEN", "Token for the service, instead of the one that `naoctl login` stored."
    yield "NAOCTL_CONFIG", "File in which `naoctl` stores addresses and tokens."


# Markdown


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(row) + " |"


def _code(text: str) -> str:
    return f"`{text}`".replace("|", "\\|")


def _value(value: Any) -> str:
    if value is PydanticUndefined:
        return "required"
    if isinstance(value, tuple):
        value = list(value)
    return _code(value if isinstance(value, str) and value else json.dumps(value))


def _cell(text: str) -> str:
    """Return text escaped for a table's cell."""
    return _text(" ".join(text.split())).replace("|", "\\|")


def _text(text: str | None) -> str:
    """Return text without the marks of rich and with angle brackets and the like as they are, outside of code."""
    plain = re.sub(r"\[/?(?:bold|dim|italic|cyan|green|red|yellow|b|i)\]", "", text or "").strip()
    parts = re.split(r"(`[^`]*`)", plain.replace("``", "`"))
    return "".join(part if part.startswith("`") else html.escape(part, quote=False) for part in parts)


def _sentence(text: str) -> str:
    text = _text(text)
    return text if text.endswith((".", ":")) else f"{text[:1].upper()}{text[1:]}."
