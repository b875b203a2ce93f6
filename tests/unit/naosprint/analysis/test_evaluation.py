"""Results of evaluations."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import naopolicies
import numpy as np
import pytest
from naosim import robots
from naosim.simspark import EmbeddedSimulator
from naospec import EvaluationSpec
from naosprint import CheckpointError, evaluate
from naosprint.analysis.results import by_name
from naosprint.arrays import FloatArray
from naosprint.rl.policy import load_policy
from naosprint.tasks.environment import open_environment
from naosprint.tasks.episodes import Episodes, Statistics
from naosprint.tasks.sprint import CHALLENGE_SCORE, Sprint1, SprintSettings, _challenge, deviation_deg, speeds_beyond
from naosprint.tasks.world import World
from numpy._core import _multiarray_umath

DISPATCHED = _multiarray_umath.__cpu_dispatch__
FEATURES = _multiarray_umath.__cpu_features__


def runs_of(*paths: FloatArray, fallen: tuple[int, ...] = (), height: float = 0.36, air: float = 0.0) -> Episodes:
    """Return runs along given x positions, straight ahead from the start."""
    n = len(paths)
    flags = np.zeros(n, dtype=bool)
    flags[list(fallen)] = True
    airborne = []
    for x in paths:
        flags_i = np.zeros(len(x), dtype=bool)
        flags_i[1 : 1 + round(air * (len(x) - 1))] = True
        airborne.append(flags_i)
    heights = [np.full(len(x), height) for x in paths]
    for i in fallen:
        heights[i][-1] = 0.26
    return Episodes(
        x=list(paths),
        y=[np.zeros(len(x)) for x in paths],
        height=heights,
        up=[np.ones(len(x)) for x in paths],
        feet=[np.zeros((len(x), 2)) for x in paths],
        airborne=airborne,
        trace=[np.zeros((len(x), 0)) for x in paths],
        ends={"fallen": flags, "arrived": ~flags},
        max_steps=3000,
    )


def summary_of(episodes: Episodes) -> dict[str, Any]:
    """Return results and tables of sprint task I as in an evaluation's document."""
    robot = robots.get("nao-0")
    settings = Sprint1.resolve(SprintSettings(name="sprint1"), robot)
    task = Sprint1(settings, World(EmbeddedSimulator(robot, 1)))
    results, tables = task.summarize(episodes, Statistics(0.95, 2000, 0))
    return {"results": [one.to_json() for one in results], "tables": [one.to_json() for one in tables]}


def steady(speed: float, distance: float) -> FloatArray:
    """Return x at every cycle of a run at constant speed from -14."""
    return -14.0 + speed * 0.02 * np.arange(round(distance / (speed * 0.02)) + 1, dtype=np.float64)


def test_speed_beyond_a_line_is_that_of_the_rest() -> None:
    """A slow first metre counts from the start line, not from a later one."""
    slow: FloatArray = -14.0 + 0.01 * np.arange(101.0)
    fast = slow[-1] + 0.04 * np.arange(1.0, 400.0)
    path = np.concatenate([slow, fast])
    assert speeds_beyond([path], 1.5, 200) == pytest.approx([2.0])
    whole = (path[-1] - path[0]) / ((len(path) - 1) * 0.02)
    assert speeds_beyond([path], 0.0, 200) == pytest.approx([whole])


def test_short_episodes_count_only_without_the_papers_rule() -> None:
    """199 samples beyond the line are not enough for the paper."""
    path: FloatArray = -14.0 + 0.04 * np.arange(199.0)
    assert len(speeds_beyond([path], 0.0, 200)) == 0
    assert speeds_beyond([path], 0.0, 2) == pytest.approx([2.0])


def test_deviation_is_the_angle_from_the_running_direction() -> None:
    """In degrees, on either side."""
    assert deviation_deg(np.array([-14.0, -4.0]), np.array([0.0, 10.0])) == pytest.approx(45.0)
    assert deviation_deg(np.array([-14.0, -4.0]), np.array([0.0, -10.0])) == pytest.approx(45.0)
    assert deviation_deg(np.array([-14.0, 14.0]), np.array([0.3, 0.3])) == 0.0


