"""Train for a moment without the service, and follow the metrics of each update."""

from pathlib import Path

from naospec import TrainingSpec
from naosprint import NullReporter, train


class Printer(NullReporter):
    """Print the reward after each update."""

    def metrics(self, row: dict[str, float]) -> None:
        """Receive the metrics of one update; those without a value yet are missing."""
        print(f"step {row['step']:,.0f}: {row['steps_per_s']:,.0f} steps/s, learning rate {row['learning_rate']:.4f}")


spec = TrainingSpec.model_validate(
    {
        "task": "sprint1",
        "total_steps": 1024,
        "algorithm": {"n_envs": 8, "n_steps": 64, "batch_size": 128, "n_epochs": 1, "hidden_sizes": [16, 16]},
    }
)
result = train(spec, workdir=Path("trained"), reporter=Printer())
print(f"{result.status} at step {result.steps}: {result.checkpoint}")
