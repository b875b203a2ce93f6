"""Terminal output: tables, curves and progress; plain lines if the output is not a terminal."""

from __future__ import annotations

import functools
import itertools
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

from naospec import flat
from naospec.metrics import format_value
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

from naoctl.descriptions import Descriptions, section_name, value_text
from naoctl.errors import plain
from naoctl.evaluations import evaluated, headline, metric_text, shown_result

if TYPE_CHECKING:
    from naospec.metrics import Metric

Json = Mapping[str, Any]

STATE_STYLE = {
    "queued": "cyan",
    "starting": "cyan",
    "running": "blue",
    "pausing": "yellow",
    "paused": "yellow",
    "evaluating": "magenta",
    "stalled": "yellow",
    "succeeded": "green",
    "failed": "red",
    "cancelled": "bright_black",
}
"""Colour by state of a job, of an evaluation."""
BARS = "▁▂▃▄▅▆▇█"
ASCII_BARS = "_.-=+*#%"
MISSING = "-"
_UTC_TIME = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC")


def make_console(*, stderr: bool = False) -> Console:
    """Return a console that neither wraps nor colours text if it is not a terminal."""
    console = _PlainConsole(stderr=stderr, highlight=False, soft_wrap=False)
    if not console.is_terminal:
        console = _PlainConsole(stderr=stderr, highlight=False, width=200, no_color=True)
    return console


class _PlainConsole(Console):
    """Console whose text never controls the terminal; colours and cursor movements are rich's own."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=plain(segment.text, keep="\t\n"))


def terminal_json(value: Any, indent: int | None = None) -> str:
    """Return JSON in which characters that control a terminal or hide text are escaped."""
    text = json.dumps(value, indent=indent, ensure_ascii=False)
    return "".join(c if c.isprintable() or c == "\n" else _escape(c) for c in text)


def _escape(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 0x10000 else json.dumps(character)[1:-1]


def print_json(console: Console, value: Any) -> None:
    """Print JSON without colour and wrapping."""
    console.file.write(terminal_json(value, indent=2) + "\n")


def print_json_line(console: Console, value: Any) -> None:
    """Print a JSON document on one line and flush."""
    console.file.write(terminal_json(value) + "\n")
    console.file.flush()


def sparkline(values: Sequence[float | None], width: int = 40, *, ascii_only: bool = False) -> str:
    """Return values as one line of bars.

    Args:
        values: in order; None and non-finite values are left out.
        width: most characters; longer series are averaged in groups of neighbours.
        ascii_only: use ASCII characters only.
    """
    known = [v for v in values if v is not None and math.isfinite(v)]
    if not known or width < 1:
        return ""
    if len(known) > width:
        edges = [round(i * len(known) / width) for i in range(width + 1)]
        known = [sum(known[a:b]) / (b - a) for a, b in itertools.pairwise(edges)]
    low, high = min(known), max(known)
    bars = ASCII_BARS if ascii_only else BARS
    if high <= low:
        return bars[len(bars) // 2] * len(known)
    return "".join(bars[min(len(bars) - 1, int((v - low) / (high - low) * len(bars)))] for v in known)


def duration(seconds: float | None) -> str:
    """Return a duration: ``42 s``, ``3 min 7 s``, ``1 h 2 min``, ``3 d 4 h``, ``40 d``."""
    if seconds is None or not math.isfinite(seconds):
        return MISSING
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    days, hours = whole // 86400, whole % 86400 // 3600
    return f"{days} d {hours} h" if days < 10 else f"{days} d"


def size(count: int) -> str:
    """Return a number of bytes: ``512 B``, ``1.5 kB``, ``31.2 MB``."""
    amount = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"


def parse_time(text: str | None) -> datetime | None:
    """Read a time of the service (ISO 8601 with zone)."""
    if not text:
        return None
    moment = datetime.fromisoformat(text)
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def ago(text: str | None, now: datetime | None = None) -> str:
    """Return the time since a timestamp of the service."""
    moment = parse_time(text)
    if moment is None:
        return MISSING
    return f"{duration(((now or datetime.now(UTC)) - moment).total_seconds())} ago"


def has_passed(text: str | None) -> bool:
    """Return whether a timestamp of the service is in the past; None never is."""
    moment = parse_time(text)
    return moment is not None and moment <= datetime.now(UTC)


def clock(text: str | None) -> str:
    """Return a timestamp of the service in local time, hours to milliseconds."""
    moment = parse_time(text)
    return moment.astimezone().strftime("%H:%M:%S.%f")[:-3] if moment else MISSING


def cell(text: object) -> Text:
    """Return text for a table without control characters and without markup."""
    return Text(plain(text))


def waiting_text(work: Json) -> str:
    """Return why work waits, with the service's times, which are in UTC, as those of this machine."""

    def local(found: re.Match[str]) -> str:
        return f"{datetime.fromisoformat(found[0].replace(' UTC', '+00:00')).astimezone():%Y-%m-%d %H:%M %Z}"

    return _UTC_TIME.sub(local, plain(work["waiting_reason"]))


