"""Lengths of many vectors in the plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["hypotenuse", "length"]


def hypotenuse(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sqrt(x^2 + y^2)."""
    root = x * x
    root += y * y
    return np.sqrt(root, out=root)


def length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of vectors (..., 2): the same bits as np.linalg.norm's, in less time."""
    return hypotenuse(vectors[..., 0], vectors[..., 1])
