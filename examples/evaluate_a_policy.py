"""Evaluate a bundled policy: its results with their confidence intervals."""

import naopolicies
from naospec import EvaluationSpec
from naosprint import evaluate

run = evaluate(naopolicies.folder("sprint"), EvaluationSpec(episodes=8, n_envs=8, bootstrap_resamples=200), threads=2)
for result in run.summary["results"][:4]:
    low, high = result["interval"]
    print(f"{result['title']}: {result['value']:.3f} {result['unit']} ({low:.3f} to {high:.3f})")
