"""Number and wait policy of threads, and the instruction sets of the libraries that compute on them."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

_QUIET = {
    # GNU OpenMP, which PyTorch's Linux wheels contain; PASSIVE alone still spins a little.
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "0",
    # LLVM and Intel OpenMP: microseconds to spin after a parallel region.
    "KMP_BLOCKTIME": "0",
}

COMMON_KERNELS = {
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENBLAS_L2_SIZE": "256",
    "OPENBLAS_NUM_THREADS": "1",
    # the only branch of MKL that is the same on the processors of all makers
    "MKL_CBWR": "COMPATIBLE",
    "MKL_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "ONEDNN_DEFAULT_FPMATH_MODE": "STRICT",
    # the groups of NumPy 2.4 that use AVX-512
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    # NumPy warns if the processor lacks a feature to disable
    "PYTHONWARNINGS": "ignore",
}
"""Environment of a process in which libraries compute the same bits on every x86-64 processor with AVX2."""


def quiet_openmp() -> bool:
    """Make OpenMP threads sleep, rather than spin, while they wait for work.

    Between two updates the simulator needs the processors on which idle OpenMP threads would spin: on two cores that
    costs a third of the throughput. OpenMP reads its settings once, when PyTorch loads it, so call this first thing
    in a process; settings that are already in the environment are kept.

    Returns:
        Whether the settings take effect, which they do before PyTorch is imported.
    """
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    return "torch" not in sys.modules


def set_learner_threads(count: int) -> None:
    """Divide ``count`` threads between two networks: PyTorch then uses half of them inside an operation."""
    import torch

    torch.set_num_threads(max(1, count // 2))


def one_blas_thread() -> AbstractContextManager[object]:
    """Limit NumPy's matrix products to the calling thread while the returned context lasts.

    OpenBLAS shares out products as small as a policy's for a hundred robots; waiting for the other thread then costs
    up to twenty times the product, most where other work keeps the processors busy.
    """
    limits: AbstractContextManager[object] = threadpool_limits(limits=1, user_api="blas")
    return limits