def test_challenge_scores_speed_plus_time_in_the_air() -> None:
    """Two metres per second with a quarter of the time off the ground."""
    runs = runs_of(steady(2.0, 28.0))
    runs.airborne[0][:] = np.arange(len(runs.x[0])) % 4 == 0
    score, speed, off, fell = _challenge(runs, 0)
    assert speed == pytest.approx(2.0, rel=0.01)
    assert off == pytest.approx(0.25, abs=0.01)
    assert score == pytest.approx(speed + off)
    assert fell == 0.0


def test_challenge_punishes_a_fall() -> None:
    """Two metres less, over the whole running time of 20 s."""
    _, speed, _, fell = _challenge(runs_of(steady(2.0, 10.0), fallen=(0,)), 0)
    assert fell == 1.0
    assert speed == pytest.approx((10.0 - 2.0 - 0.5) / 20.0, rel=0.01)


@pytest.mark.parametrize("speed_mps", [-1.0, 0.0])
def test_challenge_gives_nothing_for_running_backwards_or_jumping_on_the_spot(speed_mps: float) -> None:
    runs = runs_of(-14.0 + speed_mps * 0.02 * np.arange(1000.0))
    runs.airborne[0][:] = True
    score, speed, off, fell = _challenge(runs, 0)
    assert (score, speed, off, fell) == (0.0, 0.0, 1.0, 0.0)


def test_the_challenge_s_rules_are_part_of_its_result() -> None:
    for rule in ("0.5 m on", "costs 2 m", "20 s", "0 for a robot"):
        assert rule in CHALLENGE_SCORE.description


def test_challenge_stops_the_clock_after_twenty_seconds() -> None:
    """A slow walker is measured for 20 s, from 4 s after the start at the latest."""
    _, speed, _, fell = _challenge(runs_of(steady(0.1, 4.0)), 0)
    assert fell == 0.0
    # the clock starts at 4 s and 0.4 m, before the line at 0.5 m, from which distance counts
    assert speed == pytest.approx((0.4 + 20 * 0.1 - 0.5) / 20.0, rel=0.02)


def test_results_of_known_runs() -> None:
    """One that arrives at 2 m/s and one that falls after 5 m at 1 m/s."""
    summary = summary_of(runs_of(steady(2.0, 28.0), steady(1.0, 5.0), fallen=(1,)))
    results = by_name(summary)
    assert results["distance_m"]["episodes"] == 2
    assert results["distance_m"]["value"] == pytest.approx(16.5)
    assert results["speed_mps"]["value"] == pytest.approx(1.5)
    assert (results["fall_rate"]["value"], results["fall_rate"]["count"]) == (0.5, 1)
    assert results["arrival_rate"]["count"] == 1
    assert results["time_limit_rate"]["count"] == 0
    assert results["low_at_end"]["count"] == 1
    (table,) = summary["tables"]
    paper, everyone = (column["results"] for column in table["columns"])
    assert table["at"] == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5] or table["at"] == (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)
    assert (paper[0]["episodes"], paper[-1]["episodes"], everyone[-1]["episodes"]) == (2, 1, 2)
    assert paper[-1]["value"] == pytest.approx(2.0)
    assert everyone[-1]["value"] == pytest.approx(1.5)
    assert results["top_speed_mps"]["value"] == pytest.approx(2.0)
    json.dumps(summary, allow_nan=False)


def test_results_that_nothing_supports_are_none() -> None:
    """No NaN in the document when every episode is short."""
    summary = summary_of(runs_of(steady(1.0, 0.3), fallen=(0,)))
    paper, everyone = (column["results"] for column in summary["tables"][0]["columns"])
    assert paper[0]["value"] is None
    assert everyone[1]["value"] is None
    assert by_name(summary)["top_speed_mps"]["value"] is None
    json.dumps(summary, allow_nan=False)


