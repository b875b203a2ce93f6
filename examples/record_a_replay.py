"""Record an episode for the dashboard's player and for films."""

from pathlib import Path

import naopolicies
from naospec import EvaluationSpec
from naosprint import evaluate

replay = evaluate(naopolicies.folder("sprint"), EvaluationSpec(episodes=1, n_envs=1, bootstrap_resamples=100)).replay
paths = replay.save(Path("."))
print(f"{replay.moved_m():.1f} m in {replay.duration_s:.1f} s; {', '.join(path.name for path in paths)}")
