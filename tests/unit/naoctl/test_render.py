from __future__ import annotations

import io
import re
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import pytest
from naoctl import render
from naoctl.descriptions import PACE, Descriptions, metric_of
from naoctl.evaluations import headline
from rich.console import Console


def shown(renderable: Any, width: int = 120) -> str:
    console = Console(file=io.StringIO(), width=width, no_color=True)
    console.print(renderable)
    output = console.file
    assert isinstance(output, io.StringIO)
    return output.getvalue()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 0 s"),
        (187, "3 min 7 s"),
        (3723, "1 h 2 min"),
        (273600, "3 d 4 h"),
        (40 * 86400, "40 d"),
        (None, "-"),
        (float("nan"), "-"),
        (-3, "0 s"),
    ],
)
def test_durations(seconds: float | None, text: str) -> None:
    assert render.duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (31_200_000, "31.2 MB"), (2 * 10**13, "20.0 TB")]
)
def test_sizes(count: int, text: str) -> None:
    assert render.size(count) == text


def test_sparklines_rise_with_the_values() -> None:
    assert render.sparkline([0, 1, 2, 3, 4, 5, 6, 7]) == "▁▂▃▄▅▆▇█"
    assert render.sparkline([0, 7], ascii_only=True) == "_%"
    assert render.sparkline([3, 3, 3]) == "▅▅▅"
    assert render.sparkline([]) == ""
    assert render.sparkline([None, float("nan"), float("inf"), 2.0]) == "▅"


def test_sparklines_average_what_does_not_fit() -> None:
    line = render.sparkline(list(range(1000)), width=10)
    assert len(line) == 10
    assert list(line) == sorted(line)
    assert len(render.sparkline(list(range(11)), width=10)) == 10


def test_times_of_the_service() -> None:
    now = datetime(2026, 1, 2, 3, 5, 5, tzinfo=UTC)
    assert render.ago("2026-01-02T03:04:05Z", now) == "1 min 0 s ago"
    assert render.ago("2026-01-02T03:04:05.123456+00:00", now) == "1 min 0 s ago"
    assert render.ago(None) == "-"


def test_text_of_the_service_cannot_steer_the_terminal() -> None:
    assert render.plain("a\x1b[31mb\x07\r\nc\td") == "a�[31mb���c\td"


JUMP = {
    "name": "jump",
    "metrics": [
        {"name": "reward", "title": "Reward"},
        {"name": "height_m", "title": "Height", "unit": "m", "better": "higher"},
        {"name": "miss_rate", "title": "Misses", "unit": "%", "digits": 0, "better": "lower"},
    ],
    "listed": ["height_m", "miss_rate"],
}
METRICS = [*map(metric_of, JUMP["metrics"]), PACE]  # type: ignore[arg-type]


class Service:
    """A service that knows a task which is not installed here."""

    def get(self, path: str) -> list[dict[str, Any]]:
        assert path == "/tasks"
        return [JUMP]


def of_service(job: dict[str, Any], **metrics: float) -> dict[str, Any]:
    """Return the job with that task and these metrics."""
    return {**job, "spec": {**job["spec"], "task": {"name": "jump"}}, "latest_metrics": metrics}


def test_a_task_that_is_not_installed_here_is_described_by_the_service(job: Callable[..., dict[str, Any]]) -> None:
    descriptions = Descriptions(Service())  # type: ignore[arg-type]
    rows = [job(), of_service(job(), height_m=1.25, miss_rate=0.5)]
    text = shown(render.jobs_table(rows, descriptions))
    assert "height 1.25 m" in text
    assert "2.25 m" in text, "the metric of a task that is installed"
    assert [metric.name for metric in descriptions.shown(rows[1])] == ["reward", "height_m", "miss_rate", "steps_per_s"]
    unknown = {**job(), "spec": {"task": "of an older version"}}
    assert "first" in shown(render.jobs_table([unknown], Descriptions()))


