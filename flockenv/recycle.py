"""Recycler: fresh arrays out of memory that nobody looks at any more.

A step hands out megabytes. Above 32 MB (and sooner with other allocators) each fresh array is memory that the system
has to find, fill with zeros and map; an array that was let go of is at hand, and often still in the processor's cache.
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
    """Return how many hold a memory, the list included; views and tensors hold the array whose memory they show."""
    return sys.getrefcount(kept[k][0])


_NOBODY = _holders([(np.empty(0, np.uint8), 0)], 0)
"""What is counted when only the list holds it; asked and not written down, for Pythons count differently."""


class Recycler:
    """Makes arrays as np.empty does, out of memory that it handed out before and that nobody can see any more.

    Not for several threads at once; whoever has an array may let go of it in any thread.
    """

    def __init__(self, keep: int = 4, line: int = 1) -> None:
        """Remember up to `keep` arrays of a shape and type; one more that is asked for is simply new.

        line: of so many bytes is an address a multiple at which an array begins.
        """
        self.keep, self.line = keep, line
        self._kept: dict[Key, list[Memory]] = {}

    def maker(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Callable[[], NDArray[Any]]:
        """Return what makes arrays of this shape and type: their content is anything, their memory not their own."""
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
