"""A robot, a simulator and a task of another package work everywhere without special code."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from naosim.robots import Robot
from naosim.simulator import ServerLostError, Simulator, Truth
from naospec import EvaluationSpec, TaskSettings, TrainingSpec, plugins
from naospec.metrics import Result
from naosprint import evaluate, train
from naosprint.__main__ import main
from naosprint.analysis.report import write_report
from naosprint.analysis.results import by_name
from naosprint.registration import register_envs
from naosprint.rl.ppo import PPO
from naosprint.tasks import Chart, End, Metric, ObservationBlock, Presentation, RewardTerm, Task
from naosprint.tasks.robot_defaults import RobotDefaults
from pydantic import Field

from ..naosim import toy_simulator  # noqa: TID252 - a module of the tests
from .checkpoints import assert_same

PROGRESS = Metric("progress", "Progress", "m", "Distance crawled.", 2, "higher")


class CrawlSettings(TaskSettings):
    """Settings of the task."""

    goal: float = Field(default=0.5, gt=0.0, title="Goal", description="Distance that ends an episode, metres.")


class Crawl(Task):
    """Crawl forward to a goal."""

    name = "crawl"
    version = 2
    summary = "Crawl forward to a goal."
    Parameters = CrawlSettings
    metrics = (PROGRESS,)
    ends = (End("goal", "Goal"),)
    presentation = Presentation(
        charts=(Chart("Progress", ("progress",)),), listed=("progress",), headline=("progress",)
    )
    max_steps = 100

    def __init__(self, parameters: Any, world: Any, seed: int = 0) -> None:
        super().__init__(parameters, world, seed)
        self._before = np.zeros(self.n)
        self._step = np.zeros(self.n)
        self.arrays = {"before": self._before}

    def reward_terms(self) -> Sequence[RewardTerm]:
        return (RewardTerm("forward", 1.0, lambda rows: self._step[rows]),)

    def begin(self, rows: np.ndarray) -> None:
        self._before[rows] = self.world.position(rows)[:, 0]

    def advance(self, rows: slice) -> None:
        x = self.world.position(rows)[:, 0]
        self._step[rows] = x - self._before[rows]
        self._before[rows] = x

    def ended(self, rows: slice) -> Sequence[np.ndarray]:
        return (self._before[rows] >= self.parameters.goal,)

    def measure(self, rows: np.ndarray) -> np.ndarray:
        return self._before[rows][:, None].copy()

    def summarize(self, episodes: Any, statistics: Any) -> Any:
        return (statistics.mean(PROGRESS, [x[-1] - x[0] for x in episodes.x]),), ()


def crawler_defaults(robot: Robot) -> RobotDefaults:
    """Return what tasks use of the crawler."""
    del robot
    return RobotDefaults(("joint_angles", "height"), 0.1, 0.2)


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Offer robot, simulator and task as an installed package would."""
    extra = [
        EntryPoint("crawler", f"{toy_simulator.__name__}:CRAWLER", plugins.ROBOTS),
        EntryPoint("crawling", f"{toy_simulator.__name__}:CRAWLING", plugins.SIMULATORS),
        EntryPoint("crawl", f"{__name__}:Crawl", plugins.TASKS),
        EntryPoint("crawler", f"{__name__}:crawler_defaults", plugins.ROBOT_DEFAULTS),
    ]
    real = plugins.entry_points
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: [*real(group=group), *(e for e in extra if e.group == group)]
    )
    plugins._entries.cache_clear()
    plugins._load.cache_clear()
    yield
    plugins._entries.cache_clear()
    plugins._load.cache_clear()


def crawl_spec(total_steps: int = 32_768) -> TrainingSpec:
    """Return a training of crawlers."""
    settings = {"n_envs": 16, "n_steps": 64, "batch_size": 256, "hidden_sizes": [16, 16], "gamma": 0.95}
    return TrainingSpec.model_validate(
        {
            "task": "crawl",
            "robot": "crawler",
            "simulator": "crawling",
            "algorithm": settings,
            "total_steps": total_steps,
            "runtime": {"learner_threads": 1},
        }
    )


