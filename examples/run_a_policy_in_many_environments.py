"""Run a bundled policy with eight robots at a time, in a vector environment of Gymnasium."""

import gymnasium
import naopolicies
import naosprint  # noqa: F401 - registers the environments
from naosprint.rl.policy import load_policy

policy, manifest = load_policy(naopolicies.folder("sprint"))
spec = manifest.stage_spec
envs = gymnasium.make_vec(
    "naosprint/Sprint1-v1", num_envs=8, robot=spec.robot.model_dump(), task=spec.task.model_dump(), threads=2
)
observations, _ = envs.reset(seed=0)
for _ in range(100):
    observations, rewards, *_ = envs.step(policy.act(observations.astype(float)))
print(f"mean reward of the last of 100 steps: {rewards.mean():.3f}")
envs.close()
