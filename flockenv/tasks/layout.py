"""Layout: names, units and scales of the numbers of an observation or action row, to read them by name."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["THINGS", "Layout", "Slot", "slots_of"]

THINGS = ("food", "obstacles")
"""Kinds of entities that are not agents."""


@dataclass(frozen=True)
class Slot:
    """Consecutive numbers of a row, in this shape, each the quantity divided by `scale`."""

    name: str  # of the quantity
    shape: tuple[int, ...]  # (2,) a vector, (6, 2) six vectors, () a number
    scale: float  # row value = quantity / scale, clipped to [low, 1]
    unit: str  # of the quantity, such as m/s
    meaning: str  # of the quantity, for pages
    low: float = -1.0  # lower bound of a row value: -1 or 0
    entity: str = ""  # kind of agent or obstacle that each entry of the first axis describes; zeros: there is none
    nearest: bool = False  # all its numbers describe the first entity of that kind

    @functools.cached_property
    def size(self) -> int:
        """Numbers in the slot."""
        return math.prod(self.shape)


def slots_of(entity: str, *slots: Slot) -> tuple[Slot, ...]:
    """Return the slots as those of one kind of entity, such as "obstacles": they describe the same, in one order."""
    return tuple(replace(slot, entity=entity) for slot in slots)


@dataclass(frozen=True)
class Layout:
    """The slots of a row, in order."""

    slots: tuple[Slot, ...]

    @functools.cached_property
    def size(self) -> int:
        """Numbers in a row."""
        return sum(slot.size for slot in self.slots)

    @functools.cached_property
    def places(self) -> dict[str, int]:
        """Index of the first number of each slot in a row, by the slot's name."""
        starts = itertools.accumulate((slot.size for slot in self.slots), initial=0)
        return dict(zip((slot.name for slot in self.slots), starts, strict=False))

    @property
    def low(self) -> NDArray[np.float32]:
        """Least values of a row, (size,)."""
        return np.concatenate([np.full(slot.size, slot.low, np.float32) for slot in self.slots])

    @property
    def high(self) -> NDArray[np.float32]:
        """Greatest values of a row, (size,)."""
        return np.ones(self.size, np.float32)

    @functools.cached_property
    def entities(self) -> NDArray[np.int64]:
        """Index of the entity that each number of a row describes, (size,); -1: none. Kinds follow one another."""
        counts: dict[str, int] = {}
        for slot in self.slots:
            if slot.entity and not slot.nearest:
                counts[slot.entity] = max(counts.get(slot.entity, 0), slot.shape[0])
        first = dict(zip(counts, itertools.accumulate(counts.values(), initial=0), strict=False))
        return np.concatenate([_entities_of(slot, first.get(slot.entity, -1)) for slot in self.slots])

    @functools.cached_property
    def agent_slots(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
        """Of each entity: the column of its offset in a row (-1: no agent), the scale in m, its place in the list.

        All are (entities,); place 0 is the nearest. The offset is the first vector in m of that kind.
        """
        count = int(self.entities.max(initial=-1)) + 1
        columns, scales, places = np.full(count, -1), np.zeros(count), np.zeros(count, np.int64)
        for slot in self.slots:
            if slot.size and slot.entity not in ("", *THINGS) and slot.unit == "m" and slot.shape[1:] == (2,):
                begin, rows = self.places[slot.name], np.arange(slot.shape[0])
                entity = self.entities[begin] + rows
                if columns[entity[0]] < 0:
                    columns[entity], scales[entity], places[entity] = begin + 2 * rows, slot.scale, rows
        return columns, scales, places

    def unpack(self, rows: ArrayLike) -> SimpleNamespace:
        """Return the quantities of rows (..., size) by name, in SI units: arrays (..., *shape), float64."""
        array = np.asarray(rows, np.float64)
        if array.shape[-1:] != (self.size,):
            raise ValueError(
                f"unpack: rows have shape {array.shape}, must end with {self.size} numbers, one per slot entry"
            )
        named: dict[str, Any] = {}
        at = 0
        for slot in self.slots:
            part = array[..., at : at + slot.size] * slot.scale
            named[slot.name] = part.reshape(array.shape[:-1] + slot.shape)
            at += slot.size
        return SimpleNamespace(**named)

    def table(self) -> list[tuple[str, str, str, str]]:
        """Return a line per slot: (indices, name, unit and scale, meaning)."""
        lines, at = [], 0
        for slot in self.slots:
            where = f"{at}" if slot.size == 1 else f"{at}-{at + slot.size - 1}"
            if slot.size:
                lines.append((where, slot.name, f"{slot.unit} / {slot.scale:g}", slot.meaning))
            at += slot.size
        return lines

    @property
    def digest(self) -> str:
        """A short digest of this layout without its texts: rows with the same digest have the same meaning."""
        numbers = [(slot.name, slot.shape, slot.scale, slot.unit, slot.low) for slot in self.slots]
        return hashlib.sha256(repr(numbers).encode()).hexdigest()[:16]


def _entities_of(slot: Slot, first: int) -> NDArray[np.int64]:
    """Return the index of the entity that each number of a slot describes; `first`: that of its kind, -1: none."""
    if first < 0 or slot.nearest:
        return np.full(slot.size, first)
    return np.repeat(np.arange(first, first + slot.shape[0]), math.prod(slot.shape[1:]))