def test_crawlers_learn_to_crawl(tmp_path: Path, recorder: Any) -> None:
    """Training until the goal, evaluation and report with the task's own metrics."""
    spec = crawl_spec()
    assert (spec.task.version, spec.task.goal) == (2, 0.5)
    result = train(spec, workdir=tmp_path / "run", reporter=recorder)
    first, last = recorder.rows[1]["progress"], recorder.rows[-1]["progress"]
    assert last > first + 0.2
    assert "progress 0." in recorder.lines[-2][1]

    evaluation = evaluate(result.checkpoint, EvaluationSpec(episodes=8))
    progress = by_name(evaluation.summary)["progress"]
    assert (progress["title"], progress["episodes"]) == ("Progress", 8)
    assert progress["value"] > 0.3
    evaluation.save(tmp_path / "evaluation")
    metrics = tmp_path / "metrics.jsonl"
    metrics.write_text("".join(json.dumps(row) + "\n" for row in recorder.rows))
    page = write_report(tmp_path / "page", evaluation=tmp_path / "evaluation", metrics=metrics, film=False).read_text()
    assert "<title>crawl</title>" in page
    assert "Distance crawled" in page or f"{progress['value']:.2f} m" in page
    # no feet, so no gait
    plots = {path.stem for path in (tmp_path / "page").glob("*.svg")}
    assert plots == {"learning-curve", "trajectories", "frames", "joints"}


def assert_resumes(folder: Path, recorder: Any, *, total_steps: int, rows: int) -> None:
    """Check that a training that stops after so many rows of metrics ends as one that does not."""
    spec = crawl_spec(total_steps=total_steps)
    whole = train(spec, workdir=folder / "whole", reporter=recorder)
    recorder.rows.clear()
    half = train(spec, workdir=folder / "half", reporter=recorder, stop=lambda: len(recorder.rows) >= rows)
    rest = train(spec, workdir=folder / "rest", reporter=recorder, resume=half.checkpoint)
    assert half.status == "stopped"
    assert_same(rest.checkpoint, whole.checkpoint)


def test_resuming_continues_bit_for_bit(tmp_path: Path, recorder: Any) -> None:
    """A simulator with snapshots needs nothing else."""
    assert_resumes(tmp_path, recorder, total_steps=4096, rows=2)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("progress", "depth"), "task crawl: summarize returned depth; declare each in the task's metrics or results"),
        (("progress", "progress"), "task crawl: summarize returned progress more than once"),
    ],
)
def test_results_that_a_task_does_not_declare_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Any, names: tuple[str, ...], words: str
) -> None:
    result = train(crawl_spec(total_steps=1024), workdir=tmp_path, reporter=recorder)
    returned = tuple(Result(Metric(name, "A number"), 1.0) for name in names)
    monkeypatch.setattr(Crawl, "summarize", lambda self, episodes, statistics: (returned, ()))
    with pytest.raises(ValueError, match=words):
        evaluate(result.checkpoint, EvaluationSpec(episodes=2))


@pytest.mark.parametrize("value", [np.nan, -np.inf], ids=str)
def test_a_number_that_is_not_finite_is_named_once_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], value: float
) -> None:
    """A metric of the task, one of the learner, and a result: training, evaluation and report are whole."""
    monkeypatch.setattr(Crawl, "measure", lambda self, rows: np.full((len(rows), 1), value))
    summary = (Result(PROGRESS, np.float32(value), sd=np.nan, interval=(0.0, value), high=np.float32(2.0), episodes=2),)
    monkeypatch.setattr(Crawl, "summarize", lambda self, episodes, statistics: (summary, ()))
    update = PPO.update
    monkeypatch.setattr(PPO, "update", lambda self: {**update(self), "kl": value, "rate": np.float32(0.5)})
    words = "--task crawl --robot crawler --simulator crawling --total-steps 4096 --n-envs 16 --n-steps 64"
    run, result, page = tmp_path / "run", tmp_path / "evaluation", tmp_path / "page"
    assert main(["train", str(run), *words.split(), "--batch-size", "256"]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert told.count(f"metric progress is {value} at 2,048 steps: such values are left out") == 1
    assert told.count("metric kl is") == told.count("metric progress is") == 1
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1024, 2048, 3072, 4096]
    assert all("progress" not in row and "kl" not in row and row["rate"] == 0.5 for row in rows)

    assert main(["evaluate", str(run / "step-000000004096"), "--episodes", "2", "--output", str(result)]) == 0
    assert f"result progress is {value}: stored without a value" in capsys.readouterr().err
    stored = by_name(json.loads((result / "evaluation.json").read_text()))["progress"]
    assert (stored["value"], stored["sd"], stored["interval"], stored["high"]) == (None, None, None, 2.0)
    assert main(["report", str(result), str(page), "--metrics", str(run / "metrics.jsonl"), "--no-film"]) == 0


