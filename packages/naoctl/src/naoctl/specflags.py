"""One command-line flag per setting of a specification, derived from its models."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Container, Mapping
from functools import cache
from typing import Annotated, Any, TypeVar

import typer
from naospec import flat
from naospec.flags import ALIASES, choices_of, explain, flag_name, help_text, metavar
from naospec.flat import Setting
from pydantic import BaseModel, ValidationError
from typer.models import OptionInfo

from naoctl.context import completions
from naoctl.errors import InvalidInput

PANELS = {
    "task": "Task",
    "robot": "Robot",
    "simulator": "Simulator",
    "algorithm": "Algorithm (left out: the preset's value)",
    "runtime": "Runtime",
}
"""Headings above the flags of each section in ``--help``."""

ModelT = TypeVar("ModelT", bound=BaseModel)


@cache
def training_settings() -> dict[str, Setting]:
    """Return every setting of a training that has a flag, by short name; plug-ins contribute theirs."""
    return flat.settings()


def spec_parameters(
    settings: Mapping[str, Setting],
    *,
    panel: str,
    prefix: str = "",
    flag_prefix: str | None = None,
    shown: Container[str] | None = None,
) -> list[inspect.Parameter]:
    """Return one keyword parameter per setting for a Typer command; a parameter is None unless the user gave its flag.

    Args:
        settings: settings by short name.
        panel: heading above the flags in ``--help``; settings in sections have their section's.
        prefix: put before names, to keep two specifications apart in one command.
        flag_prefix: the prefix that users see in flags, when it is another.
        shown: settings that ``--help`` shows; the others are hidden, but work. None: all.
    """
    parameters = []
    for field, setting in settings.items():
        info = setting.info
        name = flag_name(field, prefix if flag_prefix is None else flag_prefix)
        choices = setting.choices or choices_of(info)
        annotation: Any = str | None
        declarations = [*ALIASES.get(field, ()), name]
        if setting.is_switch:
            annotation = bool | None
            declarations = [f"{name}/--no-{name[2:]}"]
        option: OptionInfo = typer.Option(
            *declarations,
            help=help_text(setting),
            metavar=metavar(setting) or None,
            show_default=False,
            rich_help_panel=PANELS.get(setting.path[0], panel) if len(setting.path) > 1 else panel,
            hidden=shown is not None and field not in shown,
            autocompletion=_completion(choices) if choices else None,
        )
        parameters.append(
            inspect.Parameter(
                prefix + field,
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=Annotated[annotation, option],
            )
        )
    return parameters


def with_parameters(function: Callable[..., None], named: Mapping[str, list[inspect.Parameter]]) -> Callable[..., None]:
    """Give a command more parameters; they reach ``function`` as one dictionary per name in ``named``.

    Args:
        function: a command that has a keyword parameter for every key of ``named``.
        named: the parameters that each of these dictionaries collects; those the user did not give are left out of it.
    """
    own = [p for p in inspect.signature(function, eval_str=True).parameters.values() if p.name not in named]
    added = [parameter for group in named.values() for parameter in group]

    def command(**values: Any) -> None:
        groups = {key: {p.name: values.pop(p.name) for p in group} for key, group in named.items()}
        given = {
            key: {name: value for name, value in group.items() if value is not None} for key, group in groups.items()
        }
        function(**values, **given)

    command.__name__ = function.__name__
    command.__doc__ = function.__doc__
    keyword = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
    command.__signature__ = inspect.Signature([*keyword, *added])  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in [*keyword, *added]}
    return command


def build(
    model: type[ModelT],
    values: Mapping[str, Any],
    *,
    from_flags: Mapping[str, Setting] | None = None,
    prefix: str = "",
    where: str = "",
) -> ModelT:
    """Validate ``values`` and build the model.

    Args:
        model: the specification.
        values: its content.
        from_flags: settings that came from flags, by short name.
        prefix: prefix of those flags.
        where: put before the paths of all other fields.

    Raises:
        InvalidInput: naming every wrong field, as its flag if it came from one, and what would be right.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise InvalidInput("; ".join(explain(model, error, from_flags or {}, prefix=prefix, where=where))) from None


def _completion(choices: tuple[str, ...]) -> Callable[[str], list[str]]:
    def complete(incomplete: str) -> list[str]:
        return completions(choices, incomplete)

    return complete
