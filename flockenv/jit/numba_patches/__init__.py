"""Patches of numba that make it compile faster; none changes a result, and each can be left out."""