def test_what_a_task_keeps_and_measures_may_be_nan_where_a_training_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Any
) -> None:
    """Such as the place of a ball that was never seen: in an array of the task, one of a block, and a metric."""

    class Unseen(Crawl):
        def __init__(self, parameters: Any, world: Any, seed: int = 0) -> None:
            super().__init__(parameters, world, seed)
            self.arrays["ball"] = np.full((self.n, 2), np.nan)

        def observation_blocks(self) -> Sequence[ObservationBlock]:
            seen = np.full(self.n, np.nan)
            block = ObservationBlock(("seen",), lambda rows: np.isnan(seen[rows])[:, None], arrays={"seen": seen})
            return [*super().observation_blocks(), block]

        def measure(self, rows: np.ndarray) -> np.ndarray:
            return np.full((len(rows), 1), np.nan)

    monkeypatch.setattr(sys.modules[__name__], "Crawl", Unseen)
    assert_resumes(tmp_path, recorder, total_steps=8192, rows=5)


def test_an_episode_that_diverges_in_every_run_ends_the_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, recorder: Any
) -> None:
    result = train(crawl_spec(total_steps=1024), workdir=tmp_path, reporter=recorder)

    class Diverging(toy_simulator.CrawlerSimulator):
        @property
        def lost(self) -> np.ndarray:
            return np.arange(self.n) == 1

        def loss_reason(self, row: int) -> str:
            return "the physics diverged"

    monkeypatch.setattr(toy_simulator, "CrawlerSimulator", Diverging)
    words = "episode 1 lost its robot 21 times, lastly because the physics diverged"
    with pytest.raises(ServerLostError, match=words):
        evaluate(result.checkpoint, EvaluationSpec(episodes=2))
    again = "episode 1 is run again, its robot was lost: the physics diverged"
    assert [record.getMessage() for record in caplog.records] == [again] * 20


