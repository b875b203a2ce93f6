"""``naoctl submit``: from flags and files to a job."""

from __future__ import annotations

import itertools
import math
import re
import uuid
from collections.abc import Container, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import naopolicies
import typer
from naospec import EvaluationSpec, TrainingSpec, flat, recipes
from naospec.flags import flag_name, parse_flags, read_value
from naospec.flat import Setting, settings_of
from naospec.job_files import JOB_FIELDS, JobFileError, load_job_file
from pydantic import TypeAdapter

from naoctl.client import Client
from naoctl.commands.browse import address, job_path
from naoctl.commands.watch import watch_job
from naoctl.context import NEWEST, Context, JsonFlag, complete_job, completions, context_of, find_checkpoint, find_job
from naoctl.descriptions import section_name
from naoctl.errors import InvalidInput, Unreachable, plain
from naoctl.help import HelpAllFlag, SettingsCommand
from naoctl.render import SHORT_ID, waiting_text
from naoctl.specflags import build, spec_parameters, training_settings, with_parameters

EVAL_PREFIX = "eval_"
EVALUATION_SETTINGS = settings_of(EvaluationSpec, leave_out=["task"])
"""Settings of an evaluation that have a flag."""
COMMON_SETTINGS = (
    "task",
    "robot",
    "simulator",
    "preset",
    "total_steps",
    "seed",
    "learning_rate",
    "n_envs",
    "hidden_sizes",
)
"""Settings that ``naoctl submit --help`` shows; ``--help-all`` and ``naoctl spec`` show all."""
COMMON_EVALUATION_SETTINGS = ("episodes",)
PARENT_FIELDS = ("parent_job_id", "parent_checkpoint_id", "parent_policy")
"""Fields of a job that name what it starts from."""
MAX_SEEDS = 256
"""Largest number of seeds in one range of ``--seeds``."""
EARLIEST, LATEST = datetime(2000, 1, 1, tzinfo=UTC), datetime(9000, 1, 1, tzinfo=UTC)
"""Bounds of the times that the service takes."""
SUBMIT_ATTEMPTS = 3
"""Attempts to submit a job when the answer is lost; the idempotency key prevents a second job."""


def _complete_recipe(incomplete: str) -> list[str]:
    return completions(recipes.names(), incomplete)


JobFile = Annotated[
    Path | None,
    typer.Argument(metavar="FILE", help="Job as YAML, TOML or JSON; flags override its values.", dir_okay=False),
]
RecipeOption = Annotated[
    str | None,
    typer.Option(
        "--recipe",
        metavar="NAME",
        help="Start from the job that trained a bundled policy, such as t1-sprint (`naoctl policies list`); flags "
        "override its values. With --from or --from-policy only the stages after that policy are trained.",
        autocompletion=_complete_recipe,
    ),
]
TagOption = Annotated[list[str] | None, typer.Option("--tag", "-t", metavar="TAG", help="Tag; may be repeated.")]
PriorityOption = Annotated[
    int | None,
    typer.Option(
        "--priority", metavar="0-9", min=0, max=9, help="Work of higher priority starts first.", show_default="5"
    ),
]
NotBeforeOption = Annotated[
    str | None,
    typer.Option("--not-before", metavar="TIME", help="Start at 22:00, at 2026-12-01T06:00, or in 8h, not before."),
]
KeyOption = Annotated[
    str | None,
    typer.Option("--idempotency-key", metavar="KEY", help="A second request with the same key makes nothing new."),
]


