"""What environments compute, compiled; naosprint.terms and naosprint.rl.normalization document it."""

from collections.abc import Mapping, Sequence

from naosprint.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray

Nodes = Sequence[tuple[str, Sequence[int], int, Sequence[float], AnyArray | None, int]]
"""Functions of an expression, the last of which is its value; empty for none."""

class Operation:
    def __init__(self, value: Nodes, stores: Sequence[tuple[AnyArray, Nodes, Nodes]]) -> None: ...
    @property
    def width(self) -> int: ...

class Step:
    def __init__(
        self,
        measurements: Sequence[Operation],
        blocks: Sequence[tuple[Operation, int, bool, bool, int]],
        terms: Sequence[tuple[Operation, float]],
        ends: Sequence[tuple[BoolArray, BoolArray, bool]],
        arrays: Mapping[str, AnyArray],
        scale: float,
        nominal: Sequence[float],
        around_nominal: bool,
        joints: Sequence[Sequence[float]],
        width: int,
        seen: int,
    ) -> None: ...
    def act(self, first: int, actions: FloatArray | Float32Array) -> None: ...
    def step(
        self,
        first: int,
        count: int,
        lost: BoolArray | None,
        max_steps: int,
        short_steps: int,
        horizon_is_terminal: bool,
        threads: int,
    ) -> None: ...
    def begin(self, rows: IntArray) -> None: ...

class Moments:
    def __init__(
        self,
        mean: FloatArray,
        variance: FloatArray,
        count: FloatArray,
        index: IntArray | None,
        sign: FloatArray | None,
        threads: int,
    ) -> None: ...
    def merge(self, samples: FloatArray) -> None: ...
    def standardize(self, samples: FloatArray, clip: float, out: Float32Array) -> bool: ...
    def scale_rewards(
        self,
        returns: FloatArray,
        rewards: FloatArray,
        dones: BoolArray,
        gamma: float,
        clip: float,
        out: Float32Array,
    ) -> None: ...

def normal(seed: int, streams: IntArray, draws: IntArray, out: FloatArray) -> None: ...
def add_normal(
    values: FloatArray, deviations: FloatArray, where: BoolArray, seed: int, streams: IntArray, draws: IntArray
) -> None: ...