def state_text(state: str) -> Text:
    """Return a state in its colour."""
    return Text(state, style=STATE_STYLE.get(state, ""))


def job_state(job: Json) -> Text:
    """Return the state of a job, or `stalled` if it runs and makes no step."""
    return state_text("stalled" if job.get("stalled_since") else job["state"])


def percent(job: Json) -> float:
    """Return the share of a job's steps that is done, 0 to 1."""
    total = job.get("total_steps") or 0
    return min(1.0, job.get("progress_step", 0) / total) if total else 0.0


COLUMNS: dict[str, tuple[str, Callable[[Json], RenderableType]]] = {
    "id": ("ID", lambda job: job["id"]),
    "name": ("Name", lambda job: cell(job["name"])),
    "state": ("State", lambda job: job_state(job)),
    "done": ("Done", lambda job: f"{percent(job):.0%}"),
    "steps": ("Steps", lambda job: f"{job['total_steps']:,}"),
    "submitted": ("Submitted", lambda job: ago(job.get("created_at"))),
    "task": ("Task", lambda job: cell(section_name(job["spec"], "task"))),
    "robot": ("Robot", lambda job: cell(section_name(job["spec"], "robot"))),
    "simulator": ("Simulator", lambda job: cell(section_name(job["spec"], "simulator"))),
    "seed": ("Seed", lambda job: str(job["spec"].get("seed", MISSING))),
    "owner": ("Owner", lambda job: cell(job["owner"])),
    "priority": ("Priority", lambda job: str(job["priority"])),
    "tags": ("Tags", lambda job: cell(" ".join(job["tags"]))),
    "worker": ("Worker", lambda job: cell(job.get("worker") or MISSING)),
}
"""Columns of the list of jobs by the name that ``--columns`` takes, beside settings and metrics."""
SHORT_ID = 6
"""Characters at the end of an id by which the list of jobs names it; its beginning is the time, which neighbours
share.
"""
NAME_WIDTH, RESULT_WIDTH = 8, 16
"""Least widths of names, which are folded, and of results, which are shortened, while there is room."""
WIDE, SUBMITTED_WIDTH, STEPS_WIDTH = 130, 95, 110
"""Least widths of a terminal from which the list of jobs shows whole ids, times of submission and numbers of steps."""


def stall_text(work: Json) -> str:
    """Return how long ago a stalled job or evaluation made its last step."""
    return f"the last step was {ago(work['stalled_since'])}"


def jobs_table(jobs: Sequence[Json], descriptions: Descriptions, width: int = 200) -> Table:
    """Return a table of jobs with as many columns as fit; names are whole, and only results are shortened."""
    shown = ["done"]
    shown += ["steps"] if width >= STEPS_WIDTH else []
    shown += ["submitted"] if width >= SUBMITTED_WIDTH else []
    headings = ["ID", "Name", "State", *(COLUMNS[name][0] for name in shown), "Result"]
    rows = [
        [
            Text(job["id"] if width >= WIDE else job["id"][-SHORT_ID:]),
            cell(job["name"]),
            job_state(job),
            *(Text(str(COLUMNS[name][1](job))) for name in shown),
            cell(", ".join(_results(job, descriptions)) or MISSING),
        ]
        for job in jobs
    ]
    widths = [max(cell_len(heading), *(row[i].cell_len for row in rows), 0) for i, heading in enumerate(headings)]
    # what the other columns and the gaps leave is for names, and then for results
    room = width - sum(widths[:1] + widths[2:-1]) - 2 * (len(headings) - 1)
    name_width = max(NAME_WIDTH, min(widths[1], room - RESULT_WIDTH))
    table = listing()
    for heading, column in zip(headings, widths, strict=True):
        match heading:
            case "Name":
                table.add_column(heading, overflow="fold", width=name_width)
            case "Result":
                table.add_column(heading, no_wrap=True, overflow="ellipsis", max_width=max(room - name_width, 1))
            case _:
                side: Literal["left", "right"] = "left" if heading in headings[:3] else "right"
                table.add_column(heading, no_wrap=True, width=column, justify=side)
    for row in rows:
        table.add_row(*row)
    return table


def _results(job: Json, descriptions: Descriptions) -> Iterator[str]:
    """Yield the metrics of a job that its own task lists, those that it has."""
    for metric in descriptions.listed(job):
        text = metric_text(job, metric)
        if text != MISSING:
            yield f"{metric.title if metric.title.isupper() else metric.title.lower()} {text}"


