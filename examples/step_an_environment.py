"""Step a Gymnasium environment with random actions."""

import gymnasium
import naosprint  # noqa: F401 - registers the environments

env = gymnasium.make("naosprint/Sprint1-v1", robot="nao-2")
observation, info = env.reset(seed=7)
env.action_space.seed(7)
total, steps, ended = 0.0, 0, False
while not ended:
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    total, steps, ended = total + float(reward), steps + 1, terminated or truncated
print(f"{observation.shape[0]} observations, {steps} steps until the fall, sum of rewards {total:.2f}")
env.close()
