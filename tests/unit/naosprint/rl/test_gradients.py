"""Gradients: the compiled kernel's are those of PyTorch in double precision."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from naosprint.mirror import Mirror
from naosprint.rl import _kernel
from naosprint.rl.gradients import Gradients, KernelGradients, Samples, TorchGradients
from naosprint.rl.symmetry import tie_weights
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor

N, OBSERVATIONS, ACTIONS = 500, 13, 6
KERNELS = pytest.mark.parametrize("kernel", _kernel.kernels())


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
    made: Callable[[ActorCriticPolicy], Gradients], policy: ActorCriticPolicy, samples: Samples, chosen: Tensor
) -> tuple[tuple[float, ...], dict[str, Tensor]]:
    gradients = made(policy)
    results = (*gradients.actor(samples, chosen), gradients.critic(samples, chosen))
    return results, {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}


def doubled(samples: Samples) -> Samples:
    return Samples(**{name: tensor.double() for name, tensor in vars(samples).items()})


@KERNELS
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
    kernel: str, layers: tuple[int, ...], count: int, changed: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("naosprint.rl.networks.FUSED", False)  # oneDNN has no doubles here
    used = settings(**changed)
    samples = drawn(new_policy(layers))
    chosen = torch.randperm(N, generator=torch.Generator().manual_seed(1))[:count]
    results, found = gradients_of(lambda p: KernelGradients(p, used, {}, kernel), new_policy(layers), samples, chosen)
    known, wanted = gradients_of(
        lambda p: TorchGradients(p, used), new_policy(layers).double(), doubled(samples), chosen
    )
    assert results == pytest.approx(known, rel=1e-5, abs=1e-6)
    clipped = known[2]
    assert count < 10 or 0.0 < clipped < 1.0, "both cases are tested"
    assert found.keys() == wanted.keys()
    for name, gradient in wanted.items():
        difference = (found[name].double() - gradient).norm() / gradient.norm().clamp_min(1e-9)
        assert difference < 1e-5, name


@KERNELS
def test_gradients_of_tied_weights_stay_mirrored(kernel: str) -> None:
    observations = Mirror(np.arange(OBSERVATIONS)[::-1].copy(), np.ones(OBSERVATIONS))
    actions = Mirror(np.arange(ACTIONS)[::-1].copy(), np.ones(ACTIONS))
    one, other = new_policy((16, 16)), new_policy((16, 16))
    projections = tie_weights(one, observations, actions)
    tie_weights(other, observations, actions)
    samples, chosen = drawn(one), torch.arange(100)
    _, found = gradients_of(lambda p: KernelGradients(p, settings(), projections, kernel), one, samples, chosen)
    _, wanted = gradients_of(lambda p: TorchGradients(p, settings()), other, samples, chosen)
    for name, gradient in wanted.items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-4, atol=1e-6)
    assert torch.equal(found["mlp_extractor.policy_net.0.bias"], found["mlp_extractor.policy_net.0.bias"].roll(8))


def test_a_spread_that_is_not_learned_gets_no_gradient() -> None:
    policy = new_policy((16,))
    policy.log_std.requires_grad_(False)
    samples = drawn(policy)
    _, found = gradients_of(lambda p: KernelGradients(p, settings(), {}), policy, samples, torch.arange(50))
    assert "log_std" not in found


def test_wrong_shapes_are_named() -> None:
    policy = new_policy((16,))
    gradients = KernelGradients(policy, settings(), {})
    samples = drawn(policy)
    with pytest.raises(ValueError, match="rows: out of range"):
        gradients.critic(samples, torch.tensor([0, N]))
    with pytest.raises(ValueError, match="observations: wrong shape"):
        gradients.critic(
            Samples(samples.observations[:, 1:].contiguous(), *list(vars(samples).values())[1:]), torch.arange(3)
        )
    with pytest.raises(ValueError, match="kernel: not supported"):
        KernelGradients(policy, settings(), {}, "mmx")
