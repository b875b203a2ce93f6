"""Read where a bundled policy comes from: the trainings behind it with their steps and settings."""

import naopolicies

for name in naopolicies.names():
    lineage = naopolicies.card(name)["lineage"]
    steps = sum(part["steps"] for part in lineage)
    print(f"{name}: {len(lineage)} trainings, {steps / 1e6:.0f} million steps")
