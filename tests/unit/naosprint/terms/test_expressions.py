"""Expressions: what Python would compute at once is refused, and what has no value is that of C."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from naosprint.terms import (
    Number,
    Store,
    constant,
    equal,
    exp,
    interpolated,
    log,
    product,
    source,
    square,
    stack,
    uniform,
    where,
)

ROWS = slice(0, 2)
ARRAY = np.array([[0.5, -2.0, 3.0], [1.0, 4.0, -6.0]])
X = source(ARRAY)
FLAG = X[0] > 0.7


@pytest.mark.parametrize(
    ("misused", "instead"),
    [
        (lambda: min(X[0], 1.0), "minimum"),
        (lambda: 0.45 < X[0] < 0.6, "&"),
        (lambda: X[0] and FLAG, "& for and"),
        (lambda: not FLAG, "~ for not"),
        (lambda: 5.0 if FLAG else 6.0, "where"),
        (lambda: where(X[0] == 1.0, 5.0, 6.0), "equal"),
        (lambda: where(X[0] != 1.0, 5.0, 6.0), "~naosprint.terms.equal"),
        (lambda: sum(square(X)), "total"),
        (lambda: tuple(X), r"x\[0\], x\[1\]"),
        (lambda: 1.0 in X, "not iterable"),
        (lambda: np.where(FLAG, 1.0, 0.0), "where"),
        (lambda: np.clip(X, 0.0, 1.0), "clip"),
        (lambda: np.array(X), "stack"),
        (lambda: np.square(X), "numpy.square: .* the functions of naosprint.terms"),
        (lambda: np.add.reduce(X), "numpy.add"),  # type: ignore[call-overload]
        (lambda: constant([X[0], 1.0]), "must be a string or a real number, not 'Number'"),
    ],
)
def test_what_python_would_compute_at_once_is_refused(misused: Callable[[], object], instead: str) -> None:
    with pytest.raises(TypeError, match=instead):
        misused()


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (-X, -ARRAY),
        (abs(X), np.abs(ARRAY)),
        (X <= 0.5, ARRAY <= 0.5),
        (~equal(X, 3.0), ARRAY != 3.0),
        ((X[0] > 0.45) & (X[0] < 0.6), [[1.0], [0.0]]),
        (np.minimum(X, 1.0), np.minimum(ARRAY, 1.0)),
        (np.arctan2(X[0], 2.0), np.arctan2(ARRAY[:, :1], 2.0)),
        (np.float64(2.0) * X, 2.0 * ARRAY),
        (np.array([1.0, 2.0, 3.0]) - X, [1.0, 2.0, 3.0] - ARRAY),
        (np.array([1.0, 2.0, 3.0]) <= X, ARRAY >= [1.0, 2.0, 3.0]),
        (X + np.int64(1), ARRAY + 1.0),
        ((X * 2.0)[-1], 2.0 * ARRAY[:, -1:]),
        (X[-2:], ARRAY[:, -2:]),
        (X[np.array([2, -3])], ARRAY[:, [2, 0]]),
        ((X + 0.0)[np.int64(1)], ARRAY[:, 1:2]),
    ],
)
def test_operators_and_columns_are_those_of_numpy(number: Number, expected: Any) -> None:
    assert isinstance(number, Number)
    np.testing.assert_array_equal(number(ROWS), np.asarray(expected, dtype=np.float64))


@pytest.mark.parametrize("number", [X, X * 2.0])
@pytest.mark.parametrize("column", [3, -4, [0, 7], slice(3, 5), []])
def test_columns_that_do_not_exist_are_refused(number: Number, column: Any) -> None:
    with pytest.raises(IndexError, match=r"no column"):
        number[column]


def test_columns_are_not_chosen_by_flags() -> None:
    with pytest.raises(TypeError, match="where chooses by flags"):
        X[[True, False, True]]
    with pytest.raises(TypeError, match="slice"):
        X[:, 0]  # type: ignore[index]


def test_expressions_are_keys_by_identity() -> None:
    other = X + 1.0
    assert {X: 1, other: 2}[other] == 2
    assert len({X, other, X}) == 2


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda: interpolated(X[0], [0, 1, 2], [10, 20, 30, 40, 50]), "3 places for 5 values"),
        (lambda: interpolated(X[0], [2, 1, 0], [10, 20, 30]), "have to increase"),
        (lambda: interpolated(X[0], [0, 1, 1], [10, 20, 30]), "have to increase"),
        (lambda: interpolated(X[0], [0, math.nan], [10, 20]), "have to increase"),
        (lambda: interpolated(X[0], [0, 1], [10, math.inf]), "finite"),
        (lambda: interpolated(X[0], [0], [10]), "2 or more"),
        (lambda: interpolated(X, [0, 1], [10, 20]), "one number is needed, not 3"),
        (lambda: product(X, X), "product: 3 and 3 numbers, but 9"),
        (lambda: product(constant(np.eye(3).ravel().tolist()), X[:2]), "product: 9 and 2 numbers"),
        (lambda: uniform(0, X, X[0], 1), "uniform: 1 numbers of 3 streams"),
        (lambda: uniform(0, X[0], X[0], 0), "uniform: 0 numbers"),
        (lambda: stack(), "stack: there has to be a number"),
        (lambda: constant([]), "constant: there has to be a number"),
        (lambda: Store(X[0], update=constant(1.0)), "its target is some columns of a source"),
        (lambda: Store(X[[2, 1, 0]], update=X), "has to be a whole source"),
        (lambda: Store(X * 2.0, update=X), "its target is a multiply"),
        (lambda: Store(X, begin=X[:2]), "begin has 2 numbers for a target of 3"),
        (lambda: Store(X[0:1], update=X), "has to be a whole source"),
        (lambda: Store(source(np.zeros(2)), update=X), "update has 3 numbers for a target of 1"),
    ],
)
def test_what_does_not_fit_is_refused_where_it_is_written(made: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        made()


def test_a_store_of_a_plain_number_names_the_function_to_use() -> None:
    with pytest.raises(TypeError, match=r"begin is 0.0, but has to be an expression, such as constant\(0.0\)"):
        Store(X, begin=0.0)  # type: ignore[arg-type]


def test_a_whole_source_is_stored_whichever_way_it_is_chosen() -> None:
    for target in (source(np.zeros(2)), source(np.zeros(2))[0], source(np.zeros((2, 3)))[:]):
        Store(target, update=constant(2.0)).apply(constant(2.0), ROWS)
        np.testing.assert_array_equal(target(ROWS), 2.0)


def test_functions_have_the_values_of_c_where_python_raises() -> None:
    """Compiled steps have them too: tests/unit/naosprint/tasks/test_compiled.py."""
    values = source(np.array([[1000.0, -1000.0, 0.0, -0.0, -1.0, math.inf, -math.inf, math.nan]]))
    row = slice(0, 1)
    e = math.exp(-1.0)
    np.testing.assert_array_equal(exp(values)(row)[0], [math.inf, 0.0, 1.0, 1.0, e, math.inf, 0.0, math.nan])
    logs = [math.log(1000.0), math.nan, -math.inf, -math.inf, math.nan, math.inf, math.nan, math.nan]
    np.testing.assert_array_equal(log(values)(row)[0], logs)
    # without a warning, which tests and some users turn into errors
    np.testing.assert_array_equal((1.0 / values)(row)[0, 2:4], [math.inf, -math.inf])
