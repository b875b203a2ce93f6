"""A task with a ball of an outside package: what it observes, a training, its own results, replay, film, export."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import EvaluationSpec, TrainingSpec
from naosprint import evaluate, train
from naosprint.analysis.film import Film
from naosprint.analysis.replay import load_replay
from naosprint.analysis.results import by_name
from naosprint.analysis.scene import Camera, robot_polygons
from naosprint.export import export_policy
from naosprint.tasks.environment import Environment, open_environment
from naosprint.tasks.observations import blocks
from pydantic import ValidationError

NAMES = ("ball_forward", "ball_left", "ball_forward_velocity", "ball_left_velocity", "ball_age")


@pytest.fixture(autouse=True)
def installed(offer: Callable[[str], None]) -> None:
    offer("naosprint-push")


def specification(**changes: Any) -> TrainingSpec:
    content = {
        "task": {"name": "push-ball", "episode_steps": 40},
        "robot": {"name": "t1", "head_pitch_rad": 0.6},
        "algorithm": {"n_envs": 16, "n_steps": 32, "batch_size": 256, "hidden_sizes": [16, 16]},
        "total_steps": 1024,
        "runtime": {"learner_threads": 1},
    }
    return TrainingSpec.model_validate(content | changes)


@contextmanager
def opened(spec: TrainingSpec, n: int = 4) -> Iterator[Environment]:
    environment = open_environment(spec, n, threads=1)
    try:
        environment.load_starts(environment.task.starts(8, 0, 2.0))
        environment.restart(np.arange(n), np.arange(n))
        yield environment
    finally:
        environment.close()


@pytest.mark.parametrize("robot", ["t1", "k1"])
def test_the_observed_ball_is_where_the_true_one_is(robot: str) -> None:
    """The robots lean and fall meanwhile, and the ball is kicked."""
    with opened(specification(robot={"name": robot, "head_pitch_rad": 0.6})) as environment:
        columns = [environment.observer.names.index(name) for name in NAMES]
        rng, errors, ages = np.random.default_rng(0), [], []
        for _ in range(30):
            observed = environment.step(rng.uniform(-0.2, 0.2, (4, environment.actuation.n_actions)))[:, columns]
            world = environment.world
            way = world.bodies["ball"].position - world.position(slice(None))
            yaw = world.yaw(slice(None))
            true = np.cos(yaw) * way[:, 0] + np.sin(yaw) * way[:, 1], np.cos(yaw) * way[:, 1] - np.sin(yaw) * way[:, 0]
            errors.append(np.abs(observed[:, :2] - np.stack(true, axis=1)).max(axis=1))
            ages.append(observed[:, 4])
        assert np.median(errors) < 0.005
        assert set(np.unique(np.round(ages, 2)).tolist()) <= {0.0, 0.02, 0.04, 0.06, 0.08, 0.1}
        assert {0.0, 0.02} <= set(np.unique(np.round(ages, 2)).tolist()), "reported in every other step"


def test_without_a_report_the_ball_is_unknown() -> None:
    """At angle 0 the head does not see a ball at the feet."""
    with opened(specification(robot="t1")) as environment:
        columns = [environment.observer.names.index(name) for name in NAMES]
        assert environment.observations[:, columns].tolist() == [[0.0, 0.0, 0.0, 0.0, 1.0]] * 4
        row = np.array([2])
        environment.world.place_ball(row, environment.world.position(row) + np.array([1.5, 0.0, -0.5]))
        environment.observer.begin(row)
        seen = environment.observations[:, columns]
        assert seen[2, 0] == pytest.approx(1.5, abs=0.05) and seen[2, 4] == 0.0
        assert (seen[[0, 1, 3], 4] == 1.0).all()


def test_the_velocity_is_that_between_two_reports() -> None:
    with opened(specification()) as environment:
        rows = np.arange(4)
        place = environment.world.position(rows).copy()
        place += [1.0, 0.0, 0.0]
        place[:, 2] = 0.11
        environment.world.place_ball(rows, place, np.tile([0.0, 0.8, 0.0], (4, 1)))
        columns = [environment.observer.names.index(name) for name in NAMES]
        for _ in range(6):
            environment.step(np.zeros((4, environment.actuation.n_actions)))
        observed = environment.observations[:, columns]
        assert observed[:, 3] == pytest.approx(environment.world.bodies["ball"].velocity[:, 1], abs=0.15)
        assert np.abs(observed[:, 2]).max() < 0.2


def test_every_episode_draws_another_place_and_a_checkpoint_continues_it() -> None:
    with opened(specification()) as environment:
        rows = np.arange(4)

        def place() -> np.ndarray:
            return environment.world.bodies["ball"].position.copy()

        first = place()
        environment.restart(rows, rows)
        assert (np.abs(place() - first).max(axis=1) > 1e-3).all()
        actions = np.full((4, environment.actuation.n_actions), 0.1)
        environment.step(actions)
        state = environment.state()
        for _ in range(10):
            environment.step(actions)
        there, ball = environment.observations.copy(), place()
        environment.load_state(state)
        for _ in range(10):
            environment.step(actions)
        assert np.array_equal(environment.observations, there) and np.array_equal(place(), ball)


def test_it_is_trained_evaluated_filmed_and_exported(tmp_path: Path, recorder: Any) -> None:
    result = train(specification(), workdir=tmp_path / "run", reporter=recorder)
    assert {"ball_m", "touch_rate", "push_fall_rate"} <= set(recorder.rows[-1])
    evaluation = evaluate(result.checkpoint, EvaluationSpec(episodes=6))
    found = by_name(evaluation.summary)
    assert found["ball_m"]["title"] == "Ball's way" and found["ball_m"]["episodes"] == 6
    evaluation.save(tmp_path / "evaluation")
    replay = load_replay(tmp_path / "evaluation" / "replay.json")
    (ball,) = replay.objects
    assert (ball.name, ball.kind, ball.size_m[0]) == ("ball", "sphere", 0.11)
    assert len(replay.shapes) == len(replay.robot.shapes) + 1 == replay.positions.shape[1]
    document = json.loads((tmp_path / "evaluation" / "replay.json").read_text())
    assert document["bodies"][-1] == {"name": "ball", "shape": "sphere", "size_m": [0.11, 0.0, 0.0], "side": "centre"}
    moved = np.ptp(replay.positions[:, -1, 0])
    assert 0.0 <= moved < 5.0 and replay.positions[0, -1, 2] == pytest.approx(0.11, abs=1e-3)
    drawn, bare = (
        robot_polygons(each, 0, Camera()) for each in (replay, type(replay)(**{**vars(replay), **without_ball(replay)}))
    )
    assert len(drawn) == len(bare) + 2, "the ball and its shadow"
    assert Film(replay).picture(0).std() > 0
    paths = export_policy(result.checkpoint, tmp_path / "export", warn=pytest.fail)
    assert {"policy.onnx", "policy.h", "check.py"} <= {path.name for path in paths}


def without_ball(replay: Any) -> dict[str, Any]:
    return {"objects": (), "positions": replay.positions[:, :-1], "rotations": replay.rotations[:, :-1]}


@pytest.mark.parametrize("simulator", ["embedded", "server"])
@pytest.mark.parametrize("robot", ["nao-0", "nao-4"])
def test_a_nao_has_no_ball(robot: str, simulator: str) -> None:
    with pytest.raises(ValidationError, match=rf"the worlds of {robot} have no ball.*\(task push-ball\)"):
        specification(robot=robot, simulator=simulator)


def test_a_ball_cannot_be_observed_without_one() -> None:
    spec = specification(task="velocity")
    with opened(spec) as environment, pytest.raises(ValueError, match="give the task a scene with a ball"):
        blocks(environment.world, ["ball"])
