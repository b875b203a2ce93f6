"""How things look in a terminal: tables, curves, progress; plain lines where there is no terminal."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from naosprint.tasks.metrics import format_value
from rich.console import Console, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from naoctl.descriptions import Descriptions, common, section_name, value_text

if TYPE_CHECKING:
    from naosprint.tasks.metrics import Metric

Json = Mapping[str, Any]

#: Colour by state of a job, of an evaluation.
STATE_STYLE = {
    "queued": "cyan",
    "starting": "cyan",
    "running": "blue",
    "pausing": "yellow",
    "paused": "yellow",
    "evaluating": "magenta",
    "succeeded": "green",
    "failed": "red",
    "cancelled": "bright_black",
}
BARS = "▁▂▃▄▅▆▇█"
ASCII_BARS = "_.-=+*#%"
MISSING = "-"


def make_console(*, stderr: bool = False) -> Console:
    """Return a console that never wraps or colours what is not shown on a terminal."""
    console = Console(stderr=stderr, highlight=False, soft_wrap=False)
    if not console.is_terminal:
        console = Console(stderr=stderr, highlight=False, width=200, no_color=True)
    return console


def print_json(console: Console, value: Any) -> None:
    """Print JSON as it is: no colour, no wrapping."""
    console.file.write(json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def print_json_line(console: Console, value: Any) -> None:
    """Print one JSON document in one line, at once."""
    console.file.write(json.dumps(value, ensure_ascii=False) + "\n")
    console.file.flush()


def sparkline(values: Sequence[float | None], width: int = 40, *, ascii_only: bool = False) -> str:
    """Draw values as one line of bars, from the least to the greatest.

    Args:
        values: in order; None and non-finite values are left out.
        width: most characters; longer series are averaged in groups of neighbours.
        ascii_only: use characters every terminal has.
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
    """Write a time span as people say it: ``42 s``, ``3:07 min``, ``1:02:03 h``, ``3 d 4 h``, ``40 d``."""
    if seconds is None or not math.isfinite(seconds):
        return MISSING
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    if whole < 86400:
        return f"{whole // 3600}:{whole % 3600 // 60:02d}:{whole % 60:02d} h"
    days, hours = whole // 86400, whole % 86400 // 3600
    return f"{days} d {hours} h" if days < 10 else f"{days} d"


def size(count: int) -> str:
    """Write a number of bytes: ``512 B``, ``1.5 kB``, ``31.2 MB``."""
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
    """Write how long ago a time of the service was."""
    moment = parse_time(text)
    if moment is None:
        return MISSING
    return f"{duration(((now or datetime.now(UTC)) - moment).total_seconds())} ago"


def has_passed(text: str | None) -> bool:
    """Tell whether a time of the service is over; one that is not set never is."""
    moment = parse_time(text)
    return moment is not None and moment <= datetime.now(UTC)


def clock(text: str | None) -> str:
    """Write a time of the service as the local wall clock shows it, without zone: hours to milliseconds."""
    moment = parse_time(text)
    return moment.astimezone().strftime("%H:%M:%S.%f")[:-3] if moment else MISSING


def plain(text: object) -> str:
    """Return text from the service without control characters: a log line must not steer the terminal."""
    return "".join(c if c.isprintable() or c == "\t" else "\N{REPLACEMENT CHARACTER}" for c in str(text))


def cell(text: object) -> Text:
    """Return text from the service for a table: no control characters, and nothing in it is markup."""
    return Text(plain(text))


def state_text(state: str) -> Text:
    """Write a state in its colour."""
    return Text(state, style=STATE_STYLE.get(state, ""))


def percent(job: Json) -> float:
    """Return the share of a job's steps that is done, 0 to 1."""
    total = job.get("total_steps") or 0
    return min(1.0, job.get("progress_step", 0) / total) if total else 0.0


#: Columns of the list of jobs beside id, name, state and metrics: heading, least terminal width at which it is shown.
LIST_COLUMNS = (("Done", 0), ("Steps", 100), ("Submitted", 90))
#: Least terminal width at which the list of jobs shows its first, second and third metric.
METRIC_WIDTHS = (78, 112, 126)