def common_fields(
    context: Context,
    tag: list[str] | None,
    priority: int | None,
    not_before: str | None,
    *,
    file: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the fields of a request that all work has: those that are given, by flags or else by a job file.

    A start in the past is noted, not refused: the request may be one that is sent again with its key.
    """
    moment, now = not_before or (file or {}).get("not_before"), datetime.now().astimezone()
    start = None if moment is None else parse_moment(str(moment), now)
    if start is not None and datetime.fromisoformat(start) < now:
        context.note(f"The start time {start} has passed: the work starts at once.")
    fields = {"tags": tag, "priority": priority, "not_before": start}
    return {name: value for name, value in fields.items() if value is not None}


def submit(
    ctx: typer.Context,
    file: JobFile = None,
    recipe: RecipeOption = None,
    name: Annotated[
        str | None,
        typer.Option("--name", "-n", metavar="NAME", help="Name of the job; numbered if you have one of that name."),
    ] = None,
    tag: TagOption = None,
    priority: PriorityOption = None,
    not_before: NotBeforeOption = None,
    parent: Annotated[
        str | None,
        typer.Option("--from", metavar="JOB", help="Start from this job's policy.", autocompletion=complete_job),
    ] = None,
    checkpoint: Annotated[
        str | None,
        typer.Option("--from-checkpoint", metavar="ID|STEP", help="Which of its checkpoints (default: the newest)."),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            "--from-policy",
            metavar="POLICY",
            help="Start from a bundled or registered policy: NAME, NAME@VERSION, NAME@ALIAS.",
            autocompletion=lambda: list(naopolicies.names()),
        ),
    ] = None,
    seeds: Annotated[str | None, typer.Option(metavar="0-4|1,2,3", help="Submit one job per seed, as a group.")] = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(metavar="FIELD=A,B", help="Submit one job per value; repeat it for all combinations."),
    ] = None,
    evaluate: Annotated[
        bool | None,
        typer.Option("--evaluate/--no-evaluate", help="Evaluate the final policy.", show_default="evaluate"),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Follow the job; the exit code is its result.")] = False,
    key: KeyOption = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Check the job, but not what it starts from, and print it with the preset's values; submit nothing.",
        ),
    ] = False,
    as_json: JsonFlag = False,
    help_all: HelpAllFlag = False,
    spec: dict[str, Any] = {},  # noqa: B006 - filled by with_parameters
    evaluation: dict[str, Any] = {},  # noqa: B006
) -> None:
    """Submit a training.

    Without any flag this trains the default task with preset fast. Every setting has a flag: --help-all lists them all,
    and `naoctl spec FIELD` explains one. Numbers may be abbreviated: 250k, 3M.
    """
    del help_all
    context = context_of(ctx)
    start = start_of(context, recipe, parent, policy)
    body = make_job(
        file,
        recipe,
        spec,
        evaluation,
        start=start,
        evaluate=evaluate,
        name=name,
        parent_checkpoint_id=checkpoint,
        parent_policy=policy,
    )
    body |= common_fields(context, tag, priority, not_before, file=body)
    if body.get("name") == NEWEST:
        raise InvalidInput(f"--name {NEWEST!r} refers to the newest job in commands", fix="Use another name.")
    group = make_group(body, seeds, grid or [], flags=spec)
    if group is None:  # a sweep may vary what switches a setting on
        for sentence in TrainingSpec.model_validate(body["spec"]).without_effect():
            context.note(sentence)
    if checkpoint and not parent and not body.get("parent_job_id"):
        raise InvalidInput("--from-checkpoint needs the job it belongs to", fix="Add --from JOB.")
    if group and watch:
        raise InvalidInput("--watch follows one job, and a sweep makes several", fix="Leave one of them out.")
    if dry_run:
        job, notes = expanded_job(body)
        for note in notes:
            context.note(note)
        if group:
            jobs = max(1, len(group["seeds"])) * math.prod(len(values) for values in group["grid"].values())
            context.note(f"The group has {jobs} jobs.")
        context.json({**group, "job": job} if group else job)
        return
    with context.client() as client:
        if parent:
            body["parent_job_id"] = find_job(client, parent)["id"]
        if checkpoint:
            body["parent_checkpoint_id"] = find_checkpoint(client, {"id": body["parent_job_id"]}, checkpoint)["id"]
        if group:
            made = hand_in(client, "/groups", {**group, "job": body}, key)
            if as_json:
                context.json(made)
                return
            context.out.print(f"Submitted {len(made['jobs'])} jobs as group {made['id']}", markup=False)
            for job in made["jobs"]:
                context.out.print(f"  {job['id']}  {plain(job['name'])}", markup=False)
            for job in {job.get("waiting_reason"): job for job in made["jobs"]}.values():
                _note_waiting(context, job)
            return
        job = hand_in(client, "/jobs", body, key)
        if as_json and not watch:
            context.json(job)
            return
        if not as_json:
            steps, task = f"{job['total_steps']:,} steps", section_name(job["spec"], "task")
            context.out.print(f"Submitted {job['id']} ({plain(job['name'])}): {steps} of {task}", markup=False)
        if watch:
            watch_job(context, client, job, as_json=as_json)
        else:
            _note_waiting(context, job)
            context.note(f"Follow it with: naoctl watch {job['id'][-SHORT_ID:]}")
            context.note(f"Dashboard: {address(context.target(), job_path(job['id']))}")


def _note_waiting(context: Context, job: Mapping[str, Any]) -> None:
    if job.get("waiting_reason"):
        context.note(f"Waiting: {waiting_text(job)}")


def start_of(context: Context, recipe: str | None, parent: str | None, policy: str | None) -> str | None:
    """Return what ``--from`` or ``--from-policy`` names, and note the stages of a recipe that it replaces.

    Raises:
        InvalidInput: if both are given.
    """
    if parent and policy:
        raise InvalidInput("--from and --from-policy both name the policy to start from", fix="Leave one of them out.")
    start = f"job {parent}" if parent else policy
    if recipe in recipes.names() and start and (note := recipes.shortened(recipe, start)):
        context.note(note)
    return start


def make_job(
    file: Path | None,
    recipe: str | None,
    spec_flags: dict[str, Any],
    evaluation_flags: dict[str, Any],
    *,
    start: str | None = None,
    evaluate: bool | None = None,
    **fields: Any,
) -> dict[str, Any]:
    """Return the body of ``POST /jobs`` from a file or a recipe, flags, and those other ``fields`` that are not None.

    What is given to start from replaces what the file or the recipe starts from.

    Raises:
        InvalidInput: naming the flag or the file's field that is wrong.
    """
    if file and recipe:
        raise InvalidInput("--recipe and FILE both describe the job", fix="Leave one of them out.")
    body = make_body(
        read_job_file(file) if file else read_recipe(recipe, start) if recipe else {},
        spec_flags,
        evaluation_flags,
        evaluate=evaluate,
        where=f"{file}: " if file else "",
    )
    if start:
        body = {field: value for field, value in body.items() if field not in PARENT_FIELDS}
    return body | {field: value for field, value in fields.items() if value is not None}


def read_job_file(path: Path) -> dict[str, Any]:
    """Return the content of a job file. Raises InvalidInput."""
    try:
        return load_job_file(path)
    except JobFileError as error:
        raise InvalidInput(error.message, fix=error.fix) from None


def read_recipe(name: str, start: str | None = None) -> dict[str, Any]:
    """Return the job of a recipe, without the stages that the policy to ``start`` from replaces.

    Raises:
        InvalidInput: naming the recipes that exist.
    """
    try:
        return recipes.job(name, start)
    except ValueError as error:
        raise InvalidInput(f"--recipe: {error}") from None


def make_body(
    file: dict[str, Any],
    spec_flags: dict[str, Any],
    evaluation_flags: dict[str, Any],
    *,
    evaluate: bool | None = None,
    where: str = "",
) -> dict[str, Any]:
    """Merge file and flags into the body of ``POST /jobs`` and check what can be checked here.

    Only what the user chose is sent; the service fills in what the preset decides.

    Args:
        file: content of the job file.
        spec_flags: flags of the training as given, by short name.
        evaluation_flags: flags of the evaluation as given, by field name with its prefix.
        evaluate: whether to evaluate the policy at all; None: as the file says.
        where: put before the names of fields that come from the file.

    Raises:
        InvalidInput: naming the flag or the file's field that is wrong.
    """
    settings = training_settings()
    for field in file:
        if field not in JOB_FIELDS:
            place = settings[field].path[:-1] if field in settings else ()
            below = f"Put it below `{' > '.join(('spec', *place))}:`."
            inside = field in settings or field in TrainingSpec.model_fields
            raise InvalidInput(
                f"{where}{field}: no such field of a job",
                fix=below if inside else f"Fields: {', '.join(JOB_FIELDS)}.",
            )
    body = dict(file)
    base = _table(file, "spec", where)
    chosen = flat.nest(parse_flags(settings, spec_flags, base=base), base)
    training = build(
        TrainingSpec, chosen, from_flags={name: settings[name] for name in spec_flags}, where=f"{where}spec."
    )
    body["spec"] = _only_given(training.model_dump(mode="json"), chosen)
    if evaluate is False:
        if evaluation_flags:
            raise InvalidInput("--no-evaluate contradicts the --eval-… flags", fix="Leave one of them out.")
        body["evaluation"] = None
    elif evaluation_flags or file.get("evaluation") is not None:
        asked = {
            **_table(file, "evaluation", where),
            **parse_flags(EVALUATION_SETTINGS, evaluation_flags, prefix=EVAL_PREFIX),
        }
        names = [name.removeprefix(EVAL_PREFIX) for name in evaluation_flags]
        checked = build(
            EvaluationSpec,
            asked,
            from_flags={name: EVALUATION_SETTINGS[name] for name in names},
            prefix=EVAL_PREFIX,
            where=f"{where}evaluation.",
        ).model_dump(mode="json")
        body["evaluation"] = _only_given(checked, asked)
    elif evaluate:
        body.pop("evaluation", None)
    return body


def _only_given(checked: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """Return the checked values of what was given, with the types that the specification gave them."""
    kept = {}
    for name, value in given.items():
        inner = checked[name]
        # a mapping may be written shorter than it is kept, as gains of `legs` are those of their joints
        nested = isinstance(inner, dict) and isinstance(value, dict) and value.keys() <= inner.keys()
        kept[name] = _only_given(inner, value) if nested else inner
    return kept


def expanded_job(body: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return a job with every setting that preset, task and robot decide and whole rollouts, and notes on rounding.

    The result is a job file that trains the same.
    """
    spec = TrainingSpec.model_validate(body["spec"])
    content = spec.model_dump(mode="json")
    rollout = spec.rollout_steps
    for stage, expanded_stage in zip(content["stages"], spec.stage_specs if spec.stages else (), strict=True):
        stage["steps"] = expanded_stage.planned_steps
    content["total_steps"] = spec.planned_steps
    notes = []
    if spec.planned_steps != spec.total_steps:
        notes.append(
            f"{spec.total_steps:,} steps are rounded up to {spec.planned_steps:,}, whole rollouts of {rollout:,} steps."
        )
    evaluation = body.get("evaluation", {})
    if evaluation is not None:
        evaluation = EvaluationSpec.model_validate(evaluation).model_dump(mode="json")
    return {**body, "spec": content, "evaluation": evaluation}, notes


def make_group(
    body: dict[str, Any], seeds: str | None, grid: list[str], *, flags: Container[str] = ()
) -> dict[str, Any] | None:
    """Return the body of ``POST /groups`` for a sweep, or None when none was requested; every combination is checked.

    Args:
        body: what all jobs share.
        seeds: value of ``--seeds``.
        grid: values of ``--grid``.
        flags: settings that have a flag of their own on the command line; a sweep cannot vary them.

    Raises:
        InvalidInput: naming the flag, and the combination that cannot be trained.
    """
    if seeds is None and not grid:
        return None
    if seeds is not None and "seed" in flags:
        raise InvalidInput("--seeds and --seed contradict each other", fix="Use one of them.")
    numbers = parse_seeds(seeds) if seeds is not None else []
    known = training_settings()
    known = {**known, **{".".join(setting.path): setting for setting in known.values()}}
    declared = flat.as_chosen(known, body["spec"])
    axes: dict[str, list[Any]] = {}
    for entry in grid:
        field, sign, values = entry.partition("=")
        field = field.strip().lstrip("-").replace("-", "_")
        items = [item.strip() for item in values.split(",") if item.strip()]
        if not sign or not items:
            raise InvalidInput(f"--grid {entry!r} is not FIELD=A,B", fix="For example --grid learning_rate=1e-4,3e-4.")
        if field not in known:
            raise InvalidInput(f"--grid: there is no setting {field}", fix="`naoctl spec` lists the settings.")
        if field in axes:
            raise InvalidInput(f"--grid: {field} is given twice", fix="Give all its values at once.")
        if known[field].name in flags:
            flag = flag_name(known[field].name)
            raise InvalidInput(f"--grid {field} and {flag} contradict each other", fix="Use one of them.")
        if seeds is not None and known[field].name == "seed":
            raise InvalidInput("--grid seed and --seeds contradict each other", fix="Use one of them.")
        axes[field] = [read_value(item, declared[field].info) for item in items]
    for picked in itertools.product(*axes.values()):
        combination = dict(zip(axes, picked, strict=True))
        if combination:
            build(TrainingSpec, flat.nest(combination, body["spec"]), where="--grid: ")
    return {
        "job": body,
        "seeds": numbers,
        "grid": {name: _typed(declared[name], values) for name, values in axes.items()},
    }


def parse_seeds(text: str) -> list[int]:
    """Read seeds: ``0-4`` or ``1,2,3`` or both, ``0-2,7``."""
    found: list[int] = []
    for part in text.split(","):
        first, sign, last = part.strip().partition("-")
        try:
            start = int(first)
            end = int(last) if sign else start
        except ValueError:
            raise InvalidInput(f"--seeds {text!r} is neither 0-4 nor 1,2,3", fix="For example --seeds 0-4.") from None
        example = "For example --seeds 0-4."
        if end < start or end - start >= MAX_SEEDS:
            raise InvalidInput(f"--seeds: {part.strip()} selects no seed or more than {MAX_SEEDS}", fix=example)
        found += range(start, end + 1)
    if len(set(found)) != len(found):
        raise InvalidInput("--seeds names a seed twice", fix="Name each once.")
    return found


def _typed(setting: Setting, values: list[Any]) -> list[Any]:
    """Return grid values as the specification reads them, so that 1e-4 is sent as a number."""
    if setting.choices:
        return values
    annotation: Any = setting.info.annotation
    adapter: TypeAdapter[Any] = TypeAdapter(annotation)
    return [adapter.dump_python(adapter.validate_python(value), mode="json") for value in values]


def _table(file: dict[str, Any], field: str, where: str) -> dict[str, Any]:
    value = file.get(field)
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InvalidInput(f"{where}{field} is not a mapping", fix=f"Write `{field}:` and its fields below it.")
    return value


def parse_moment(text: str, now: datetime) -> str:
    """Return a time as the service reads it: of ``22:00`` the next one, ``8h`` or ``30min`` from now, or a date.

    Raises:
        InvalidInput: if it is none of these, or a year is far from now.
    """
    fix = "Write 22:00, 2026-12-01T06:00, 8h or 30min."
    try:
        if found := re.fullmatch(r"(\d+(?:\.\d+)?) ?(min|h|d)", text):
            unit = {"min": "minutes", "h": "hours", "d": "days"}[found[2]]
            moment = (now + timedelta(**{unit: float(found[1])})).replace(microsecond=0)
        elif re.fullmatch(r"\d{1,2}:\d{2}", text):
            moment = now.replace(hour=int(text[:-3]), minute=int(text[-2:]), second=0, microsecond=0)
            moment = moment if moment > now else moment + timedelta(days=1)
        else:
            given = datetime.fromisoformat(text)
            moment = given if given.tzinfo else given.replace(tzinfo=now.tzinfo)
    except (ValueError, OverflowError):
        raise InvalidInput(f"--not-before {text!r} is no time", fix=fix) from None
    if not EARLIEST <= moment < LATEST:
        words = f"--not-before {text!r} is not from the year {EARLIEST.year} to the year {LATEST.year - 1}"
        raise InvalidInput(words, fix=fix)
    return moment.isoformat()


def hand_in(client: Client, path: str, body: dict[str, Any], key: str | None) -> dict[str, Any]:
    """POST a body with an idempotency key, again if the answer is lost; return the answer."""
    headers = {"Idempotency-Key": key or uuid.uuid4().hex}
    for attempt in range(1, SUBMIT_ATTEMPTS + 1):
        try:
            made: dict[str, Any] = client.post(path, body, headers=headers)
            return made
        except Unreachable as error:
            if attempt == SUBMIT_ATTEMPTS or "refused" in error.message:
                raise
    raise AssertionError("unreachable")


def register(app: typer.Typer) -> None:
    """Add the command, with one flag per setting of the specifications."""
    training = spec_parameters(training_settings(), panel="Training", shown=COMMON_SETTINGS)
    evaluation = spec_parameters(
        EVALUATION_SETTINGS, panel="Evaluation", prefix=EVAL_PREFIX, shown=COMMON_EVALUATION_SETTINGS
    )
    command = with_parameters(submit, {"spec": training, "evaluation": evaluation})
    app.command("submit", cls=SettingsCommand)(command)
