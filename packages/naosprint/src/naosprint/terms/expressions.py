"""Numbers of each robot as data: expressions of what simulators report and tasks store.

An observation, measurement or reward term is written once, as an expression::

    moved = perceptor("torso_pos") - before
    speed = hypot(moved[0], moved[1]) / STEP_S

Three interpreters read it: NumPy here, which is the reference; C++ (packages/naosprint/cpp/operations.cpp), with the
same bits; and exported skills (naosprint/export/skills/terms.py), from its description as JSON. Functions have the
names of NumPy's where it has them.

An expression has no values while it is written. What Python would decide at once by them (``if``, ``and``, ``not``,
``min``, ``==``, chained comparisons) or loop over raises TypeError, which names the function that does it in every
step.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias, Union

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
        # as in C++, what a function has no value for is NaN or infinite
        with np.errstate(all="ignore"):
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
        """Return some of the numbers; negative columns count from the last.

        Raises:
            IndexError: if there is no such column.
        """
        if isinstance(columns, slice):
            columns = range(self.width)[columns]
        chosen = tuple(map(self._column, columns if isinstance(columns, Iterable) else (columns,)))
        if not chosen:
            raise IndexError(f"no column of the {self.width} is chosen")
        if self.function == "source":
            picked = tuple(self.constants[column] for column in chosen)
            return Number("source", (), len(chosen), picked, self.read, self.label)
        return Number("columns", (self,), len(chosen), tuple(map(float, chosen)))

    def _column(self, column: int) -> int:
        """Return a column's place from the first."""
        if isinstance(column, bool | np.bool_):
            raise TypeError("columns are chosen by their places, not by flags; naosprint.terms.where chooses by flags")
        place = operator.index(column)
        if not -self.width <= place < self.width:
            raise IndexError(f"there is no column {place}: the expression has {self.width}, from 0 to {self.width - 1}")
        return place % self.width

    # what Python would compute at once

    __hash__ = object.__hash__  # by identity, although == is refused

    def __bool__(self) -> NoReturn:
        raise TypeError(
            "an expression is neither true nor false before a step: use & for and, | for or, ~ for not, where for if, "
            "minimum and maximum for min and max, and (low < x) & (x < high) for low < x < high"
        )

    def __eq__(self, other: object) -> NoReturn:
        raise TypeError("use naosprint.terms.equal(a, b) for a == b, which no step would compute")

    def __ne__(self, other: object) -> NoReturn:
        raise TypeError("use ~naosprint.terms.equal(a, b) for a != b, which no step would compute")

    def __iter__(self) -> NoReturn:
        raise TypeError(
            "an expression is no sequence: use naosprint.terms.total for its sum, mean for its mean, and x[0], x[1] "
            "for its columns"
        )

    def __array__(self, *arguments: object, **options: object) -> NoReturn:
        raise TypeError(
            "an expression has no values before a step: use the functions of naosprint.terms in place of NumPy's, such "
            "as where, clip, stack, total and mean"
        )

    def __array_ufunc__(self, function: np.ufunc, method: str, *operands: Any, **options: object) -> Number:
        """Apply NumPy's functions of a name that :mod:`naosprint.terms` has, also for an operator after an array."""
        name = function.__name__
        if name == "less_equal":
            name, operands = "greater_equal", operands[::-1]
        if name not in _ELEMENTWISE + _OWN or method != "__call__" or options:
            raise TypeError(
                f"numpy.{name}: an expression has no values before a step; use the functions of naosprint.terms"
            )
        return _apply(name, *operands)

    # operators

    def __neg__(self) -> Number:
        return _apply("multiply", -1.0, self)

    def __abs__(self) -> Number:
        return _apply("absolute", self)

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

    def __le__(self, other: Operand) -> Number:
        return _apply("greater_equal", other, self)

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
        target: source of the array, with all of its columns.
        begin: its value at the start of an episode; None if it stays.
        update: its value after a step; None if it stays.

    Raises:
        ValueError: if the target is no whole source, or a value has another width.
    """

    target: Number
    begin: Number | None = None
    update: Number | None = None

    def __post_init__(self) -> None:
        """Refuse what one of the interpreters would store otherwise than it is written."""
        target = self.target
        if target.function != "source" or target.constants != _all_columns(target.array):
            what = "some columns of a source" if target.function == "source" else f"a {target.function}"
            raise ValueError(
                f"Store: its target is {what}, but has to be a whole source; keep the other columns with stack(...)"
            )
        for name, value in (("begin", self.begin), ("update", self.update)):
            if value is not None and not isinstance(value, Number):
                raise TypeError(f"Store: {name} is {value!r}, but has to be an expression, such as constant(0.0)")
            if value is not None and value.width not in (1, target.width):
                raise ValueError(f"Store: {name} has {value.width} numbers for a target of {target.width}")

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
    columns = _all_columns(read())
    return Number("source", (), len(columns), columns, read, label)


def constant(values: float | Sequence[float]) -> Number:
    """Return numbers that all robots share."""
    numbers = (float(values),) if isinstance(values, int | float | np.generic) else tuple(map(float, values))
    if not numbers:
        raise ValueError("constant: there has to be a number")
    return Number("constant", (), len(numbers), numbers)


def given(label: str, number: Number) -> Number:
    """Return a number that an exported skill is given by this name, instead of computing it."""
    return Number("given", (number,), number.width, label=label)


def stack(*numbers: Operand) -> Number:
    """Return numbers one after the other."""
    if not numbers:
        raise ValueError("stack: there has to be a number")
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
    """Return a table's value at one number, linearly between ``at``, which increase, and constant beyond them.

    Raises:
        ValueError: if there are several numbers, or the table is none.
    """
    if number.width != 1:
        raise ValueError(f"interpolated: one number is needed, not {number.width}; interpolate each column, then stack")
    if len(at) != len(values) or len(at) < 2:
        raise ValueError(f"interpolated: {len(at)} places for {len(values)} values; there have to be 2 or more of each")
    if not np.isfinite([*at, *values]).all() or not all(low < high for low, high in pairwise(at)):
        raise ValueError(f"interpolated: the places {list(map(float, at))} have to increase, and all to be finite")
    return Number("interpolated", (number,), 1, (*map(float, at), *map(float, values)))


def product(matrix: Number, columns: Number) -> Number:
    """Return the product of a 3 x 3 matrix, row by row, and 3 x m numbers: a vector, a matrix, or m vectors."""
    if matrix.width != 9 or columns.width % 3:
        raise ValueError(f"product: {matrix.width} and {columns.width} numbers, but 9 and a multiple of 3 are needed")
    return Number("product", (matrix, columns), columns.width)


def uniform(seed: int, streams: Number, draws: Number, count: int) -> Number:
    """Return ``count`` numbers from [0, 1) of a stream's draw, as :func:`naosprint.terms.randomness.uniform`."""
    if streams.width != 1 or draws.width != 1 or count < 1:
        raise ValueError(
            f"uniform: {count} numbers of {streams.width} streams in {draws.width} draws; one of both is needed, and "
            "a number or more"
        )
    return Number("uniform", (streams, draws), count, (float(seed),))


