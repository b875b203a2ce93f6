from __future__ import annotations

import io
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import pytest
from naoctl import render
from naoctl.judgement import headline
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
        (59.6, "1:00 min"),
        (187, "3:07 min"),
        (3723, "1:02:03 h"),
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
    assert render.ago("2026-01-02T03:04:05Z", now) == "1:00 min ago"
    assert render.ago("2026-01-02T03:04:05.123456+00:00", now) == "1:00 min ago"
    assert render.ago(None) == "-"


def test_text_of_the_service_cannot_steer_the_terminal() -> None:
    assert render.plain("a\x1b[31mb\x07\r\nc\td") == "a�[31mb���c\td"


def test_the_list_shows_what_matters(job: Callable[..., dict[str, Any]]) -> None:
    rows = [job(), job(id="job_" + "2" * 26, name="[red]x[/red]\x1b[2J", latest_metrics={}, total_steps=0)]
    text = shown(render.jobs_table(rows))
    assert "job_01m7y0yae5d2d9p46g58mkcxxh" in text
    assert "25%" in text
    assert "2.25 m" in text
    assert "[red]x[/red]" in text
    assert "\x1b" not in text


@pytest.mark.parametrize("width", [64, 80, 90, 100, 120, 200])
def test_the_list_fits_any_terminal_and_keeps_ids_and_states_whole(
    job: Callable[..., dict[str, Any]], width: int
) -> None:
    rows = [job(name="a long name of a job that goes on and on", state="evaluating", total_steps=200_000_000)]
    text = shown(render.jobs_table(rows, width), width=width)
    assert "job_01m7y0yae5d2d9p46g58mkcxxh" in text
    assert "evaluating" in text
    assert len(text.splitlines()) == 2
    assert max(len(line) for line in text.splitlines()) <= width
    assert ("200,000,000" in text) == (width >= 100)
    assert ("2.25 m" in text) == (width >= 78)


def test_a_job_in_detail(job: Callable[..., dict[str, Any]]) -> None:
    text = shown(render.job_details(job(state="failed", error="the disk is full", cancel_requested=True)))
    for words in ("250 of 1,000 steps (25%)", "failed (cancel requested)", "the disk is full", "preset fast, seed 0"):
        assert words in text


def test_the_live_picture_shows_progress_figures_and_course(job: Callable[..., dict[str, Any]]) -> None:
    curve = render.Curve()
    for step in range(100):
        curve.add({"step": step * 10, "reward": step, "fall_rate": 1 - step / 100, "eta_s": 61, "policy_loss": None})
    text = shown(render.live_view(job(), curve, width=80, ascii_only=False, note="checkpoint at step 500"), width=80)
    assert "990 of 1,000 steps" in text
    assert "1:01 min" in text
    assert "99.00" in text
    assert "▁" in text and "█" in text
    assert "checkpoint at step 500" in text
    falls = next(line for line in text.splitlines() if line.startswith("Falls"))
    assert falls.split()[1:3] == ["1%", "1%"]
    assert max(len(line) for line in text.splitlines()) <= 80


def test_the_live_picture_without_any_figure_yet(job: Callable[..., dict[str, Any]]) -> None:
    text = shown(render.live_view(job(state="queued", progress_step=0), render.Curve(), width=60, ascii_only=True))
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
    line = render.progress_line(job(), {"step": 500, "reward": 1.234, "fall_rate": 0.5, "eta_s": 30.0})
    assert line.split() == ["500", "of", "1,000", "steps", "50%", "reward", "1.23", "falls", "50%", "ETA", "30", "s"]


def test_headline_figures_carry_their_intervals() -> None:
    summary = {
        "distance_m": {"mean": 12.25, "ci": [12.0, 12.7]},
        "speed_mps": {"mean": None, "ci": None},
        "falls": {"rate": 0.25, "ci": [0.2, 0.3]},
        "paper": {"top_speed_mps": 3.9, "top_speed_sd_mps": 0.07},
        "run_challenge": {"score": {"mean": 1.5, "ci": [1.4, 1.6]}},
        "training": {"seed": 3},
    }
    assert headline(summary) == {
        "Distance": "12.25 m [12.00, 12.70]",
        "Speed, whole run": "-",
        "Run challenge score": "1.50 [1.40, 1.60]",
        "Top speed (paper)": "3.90 m/s (sd 0.07)",
        "Falls": "25.0% [20.0%, 30.0%]",
    }
    assert headline({}) == {}
    assert headline({"paper": {"top_speed_mps": None}}) == {"Top speed (paper)": "-"}
