"""Layout: names, units and scales of the numbers of an observation or action row, to read them by name."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Layout", "Slot"]


@dataclass(frozen=True)
class Slot:
    """Consecutive numbers of a row, in this shape, each the quantity divided by `scale`."""

    name: str
    shape: tuple[int, ...]  # (2,) a vector, (6, 2) six vectors, () a number
    scale: float  # row value = quantity / scale, clipped to [low, 1]
    unit: str
    meaning: str
    low: float = -1.0

    @property
    def size(self) -> int:
        """Numbers in the slot."""
        return math.prod(self.shape)


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