def centre_of_mass(angles_deg: Number, address: int, compute: Callable[[FloatArray], FloatArray]) -> Number:
    """Return a robot's centre of mass from its (J,) joint angles in degrees, by functions of its own module."""
    return Number("centre_of_mass", (angles_deg,), 3, address=address, compute=compute)


def sources(number: Number) -> Iterator[Number]:
    """Yield the sources that an expression is computed from."""
    return (each for each in _in_order(number, {}).values() if each.function == "source")


def _all_columns(array: AnyArray) -> tuple[float, ...]:
    """Return the columns of a whole source."""
    return tuple(map(float, range(math.prod(array.shape[1:]))))


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


def _exp(value: float) -> float:
    try:
        return math.exp(value)
    except OverflowError:
        return math.inf


def _log(value: float) -> float:
    if value > 0.0:
        return math.log(value)
    return -math.inf if value == 0.0 else math.nan


def _of_the_c_library(function: Callable[..., float], arguments: int) -> Callable[..., AnyArray]:
    """Return a function of the C library for arrays; NumPy has its own, whose last bit depends on the processor.

    Where Python raises an error, the function has to return what C does.
    """
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
_OWN = ("exp", "log", "arctan2")

FUNCTIONS: Mapping[str, Callable[..., AnyArray]] = {
    "sum": _sum,
    "where": _where,
    "exp": _of_the_c_library(_exp, 1),
    "log": _of_the_c_library(_log, 1),
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