def test_document_describes_itself(checkpoint: Path) -> None:
    """Every result has all fields for display, and the headline names results."""
    summary = evaluate(checkpoint, EvaluationSpec(episodes=3, task="sprint2")).summary
    described = {"name", "title", "unit", "description", "digits", "better", "kind", "value", "interval", "episodes"}
    rows = summary["results"] + [r for t in summary["tables"] for column in t["columns"] for r in column["results"]]
    for result in rows:
        assert described <= result.keys()
        assert result["title"] and result["description"]
    assert set(summary["headline"]) <= set(by_name(summary))
    assert (summary["format"], summary["robot"], summary["simulator"]) == (4, "nao-0", "embedded")
    assert (summary["task"]["name"], summary["task"]["version"]) == ("sprint2", 1)
    assert summary["task"]["settings"]["min_height_m"] == 0.27


def test_evaluation_is_repeatable_and_complete(checkpoint: Path, tmp_path: Path) -> None:
    """The same seed gives the same numbers with any number of threads; another seed gives other starts."""
    spec = EvaluationSpec(episodes=12, n_envs=5, trajectories=4, task="sprint2")
    calls: list[tuple[int, int]] = []
    first = evaluate(checkpoint, spec, progress=lambda done, total: calls.append((done, total)))
    second = evaluate(checkpoint, spec, threads=2)
    assert first.to_json() == second.to_json()
    other = evaluate(checkpoint, EvaluationSpec(episodes=12, n_envs=5, task="sprint2", seed=1))
    assert by_name(other.summary)["distance_m"] != by_name(first.summary)["distance_m"]
    assert calls[-1] == (12, 12)
    assert first.summary["checkpoint"]["step"] == 512

    results, paths, *replays = first.save(tmp_path / "out")
    assert [path.name for path in replays] == ["replay.json", "replay.npz"]
    assert json.loads(results.read_text()) == first.summary
    with np.load(paths, allow_pickle=False) as saved:
        assert saved["x"].shape[0] == 4
        assert saved["x"].shape == saved["y"].shape == saved["height"].shape
        lengths = (~np.isnan(saved["x"])).sum(axis=1)
        assert saved["joint_angles"].shape == (lengths[0], 20)
        assert abs(saved["x"][0, 0] + 14.0) < 0.1


def test_trajectories_and_results_describe_the_same_episodes(checkpoint: Path) -> None:
    """Distances recomputed from the paths are those in the summary."""
    evaluation = evaluate(checkpoint, EvaluationSpec(episodes=9, n_envs=4, task="sprint2"))
    x = evaluation.trajectories.x
    assert len(x) == 9
    distances = [row[~np.isnan(row)][-1] - row[0] for row in x]
    assert evaluation.result("distance_m") == pytest.approx(np.mean(distances), abs=1e-5)


def test_episode_does_not_depend_on_its_neighbours(checkpoint: Path) -> None:
    """The first episodes of a long evaluation are those of a short one."""
    short = evaluate(checkpoint, EvaluationSpec(episodes=4, n_envs=4, task="sprint2")).trajectories
    long = evaluate(checkpoint, EvaluationSpec(episodes=8, n_envs=4, task="sprint2")).trajectories
    columns = short.x.shape[1]
    np.testing.assert_allclose(short.x[:4], long.x[:4, :columns], atol=1e-6)


SHORT = {"name": "velocity", "episode_steps": 250, "command_steps": 60}
"""Episodes of 5 s, in which the command changes several times."""


