from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

class Worlds:
    def __init__(
        self,
        *,
        functions: Mapping[str, int],
        model: int,
        joints: int,
        positions: int,
        torso: int,
        state: int,
        signature: int,
        data: NDArray[np.uint64],
        ctrl: NDArray[np.uint64],
        sensordata: NDArray[np.uint64],
        qpos: NDArray[np.uint64],
        substeps: int,
        delay: int,
        truncate: bool,
        threads: int,
    ) -> None: ...
    def step(self, targets: NDArray[np.float64], first: int, active: NDArray[np.uint8] | None) -> None: ...
    def step_unchanged(self) -> None: ...
    def step_bare(self, cycles: int) -> None: ...
    def save(self, row: int, out: NDArray[np.float64]) -> None: ...
    def load(self, row: int, from_: NDArray[np.float64], /) -> None: ...
    def warning(self, row: int) -> str: ...
    @property
    def row_size(self) -> int: ...
    def views(self) -> dict[str, NDArray[Any]]: ...
