"""Recycler: fresh arrays out of memory that nobody looks at any more.

A step hands out megabytes. Above 32 MB (and sooner with other allocators) each fresh array is memory that the system
has to find, fill with zeros and map; an array that was let go of is at hand, and often still in the processor's cache.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Recycler"]

Key = tuple[tuple[int, ...], np.dtype[Any]]


def _holders(kept: list[NDArray[Any]], k: int) -> int:
    """Return how many hold an array, the list included; views and tensors hold the array whose memory they show."""
    return sys.getrefcount(kept[k])


_NOBODY = _holders([np.empty(0)], 0)
"""What is counted when only the list holds it; asked and not written down, for Pythons count differently."""


class Recycler:
    """Makes arrays as np.empty does, out of memory that it handed out before and that nobody can see any more.

    Not for several threads at once; whoever has an array may let go of it in any thread.
    """

    def __init__(self, keep: int = 4) -> None:
        """keep: how many arrays of a shape and type to remember; one more that is asked for is simply new."""
        self.keep = keep
        self._kept: dict[Key, list[NDArray[Any]]] = {}

    def empty(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return an array whose content is anything; a view of ours, so that its flags and shape are the caller's."""
        kept = self._kept.setdefault((shape, dtype), [])
        for k in range(len(kept)):
            if _holders(kept, k) == _NOBODY:
                return kept[k].view()
        array = np.empty(shape, dtype)
        if len(kept) < self.keep:
            kept.append(array)
        return array.view()
