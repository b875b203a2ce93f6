"""What a training that starts from another policy knows about its observations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from naospec import TrainingSpec
from naosprint import train
from naosprint.arrays import AnyArray
from naosprint.rl.checkpoint import (
    ENVIRONMENT,
    LEARNER,
    POLICY,
    CheckpointError,
    TrainingState,
    read_arrays,
    read_file,
    read_manifest,
    save_checkpoint,
)
from naosprint.rl.networks import actor_of, critic_of
from naosprint.rl.normalization import GUESSED_SAMPLES, NO_SAMPLES, with_counts
from naosprint.rl.ppo import PPO
from naosprint.rl.rollout import TrainingEnvironment
from naosprint.rl.warm_start import adapt, widen, with_critic
from naosprint.tasks.environment import open_training_environment

from ..checkpoints import assert_same  # noqa: TID252 - a module of these tests

Make = Callable[..., TrainingSpec]

COUNTS = "observation_counts"
CRITIC_COUNTS = "critic_observation_counts"


def edited(checkpoint: Path, folder: Path, **policy: AnyArray | None) -> Path:
    """Save a checkpoint with other arrays of its policy; ``None`` leaves one out."""
    manifest = read_manifest(checkpoint)
    files = {name: read_file(checkpoint, manifest, name) for name in manifest.files}
    arrays = {name: array for name, array in {**files[POLICY], **policy}.items() if array is not None}
    fields = {name: getattr(manifest, name) for name in TrainingState.__slots__ if hasattr(manifest, name)}
    state = TrainingState(**fields, policy=arrays, learner=files[LEARNER], environment=files[ENVIRONMENT])
    return save_checkpoint(folder / checkpoint.name, manifest.spec, state)


@contextmanager
def opened(spec: TrainingSpec) -> Iterator[PPO]:
    """Open a learner whose first episodes have begun."""
    environment, n_starts = open_training_environment(spec)
    learner = PPO(spec, TrainingEnvironment.from_spec(spec, environment, n_starts))
    try:
        learner.begin()
        yield learner
    finally:
        environment.close()


def counts_of(checkpoint: Path) -> dict[str, float]:
    """Return the number of samples of each observation by its name, critic's included."""
    manifest, policy = read_manifest(checkpoint), with_counts(read_arrays(checkpoint / POLICY))
    counts = np.append(policy[COUNTS], policy.get(CRITIC_COUNTS, ()))
    return dict(zip((*manifest.observations, *manifest.critic), counts.tolist(), strict=True))


def test_what_a_policy_has_not_observed_is_soon_standardized_by_its_samples(make_spec: Make) -> None:
    """From walking to kicking: the ball, the aim and the steps before are new, and the parent has very many samples."""
    settings = {"robot": "t1", "symmetric_policy": True, "critic_observations": True, "n_envs": 16}
    walk = make_spec(task="velocity", **settings)
    kick = make_spec(task="kick", history_steps=1, handover_states=8, **settings)
    with opened(walk) as walker, opened(kick) as kicker:
        assert walker.collect()
        given = {name: array for name, array in walker.policy_state().items() if not name.endswith(COUNTS)}
        old, new = (each.environment.environment for each in (walker, kicker))
        names = old.observer.names, new.observer.names
        critics = old.observer.critic_names, new.observer.critic_names
        joints = old.actuation.names, new.actuation.names
        policy = kicker.adapt_policy(
            {**given, "observation_count": np.array([3e8])}, observations=names, actions=joints, critic=critics
        )
        kicker.load_policy_state(policy)
        kicker.begin()
        for _ in range(4):
            assert kicker.collect()
            kicker.update()
        counts, samples = kicker.normalizer.observation_moments.count, kick.algorithm.n_envs * (4 * 32 + 1)
        present = np.abs(kicker.rollout.observations.mean(axis=(0, 1)))
        known = {*names[0], *critics[0]}
        everything = (*names[1], *critics[1])
        assert {"aim_cos", "ball_left", "gravity_x_ago1"} <= set(names[1]) - known
        assert set(critics[1]) - known
        for name, count, mean in zip(everything, counts, present, strict=True):
            if name in known:
                assert count > 3e8, name
            else:
                assert count <= samples + GUESSED_SAMPLES, name
                assert mean < 1.0, name
        np.testing.assert_array_equal(counts, counts[new.observer.mirror.index])


