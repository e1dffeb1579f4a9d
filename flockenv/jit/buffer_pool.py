"""Recycler: new arrays in memory that nothing refers to any more.

A step returns megabytes. Above 32 MB (less with other allocators) each new array is memory that the system has to
find, fill with zeros and map; the memory of a released array is mapped, and often still in the processor's cache.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Recycler"]

Key = tuple[tuple[int, ...], np.dtype[Any]]
Memory = tuple[NDArray[np.uint8], int]
"""Bytes, and where in them an array begins."""


def _holders(kept: list[Memory], k: int) -> int:
    """Return the number of references to a memory, the list's included; views and tensors refer to their base array."""
    return sys.getrefcount(kept[k][0])


_NOBODY = _holders([(np.empty(0, np.uint8), 0)], 0)
"""The count if only the list refers to it; measured, because versions of Python count differently."""


class Recycler:
    """Makes arrays as np.empty does, in memory that it returned before and that nothing refers to any more.

    Not for several threads at once; arrays may be released in any thread.
    """

    def __init__(self, keep: int = 4, line: int = 1) -> None:
        """Keep up to `keep` arrays of a shape and type; any more are allocated and not kept.

        line: bytes; arrays begin at addresses that are multiples of it.
        """
        self.keep, self.line = keep, line
        self._kept: dict[Key, list[Memory]] = {}

    def maker(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Callable[[], NDArray[Any]]:
        """Return a function that makes arrays of this shape and type: with any content, as views of kept memory."""
        kept = self._kept.setdefault((shape, dtype), [])

        def make() -> NDArray[Any]:
            for k in range(len(kept)):
                if _holders(kept, k) == _NOBODY:
                    return np.ndarray(shape, dtype, *kept[k])
            room = np.empty(math.prod(shape) * dtype.itemsize + self.line, np.uint8)
            memory = room, -room.__array_interface__["data"][0] % self.line
            if len(kept) < self.keep:
                kept.append(memory)
            return np.ndarray(shape, dtype, *memory)

        return make