@pytest.mark.parametrize(
    ("policy", "task", "deterministic"),
    [
        ("t1-run", {**SHORT, "push_mps": 0.5, "push_steps": 5, "sensor_noise": 1.0, "extra_delay": 1}, True),
        (
            "t1-run",
            {
                **SHORT,
                "mass_variation": 0.2,
                "gain_variation": 0.2,
                "centre_of_mass_m": 0.01,
                "stiffness_min": 0.5,
                "friction_min": 0.7,
                "gravity_min": 0.9,
                "extra_delay_max": 2,
                "undisturbed_fraction": 0.5,
            },
            True,
        ),
        ("sprint", {"name": "sprint1", "sensor_noise": 1.0}, False),
        ("t1-kick-firm", {"name": "kick", "friction_min": 0.5, "mass_variation": 0.2}, True),
    ],
    ids=["pushes, noise and commands", "another robot, friction, gravity, delay", "exploration of a NAO", "a walker"],
)
def test_the_number_of_environments_changes_no_result(policy: str, task: dict[str, Any], deterministic: bool) -> None:
    """Random numbers follow from seed and episode, not from the robot that happens to run it."""

    def paths(n_envs: int, seed: int = 3) -> list[bytes]:
        spec = EvaluationSpec(
            episodes=4, n_envs=n_envs, seed=seed, trajectories=4, task=task, deterministic=deterministic
        )
        found = evaluate(naopolicies.folder(policy), spec).trajectories
        return [found.x.tobytes(), found.y.tobytes(), found.height.tobytes()]

    assert paths(4) == paths(1) == paths(3)
    assert paths(4) != paths(4, seed=4)


def test_replay_is_the_middle_one_of_the_first_episodes(checkpoint: Path) -> None:
    """Its torso follows that episode's path, from the start to the end."""
    evaluation = evaluate(checkpoint, EvaluationSpec(episodes=9, n_envs=4, task="sprint2"))
    replay, paths = evaluation.replay, evaluation.trajectories
    ends = []
    for x in paths.x[:5]:
        kept = x[~np.isnan(x)]
        ends.append((round(float(kept[-1] - kept[0]), 1), -len(kept)))
    middle = sorted(range(5), key=lambda i: ends[i])[2]
    samples = len(replay.positions)
    np.testing.assert_allclose(replay.positions[:, 0, 0], paths.x[middle, :samples], atol=1e-5)
    np.testing.assert_allclose(replay.positions[:, 0, 2], paths.height[middle, :samples], atol=1e-5)
    np.testing.assert_allclose(replay.foot_forces[:, 0], paths.left_foot_force[middle, :samples], atol=1e-3)
    assert samples == int((~np.isnan(paths.x[middle])).sum())


def test_an_evaluation_never_begins_as_its_training_did(checkpoint: Path) -> None:
    """Also with its seed, which both have if none is given."""
    training = load_policy(checkpoint)[1].spec
    spec = EvaluationSpec(episodes=16, n_envs=16, seed=training.seed, trajectories=16)
    environment = open_environment(training, 16, threads=1, seed=training.seed)
    environment.load_starts(environment.task.starts(16, training.seed, training.task.start_noise_deg))
    environment.restart(np.arange(16), np.arange(16), episodes=np.arange(16))
    first = environment.simulator.truth.torso_position[:, 2].copy()
    assert not np.isclose(evaluate(checkpoint, spec).trajectories.height[:, 0], first, atol=1e-7).any()


def test_a_task_that_has_not_grown_is_not_evaluated(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Sprint1, "growth", 0.1)
    with pytest.raises(ValueError, match=r"task sprint1: growth is 0\.1 in an evaluation; override for_evaluation"):
        evaluate(checkpoint, EvaluationSpec(episodes=2))


def test_noisy_policy_differs_from_the_deterministic(checkpoint: Path) -> None:
    """Drawn actions are drawn from the seed."""
    spec = EvaluationSpec(episodes=4, task="sprint2", deterministic=False)
    first, second = evaluate(checkpoint, spec), evaluate(checkpoint, spec)
    calm = evaluate(checkpoint, EvaluationSpec(episodes=4, task="sprint2"))
    assert first.to_json() == second.to_json()
    assert by_name(first.summary)["distance_m"] != by_name(calm.summary)["distance_m"]


def test_evaluation_can_be_stopped(checkpoint: Path) -> None:
    """The message contains the number of finished episodes."""
    with pytest.raises(InterruptedError, match="0 of 5"):
        evaluate(checkpoint, EvaluationSpec(episodes=5), stop=lambda: True)


