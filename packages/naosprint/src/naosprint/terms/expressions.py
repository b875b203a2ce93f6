"""Numbers of each robot as data: expressions of what simulators report and tasks store.

An observation, measurement or reward term is written once, as an expression::

    moved = perceptor("torso_pos") - before
    speed = hypot(moved[0], moved[1]) / STEP_S

Three interpreters read it: NumPy here, which is the reference; C++ (packages/naosprint/cpp/operations.cpp), with the
same bits; and exported skills (naosprint/export/skills/terms.py), from its description as JSON. Functions have the
names of NumPy's where it has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, TypeAlias, Union

import numpy as np

from naosprint.terms import randomness

if TYPE_CHECKING:
    from naosprint.arrays import AnyArray, FloatArray, IntArray

Operand: TypeAlias = Union["Number", float, Sequence[float]]
"""What functions take: numbers of each robot, or the same ones for all."""

_Operation: TypeAlias = "Callable[[slice | IntArray, Sequence[FloatArray]], FloatArray]"


@dataclass(frozen=True, eq=False)
class Number:
    """Some numbers of each robot: a function of others. ``number(rows)`` computes them with NumPy.

    Attributes:
        function: name in :data:`FUNCTIONS`, or ``source``, ``constant``, ``given``.
        arguments: what the function is applied to.
        width: how many numbers.
        constants: values of a constant, columns of a source, seed of random numbers.
        read: returns the (n, ...) array of a source; see :attr:`array`.
        label: name of a source, or of what is given to a skill instead.
        address: address of a function of another module, for C++.
        compute: NumPy's form of a function of another module.
    """

    function: str
    arguments: tuple[Number, ...] = ()
    width: int = 1
    constants: tuple[float, ...] = ()
    read: Callable[[], AnyArray] | None = field(default=None, repr=False)
    label: str = ""
    address: int = 0
    compute: Callable[[FloatArray], FloatArray] | None = field(default=None, repr=False)

    @property
    def array(self) -> AnyArray:
        """The (n, ...) array of a source."""
        assert self.read is not None, self.function
        return self.read()

    def __call__(self, rows: slice | IntArray) -> FloatArray:
        """Return the (k, width) numbers of the robots ``rows``."""
        values: list[FloatArray] = []
        for compute in self._operations:
            values.append(compute(rows, values))
        return values[-1] if values[-1].flags.writeable else values[-1].copy()

    @cached_property
    def _operations(self) -> tuple[_Operation, ...]:
        """What computes this number with NumPy, one after the other, from the values of those before."""
        order = _in_order(self, {})
        index = {identity: i for i, identity in enumerate(order)}
        return tuple(
            _operation(number, [index[id(argument)] for argument in number.arguments]) for number in order.values()
        )

    def __getitem__(self, columns: int | slice | Sequence[int]) -> Number:
        """Return some of the numbers."""
        if isinstance(columns, slice):
            columns = range(self.width)[columns]
        chosen = (columns,) if isinstance(columns, int) else tuple(columns)
        if self.function == "source":
            picked = tuple(self.constants[column] for column in chosen)
            return Number("source", (), len(chosen), picked, self.read, self.label)
        return Number("columns", (self,), len(chosen), tuple(map(float, chosen)))

    def __add__(self, other: Operand) -> Number:
        return _apply("add", self, other)

    def __radd__(self, other: Operand) -> Number:
        return _apply("add", other, self)

    def __sub__(self, other: Operand) -> Number:
        return _apply("subtract", self, other)

    def __rsub__(self, other: Operand) -> Number:
        return _apply("subtract", other, self)

    def __mul__(self, other: Operand) -> Number:
        return _apply("multiply", self, other)

    def __rmul__(self, other: Operand) -> Number:
        return _apply("multiply", other, self)

    def __truediv__(self, other: Operand) -> Number:
        return _apply("divide", self, other)

    def __rtruediv__(self, other: Operand) -> Number:
        return _apply("divide", other, self)

    def __mod__(self, other: Operand) -> Number:
        return _apply("remainder", self, other)

    def __lt__(self, other: Operand) -> Number:
        return _apply("less", self, other)

    def __gt__(self, other: Operand) -> Number:
        return _apply("greater", self, other)

    def __ge__(self, other: Operand) -> Number:
        return _apply("greater_equal", self, other)

    def __and__(self, other: Number) -> Number:
        return _apply("multiply", self, other)

    def __or__(self, other: Number) -> Number:
        return _apply("maximum", self, other)

    def __invert__(self) -> Number:
        return 1.0 - self


@dataclass(frozen=True, eq=False)
class Store:
    """A stored number: what it becomes when an episode begins, and after each step.

    Stores of a part are computed one after the other, each from the arrays as they are then.

    Attributes:
        target: source of the array.
        begin: its value at the start of an episode; None if it stays.
        update: its value after a step; None if it stays.
    """

    target: Number
    begin: Number | None = None
    update: Number | None = None

    def apply(self, number: Number | None, rows: slice | IntArray) -> None:
        """Compute ``begin`` or ``update`` with NumPy."""
        if number is None:
            return
        array = self.target.array
        chosen, values = array[rows], number(rows)
        if values.size != chosen.size:
            values = np.broadcast_to(values, (len(chosen), self.target.width))
        array[rows] = values.reshape(chosen.shape).astype(array.dtype, copy=False)


def source(array: AnyArray | Callable[[], AnyArray], label: str = "") -> Number:
    """Return all columns of an array with one row per robot: of 64-bit floats or integers, or flags.

    Args:
        array: (n, ...) array, or a function that returns it. Compiled steps use the one that it returns first.
        label: what a skill calls it; without a name, an observation of it cannot be exported.
    """
    read = array if callable(array) else lambda: array
    width = int(np.prod(read().shape[1:], dtype=np.int64))
    return Number("source", (), width, tuple(map(float, range(width))), read, label)


def constant(values: float | Sequence[float]) -> Number:
    """Return numbers that all robots share."""
    numbers = (float(values),) if isinstance(values, int | float) else tuple(map(float, values))
    return Number("constant", (), len(numbers), numbers)


def given(label: str, number: Number) -> Number:
    """Return a number that an exported skill is given by this name, instead of computing it."""
    return Number("given", (number,), number.width, label=label)


def stack(*numbers: Operand) -> Number:
    """Return numbers one after the other."""
    parts = tuple(map(_number, numbers))
    widths = [part.width for part in parts]
    return Number("stack", parts, sum(widths), tuple(map(float, widths)))


def total(number: Number) -> Number:
    """Return the sum of a robot's numbers."""
    return Number("sum", (number,))