def test_policies_keep_the_number_of_samples_of_each_observation(
    make_spec: Make, tmp_path: Path, recorder: Any
) -> None:
    """What joined one training has fewer samples in the next one, too; a file has them only if they differ."""

    def start(name: str, parent: Path | None, **settings: Any) -> Path:
        spec = make_spec(robot="t1", **settings)
        return train(spec, workdir=tmp_path / name, reporter=recorder, initial_policy=parent).checkpoint

    plain = start("plain", None)
    privileged = start("privileged", plain, critic_observations=True)
    again = start("again", privileged, critic_observations=True)
    a_training = 512 + 8
    for checkpoint, trainings in ((plain, (1, 0)), (privileged, (2, 1)), (again, (3, 2))):
        manifest, counts = read_manifest(checkpoint), counts_of(checkpoint)
        for names, number in zip((manifest.observations, manifest.critic), trainings, strict=True):
            np.testing.assert_allclose([counts[name] for name in names], number * a_training, atol=1e-3)
    written = [{name for name in read_arrays(each / POLICY) if name.endswith(COUNTS)} for each in (plain, again)]
    assert written == [set(), {CRITIC_COUNTS}]


def test_a_training_resumes_from_a_policy_with_and_without_these_numbers(
    make_spec: Make, tmp_path: Path, recorder: Any
) -> None:
    spec = make_spec(robot="t1", critic_observations=True)
    plain = train(make_spec(robot="t1"), workdir=tmp_path / "plain", reporter=recorder).checkpoint
    whole = train(spec, workdir=tmp_path / "whole", reporter=recorder, initial_policy=plain).checkpoint
    start = whole.parent / "step-000000000000"
    earlier = edited(start, tmp_path / "earlier", **{CRITIC_COUNTS: None})
    for folder in (start, earlier):
        resumed = train(spec, workdir=tmp_path / "resumed" / folder.parent.name, reporter=recorder, resume=folder)
        assert_same(resumed.checkpoint, whole)
    counts = read_arrays(whole / POLICY)[CRITIC_COUNTS]
    for name, wrong in (("shape", counts[:-1]), ("numbers", np.full_like(counts, np.nan))):
        damaged = edited(whole, tmp_path / name, **{CRITIC_COUNTS: wrong})
        for begin in ({"initial_policy": damaged}, {"resume": damaged}):
            with pytest.raises(CheckpointError, match=f"array '{CRITIC_COUNTS}'"):
                train(spec, workdir=tmp_path / "damaged", reporter=recorder, **begin)


