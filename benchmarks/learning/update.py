"""Measure PPO's update against its matrix products alone; write update.json beside this file.

    python benchmarks/learning/update.py [--rounds 3]

Preset fast, actor and critic on a core each, in turn within each round:

- ``kernel``: the whole update by the compiled kernel, Adam and clipping included;
- ``torch``: the same by PyTorch;
- ``products``: the matrix products of forward and backward pass of both networks and nothing else, each by the faster
  one of oneDNN and MKL.

Compare the ratios only. The machine must be idle.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naospec.json_text import json_text
from naosprint.programs import integer, run_program
from naosprint.threads import quiet_openmp, set_learner_threads

quiet_openmp()

import numpy as np  # noqa: E402
import torch  # noqa: E402
from naospec import TrainingSpec  # noqa: E402
from naosprint.rl.networks import actor_of, critic_of, linear_layers  # noqa: E402
from naosprint.rl.ppo import PPO  # noqa: E402
from naosprint.rl.rollout import TrainingEnvironment  # noqa: E402
from naosprint.tasks.environment import open_training_environment  # noqa: E402
from run import machine, spec_of  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

RECORD = Path(__file__).with_suffix(".json")
MEASURE_S = 8.0
SETTINGS: dict[str, Any] = {"simulator_threads": 2, "learner_threads": 2}


def opened(spec: TrainingSpec) -> PPO:
    """Return a learner with a rollout."""
    environment, n_starts = open_training_environment(spec)
    ppo = PPO(spec, TrainingEnvironment.from_spec(spec, environment, n_starts))
    ppo.begin()
    ppo.collect()
    return ppo


def update(ppo: PPO) -> None:
    """Update without changing anything, so that the divergence ends no update early."""
    ppo.rate_factor = 0.0
    ppo.update()


def rate(work: Callable[[], object], samples: int) -> float:
    """Return samples a second of repeated work."""
    work()
    began, done = time.perf_counter(), 0
    while time.perf_counter() - began < MEASURE_S:
        work()
        done += samples
    return done / (time.perf_counter() - began)


def faster(ways: Sequence[Callable[[], object]]) -> Callable[[], object]:
    """Return the way that takes less time, measured alone."""

    def seconds(way: Callable[[], object]) -> float:
        times = []
        for _ in range(30):
            began = time.perf_counter()
            way()
            times.append(time.perf_counter() - began)
        return min(times)

    return min(ways, key=seconds)


def products(layers: Sequence[torch.nn.Linear], rows: int) -> list[Callable[[], object]]:
    """Return the products of one network's forward and backward pass for a minibatch."""

    def both(left: torch.Tensor, right: torch.Tensor) -> Callable[[], object]:
        # right is (out, in): left times its transpose
        one_dnn = partial(torch.ops.mkldnn._linear_pointwise, left, right, None, "none", [], "")
        return faster([one_dnn, partial(torch.matmul, left, right.t())])

    found = []
    for number, layer in enumerate(layers):
        inputs, errors = torch.randn(rows, layer.in_features), torch.randn(rows, layer.out_features)
        weight = layer.weight.detach()
        found += [both(inputs, weight), both(errors.t(), inputs.t())]
        if number:
            found.append(both(errors, weight.t()))
    return found


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=integer(), default=3)
    parser.add_argument("--json", type=Path, default=RECORD, help="file for the results")
    options = parser.parse_args()
    compiled = opened(spec_of(**SETTINGS))
    plain = opened(spec_of(**SETTINGS, compiled_update=False))
    spec = compiled.spec
    samples, batch = spec.rollout_steps, compiled.settings.batch_size
    passes = compiled.settings.n_epochs * samples // batch
    policy = compiled.policy
    set_learner_threads(1)
    networks = [products(linear_layers(network(policy)), batch) for network in (actor_of, critic_of)]
    with ThreadPoolExecutor(2, initializer=lambda: torch.set_num_threads(1)) as cores:

        def multiply(network: list[Callable[[], object]]) -> None:
            for _ in range(passes):
                for product in network:
                    product()

        rounds = []
        for number in range(options.rounds):
            set_learner_threads(2)
            found = {"kernel": rate(partial(update, compiled), samples), "torch": rate(partial(update, plain), samples)}
            set_learner_threads(1)
            found["products"] = rate(lambda: list(cores.map(multiply, networks)), samples)
            rounds.append(found)
            shown = ", ".join(f"{name} {value:,.0f} samples/s" for name, value in found.items())
            print(f"round {number + 1}: {shown}; kernel / products {found['kernel'] / found['products']:.2f}")
    for ppo in (compiled, plain):
        ppo.environment.close()
    ratios = {
        name: round(float(np.mean([found["kernel"] / found[name] for found in rounds])), 2)
        for name in ("products", "torch")
    }
    options.json.write_text(json_text({**machine(), "kernel_over": ratios, "rounds": rounds}), encoding="utf-8")
    print(f"kernel over: {ratios}")


if __name__ == "__main__":
    run_program(main)
