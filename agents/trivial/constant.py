"""Pushes with full force along the first axis of its frame."""

import numpy as np


def predict(observation):
    """Return the same action for every row."""
    return np.tile(np.float32([1.0, 0.0]), (len(observation), 1))