def test_only_what_a_policy_lacks_is_guessed() -> None:
    """Joints are like the other joints, and the steps before like the latest; what nothing is known of is new."""
    names, joints = ("knee", "tilt"), ("knee",)
    layers = {f"mlp_extractor.{net}_net.0.weight": np.ones((2, 2), np.float32) for net in ("policy", "value")}
    action = {"action_net.weight": np.ones((1, 2), np.float32), "action_net.bias": np.zeros(1, np.float32)}
    given = {**layers, **action, "log_std": np.zeros(1, np.float32), "observation_count": np.array([3e8])}
    given |= {"observation_mean": np.array([1.0, 2.0]), "observation_variance": np.array([3.0, 4.0])}
    now = ("tilt", "tilt_ago1", "knee", "toe", "ball", "other")
    found = adapt(
        with_counts(given),
        observations=(names, now),
        actions=(joints, ("knee", "toe")),
        rest=np.zeros(2),
        spreads={"ball": 0.2, "tilt": 9.0},
    )
    np.testing.assert_array_equal(found["observation_mean"], [2.0, 2.0, 1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(found["observation_variance"], [4.0, 4.0, 3.0, 3.0, 0.04, 1.0])
    guessed, blank = GUESSED_SAMPLES, NO_SAMPLES
    np.testing.assert_array_equal(found[COUNTS], [3e8, guessed, 3e8, guessed, guessed, blank])
    assert not found["mlp_extractor.policy_net.0.weight"][:, [1, 3, 4, 5]].any()
    critic = with_critic(found, len(now), ((), ("height",)))
    np.testing.assert_array_equal(critic[CRITIC_COUNTS], [blank])
    # a critic that observes what the policy does leaves the rest out, also of a checkpoint without names
    for before in (("height",), ()):
        left = with_critic(critic, len(now), (before, ()))
        assert left.keys() == found.keys()
        for name in found:
            np.testing.assert_array_equal(left[name], found[name])


@pytest.mark.parametrize("symmetric", [True, False])
def test_wider_networks_compute_the_same_at_first_and_learn(make_spec: Make, symmetric: bool) -> None:
    """Also with a critic that observes more than before; afterwards what was added takes part."""
    settings = {"robot": "t1", "symmetric_policy": symmetric}
    narrow = make_spec(hidden_sizes=(6, 4), seed=1, **settings)
    wide = make_spec(hidden_sizes=(10, 8), critic_observations=True, seed=2, **settings)
    with opened(narrow) as giver, opened(wide) as taker:
        assert giver.collect()
        giver.update()
        given = giver.policy_state()
        old, new = (each.environment.environment for each in (giver, taker))
        critic, joints = (old.observer.critic_names, new.observer.critic_names), (old.actuation.names,) * 2
        taker.load_policy_state(
            taker.adapt_policy(given, observations=(old.observer.names,) * 2, actions=joints, critic=critic)
        )
        seen = np.random.default_rng(0).normal(size=(5, len(new.observer.names) + len(critic[1]))).astype(np.float32)

        def outputs(learner: PPO, seen: AnyArray) -> list[AnyArray]:
            seen = torch.from_numpy(seen[:, : learner.environment.n_observations])
            with torch.no_grad():
                return [network(seen).numpy() for network in (actor_of(learner.policy), critic_of(learner.policy))]

        for ours, theirs in zip(outputs(taker, seen), outputs(giver, seen), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)
        began = {name: array.numpy().copy() for name, array in taker.policy.state_dict().items()}
        assert taker.collect()
        taker.update()
        for name, array in taker.policy.state_dict().items():
            if name != "log_std":
                moved = array.numpy() != began[name]
                # the actor's weights of what only the critic observes stay 0
                assert moved[..., : len(new.observer.names)].all() or "bias" in name, name
        if symmetric:
            mirrored = seen.copy()
            mirrored = new.observer.mirror.apply(seen.astype(float)).astype(np.float32)
            np.testing.assert_allclose(outputs(taker, mirrored)[1], outputs(taker, seen)[1], atol=1e-5)


def test_what_is_no_narrower_network_is_left_to_the_check() -> None:
    layers = {"mlp_extractor.policy_net.0": (4, 3), "action_net": (2, 4), "mlp_extractor.value_net.0": (4, 3)}
    wider = {f"{name}.weight": np.ones(shape, np.float32) for name, shape in {**layers, "value_net": (1, 4)}.items()}
    wider |= {name.replace("weight", "bias"): np.ones(len(array), np.float32) for name, array in wider.items()}
    fitting = dict(wider)
    for name, array in wider.items():
        assert all((found == fitting[each]).all() for each, found in widen(fitting, wider).items())
        for damaged in (np.zeros((*array.shape, 1), np.float32), np.zeros((9, *array.shape[1:]), np.float32)):
            assert widen({**fitting, name: damaged}, wider)[name] is damaged
        del fitting[name]
        assert widen(fitting, wider) is fitting
        fitting[name] = array