def mean(number: Number) -> Number:
    """Return the mean of a robot's numbers."""
    return total(number) / float(number.width)


def square(number: Number) -> Number:
    """Return the square of each number."""
    return number * number


def sin(number: Number) -> Number:
    """Return the sine of each number."""
    return _apply("sin", number)


def cos(number: Number) -> Number:
    """Return the cosine of each number."""
    return _apply("cos", number)


def sqrt(number: Number) -> Number:
    """Return the root of each number."""
    return _apply("sqrt", number)


def absolute(number: Number) -> Number:
    """Return each number without its sign."""
    return _apply("absolute", number)


def exp(number: Number) -> Number:
    """Return e to the power of each number."""
    return _apply("exp", number)


def log(number: Number) -> Number:
    """Return the natural logarithm of each number."""
    return _apply("log", number)


def arctan2(y: Operand, x: Operand) -> Number:
    """Return the angle of (x, y) from the x axis, radians."""
    return _apply("arctan2", y, x)


def hypot(x: Operand, y: Operand) -> Number:
    """Return the length of (x, y)."""
    return _apply("hypot", x, y)


def copysign(size: Operand, sign: Operand) -> Number:
    """Return numbers of this size with the sign of others."""
    return _apply("copysign", size, sign)


def minimum(a: Operand, b: Operand) -> Number:
    """Return the smaller of two numbers."""
    return _apply("minimum", a, b)


def maximum(a: Operand, b: Operand) -> Number:
    """Return the larger of two numbers."""
    return _apply("maximum", a, b)


def clip(number: Number, low: Operand, high: Operand) -> Number:
    """Return numbers limited to [low, high]."""
    return minimum(maximum(number, low), high)


def equal(a: Operand, b: Operand) -> Number:
    """Return 1 where two numbers are equal, else 0."""
    return _apply("equal", a, b)


def known(number: Number) -> Number:
    """Return 1 where a number is one, 0 where it is NaN, which differs from itself."""
    return equal(number, number)


def where(flag: Number, yes: Operand, no: Operand) -> Number:
    """Return ``yes`` where a flag is not 0, else ``no``."""
    return _apply("where", flag, yes, no)


def wrapped(angle: Number) -> Number:
    """Return angles in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def interpolated(number: Number, at: Sequence[float], values: Sequence[float]) -> Number:
    """Return a table's value at one number, linearly between ``at``, which increase, and constant beyond them."""
    return Number("interpolated", (number,), 1, (*map(float, at), *map(float, values)))


def product(matrix: Number, columns: Number) -> Number:
    """Return the product of a 3 x 3 matrix, row by row, and 3 x m numbers: a vector, a matrix, or m vectors."""
    return Number("product", (matrix, columns), columns.width)


def uniform(seed: int, streams: Number, draws: Number, count: int) -> Number:
    """Return ``count`` numbers from [0, 1) of a stream's draw, as :func:`naosprint.terms.randomness.uniform`."""
    return Number("uniform", (streams, draws), count, (float(seed),))


def centre_of_mass(angles_deg: Number, address: int, compute: Callable[[FloatArray], FloatArray]) -> Number:
    """Return a robot's centre of mass from its (J,) joint angles in degrees, by functions of its own module."""
    return Number("centre_of_mass", (angles_deg,), 3, address=address, compute=compute)


def _number(operand: Operand) -> Number:
    return operand if isinstance(operand, Number) else constant(operand)