def chosen_table(jobs: Sequence[Json], names: Sequence[str]) -> Table:
    """Return a table of jobs with the columns of these names."""
    table = listing()
    for name in names:
        table.add_column(COLUMNS[name][0] if name in COLUMNS else name, overflow="fold")
    for job in jobs:
        table.add_row(
            *(COLUMNS[name][1](job) if name in COLUMNS else cell(_text(value_of(job, name))) for name in names)
        )
    return table


def value_of(job: Json, name: str) -> Any:
    """Return what a job has under a name: a field, a setting such as ``algorithm.gamma``, a result or a metric.

    A setting's short name, such as ``gamma``, means the setting where nothing else has that name.
    """
    if name == "done":
        return percent(job)
    if name in ("task", "robot", "simulator"):
        return section_name(job["spec"], name)
    value = _setting(job, tuple(name.split(".")))
    if value is not None:
        return value
    results = {item["name"]: item["value"] for item in (shown_result(job) or {}).get("results", ())}
    fields = {"steps": job["total_steps"], "submitted": job.get("created_at")}
    value = fields.get(name, results.get(name, (job.get("latest_metrics") or {}).get(name, job.get(name))))
    return _setting(job, _short_names().get(name, ())) if value is None else value


def _setting(job: Json, path: tuple[str, ...]) -> Any:
    value: Any = job["spec"] if path else None
    for part in path:
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


@functools.cache
def _short_names() -> dict[str, tuple[str, ...]]:
    return {name: setting.path for name, setting in flat.settings().items()}


def _text(value: Any) -> str:
    if value is None:
        return MISSING
    return f"{value:g}" if isinstance(value, float) else str(value)


def listing(*headings: str) -> Table:
    """Return an empty table with these columns; nothing is cut, and ids stay in one piece to be copied."""
    columns = [Column(each, overflow="fold", no_wrap=each == "ID") for each in headings]
    return Table(*columns, box=None, pad_edge=False, header_style="bold")