def test_a_trace_of_another_width_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Any) -> None:
    result = train(crawl_spec(total_steps=1024), workdir=tmp_path, reporter=recorder)
    monkeypatch.setattr(Crawl, "trace", ("ball_x", "ball_y"))
    with pytest.raises(ValueError, match=r"task crawl: trace_row, for ball_x, ball_y, returned .* \(2, 0\); \(2, 2\)"):
        evaluate(result.checkpoint, EvaluationSpec(episodes=2))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"groups": (slice(0, 4),)},
            r"groups: expected each of 16 robots in one, in order, got \(slice\(0, 4, None\),\)",
        ),
        ({"groups": ()}, r"groups: expected each of 16 robots in one, in order, got \(\)"),
        ({"perceptors": {}}, r"perceptors\['joint_angles'\]: expected an array of .* of shape \(16, 2\), got nothing"),
        (
            {"perceptors": {"joint_angles": np.zeros((1, 2))}},
            r"perceptors\['joint_angles'\]: .* got float64 of shape \(1, 2\)",
        ),
        ({"perceptors": {"joint_angles": [[0.0, 0.0]] * 16}}, r"perceptors\['joint_angles'\]: .* \(16, 2\), got list"),
        (
            {"truth": Truth(np.zeros((16, 3)), np.zeros((16, 9)))},
            r"truth.torso_rotation: .* \(16, 3, 3\), got float64 of",
        ),
        ({"n": 15}, "simulator crawling: open returned Changed of 15 robots; a Simulator of 16 is needed"),
    ],
)
def test_what_a_simulator_lacks_is_named_before_a_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Any, change: dict[str, Any], words: str
) -> None:
    """Robots of no group would stand still, and what they are not rewarded for would be learned."""

    class Changed(toy_simulator.CrawlerSimulator):
        def __init__(self, robot: Robot, n: int) -> None:
            super().__init__(robot, n)
            vars(self).update(change)

    monkeypatch.setattr(toy_simulator, "CrawlerSimulator", Changed)
    with pytest.raises(ValueError, match=words):
        train(crawl_spec(total_steps=1024), workdir=tmp_path, reporter=recorder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lost": [False] * 16}, r"Changed: lost: expected an array of flags \(bool\) of shape \(16,\), got list"),
        ({"lost": np.zeros(16)}, r"Changed: lost: .* got float64 of shape \(16,\)"),
        (
            {"foot_forces": lambda self: np.zeros(16)},
            r"Changed: foot_forces\(\): .* \(16, 2\), got float64 of shape \(16,\)",
        ),
        ({"bodies": lambda self: np.zeros((16, 2, 7))}, r"Changed: bodies\(\): .* \(16, 1, 7\), got float64 of shape"),
        ({"bodies": Simulator.bodies}, r"Changed: bodies\(\): missing, but there are shapes to draw; write it, or"),
        ({"counters": ["falls"]}, "Changed: counters: expected a mapping of names to numbers, got list"),
        (
            {"counters": {"falls": "many"}},
            "Changed: counters: expected a whole number by a name, got 'many' by 'falls'",
        ),
    ],
)
def test_what_a_simulator_reports_is_checked_before_a_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Any, change: dict[str, Any], words: str
) -> None:
    """Some of it only evaluations and films use, after a long training."""
    changed = type("Changed", (toy_simulator.CrawlerSimulator,), change)
    monkeypatch.setattr(toy_simulator, "CrawlerSimulator", changed)
    with pytest.raises(ValueError, match=words):
        train(crawl_spec(total_steps=1024), workdir=tmp_path, reporter=recorder)
    assert not recorder.rows


@pytest.mark.parametrize("method", ["starts", "place", "begin", "advance"])
def test_an_array_that_a_task_adds_late_is_named_before_a_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Any, method: str
) -> None:
    """Evaluations reset to their first values the arrays that there are at the beginning."""
    usual = getattr(Crawl, method)
    late = {method: lambda self, *given: self.arrays.update(late=np.zeros(self.n)) or usual(self, *given)}
    monkeypatch.setattr(sys.modules[__name__], "Crawl", type("Late", (Crawl,), late))
    with pytest.raises(ValueError, match="task crawl: arrays: 'late' was added after __init__; make it there"):
        train(crawl_spec(total_steps=1024), workdir=tmp_path, reporter=recorder)


def test_arrays_of_a_task_without_names_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Any
) -> None:
    class Listed(Crawl):
        def __init__(self, parameters: Any, world: Any, seed: int = 0) -> None:
            super().__init__(parameters, world, seed)
            self.arrays = [self._before]  # type: ignore[assignment]

    monkeypatch.setattr(sys.modules[__name__], "Crawl", Listed)
    with pytest.raises(ValueError, match="task crawl: arrays is list; a dict of arrays is needed"):
        train(crawl_spec(total_steps=1024), workdir=tmp_path, reporter=recorder)


def test_the_command_line_offers_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "--goal VALUE Distance that ends an episode, metres." in text and "(task crawl) (default: 0.5)" in text
    assert "crawler" in text


def test_gymnasium_offers_it() -> None:
    register_envs()
    try:
        env = gymnasium.make("naosprint/Crawl-v2", robot="crawler", simulator="crawling", goal=0.02)
        env.reset(seed=0)
        env.action_space.seed(0)
        info: dict[str, Any] = {}
        while not info:
            *_, info = env.step(env.action_space.sample())
        assert info["progress"] >= 0.02 or info["end"] == "time_limit"
    finally:
        gymnasium.registry.pop("naosprint/Crawl-v2", None)