def jobs_table(jobs: Sequence[Json], descriptions: Descriptions, width: int = 200) -> Table:
    """Return the list of jobs, with as many columns as the width has room for; the name gives way first."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("ID", no_wrap=True, min_width=30)
    table.add_column("Name", no_wrap=True, overflow="ellipsis", max_width=40)
    table.add_column("State", no_wrap=True, min_width=10)
    listed = common([descriptions.listed(job) for job in jobs])
    metrics = [metric for metric, least in zip(listed, METRIC_WIDTHS, strict=False) if width >= least]
    shown = [heading for heading, least in LIST_COLUMNS if width >= least]
    headings = [*shown[:2], *(metric.title for metric in metrics), *shown[2:]]
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for job in jobs:
        row = job.get("latest_metrics") or {}
        own = {metric.name for metric in descriptions.listed(job)}
        cells = {
            "Done": f"{percent(job):.0%}",
            "Steps": f"{job['total_steps']:,}",
            "Submitted": ago(job.get("created_at")),
            **{metric.title: value_text(metric, row) if metric.name in own else MISSING for metric in metrics},
        }
        # A table that is too wide shrinks all its columns; only the name can lose characters without losing sense.
        room = width - 30 - 10 - sum(max(len(heading), 11) + 2 for heading in headings) - 4
        name = plain(job["name"])
        short = name if len(name) <= max(room, 8) else name[: max(room, 8) - 1] + "…"
        table.add_row(cell(job["id"]), cell(short), state_text(job["state"]), *(cells[heading] for heading in headings))
    return table


def pairs(rows: Iterable[tuple[str, RenderableType]]) -> Table:
    """Return a table of names and values without lines."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bright_black", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    return table


def training_text(spec: Json) -> str:
    """Return what a stored specification trains, in one line: task, robot, preset, seed, simulator."""
    algorithm = spec.get("algorithm")
    preset = algorithm.get("preset", MISSING) if isinstance(algorithm, Mapping) else MISSING
    robot, simulator = section_name(spec, "robot"), section_name(spec, "simulator")
    return (
        f"{section_name(spec, 'task')}, robot {robot}, preset {preset}, seed {spec.get('seed', MISSING)}, {simulator}"
    )


def job_details(job: Json, metrics: Sequence[Metric] = ()) -> Table:
    """Return one job in detail, with its newest value of each of ``metrics``."""
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
        *([("Waiting", cell(job["waiting_reason"]))] if job.get("waiting_reason") else []),
        ("Progress", f"{job['progress_step']:,} of {job['total_steps']:,} steps ({percent(job):.0%})"),
        ("Training", training_text(job["spec"])),
        ("Owner", cell(job["owner"])),
        ("Tags", cell(", ".join(job["tags"]) or MISSING)),
        ("Attempt", f"{job['attempt']} ({job.get('failures', 0)} of at most {job['max_attempts']} lost)"),
        ("Worker", cell(job.get("worker") or MISSING)),
        ("Submitted", ago(job.get("created_at"))),
        ("Took" if finished else "Running for", duration(took)),
    ]
    if job.get("parent_job_id"):
        rows.append(("Parent", job["parent_job_id"]))
    if job.get("group_id"):
        rows.append(("Group", job["group_id"]))
    latest = job.get("latest_metrics") or {}
    rows += [(metric.title, value_text(metric, latest)) for metric in metrics if metric.name in latest]
    if job.get("error"):
        rows.append(("Error", Text(plain(job["error"]), style="red")))
    return pairs(rows)


class Curve:
    """Metrics of a job over time, no more points than a terminal can show."""

    #: Points kept per metric; beyond it every second one is dropped.
    LIMIT = 4096

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
    """Return the picture that ``watch`` keeps on the screen: progress, metrics and curves of one job."""
    latest = curve.latest
    step = max(int(latest.get("step", 0)), int(job.get("progress_step") or 0))
    total = job["total_steps"]
    head = Text.assemble((plain(job["name"]), "bold"), "  ", state_text(job["state"]), f"  {job['id']}")
    bar_width = max(10, min(60, width - 44))
    line = Table.grid(padding=(0, 2))
    eta = duration(latest.get("eta_s")) if job["state"] == "running" else MISSING
    line.add_row(
        ProgressBar(total=max(total, 1), completed=min(step, total), width=bar_width),
        f"{min(step, total):,} of {total:,} steps",
        f"ETA {eta}",
    )
    table = Table(box=None, pad_edge=False, header_style="bright_black")
    table.add_column("")
    table.add_column("Now", justify="right", no_wrap=True)
    table.add_column("Best", justify="right", no_wrap=True)
    table.add_column("Course", no_wrap=True)
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
        parts += ["", Text(f"Waiting: {plain(job['waiting_reason'])}", style="yellow")]
    if curve.series:
        parts += ["", table]
    if note:
        parts += ["", Text(note, style="yellow")]
    return Group(*parts)


def progress_line(job: Json, row: Json, metrics: Sequence[Metric]) -> str:
    """Return one line that says how far a job is, for output that is no terminal."""
    step, total = int(row.get("step", job.get("progress_step", 0))), job["total_steps"]
    values = "  ".join(f"{metric.title.lower()} {value_text(metric, row)}" for metric in metrics if metric.name in row)
    share = min(1.0, step / total) if total else 0.0
    return f"{step:>12,} of {total:,} steps {share:>4.0%}  {values}  ETA {duration(row.get('eta_s'))}"
