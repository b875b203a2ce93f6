"""Evaluate a bundled policy: its results with their confidence intervals."""

import naopolicies
from naospec import EvaluationSpec
from naosprint import evaluate
from naosprint.analysis.results import range_text, value_text

run = evaluate(naopolicies.folder("sprint"), EvaluationSpec(episodes=8, n_envs=8, bootstrap_resamples=200), threads=2)
for result in run.summary["results"][:4]:
    print(f"{result['title']}: {value_text(result)} ({range_text(result)})")  # shares are from 0 to 1, shown in percent
