"""Buffer pool: new arrays in the memory of released ones.

A step returns megabytes. Above 32 MB (less with other allocators) the system has to find, zero and map memory for each
new array; the memory of a released array is already mapped, and often still in the processor's cache.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BufferPool"]

Key = tuple[tuple[int, ...], np.dtype[Any]]
Memory = tuple[NDArray[np.uint8], int]
"""A byte buffer, and the offset at which an array begins in it."""


def _holders(kept: list[Memory], k: int) -> int:
    """Return the number of references to buffer k of the list, whose own, and those of views, are included."""
    return sys.getrefcount(kept[k][0])


_NOBODY = _holders([(np.empty(0, np.uint8), 0)], 0)
"""Number of references if only the list refers to a buffer, measured, as it depends on the version of Python."""


class BufferPool:
    """Buffer pool that returns arrays like np.empty, in the memory of earlier ones without references.

    It is not thread-safe, but arrays may be released in any thread.
    """

    def __init__(self, keep: int = 4, line: int = 1) -> None:
        """Keep up to `keep` buffers for each shape and dtype; further arrays are allocated and not kept.

        line: alignment in bytes; arrays begin at multiples of it.
        """
        self.keep, self.line = keep, line
        self._kept: dict[Key, list[Memory]] = {}

    def maker(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Callable[[], NDArray[Any]]:
        """Return a function that makes arrays of this shape and dtype: uninitialised views of pooled buffers."""
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