def test_missing_checkpoint_is_named(tmp_path: Path) -> None:
    """The error is raised before anything is simulated."""
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        evaluate(tmp_path, EvaluationSpec())


def test_task_of_the_evaluation_decides_the_end(checkpoint: Path) -> None:
    """A policy trained on task one can be evaluated on task two."""
    evaluation: Any = evaluate(checkpoint, EvaluationSpec(episodes=3, task="sprint2"))
    assert by_name(evaluation.summary)["episode_length"]["high"] <= 400


EVALUATE = """
import hashlib, naopolicies, numpy
from naospec import EvaluationSpec
from naosprint import evaluate
from numpy._core._multiarray_umath import __cpu_features__
result = evaluate(naopolicies.folder("sprint"), EvaluationSpec(episodes=2, n_envs=2, bootstrap_resamples=100))
paths = result.trajectories
arrays = (paths.x, paths.y, paths.height, paths.joint_angles)
print(__cpu_features__["X86_V3"], hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest())
"""


def test_evaluation_does_not_depend_on_the_instruction_sets_of_the_libraries() -> None:
    """Each way of OpenBLAS to sum up, and NumPy with or without wide registers, gives the same bits."""
    narrow = {"NPY_DISABLE_CPU_FEATURES": " ".join(name for name in DISPATCHED if FEATURES[name])}
    variants = ({"OPENBLAS_CORETYPE": "Haswell"}, {"OPENBLAS_CORETYPE": "Prescott", **narrow})
    running = [
        subprocess.Popen(
            [sys.executable, "-c", EVALUATE], env={**os.environ, **each}, stdout=subprocess.PIPE, text=True
        )
        for each in variants
    ]
    (wide, one), (plain, other) = (process.communicate(timeout=120)[0].split() for process in running)
    assert [process.returncode for process in running] == [0, 0]
    assert one == other
    assert plain == "False", (wide, plain)


def test_an_evaluation_runs_on_the_requested_engine_and_names_it() -> None:
    """The exact one by default; results of both are the same within what rounding makes of a run."""
    found = {}
    for engine in (None, "fast"):
        spec = EvaluationSpec(episodes=2, engine=engine, trajectories=0, bootstrap_resamples=100)
        summary = evaluate(naopolicies.folder("t1-sprint"), spec).summary
        assert summary["engine"] == (engine or "mujoco") and summary["evaluation"]["engine"] == engine
        found[engine] = by_name(summary)["speed_mps"]["value"]
    assert found[None] == pytest.approx(found["fast"], abs=0.05) and found[None] != found["fast"]
    assert "engine" not in evaluate(naopolicies.folder("sprint"), EvaluationSpec(episodes=1)).summary


def test_neighbours_on_the_fast_engine_change_no_result() -> None:
    """Arms that touch the thighs in some of the robots only: a robot alone has the path that it has among others."""

    def paths(n_envs: int) -> list[bytes]:
        spec = EvaluationSpec(episodes=4, n_envs=n_envs, seed=5, trajectories=4, bootstrap_resamples=100, engine="fast")
        found = evaluate(naopolicies.folder("t1-run"), spec).trajectories
        return [found.x.tobytes(), found.joint_angles.tobytes()]

    assert paths(4) == paths(1)


@pytest.mark.parametrize("returned", ["results", "one", "pair", "nothing"])
def test_what_summarize_has_to_return_is_named(
    returned: str, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = Sprint1.summarize

    def summarize(task: Sprint1, episodes: Episodes, statistics: Statistics) -> Any:
        results, _ = usual(task, episodes, statistics)
        return {"results": results, "one": results[0], "pair": (results[0], results[1]), "nothing": None}[returned]

    monkeypatch.setattr(Sprint1, "summarize", summarize)
    with pytest.raises(ValueError, match=r"task sprint1: summarize has to return .*, as \(results, \(\)\)"):
        evaluate(checkpoint, EvaluationSpec(episodes=2))
