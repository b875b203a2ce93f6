"""Write specifications: what is left out follows from preset, task and robot, and equal ones have the same digest."""

from naospec import TrainingSpec

spec = TrainingSpec.model_validate({"task": "sprint1", "robot": "t1", "total_steps": 5_000_000})
print(f"{spec.algorithm.n_envs} robots, {spec.planned_steps:,} steps, learning rate {spec.algorithm.learning_rate}")
for seed in (0, 1):
    other = TrainingSpec.model_validate(spec.written().with_settings({"seed": seed, "learning_rate": 3e-4}))
    print(f"seed {seed}: digest {other.digest()[:12]}, differs from the preset in {other.overrides()}")
