"""Expressions for the interpreter in C++."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias

from naosprint import _compiled
from naosprint.arrays import AnyArray
from naosprint.terms.expressions import Number, Store

Node: TypeAlias = tuple[str, list[int], int, list[float], AnyArray | None, int]


def compilable(number: Number | None) -> bool:
    """Return whether C++ computes an expression: all sources return the same array at every call."""
    if number is None:
        return True
    if number.read is not None:
        first, second = number.array, number.array
        return bool(first.__array_interface__["data"] == second.__array_interface__["data"])
    return all(map(compilable, number.arguments))


def operation(value: Number | None, stores: Iterable[Store] = ()) -> _compiled.Operation:
    """Return the object that computes a value and what is stored for it.

    Raises:
        ValueError: if there is no such function, or an argument does not fit.
    """
    kept = [(store.target.array, nodes(store.begin), nodes(store.update)) for store in stores]
    return _compiled.Operation(nodes(value), kept)


def nodes(number: Number | None) -> list[Node]:
    """Return an expression's functions, each after its arguments; what skills are given is computed here."""
    found: list[Node] = []
    if number is not None:
        _add(number, found, {})
    return found


def _add(number: Number, found: list[Node], places: dict[int, int]) -> int:
    """Append a number and what it is computed from; return its index."""
    if id(number) in places:
        return places[id(number)]
    if number.function == "given":
        place = _add(number.arguments[0], found, places)
    else:
        arguments = [_add(argument, found, places) for argument in number.arguments]
        array = None if number.read is None else number.array
        found.append((number.function, arguments, number.width, list(number.constants), array, number.address))
        place = len(found) - 1
    places[id(number)] = place
    return place
