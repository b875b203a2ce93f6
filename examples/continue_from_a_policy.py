"""Train on from the weights of a bundled policy, for another robot of its family."""

from pathlib import Path

import naopolicies
from naospec import TrainingSpec
from naosprint import NullReporter, train

given = TrainingSpec.model_validate(naopolicies.spec("sprint"))
spec = TrainingSpec.model_validate(
    {
        "task": given.task.model_dump(),
        "robot": {**given.robot.model_dump(), "name": "nao-3"},
        "total_steps": 512,
        "algorithm": {**given.algorithm.model_dump(), "n_envs": 8, "n_steps": 64, "batch_size": 128, "n_epochs": 1},
    }
)
result = train(spec, workdir=Path("further"), reporter=NullReporter(), initial_policy=naopolicies.folder("sprint"))
print(f"{result.status} at step {result.steps}")
