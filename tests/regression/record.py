"""Record again what the regression tests compare with.

    python tests/regression/record.py [policies] [trainings] [api]

This rewrites the files in ``records``: those that are named, or all. Record again only where the arithmetic, or a
response of the API, deliberately changed; the commit message states why. A test that fails for any other reason has
found an error.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import runs
from comparison import write_record


def main() -> None:
    """Run the requested kinds and write their records."""
    asked = sys.argv[1:] or ["policies", "trainings", "api"]
    with ThreadPoolExecutor(2) as pool:
        if "trainings" in asked:
            found = {name: pool.submit(runs.run, f"training-{name}") for name in ("paper", "fast", "compiled")}
            results = {name: run.result()["results"] for name, run in found.items()}
            write_record("trainings", {"platform": found["paper"].result()["platform"], "results": results})
        if "policies" in asked:
            write_record("policies", runs.run("evaluations"))
        if "api" in asked:
            write_record("api", runs.run_script(Path(__file__).with_name("api_scenario.py")))


if __name__ == "__main__":
    main()