def test_the_usage_of_a_training_is_one_line(job: Callable[..., dict[str, Any]]) -> None:
    row = {
        "cpus": 1.93,
        "memory_mb": 812.4,
        "collect_s": 0.75,
        "simulator_s": 0.5,
        "learn_s": 0.25,
        "steps_per_s": 24000,
    }
    text = "1.9 CPUs, 812 MiB; simulator 50%, rest of collection 25%, learner 25%; 24,000 steps/s"
    assert render.usage_text(row) == text
    assert render.usage_text({"reward": 1.0}) == ""
    assert "Usage" in shown(render.job_details(job(latest_metrics=row)))


def test_the_list_shows_what_matters(job: Callable[..., dict[str, Any]]) -> None:
    rows = [job(), job(id="job_" + "2" * 26, name="[red]x[/red]\x1b[2J", latest_metrics={}, total_steps=0)]
    text = shown(render.jobs_table(rows, Descriptions()))
    assert "job_01m7y0yae5d2d9p46g58mkcxxh" in text
    assert "25%" in text
    assert "2.25 m" in text
    assert "[red]x[/red]" in text
    assert "\x1b" not in text


@pytest.mark.parametrize("width", [64, 80, 90, 100, 120, 200])
def test_the_list_fits_any_terminal_and_keeps_names_and_states_whole(
    job: Callable[..., dict[str, Any]], width: int
) -> None:
    rows = [job(name="t1-sprint-wide-s3", state="evaluating", total_steps=200_000_000)]
    text = shown(render.jobs_table(rows, Descriptions(), width), width=width)
    assert "cxxh" in text and ("job_01m7y0yae5d2d9p46g58mkcxxh" in text) == (width >= 130)
    assert "t1-sprint-wide-s3" in text
    assert "evaluating" in text
    assert len(text.splitlines()) == 2
    assert max(len(line) for line in text.splitlines()) <= width
    assert ("200,000,000" in text) == (width >= 110)
    assert "2.25 m" in text


@pytest.mark.parametrize("width", [64, 72, 76, 80, 100])
def test_long_names_are_folded_and_cut_results_say_so(job: Callable[..., dict[str, Any]], width: int) -> None:
    metrics = {"distance_m": 0.4, "speed_mps": 0.46, "fall_rate": 0.979}
    rows = [job(name="speed-batch_size-512", state="running", latest_metrics=metrics), job(name="n" * 60)]
    lines = shown(render.jobs_table(rows, Descriptions(), width), width=width).splitlines()
    assert max(map(len, lines)) <= width
    assert "speed-batch_size-512" in lines[1] and "25%" in lines[1]
    assert sum(line.count("n" * 8) for line in lines) >= 4
    assert lines[1].rstrip().endswith(("…", "falls 97.9 %", "falls 97.9%"))


def test_ids_stay_in_one_piece_beside_long_columns() -> None:
    table = render.listing("ID", "Robots", "Works on")
    table.add_row("vm:7802:8976ab12cd34", "k1, nao-0, nao-1, nao-2, nao-3, nao-4, t1", "job_01m7y0yae5d2d9p46g58mkcxxh")
    text = shown(table, width=60)
    assert "vm:7802:8976ab12cd34" in text and "…" not in text


def test_a_long_name_leaves_its_value_room() -> None:
    """As that of a long alias before what it requires."""
    table = render.pairs(
        [("Started from", "random weights"), (f"{'a' * 60} requires", "b" * 40), ("Notes", "c " * 200)]
    )
    lines = shown(table, width=80).splitlines()
    assert lines[0].split("  ")[0] == "Started from"
    assert any("b" * 36 in line for line in lines)
    table = render.pairs([("Started from", "random weights"), ("Notes", "c" * 500)])
    assert shown(table, width=40).splitlines()[0].startswith("Started from  random weights")


def test_a_list_of_several_tasks_shows_the_results_of_each(job: Callable[..., dict[str, Any]]) -> None:
    getup = job(spec={**job()["spec"], "task": {"name": "getup"}}, latest_metrics={"success_rate": 0.5})
    text = shown(render.jobs_table([job(), getup], Descriptions(), 100), width=100)
    assert "distance 2.25 m" in text
    assert re.search(r"50\.0 ?%", text)


