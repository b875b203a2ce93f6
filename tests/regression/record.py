"""Record again what the regression tests compare with: ``python tests/regression/record.py``.

This rewrites all files in ``records``. Record again only where the arithmetic, or a response of the API, deliberately
changed; the commit message states why. A test that fails for any other reason has found an error.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import runs
from comparison import write_record


def main() -> None:
    """Run everything and write all records."""
    with ThreadPoolExecutor(2) as pool:
        paper = pool.submit(runs.run, "training-paper")
        fast = pool.submit(runs.run, "training-fast")
        evaluations = pool.submit(runs.run, "evaluations")
        api = pool.submit(runs.run_script, Path(__file__).with_name("api_scenario.py"))
        results = {"fast": fast.result()["results"], "paper": paper.result()["results"]}
        write_record("policies", evaluations.result())
        write_record("trainings", {"platform": paper.result()["platform"], "results": results})
        write_record("api", api.result())


if __name__ == "__main__":
    main()
