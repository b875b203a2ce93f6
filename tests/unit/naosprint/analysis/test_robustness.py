"""Ranges of disturbances: what is searched, kept, plotted and refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import naopolicies
import pytest
from naospec import TrainingSpec
from naospec.metrics import Metric, Result
from naosprint import train
from naosprint.__main__ import main
from naosprint.analysis import examination, figures
from naosprint.analysis.motion import motion
from naosprint.analysis.robustness import CONDITIONS, DISTURBANCES, Disturbance, Point, ranges


def test_the_range_ends_where_too_many_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search finds every border of the grid, with few runs, and keeps what it has run in order."""
    pushes = next(each for each in DISTURBANCES if each.name == "pushes")
    for border in (None, *range(len(pushes.strengths))):
        limit = -1.0 if border is None else pushes.strengths[border]

        def run(checkpoint: Path, disturbance: Disturbance, strength: float, *_: int, limit: float = limit) -> Point:
            return Point(strength, 0.05 if strength <= limit else 0.06, 0.0, 1.0)

        monkeypatch.setattr("naosprint.analysis.robustness._run", run)
        (found,) = ranges(Path("unused"), names=["pushes"])
        assert found.reached == (None if border is None else limit)
        assert found.complete == (border == len(pushes.strengths) - 1)
        assert len(found.points) <= 7
        assert [point.strength for point in found.points] == sorted(point.strength for point in found.points)


def test_a_policy_is_examined_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """t1-sprint stands no delay; the NAO's engine has no pushes and no contacts, which is said instead."""
    arguments = ["--episodes", "3", "--threads", "1", "--output", str(tmp_path)]
    assert main(["examine", "t1-sprint", "--only", "delay,conditions", *arguments]) == 0
    printed = capsys.readouterr().out
    assert "delay        Delay     none" in printed and "the first five at once" in printed
    written = json.loads((tmp_path / "examination.json").read_text(encoding="utf-8"))
    (delay,) = written["ranges"]["disturbances"]
    assert delay["text"] == "none" and delay["points"][0][:2] == [0.0, 0.0] and delay["points"][-1][:2] == [5.0, 1.0]
    falls = {
        row["disturbance"]: next(each["value"] for each in row["results"] if each["name"] == "fall_rate")
        for row in written["robustness"]
    }
    assert falls.keys() == CONDITIONS.keys() - {"1 cm of noise on the ball"}  # which there is none of
    assert (falls["none"], falls["masses of bodies up to 10 % different"], falls["20 ms more delay"]) == (0.0, 0.0, 1.0)
    assert (tmp_path / "robustness.svg").read_text(encoding="utf-8").count("<svg") == 1
    assert main(["examine", "sprint", "--only", "pushes,motion", *arguments[:4]]) == 0
    printed = capsys.readouterr().out
    assert "not possible in this simulator" in printed and "Largest joint speed" not in printed
    assert main(["examine", "t1-sprint", "--only", "motion", *arguments]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["examination.json"], "the drawing showed other results"


def test_a_running_robot_moves_faster_and_lands_harder_than_a_standing_one(tmp_path: Path) -> None:
    """Also if it was trained on servers, which report neither forces nor contacts."""
    folder = shutil.copytree(naopolicies.folder("t1-sprint"), tmp_path / "policy")
    manifest = naopolicies.checkpoint("t1-sprint")
    spec = TrainingSpec.model_validate({**manifest["spec"], "simulator": "server"})
    edited = {**manifest, "spec": spec.model_dump(mode="json"), "spec_sha256": spec.digest()}
    (folder / "checkpoint.json").write_text(json.dumps(edited), encoding="utf-8")
    found = motion(folder, threads=1)
    assert found["running"]["joint_speed_rad_s"] > 10 * found["standing"]["joint_speed_rad_s"] > 0.0
    assert found["running"]["foot_force_n"] > 3 * found["standing"]["foot_force_n"] > 100.0
    assert found["running"]["torque_at_limit"] > found["standing"]["torque_at_limit"]


def test_rows_have_a_cell_for_each_result_that_any_condition_has() -> None:
    """A card may lack a result that no episode supported: corners, if every robot fell before one."""

    def result(name: str, value: float) -> dict[str, object]:
        metric = Metric(name, name.title(), "%", "", 1, "higher", "rate")
        return Result(metric, value).to_json()

    conditions = [("none", [result("line", 0.75), result("corner", 0.45)]), ("delay", [result("line", 0.5)])]
    card = {"robustness": [{"disturbance": name, "results": results} for name, results in conditions]}
    ((_, table),) = examination.rows(card)
    assert table == [["Disturbance", "Line", "Corner"], ["none", "75.0 %", "45.0 %"], ["delay", "50.0 %", "-"]]


def test_figures_have_a_panel_for_each_range_that_was_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "naosprint.analysis.robustness._run", lambda *arguments: Point(arguments[2], arguments[2] / 10.0, 0.0, 1.0)
    )
    found = ranges(naopolicies.folder("t1-sprint"))
    assert len(figures.robustness(found, 0.05).axes) == len(DISTURBANCES)


def test_unknown_disturbances_and_impossible_numbers_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["--only", "rain"], "rain: unknown; choose among motion, conditions, pushes"),
        (["--episodes", "0"], "--episodes: must be between 1"),
        (["--most-failures", "5"], "--most-failures: must be at least 0 and less than 1"),
    ):
        assert main(["examine", "t1-sprint", *arguments]) == 1
        assert message in capsys.readouterr().err


def test_a_task_without_a_disturbance_is_examined_in_the_others(
    offer: Callable[[str], None], tmp_path: Path, capsys: pytest.CaptureFixture[str], recorder: Any
) -> None:
    """Own tasks need not inherit the settings of disturbances."""
    offer("naosprint-backwards")
    algorithm = {"n_envs": 2, "n_steps": 16, "batch_size": 32, "hidden_sizes": [8]}
    spec = TrainingSpec.model_validate(
        {"robot": "nao-0", "task": "run-backwards", "algorithm": algorithm, "total_steps": 32}
    )
    checkpoint = train(spec, workdir=tmp_path / "run", reporter=recorder).checkpoint
    assert (
        main(["examine", str(checkpoint), "--only", "pushes,noise,conditions", "--episodes", "2", "--threads", "1"])
        == 0
    )
    printed = capsys.readouterr().out
    assert printed.count("not a setting of this task") == 2 and "none" in printed
    (found, _) = ranges(checkpoint, names=["pushes", "noise"])
    assert found.missing and found.impossible == "task run-backwards has no setting push_mps"
