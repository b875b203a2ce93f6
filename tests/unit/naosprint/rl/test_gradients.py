"""Gradients: the compiled kernel's are those of PyTorch in double precision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from naosprint.mirror import Mirror
from naosprint.rl import _kernel
from naosprint.rl.gradients import KernelGradients, Samples
from naosprint.rl.ppo import Losses
from naosprint.rl.symmetry import Symmetry, tie_weights
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor

N, OBSERVATIONS, ACTIONS = 500, 13, 6
KERNELS = pytest.mark.parametrize("kernel", _kernel.kernels())
LOSSES = pytest.mark.parametrize("losses", ["both", "imitation"])


def settings(**changed: object) -> SimpleNamespace:
    usual = {
        "advantage_normalization": "minibatch",
        "clip_range": 0.2,
        "entropy_coefficient": 0.0,
        "value_coefficient": 0.5,
    }
    return SimpleNamespace(**{**usual, **changed})


def new_policy(layers: tuple[int, ...]) -> ActorCriticPolicy:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return ActorCriticPolicy(
            spaces.Box(-np.inf, np.inf, (OBSERVATIONS,), np.float32),
            spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32),
            lambda _: 1e-3,
            net_arch=list(layers),
            activation_fn=torch.nn.Tanh,
            log_std_init=-1.0,
        )


def drawn(policy: ActorCriticPolicy) -> Samples:
    """Return samples of a slightly different policy, so that some ratios are clipped."""
    generator = torch.Generator().manual_seed(5)
    observations = torch.randn((N, OBSERVATIONS), generator=generator)
    with torch.no_grad():
        mean = policy.action_net(policy.mlp_extractor.policy_net(observations))
        noise = torch.randn((N, ACTIONS), generator=generator)
        log_probs = -0.5 * noise.square().sum(dim=1) - policy.log_std.sum() - ACTIONS * 0.5 * np.log(2.0 * np.pi)
        actions = mean + 0.1 * torch.randn((N, ACTIONS), generator=generator) + policy.log_std.exp() * noise
    advantages, returns = torch.randn((2, N), generator=generator)
    advantages[:7] = 0.0
    return Samples(observations, actions, log_probs.float(), advantages, returns)


def gradients_of(
    made: Callable[[ActorCriticPolicy], KernelGradients | Losses],
    policy: ActorCriticPolicy,
    samples: Samples,
    chosen: Tensor,
    losses: str = "both",
) -> tuple[tuple[float, ...], dict[str, Tensor]]:
    gradients = made(policy)
    samples = gradients.prepare(samples)
    results = getattr(gradients, losses)(samples, chosen)
    return results, {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}


def doubled(samples: Samples) -> Samples:
    return Samples(**{name: tensor.double() for name, tensor in vars(samples).items()})


@KERNELS
@LOSSES
@pytest.mark.parametrize(
    ("layers", "count", "changed"),
    [
        ((128, 128), 256, {}),
        ((64, 64), 70, {"advantage_normalization": "rollout", "clip_range": 0.05}),
        ((48, 10, 20), 333, {"entropy_coefficient": 0.02, "value_coefficient": 1.0}),
        ((7,), 2, {}),
    ],
)
def test_kernels_compute_the_gradients_of_double_precision(
    kernel: str, losses: str, layers: tuple[int, ...], count: int, changed: dict[str, object]
) -> None:
    used = settings(**changed)
    samples = drawn(new_policy(layers))
    chosen = torch.randperm(N, generator=torch.Generator().manual_seed(1))[:count]
    one, other = new_policy(layers), new_policy(layers).double()
    results, found = gradients_of(lambda p: KernelGradients(p, used, None, kernel), one, samples, chosen, losses)
    known, wanted = gradients_of(lambda p: Losses(p, used), other, doubled(samples), chosen, losses)
    assert results == pytest.approx(known, rel=1e-5, abs=1e-6)
    if losses == "both":
        clipped = known[3]
        assert count < 10 or 0.0 < clipped < 1.0, "both cases are tested"
    assert found.keys() == wanted.keys()
    for name, gradient in wanted.items():
        difference = (found[name].double() - gradient).norm() / gradient.norm().clamp_min(1e-9)
        assert difference < 1e-5, name


def mirror(width: int, singles: tuple[float, ...]) -> Mirror:
    """Return a mirror with the signs of single numbers at the end; the pairs before them have both signs."""
    pairs = width - len(singles)
    index, sign = np.arange(width), np.ones(width)
    index[:pairs] = index[:pairs][::-1]
    sign[pairs:] = singles
    sign[0] = sign[pairs - 1] = -1.0
    return Mirror(index, sign)


@KERNELS
@LOSSES
@pytest.mark.parametrize("layers", [(128, 128), (40, 6), (16,)])
@pytest.mark.parametrize(
    ("observations", "actions"),
    [
        (mirror(OBSERVATIONS, (1.0,)), mirror(ACTIONS, ())),
        (mirror(OBSERVATIONS, (1.0, -1.0, -1.0)), mirror(ACTIONS, (-1.0, 1.0))),
        (mirror(OBSERVATIONS, (1.0, 1.0, 1.0, -1.0, -1.0)), mirror(ACTIONS, (-1.0, -1.0))),
    ],
    ids=["pairs", "singles", "turned"],
)
def test_gradients_of_symmetric_networks_are_those_of_double_precision(
    kernel: str, losses: str, layers: tuple[int, ...], observations: Mirror, actions: Mirror
) -> None:
    one = new_policy(layers)
    symmetry = tie_weights(one, observations, actions)
    with torch.no_grad():
        one.log_std += torch.linspace(-0.2, 0.3, ACTIONS)[
            torch.from_numpy(np.minimum(actions.index, np.arange(ACTIONS)))
        ]
    other = new_policy(layers).double()
    tie_weights(other, observations, actions)
    other.load_state_dict({name: tensor.double() for name, tensor in one.state_dict().items()})
    samples, chosen = drawn(one), torch.randperm(N, generator=torch.Generator().manual_seed(1))[:200]
    results, found = gradients_of(
        lambda p: KernelGradients(p, settings(), symmetry, kernel), one, samples, chosen, losses
    )
    known, wanted = gradients_of(lambda p: Losses(p, settings()), other, doubled(samples), chosen, losses)
    assert results == pytest.approx(known, rel=1e-5, abs=1e-6)
    assert found.keys() == wanted.keys()
    for name, gradient in wanted.items():
        difference = (found[name].double() - gradient).norm() / gradient.norm().clamp_min(1e-9)
        assert difference < 1e-5, name


@KERNELS
def test_gradients_of_symmetric_networks_are_mirrored_bit_for_bit(kernel: str) -> None:
    observations, actions = mirror(OBSERVATIONS, (1.0, -1.0, -1.0)), mirror(ACTIONS, (-1.0, 1.0))
    policy = new_policy((16, 16))
    symmetry = tie_weights(policy, observations, actions)
    _, found = gradients_of(
        lambda p: KernelGradients(p, settings(), symmetry, kernel), policy, drawn(policy), torch.arange(100)
    )
    for body, mirrors in (("policy", symmetry.actor), ("value", symmetry.critic)):
        for layer, (columns, rows) in enumerate(pairwise(mirrors[:-1])):
            gradient = found[f"mlp_extractor.{body}_net.{2 * layer}.weight"].numpy()
            assert np.array_equal(gradient, columns.apply(rows.apply(gradient.T).T))
    assert np.array_equal(
        found["action_net.weight"].numpy(),
        symmetry.actor[-2].apply(actions.apply(found["action_net.weight"].numpy().T).T),
    )
    assert np.array_equal(found["action_net.bias"].numpy(), actions.apply(found["action_net.bias"].numpy()))


@pytest.mark.parametrize(
    ("mirrors", "message"),
    [
        ((Mirror.of_pairs(12), Mirror.of_pairs(16), Mirror.of_pairs(6)), "widths do not match"),
        ((mirror(OBSERVATIONS, (1.0,)), Mirror.of_pairs(6)), "one of the inputs and one of each layer's outputs"),
        ((mirror(OBSERVATIONS, (1.0,)), mirror(16, (1.0, 1.0)), Mirror.of_pairs(6)), "hidden layers have pairs"),
        ((mirror(OBSERVATIONS, (1.0,)), Mirror.of_pairs(16), Mirror(np.roll(np.arange(6), 1), np.ones(6))), "exchange"),
    ],
)
def test_wrong_mirrors_are_named(mirrors: tuple[Mirror, ...], message: str) -> None:
    with pytest.raises(ValueError, match=f"mirrors: .*{message}"):
        KernelGradients(new_policy((16,)), settings(), Symmetry(mirrors, mirrors))


def test_a_spread_that_is_not_learned_gets_no_gradient() -> None:
    policy = new_policy((16,))
    policy.log_std.requires_grad_(False)
    samples = drawn(policy)
    _, found = gradients_of(lambda p: KernelGradients(p, settings()), policy, samples, torch.arange(50))
    assert "log_std" not in found


def test_imitation_leaves_the_spread_alone() -> None:
    """Also after an update that has learned it."""
    policy = new_policy((16,))
    gradients, samples = KernelGradients(policy, settings()), drawn(policy)
    gradients.both(samples, torch.arange(50))
    assert policy.log_std.grad is not None
    gradients.imitation(samples, torch.arange(50))
    assert policy.log_std.grad is None


def test_wrong_shapes_are_named() -> None:
    policy = new_policy((16,))
    gradients = KernelGradients(policy, settings())
    samples = drawn(policy)
    with pytest.raises(ValueError, match="rows: out of range"):
        gradients.both(samples, torch.tensor([0, N]))
    with pytest.raises(ValueError, match="observations: wrong shape"):
        gradients.both(
            Samples(samples.observations[:, 1:].contiguous(), *list(vars(samples).values())[1:]), torch.arange(3)
        )
    with pytest.raises(ValueError, match="actions, returns: wrong shape"):
        gradients.imitation(replace(samples, actions=samples.actions[:, 1:].contiguous()), torch.arange(3))
    with pytest.raises(ValueError, match="kernel: not supported"):
        KernelGradients(policy, settings(), None, "mmx")
