"""Test the thread settings, in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys

from naosprint.threads import one_blas_thread
from threadpoolctl import threadpool_info  # type: ignore[import-untyped]


def run(code: str, **environment: str) -> str:
    """Run Python code in a fresh process without OpenMP settings and return its output."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("OMP_", "GOMP_", "KMP_"))}
    result = subprocess.run(
        [sys.executable, "-c", code], env={**clean, **environment}, capture_output=True, text=True, check=True
    )
    return result.stdout.strip()


def test_importing_the_package_does_not_load_torch() -> None:
    """So that OpenMP can be configured before PyTorch is loaded."""
    assert run("import sys, naosprint; print('torch' in sys.modules)") == "False"


def test_openmp_is_told_to_sleep_before_torch_loads() -> None:
    """The settings are in the environment, and the call returns true."""
    code = (
        "import os; from naosprint.threads import quiet_openmp; print(quiet_openmp(), "
        "os.environ['OMP_WAIT_POLICY'], os.environ['GOMP_SPINCOUNT'], os.environ['KMP_BLOCKTIME'])"
    )
    assert run(code) == "True PASSIVE 0 0"


def test_settings_of_the_environment_are_kept() -> None:
    """Settings that exist are kept."""
    code = "import os; from naosprint.threads import quiet_openmp; quiet_openmp(); print(os.environ['OMP_WAIT_POLICY'])"
    assert run(code, OMP_WAIT_POLICY="ACTIVE") == "ACTIVE"


def test_a_late_call_says_so() -> None:
    """It returns False if torch is already loaded."""
    assert run("import torch; from naosprint.threads import quiet_openmp; print(quiet_openmp())") == "False"


def test_learner_threads_are_set() -> None:
    """PyTorch uses the requested number of threads."""
    code = "from naosprint.threads import set_learner_threads as s; s(1); import torch; print(torch.get_num_threads())"
    assert run(code) == "1"


def test_numpy_multiplies_on_one_thread_while_asked_to() -> None:
    """OpenBLAS uses one thread, and afterwards the previous number."""

    def threads() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    before = threads()
    assert before, "NumPy's library is not known"
    with one_blas_thread():
        assert set(threads()) == {1}
    assert threads() == before