def _apply(function: str, *operands: Operand) -> Number:
    arguments = tuple(map(_number, operands))
    width = max(argument.width for argument in arguments)
    for argument in arguments:
        if argument.width not in (1, width):
            raise ValueError(f"{function}: {argument.width} and {width} numbers do not fit")
    return Number(function, arguments, width)


# NumPy's interpreter


def _of_the_c_library(function: Callable[..., float], arguments: int) -> Callable[..., AnyArray]:
    """Return a function of the C library for arrays; NumPy has its own, whose last bit depends on the processor."""
    each = np.frompyfunc(function, arguments, 1)
    return lambda *values: np.asarray(each(*values), dtype=np.float64)


def _sum(values: FloatArray) -> FloatArray:
    return np.asarray(np.ascontiguousarray(values).sum(axis=1, keepdims=True))


def _where(flag: FloatArray, yes: FloatArray, no: FloatArray) -> FloatArray:
    return np.asarray(np.where(flag != 0.0, yes, no))


def _interpolated(number: Number, values: FloatArray) -> FloatArray:
    half = len(number.constants) // 2
    return np.interp(values, number.constants[:half], number.constants[half:])


def _product(number: Number, matrix: FloatArray, columns: FloatArray) -> FloatArray:
    k = max(len(matrix), len(columns))
    a, b = matrix.reshape(-1, 3, 3, 1), columns.reshape(-1, 1, 3, number.width // 3)
    rows = a[:, :, 0] * b[:, :, 0] + a[:, :, 1] * b[:, :, 1] + a[:, :, 2] * b[:, :, 2]
    return rows.reshape(k, number.width)


def _uniform(number: Number, streams: FloatArray, draws: FloatArray) -> FloatArray:
    return randomness.uniform(
        int(number.constants[0]), streams[:, 0].astype(np.int64), draws[:, 0].astype(np.int64), number.width
    )


_ELEMENTWISE = (
    *("add", "subtract", "multiply", "divide", "remainder", "hypot", "sin", "cos", "sqrt"),
    *("absolute", "copysign", "minimum", "maximum", "less", "greater", "greater_equal", "equal"),
)

FUNCTIONS: Mapping[str, Callable[..., AnyArray]] = {
    "sum": _sum,
    "where": _where,
    "exp": _of_the_c_library(math.exp, 1),
    "log": _of_the_c_library(math.log, 1),
    "arctan2": _of_the_c_library(math.atan2, 2),
    **{name: getattr(np, name) for name in _ELEMENTWISE},
}
"""Functions of (k, width) arrays by name, besides those that `_operation` treats."""


_OF_CONSTANTS: Mapping[str, Callable[..., AnyArray]] = {
    "uniform": _uniform,
    "interpolated": _interpolated,
    "product": _product,
}
"""Functions that depend on the number's constants or width, too."""


def _in_order(number: Number, found: dict[int, Number]) -> dict[int, Number]:
    """Return a number and all that it is computed from, by identity, arguments first."""
    if id(number) not in found:
        for argument in number.arguments:
            _in_order(argument, found)
        found[id(number)] = number
    return found


def _operation(number: Number, at: Sequence[int]) -> _Operation:
    """Return what computes a number's (k, width) values from those before; ``at`` are the indices of its arguments."""
    if number.function == "source":
        return _read(number)
    if number.function == "constant":
        shared = np.array([number.constants])
        shared.flags.writeable = False
        return lambda rows, values: shared
    if number.function == "given":
        return lambda rows, values: values[at[0]]
    if number.function == "columns":
        chosen = _columns(number)
        return lambda rows, values: values[at[0]][:, chosen]
    if number.function == "stack":
        return lambda rows, values: _stacked([values[each] for each in at])
    function = _function(number)
    match at:
        case [only]:
            return lambda rows, values: np.asarray(function(values[only]), dtype=np.float64)
        case [left, right]:
            return lambda rows, values: np.asarray(function(values[left], values[right]), dtype=np.float64)
    return lambda rows, values: np.asarray(function(*[values[each] for each in at]), dtype=np.float64)


def _function(number: Number) -> Callable[..., AnyArray]:
    if number.function in _OF_CONSTANTS:
        return partial(_OF_CONSTANTS[number.function], number)
    return FUNCTIONS[number.function] if number.compute is None else number.compute


def _read(number: Number) -> _Operation:
    columns = _columns(number)

    def values(rows: slice | IntArray, values: Sequence[FloatArray]) -> FloatArray:
        chosen = number.array[rows]
        if chosen.ndim != 2:
            chosen = chosen.reshape(len(chosen), math.prod(chosen.shape[1:]))
        return np.array(chosen[:, columns], dtype=np.float64)

    return values


def _columns(number: Number) -> slice | IntArray:
    """Return the indices of columns, as a slice where they follow each other."""
    first, *others = columns = [int(column) for column in number.constants]
    if others == list(range(first + 1, first + len(columns))):
        return slice(first, first + len(columns))
    return np.array(columns, dtype=np.int64)


def _stacked(parts: Sequence[FloatArray]) -> FloatArray:
    k = max(map(len, parts))
    return np.concatenate([part if len(part) == k else np.broadcast_to(part, (k, part.shape[1])) for part in parts], 1)