def test_columns_are_fields_settings_and_metrics(job: Callable[..., dict[str, Any]]) -> None:
    names = ["id", "robot", "algorithm.learning_rate", "distance_m", "unknown"]
    lines = shown(render.chosen_table([job()], names)).splitlines()
    assert lines[0].split() == ["ID", "Robot", *names[2:]]
    assert lines[1].split() == [job()["id"], "nao-0", "0.0005", "2.25", "-"]


def test_a_short_name_is_a_setting_where_nothing_else_has_it(
    job: Callable[..., dict[str, Any]],
) -> None:
    spec = {"algorithm": {"name": "ppo", "gamma": 0.98, "learning_rate": 5e-4}}
    found = job(spec={**job()["spec"], **spec}, latest_metrics={"learning_rate": 1e-4})
    assert [render.value_of(found, name) for name in ("gamma", "n_envs", "learning_rate")] == [0.98, None, 1e-4]


def test_a_job_in_detail(job: Callable[..., dict[str, Any]]) -> None:
    text = shown(render.job_details(job(state="failed", error="the disk is full", cancel_requested=True)))
    for words in ("250 of 1,000 steps (25%)", "failed (cancel requested)", "the disk is full", "preset fast, seed 0"):
        assert words in text


def test_the_live_picture_shows_progress_figures_and_course(job: Callable[..., dict[str, Any]]) -> None:
    curve = render.Curve()
    for step in range(100):
        curve.add({"step": step * 10, "reward": step, "miss_rate": 1 - step / 100, "eta_s": 61, "policy_loss": None})
    text = shown(
        render.live_view(job(), curve, METRICS, width=80, ascii_only=False, note="checkpoint at step 500"), width=80
    )
    assert "990 of 1,000 steps" in text
    assert "1 min 1 s" in text
    assert "99.00" in text
    assert "▁" in text and "█" in text
    assert "checkpoint at step 500" in text
    misses = next(line for line in text.splitlines() if line.startswith("Misses"))
    assert misses.split()[1:5] == ["1", "%", "1", "%"]
    assert max(len(line) for line in text.splitlines()) <= 80


def test_the_live_picture_without_any_figure_yet(job: Callable[..., dict[str, Any]]) -> None:
    text = shown(
        render.live_view(job(state="queued", progress_step=0), render.Curve(), METRICS, width=60, ascii_only=True)
    )
    assert "queued" in text
    assert "ETA -" in text


def test_curves_stay_small() -> None:
    curve = render.Curve()
    for step in range(3 * render.Curve.LIMIT):
        curve.add({"reward": float(step)})
    values = curve.series["reward"]
    assert len(values) <= render.Curve.LIMIT + 1
    assert values == sorted(values)
    assert curve.latest["reward"] == 3 * render.Curve.LIMIT - 1


def test_a_line_of_progress(job: Callable[..., dict[str, Any]]) -> None:
    line = render.progress_line(job(), {"step": 500, "reward": 1.234, "miss_rate": 0.5, "eta_s": 30.0}, METRICS)
    assert " ".join(line.split()) == "500 of 1,000 steps 50% in training: reward 1.23 misses 50 % ETA 30 s"


def result(name: str, value: float | None, **more: Any) -> dict[str, Any]:
    """One result of an evaluation as it describes itself."""
    return {"name": name, "title": name.capitalize(), "unit": "m", "digits": 2, "value": value, **more}


def test_results_carry_their_intervals() -> None:
    results = [
        result("height", 12.25, interval=[12.0, 12.7]),
        result("width", None, interval=None),
        result("misses", 0.25, unit="%", digits=1, interval=[0.2, 0.3]),
        result("angle", 3.0, unit="°", digits=1, sd=0.5),
        result("left_out", 1.0),
    ]
    names = ["misses", "height", "width", "angle", "unknown"]
    assert headline({"results": results, "headline": names}) == {
        "Misses": "25.0 % [20.0, 30.0]",
        "Height": "12.25 m [12.00, 12.70]",
        "Width": "-",
        "Angle": "3.0° (sd 0.5)",
    }
    assert list(headline({"results": results})) == ["Height", "Width", "Misses", "Angle", "Left_out"]
    assert headline({}) == {}