def pairs(rows: Iterable[tuple[str, RenderableType]]) -> Table:
    """Return a table of names and values without lines."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bright_black", overflow="fold")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    return table


def training_text(spec: Json) -> str:
    """Return a stored specification in one line: task, robot, preset, seed, simulator."""
    algorithm = spec.get("algorithm")
    preset = algorithm.get("preset", MISSING) if isinstance(algorithm, Mapping) else MISSING
    robot, simulator = section_name(spec, "robot"), section_name(spec, "simulator")
    return (
        f"{section_name(spec, 'task')}, robot {robot}, preset {preset}, seed {spec.get('seed', MISSING)}, {simulator}"
    )


def job_details(job: Json, metrics: Sequence[Metric] = ()) -> Table:
    """Return a table of one job, with its evaluation and the newest value of each of ``metrics``."""
    started, finished = parse_time(job.get("started_at")), parse_time(job.get("finished_at"))
    took = ((finished or datetime.now(UTC)) - started).total_seconds() if started else None
    state = state_text(job["state"])
    requests = [
        r for r in ("cancel", "pause") if job.get(f"{r}_requested") and job["state"] not in ("cancelled", "paused")
    ]
    if requests:
        state.append(f" ({' and '.join(requests)} requested)")
    rows: list[tuple[str, RenderableType]] = [
        ("Job", job["id"]),
        ("Name", cell(job["name"])),
        ("State", state),
        *([("Waiting", waiting_text(job))] if job.get("waiting_reason") else []),
        *([("Stalled", Text(stall_text(job), "yellow"))] if job.get("stalled_since") else []),
        ("Progress", f"{job['progress_step']:,} of {job['total_steps']:,} steps ({percent(job):.0%})"),
        ("Training", training_text(job["spec"])),
        ("Owner", cell(job["owner"])),
        ("Tags", cell(", ".join(job["tags"]) or MISSING)),
        ("Attempt", f"{job['attempt']} ({job.get('failures', 0)} of at most {job['max_attempts']} failed)"),
        ("Worker", cell(job.get("worker") or MISSING)),
        ("Submitted", ago(job.get("created_at"))),
        ("Took" if finished else "Running for", duration(took)),
    ]
    if job.get("parent_job_id"):
        rows.append(("Parent", job["parent_job_id"]))
    if software := software_text(job.get("software") or {}):
        rows.append(("Software", cell(software)))
    if job.get("group_id"):
        rows.append(("Group", job["group_id"]))
    if result := shown_result(job):
        rows.append(("Evaluation", evaluated(result)))
        rows += headline(result).items()
    latest = job.get("latest_metrics") or {}
    training = ", ".join(
        f"{metric.title.lower()} {value_text(metric, latest)}" for metric in metrics if metric.name in latest
    )
    if training:
        rows.append(("In training", f"{training} (latest episodes, with exploration)"))
    if usage := usage_text(latest):
        rows.append(("Usage", usage))
    if job.get("error"):
        rows.append(("Error", Text(plain(job["error"]), style="red")))
    return pairs(rows)


def software_text(software: Mapping[str, str]) -> str:
    """Return in one line what a training ran with; empty before its first attempt."""
    names = [name for name in ("naosprint", "python", "torch", "numpy", "mujoco") if name in software]
    commit = software.get("commit", "")
    state = " with changed files" if commit.endswith("+") else ""
    parts = [f"{name} {software[name]}" for name in names] + ([f"commit {commit[:12]}{state}"] if commit else [])
    return ", ".join(parts)


def usage_text(row: Mapping[str, Any]) -> str:
    """Return what a training uses and where its time goes, of a row of metrics; empty without such metrics."""
    parts = []
    if "cpus" in row and "memory_mb" in row:
        parts.append(f"{row['cpus']:.1f} CPUs, {row['memory_mb']:,.0f} MiB")
    if "collect_s" in row and "learn_s" in row:
        total = max(row["collect_s"] + row["learn_s"], 1e-9)
        names = {"simulator_s": "simulator", "collect_s": "rest of collection", "learn_s": "learner"}
        spent = {**row, "collect_s": row["collect_s"] - row.get("simulator_s", 0.0)}
        parts.append(", ".join(f"{title} {spent[name] / total:.0%}" for name, title in names.items() if name in row))
    if "steps_per_s" in row:
        parts.append(f"{row['steps_per_s']:,.0f} steps/s")
    return "; ".join(parts)


class Curve:
    """Metrics of a job over time, limited in number."""

    LIMIT = 4096
    """Maximum number of points per metric; beyond it every second one is dropped."""

    def __init__(self) -> None:
        self.series: dict[str, list[float]] = {}
        self.latest: dict[str, float] = {}

    def add(self, row: Mapping[str, Any]) -> None:
        """Add one metrics row."""
        for key, value in row.items():
            if not isinstance(value, int | float) or not math.isfinite(value):
                continue
            self.latest[key] = value
            values = self.series.setdefault(key, [])
            values.append(float(value))
            if len(values) > self.LIMIT:
                del values[1::2]


def live_view(
    job: Json, curve: Curve, metrics: Sequence[Metric], *, width: int, ascii_only: bool, note: str = ""
) -> RenderableType:
    """Return the live display of ``watch``: progress, metrics and curves of one job."""
    latest = curve.latest
    step = max(int(latest.get("step", 0)), int(job.get("progress_step") or 0))
    total = job["total_steps"]
    head = Text.assemble((plain(job["name"]), "bold"), "  ", job_state(job), f"  {job['id']}")
    bar_width = max(10, min(60, width - 44))
    line = Table.grid(padding=(0, 2))
    eta = duration(latest.get("eta_s")) if job["state"] == "running" else MISSING
    line.add_row(
        ProgressBar(total=max(total, 1), completed=min(step, total), width=bar_width),
        f"{min(step, total):,} of {total:,} steps",
        f"ETA {eta}",
    )
    table = Table(box=None, pad_edge=False, header_style="bright_black")
    table.add_column("In training")
    table.add_column("Now", justify="right", no_wrap=True)
    table.add_column("Best", justify="right", no_wrap=True)
    table.add_column("Trend", no_wrap=True)
    for metric in metrics:
        values = curve.series.get(metric.name)
        if not values:
            continue
        best = min(values) if metric.better == "lower" else max(values)
        table.add_row(
            metric.title,
            format_value(metric, values[-1]),
            format_value(metric, best),
            sparkline(values, max(10, min(60, width - 44)), ascii_only=ascii_only),
        )
    parts: list[RenderableType] = [head, line]
    if job.get("waiting_reason"):
        parts += ["", Text(f"Waiting: {waiting_text(job)}", style="yellow")]
    if job.get("stalled_since"):
        parts += ["", Text(f"Stalled: {stall_text(job)}", style="yellow")]
    if curve.series:
        parts += ["", table]
        if usage := usage_text(latest):
            parts += ["", Text(usage, style="bright_black")]
    if note:
        parts += ["", Text(note, style="yellow")]
    return Group(*parts)


def progress_line(job: Json, row: Json, metrics: Sequence[Metric]) -> str:
    """Return the progress of a job as one line."""
    step, total = int(row.get("step", job.get("progress_step", 0))), job["total_steps"]
    values = "  ".join(f"{metric.title.lower()} {value_text(metric, row)}" for metric in metrics if metric.name in row)
    share = min(1.0, step / total) if total else 0.0
    return f"{step:>12,} of {total:,} steps {share:>4.0%}  in training: {values}  ETA {duration(row.get('eta_s'))}"
