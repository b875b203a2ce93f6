"""Stop a training and resume it: the policy has the same bits as that of a training that never stopped."""

from pathlib import Path

from naospec import TrainingSpec
from naosprint import NullReporter, train

settings = {
    "task": "sprint1",
    "algorithm": {"n_envs": 8, "n_steps": 32, "batch_size": 64, "n_epochs": 1, "hidden_sizes": [8]},
    "runtime": {"simulator_threads": 1, "learner_threads": 1},
}
half = TrainingSpec.model_validate({**settings, "total_steps": 512})
whole = TrainingSpec.model_validate({**settings, "total_steps": 1024})
first = train(half, workdir=Path("stopped"), reporter=NullReporter())
resumed = train(whole, workdir=Path("stopped"), reporter=NullReporter(), resume=first.checkpoint)
straight = train(whole, workdir=Path("straight"), reporter=NullReporter())
same = (resumed.checkpoint / "policy.npz").read_bytes() == (straight.checkpoint / "policy.npz").read_bytes()
print(f"the same bits: {same}")
