from collections.abc import Sequence

from naosprint.arrays import Float32Array, FloatArray, IntArray

class Gradients:
    def __init__(
        self,
        layers: Sequence[tuple[Float32Array, Float32Array, Float32Array, Float32Array]],
        mirrors: Sequence[tuple[IntArray, FloatArray]],
        kernel: str,
    ) -> None: ...
    @property
    def kernel(self) -> str: ...
    def split(self, observations: Float32Array, halves: Float32Array) -> None: ...
    def both(
        self,
        critic: Gradients,
        log_std: Float32Array,
        log_std_gradient: Float32Array | None,
        observations: Float32Array,
        actions: Float32Array,
        log_probs: Float32Array,
        advantages: Float32Array,
        returns: Float32Array,
        rows: IntArray,
        normalize: bool,
        clip_range: float,
        coefficient: float,
        concurrent: bool,
    ) -> tuple[float, float, float, float]: ...
    def imitation(
        self,
        critic: Gradients,
        observations: Float32Array,
        actions: Float32Array,
        returns: Float32Array,
        rows: IntArray,
        coefficient: float,
        concurrent: bool,
    ) -> tuple[float, float]: ...

def kernels() -> list[str]: ...

class Adam:
    def __init__(
        self,
        arrays: Sequence[tuple[Float32Array, Float32Array, Float32Array, Float32Array, Float32Array]],
        kernel: str = "",
    ) -> None: ...
    def clip(self, most: float) -> None: ...
    def step(self, rate: float, epsilon: float) -> None: ...

class Forward:
    def __init__(self, layers: list[tuple[Float32Array, Float32Array]], kernel: str = "") -> None: ...
    def pack(self) -> None: ...
    def run(
        self, inputs: Float32Array, outputs: Float32Array, added: Float32Array | None = None, threads: int = 0
    ) -> None: ...
