"""PPO, and stable-baselines3's SAC as an outside package wraps it, conform to the interface of learners."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naospec import EvaluationSpec, TrainingSpec, plugins
from naosprint import evaluate, train
from naosprint.export import export_policy
from naosprint.rl.checkpoint import CheckpointError
from naosprint.rl.conformance import CHECKS, Check, check
from naosprint.rl.policy import load_policy

from ..checkpoints import assert_same  # noqa: TID252 - a module of these tests

PACKAGE = Path(__file__).parents[3] / "packages" / "naosprint-sac"
SMALL = {"n_envs": 4, "n_steps": 16}
PPO = {"name": "ppo", **SMALL, "batch_size": 32, "hidden_sizes": [16, 16]}
SAC = {"name": "sac", **SMALL, "units": 16, "buffer_steps": 500, "random_steps": 64, "gradient_steps": 2}


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Offer the package's algorithm as its metadata does."""
    real, entry = plugins.entry_points, EntryPoint("sac", "naosprint_sac:SAC", plugins.LEARNERS)
    monkeypatch.syspath_prepend(PACKAGE)
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: [*real(group=group), *([entry] if group == entry.group else [])]
    )
    plugins._entries.cache_clear()
    plugins._load.cache_clear()
    yield
    plugins._entries.cache_clear()
    plugins._load.cache_clear()
    sys.modules.pop("naosprint_sac", None)


def spec_of(algorithm: dict[str, Any], total_steps: int = 256, robot: str = "nao-0") -> TrainingSpec:
    runtime = {"learner_threads": 1, "simulator_threads": 1, "checkpoint_interval_steps": 128}
    return TrainingSpec.model_validate(
        {"algorithm": algorithm, "total_steps": total_steps, "robot": robot, "runtime": runtime}
    )


@pytest.mark.parametrize("algorithm", [PPO, SAC], ids=lambda algorithm: algorithm["name"])
@pytest.mark.parametrize("one", CHECKS, ids=lambda one: one.__name__)
def test_conformance(one: Check, algorithm: dict[str, Any]) -> None:
    one(spec_of(algorithm))


def test_a_learner_that_breaks_the_rules_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undeclared metrics, a policy that changes its input, a state that is not restored."""
    import naosprint_sac
    from naosprint.rl.policy import NetworkPolicy

    def careless(policy: NetworkPolicy, observations: np.ndarray, rng: Any = None) -> np.ndarray:
        observations += 1.0
        return np.zeros((len(observations), policy.n_actions))

    learner = naosprint_sac.SACLearner
    update = learner.update
    monkeypatch.setattr(learner, "update", lambda self: {**update(self), "mood": 1.0})
    monkeypatch.setattr(learner, "load_state", lambda self, state, new_episodes: None)
    monkeypatch.setattr(NetworkPolicy, "act", careless)
    failed = {result.name: result.message for result in check(spec_of(SAC)) if not result.passed}
    assert "['mood'], which are not among the kind's metrics" in failed.pop(CHECKS[0].__name__)
    assert "load_state: must restore state (differs: 0.0.exp_avg" in failed.pop("a_restored_learner_continues")
    assert "act: must not change the observations" in failed.pop("policies_act")
    assert not failed


def test_a_policy_that_takes_no_generator_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations pass one, or None."""
    from naosprint.rl.policy import NetworkPolicy

    monkeypatch.setattr(
        NetworkPolicy, "act", lambda policy, observations: np.zeros((len(observations), policy.n_actions))
    )
    (policies_act,) = (one for one in CHECKS if one.__name__ == "policies_act")
    with pytest.raises(TypeError, match="positional arguments"):
        policies_act(spec_of(PPO))


@pytest.mark.parametrize("robot", ["nao-0", "t1"])
def test_its_policies_are_evaluated_and_exported(robot: str, tmp_path: Path, recorder: Any) -> None:
    """The exported network gives the actions of the checkpoint's policy, in ONNX and in the skill."""
    import onnxruntime

    result = train(spec_of(SAC, robot=robot), workdir=tmp_path / "run", reporter=recorder)
    assert {"sac_actor_loss", "sac_critic_loss"} <= recorder.rows[-1].keys()
    assert evaluate(result.checkpoint, EvaluationSpec(episodes=2)).result("distance_m") is not None
    with pytest.raises(ValueError, match="use deterministic=true"):
        evaluate(result.checkpoint, EvaluationSpec(episodes=2, deterministic=False))
    export_policy(result.checkpoint, tmp_path / "exported")
    policy, _ = load_policy(result.checkpoint)
    names = json.loads((tmp_path / "exported" / "policy.json").read_text())["observations"]
    raw = np.random.default_rng(0).standard_normal((20, len(names)))
    session = onnxruntime.InferenceSession(tmp_path / "exported" / "policy.onnx", providers=["CPUExecutionProvider"])
    (found,) = session.run(["actions"], {"observations": raw.astype(np.float32)})
    np.testing.assert_allclose(found, policy.act(raw), atol=1e-5)


def test_its_trainings_resume_bit_for_bit_and_start_from_each_other(tmp_path: Path, recorder: Any) -> None:
    whole = train(spec_of(SAC), workdir=tmp_path / "whole", reporter=recorder)
    recorder.rows.clear()
    half = train(spec_of(SAC), workdir=tmp_path / "half", reporter=recorder, stop=lambda: len(recorder.rows) > 1)
    assert half.status == "stopped"
    rest = train(spec_of(SAC), workdir=tmp_path / "rest", reporter=recorder, resume=half.checkpoint)
    assert_same(rest.checkpoint, whole.checkpoint)
    again = train(spec_of(SAC, 64), workdir=tmp_path / "again", reporter=recorder, initial_policy=whole.checkpoint)
    assert again.status == "finished"
    with pytest.raises(CheckpointError, match="was trained by algorithm sac, this training uses ppo; set algorithm"):
        train(spec_of(PPO), workdir=tmp_path / "ppo", reporter=recorder, initial_policy=whole.checkpoint)
    with pytest.raises(CheckpointError, match="to which this algorithm cannot adapt it; use the same robot and task"):
        other = spec_of(SAC, robot="nao-4")
        train(other, workdir=tmp_path / "other", reporter=recorder, initial_policy=whole.checkpoint)
