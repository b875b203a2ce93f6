"""Draw a robot: a Gymnasium environment with render_mode rgb_array, and a PNG of its last picture."""

from pathlib import Path

import gymnasium
import naosprint  # noqa: F401 - registers the environments
import numpy as np
from PIL import Image

env = gymnasium.make("naosprint/Sprint1-v1", robot="t1", render_mode="rgb_array")
env.reset(seed=0)
for _ in range(5):
    env.step(np.zeros(env.action_space.shape, dtype=np.float32))
path = Path("t1.png")
Image.fromarray(env.render()).save(path)
print(f"{path}: {path.stat().st_size} bytes")
env.close()
