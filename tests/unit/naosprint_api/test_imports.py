"""The API stays light."""

from __future__ import annotations

import subprocess
import sys


def test_the_api_never_imports_what_only_workers_need() -> None:
    code = (
        "import sys, naosprint_api.__main__; "
        "print([name for name in ('torch', 'gymnasium', 'matplotlib', 'mujoco', 'naosim._core', 'naosprint_worker') "
        "if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
