"""Expressions as data for exported skills, which interpret them: see naosprint/export/skills/terms.py."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

from naosprint.terms.expressions import Number, Store


class DescribedBlock(Protocol):
    """A block of observations."""

    names: tuple[str, ...]
    value: Any
    stores: tuple[Store, ...]
    rates: bool
    angular: bool


class Description:
    """Description of what a policy observes: all of its blocks, and the stores that they depend on.

    A block in Python only has no description; the skill is given its numbers by their names, as inputs.

    Args:
        blocks: blocks of the observation, in order.
        stores: what the task stores besides, in order.
        start: x and y at which runs begin in trainings, metres.
    """

    def __init__(
        self, blocks: Sequence[DescribedBlock], stores: Iterable[Store], start: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self._start = start
        self._given = tuple(blocks)
        self._stores = (*stores, *(store for block in blocks for store in block.stores))
        self._targets: dict[int, int] = {}  # address of a stored array: its place among the stored arrays
        for store in self._stores:
            self._targets.setdefault(_address(store.target), len(self._targets))
        self._nodes: list[list[Any]] = []
        self._places: dict[int, int] = {}
        self._needed: set[int] = set()
        self._blocks = [[self._value(block), block.rates, block.angular] for block in blocks]
        kept = self._reached()
        self._steps = [[self._targets[_address(s.target)], *self._both(s)] for s in self._stores if s in kept]

    def document(self) -> dict[str, Any]:
        """Return the description as JSON.

        ``stored`` are arrays with their names and widths; ``nodes`` are functions, each with the places of its
        arguments and its constants, inputs with their names. ``stores`` are places of stored arrays, in order, each
        with the places of its value at the start of a run and after each cycle, or null. ``blocks`` are places of
        numbers that are observed, whether their rates follow, and whether these take the short way round.
        """
        stored = {self._targets[_address(each.target)]: [each.target.label, each.target.width] for each in self._stores}
        return {
            "start": self._start,
            "stored": [stored[place] for place in range(len(stored))],
            "nodes": self._nodes,
            "stores": self._steps,
            "blocks": self._blocks,
        }

    def observed_by(self, name: str) -> list[str]:
        """Return the names of the observations that depend on an input."""
        stores = {target: [place for place in places if place is not None] for target, *places in self._steps}

        def depends(place: int, seen: set[int]) -> bool:
            function, arguments, constants, *label = self._nodes[place]
            if function == "stored" and constants[0] not in seen:
                arguments = stores.get(constants[0], [])
                seen = seen | {constants[0]}
            return label == [name] or any(depends(each, seen) for each in arguments)

        found = [block for block, (place, *_) in zip(self._given, self._blocks, strict=True) if depends(place, set())]
        return [each for block in found for each in (block.names if isinstance(block.value, Number) else [name])]

    def _reached(self) -> set[Store]:
        """Return the stores that observations depend on."""
        kept: set[Store] = set()
        while True:
            more = {s for s in self._stores if self._targets[_address(s.target)] in self._needed and s not in kept}
            if not more:
                return kept
            for store in more:
                self._both(store)
            kept |= more

    def _both(self, store: Store) -> list[int | None]:
        return [None if number is None else self._place(number) for number in (store.begin, store.update)]

    def _value(self, block: DescribedBlock) -> int:
        if isinstance(block.value, Number):
            return self._place(block.value)
        inputs = [self._add("input", [], [], name) for name in block.names]
        return self._add("stack", inputs, [])

    def _place(self, number: Number) -> int:
        if id(number) in self._places:
            return self._places[id(number)]
        if number.function == "given":
            place = self._add("input", [], [], number.label)
        elif number.function == "source":
            at = self._targets.get(_address(number))
            if at is not None:
                self._needed.add(at)
                place = self._add("stored", [], [at, *map(int, number.constants)])
            else:
                place = self._add(
                    "input", [], list(map(int, number.constants)), number.label or "the robot's true state"
                )
        elif number.function == "centre_of_mass":
            place = self._add("input", [], [], number.function)
        else:
            place = self._add(number.function, [self._place(each) for each in number.arguments], list(number.constants))
        self._places[id(number)] = place
        return place

    def _add(self, function: str, arguments: list[int], constants: list[Any], label: str = "") -> int:
        self._nodes.append([function, arguments, constants, *([label] if label else [])])
        return len(self._nodes) - 1


def _address(number: Number) -> int:
    return int(number.array.__array_interface__["data"][0])
