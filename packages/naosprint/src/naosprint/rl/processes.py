"""The processes of one training: each has its own environments, and all have the same weights.

``torchrun`` or Slurm starts the processes; PyTorch's Gloo backend connects them. Each computes gradients on its
share of each minibatch; their mean is the gradient of all. Gloo adds numbers in a fixed order and gives every process
the same sums, so that a training with the same seed and the same number of processes has the same result, and no
weights need to be sent.
"""

from __future__ import annotations

import io
import os
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from naospec import TrainingSpec
    from torch import Tensor

    from naosprint.arrays import AnyArray, FloatArray

TIMEOUT_S = 600.0
"""Time after which a process that does not answer is lost, seconds."""

_SEED_STEP = 104_729


class ProcessLostError(RuntimeError):
    """Another process of the training has ended or does not answer."""


class Processes:
    """The processes of one training; this class itself stands for a single one.

    Attributes:
        rank: number of this process, from 0. The first one reports and writes checkpoints.
        size: number of processes.
    """

    rank = 0
    size = 1

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sum of all processes' ``values``."""
        return values

    def any(self, flag: bool) -> bool:
        """Return whether ``flag`` is true in any process."""
        return bool(self.sum(np.array([float(flag)]))[0] > 0.0)

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their means over all processes."""

    def gather(self, arrays: Mapping[str, AnyArray]) -> list[Mapping[str, AnyArray]]:
        """Return the arrays of each process, in order, in the first; nothing in the others."""
        return [arrays]

    def share(self, spec: TrainingSpec) -> TrainingSpec:
        """Return the specification of this process's environments: its share of them, with a seed of its own.

        Raises:
            ValueError: if environments or minibatch cannot be divided evenly.
        """
        if self.size == 1:
            return spec
        require_divisible(spec, self.size)
        algorithm = spec.algorithm.model_copy(update={"n_envs": spec.algorithm.n_envs // self.size})
        seed = (spec.seed + _SEED_STEP * self.rank) % 2**31
        return spec.model_copy(update={"algorithm": algorithm, "seed": seed})


def require_divisible(spec: TrainingSpec, size: int) -> None:
    """Raise ValueError if environments or minibatch cannot be divided evenly among ``size`` processes."""
    for name in ("n_envs", "batch_size"):
        value = getattr(spec.algorithm, name)
        if value % size:
            raise ValueError(f"{name}: {value} cannot be divided among {size} processes; use a multiple of it")


ALONE = Processes()
"""A training in one process."""


class ConnectedProcesses(Processes):
    """Processes that are connected by Gloo."""

    def __init__(self) -> None:
        import torch.distributed

        self._distributed = torch.distributed
        with _losses():
            self._distributed.init_process_group("gloo", timeout=timedelta(seconds=TIMEOUT_S))
        self.rank, self.size = self._distributed.get_rank(), self._distributed.get_world_size()

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sum of all processes' ``values``."""
        import torch

        total = torch.from_numpy(np.array(values, dtype=np.float64))
        with _losses():
            self._distributed.all_reduce(total)
        result: FloatArray = total.numpy()
        return result

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors by their means over all processes."""
        import torch

        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        with _losses():
            self._distributed.all_reduce(flat)
        flat /= self.size
        first = 0
        for tensor in tensors:
            tensor.copy_(flat[first : first + tensor.numel()].view_as(tensor))
            first += tensor.numel()

    def gather(self, arrays: Mapping[str, AnyArray]) -> list[Mapping[str, AnyArray]]:
        """Return the arrays of each process, in order, in the first; nothing in the others."""
        import torch

        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **arrays)
        own = torch.frombuffer(stream.getbuffer(), dtype=torch.uint8)
        lengths = self.sum(np.eye(self.size)[self.rank] * len(own)).astype(np.int64)
        padded = torch.zeros(int(lengths.max()), dtype=torch.uint8)
        padded[: len(own)] = own
        parts = [torch.empty_like(padded) for _ in lengths] if self.rank == 0 else None
        with _losses():
            self._distributed.gather(padded, parts)
        gathered: list[Mapping[str, AnyArray]] = []
        for part, length in zip(parts or (), lengths.tolist(), strict=False):
            with np.load(io.BytesIO(part.numpy()[:length].tobytes()), allow_pickle=False) as archive:
                gathered.append(dict(archive))
        return gathered


@contextmanager
def connected(spec: TrainingSpec | None = None) -> Iterator[Processes]:
    """Connect the processes that ``torchrun`` or Slurm has started, as the environment variables tell.

    Args:
        spec: what they will train, checked before any of them waits for another.

    Raises:
        ValueError: if environments or minibatch of a stage cannot be divided evenly among them.
        ProcessLostError: if they do not all appear.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield ALONE
        return
    # each finds this by itself: once one has ended, others would only report that it is gone
    for stage in spec.stage_specs if spec is not None else ():
        require_divisible(stage, size)
    processes = ConnectedProcesses()
    try:
        yield processes
    finally:
        processes._distributed.destroy_process_group()


@contextmanager
def _losses() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        raise ProcessLostError(f"another process of this training has ended or does not answer: {error}") from error
