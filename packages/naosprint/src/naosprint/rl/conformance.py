"""Checks that an algorithm conforms to :class:`naosprint.rl.learner.LearnerKind` and its learners to `Learner`.

:func:`check` runs all of them; a test suite runs them one by one::

    SPEC = TrainingSpec(algorithm={"name": "mine", "n_envs": 4, "n_steps": 16})


    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_conformance(check):
        check(SPEC)

The simulator of the specification must be embedded, and :data:`UPDATES` updates should take seconds. A check that fails
raises AssertionError with a message that describes the problem.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from naospec import TrainingSpec

from naosprint.arrays import AnyArray
from naosprint.rl.learner import Learner, LearnerKind, learner_kind
from naosprint.rl.policy import Policy
from naosprint.rl.rollout import TrainingEnvironment
from naosprint.tasks.environment import open_training_environment

UPDATES = 3
"""Updates of each training that is checked."""

_MAX_ARRAYS = 1000

Check = Callable[[TrainingSpec], None]


@dataclass(frozen=True)
class LearnerCheck:
    """Outcome of one check; the message is empty if it passed."""

    name: str
    passed: bool
    message: str = ""


def check(spec: TrainingSpec) -> list[LearnerCheck]:
    """Run all checks on trainings of this specification and return their results."""
    results = []
    for one in CHECKS:
        name = getattr(one, "__name__", str(one))
        try:
            one(spec)
        except Exception as error:  # an algorithm that raises does not conform either
            results.append(LearnerCheck(name, False, f"{type(error).__name__}: {error}"))
        else:
            results.append(LearnerCheck(name, True))
    return results


def updates_count_steps_and_report_declared_metrics(spec: TrainingSpec) -> None:
    """Check the counters, and that an update returns finite numbers by the names that the kind declares."""
    declared = {metric.name for metric in _kind(spec).metrics}
    with _opened(spec) as training:
        learner = training.learner
        _require((learner.steps, learner.updates) == (0, 0), "steps and updates: a new learner has none")
        for number in range(1, UPDATES + 1):
            _require(learner.collect() is True, "collect: must return True for a complete rollout")
            _require(learner.steps == number * spec.rollout_steps, "steps: must grow by n_envs * n_steps a rollout")
            metrics = learner.update()
            _require(learner.updates == number, "updates: must grow by 1 an update")
            unknown = sorted(metrics.keys() - declared)
            _require(not unknown, f"update: returned {unknown}, which are not among the kind's metrics")
            for name, value in metrics.items():
                _require(math.isfinite(value), f"update: {name} is {value}; leave out what has no value yet")


def states_are_plain_arrays(spec: TrainingSpec) -> None:
    """Check that checkpoints can contain both states, and that a rollout does not change what was returned before."""
    with _trained(spec) as training:
        learner = training.learner
        for method in ("policy_state", "state"):
            state: Mapping[str, AnyArray] = getattr(learner, method)()
            _require(len(state) <= _MAX_ARRAYS, f"{method}: {len(state)} arrays are more than {_MAX_ARRAYS}")
            for name, array in state.items():
                plain = isinstance(array, np.ndarray) and array.dtype.kind in "fiub"
                _require(plain, f"{method}: {name} must be an array of plain numbers")
        missing = sorted(set(learner.own_state) - learner.state().keys())
        _require(not missing, f"own_state: names {missing}, which state() does not return")
        before = {**learner.policy_state(), **learner.state()}
        kept = {name: array.copy() for name, array in before.items()}
        learner.collect()
        _require_same(before, kept, "state: a rollout must not change arrays that were returned before; copy them")


def a_restored_learner_continues(spec: TrainingSpec) -> None:
    """Check that a learner with a restored state does what the first one does, to the last bit."""
    with _trained(spec) as one, _opened(spec) as other:
        first, second = one.learner, other.learner
        second.load_policy_state(_copied(first.policy_state()))
        other.environment.load_state(one.environment.state())
        second.load_state(_copied(first.state()), new_episodes=False)
        second.steps, second.updates = first.steps, first.updates
        _require_same(second.policy_state(), first.policy_state(), "load_policy_state: must restore policy_state")
        _require_same(second.state(), first.state(), "load_state: must restore state")
        for _ in range(UPDATES):
            for learner in (first, second):
                learner.collect()
                learner.update()
        _require_same(second.policy_state(), first.policy_state(), "load_state: the restored learner differs later")


def a_stopped_rollout_is_discarded(spec: TrainingSpec) -> None:
    """Check that a rollout ends when the training is asked to stop, and changes neither policy nor counters."""
    with _trained(spec) as training:
        learner = training.learner
        before, steps, calls = _copied(learner.policy_state()), learner.steps, iter(range(1 << 30))
        _require(learner.collect(lambda: next(calls) > 0) is False, "collect: must return False once stop returns True")
        _require(learner.steps == steps, "collect: a discarded rollout must not count")
        _require_same(learner.policy_state(), before, "collect: a discarded rollout must not change the policy")


def the_same_seed_has_the_same_result(spec: TrainingSpec) -> None:
    """Check that two trainings of the same specification end with the same policy."""
    with _trained(spec) as one, _trained(spec) as other:
        first, second = one.learner, other.learner
        _require_same(first.policy_state(), second.policy_state(), "two trainings with the same seed must be the same")


def a_training_starts_from_another_policy(spec: TrainingSpec) -> None:
    """Check that a new learner takes over a policy and can train it."""
    with _trained(spec) as one, _opened(spec) as other:
        old, new = one.learner, other.learner
        new.load_policy_state(_copied(old.policy_state()))
        _require_same(new.policy_state(), old.policy_state(), "load_policy_state: must restore policy_state")
        new.collect()
        new.update()


def policies_act(spec: TrainingSpec) -> None:
    """Check that a loaded policy acts on each row of raw observations alone, with actions in [-1, 1]."""
    with _trained(spec) as training:
        learner = training.learner
        environment = training.environment
        policy = _load(spec, training, learner.policy_state())
        _require(isinstance(policy, Policy), "load_policy: must return a naosprint.rl.policy.Policy")
        observations = environment.observations.copy()
        given = observations.copy()
        actions = policy.act(given)
        shape = (environment.n, environment.n_actions)
        _require(actions.shape == shape, f"act: expected {shape}, got {actions.shape}")
        _require(bool((np.abs(actions) <= 1.0).all()), "act: actions must be in [-1, 1]")
        _require(np.array_equal(given, observations), "act: must not change the observations")
        # as evaluations call it
        _require(np.array_equal(policy.act(observations, None), actions), "act: must not draw without a generator")
        alone = np.concatenate([policy.act(observations[row : row + 1]) for row in range(environment.n)])
        _require(np.array_equal(alone, actions), "act: a row's actions must not depend on the other rows")


def damaged_policies_are_refused(spec: TrainingSpec) -> None:
    """Check that arrays that are missing, cut or not finite raise KeyError or ValueError, and nothing else."""
    with _trained(spec) as training:
        learner = training.learner
        state = learner.policy_state()
        refused = 0
        for name, array in state.items():
            rest = {other: value for other, value in state.items() if other != name}
            broken = [rest, {**rest, name: array.reshape(-1)[:-1]}]
            if array.dtype.kind == "f":
                broken.append({**rest, name: np.full_like(array, np.nan)})
            for damaged in broken:
                try:
                    _load(spec, training, damaged)
                except (KeyError, ValueError):
                    refused += 1
        _require(refused >= 3, "load_policy: must refuse arrays that are missing, of another shape, or not finite")


CHECKS: tuple[Check, ...] = (
    updates_count_steps_and_report_declared_metrics,
    states_are_plain_arrays,
    a_restored_learner_continues,
    a_stopped_rollout_is_discarded,
    the_same_seed_has_the_same_result,
    a_training_starts_from_another_policy,
    policies_act,
    damaged_policies_are_refused,
)
"""All checks."""


@dataclass(frozen=True)
class _Training:
    """A learner and its environments."""

    learner: Learner
    environment: TrainingEnvironment


def _kind(spec: TrainingSpec) -> LearnerKind:
    kind = learner_kind(spec.algorithm.name)
    return kind


@contextmanager
def _opened(spec: TrainingSpec) -> Iterator[_Training]:
    """Open a learner that has begun."""
    inner, n_starts = open_training_environment(spec)
    environment = TrainingEnvironment.from_spec(spec, inner, n_starts)
    try:
        learner = _kind(spec).open(spec, environment)
        learner.begin()
        yield _Training(learner, environment)
    finally:
        environment.close()


@contextmanager
def _trained(spec: TrainingSpec) -> Iterator[_Training]:
    """Open a learner after some updates."""
    with _opened(spec) as training:
        for _ in range(UPDATES):
            training.learner.collect()
            training.learner.update()
        yield training


def _load(spec: TrainingSpec, training: _Training, state: Mapping[str, AnyArray]) -> Policy:
    inner = training.environment.environment
    names = {"observations": inner.observer.names, "actions": inner.actuation.names}
    return _kind(spec).load_policy(state, spec.algorithm, **names)


def _copied(state: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: array.copy() for name, array in state.items()}


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def _require_same(found: Mapping[str, AnyArray], expected: Mapping[str, AnyArray], message: str) -> None:
    differing = [
        name
        for name in sorted(found.keys() | expected.keys())
        if name not in found or name not in expected or not np.array_equal(found[name], expected[name])
    ]
    _require(not differing, f"{message} (differs: {', '.join(differing[:4])})")
