"""Compare two policies in the same episodes: the same seed gives both the same starts."""

import naopolicies
from naospec import EvaluationSpec
from naosprint import evaluate

spec = EvaluationSpec(episodes=8, n_envs=8, seed=3, bootstrap_resamples=200)
for name in ("sprint-hour", "sprint"):
    run = evaluate(naopolicies.folder(name), spec, threads=2)
    print(f"{name}: {run.result('top_speed_mps'):.2f} m/s")
