"""Export a policy as a skill for a team's code: Python files that need nothing but NumPy."""

from pathlib import Path

import naopolicies
from naosprint.export import export_policy

paths = export_policy(naopolicies.folder("t1-sprint"), Path("skill"), ["numpy", "skill"], name="sprint")
print(", ".join(sorted(path.name for path in paths)))
