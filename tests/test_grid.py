"""Interpolation on a grid: exact for functions that are linear along each axis."""

from __future__ import annotations

import numpy as np
import pytest

from flockenv.maths.grid import pack_grid, points_of, sample_points

LOW, SPACING, COUNTS = (-1.0, 2.0, 0.5), 0.25, (9, 7, 5)


def table(dimension: int) -> np.ndarray:
    at = points_of(LOW[:dimension], SPACING, COUNTS[:dimension])
    slope = np.array([2.0, -3.0, 0.5])[:dimension]
    return pack_grid(np.stack([at @ slope + 1, at[..., 0] * at[..., 1]], axis=-1), LOW[:dimension], SPACING)


@pytest.mark.parametrize("dimension", [2, 3])
def test_interpolation_is_linear_along_each_axis(dimension: int) -> None:
    low = np.array(LOW[:dimension])
    high = low + SPACING * (np.array(COUNTS[:dimension]) - 1)
    where = np.random.default_rng(1).uniform(low, high, (400, dimension))
    found = sample_points(table(dimension), where)
    np.testing.assert_allclose(found[:, 0], where @ np.array([2.0, -3.0, 0.5])[:dimension] + 1, atol=1e-12)
    # x y is linear along each axis: bilinear interpolation is exact, the nearest point is not.
    np.testing.assert_allclose(found[:, 1], where[:, 0] * where[:, 1], atol=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_points_outside_get_the_value_of_the_nearest_edge(dimension: int) -> None:
    low = np.array(LOW[:dimension])
    high = low + SPACING * (np.array(COUNTS[:dimension]) - 1)
    where = np.random.default_rng(2).uniform(-1e3, 1e3, (400, dimension))
    where[:3] = [low, high, np.full(dimension, np.nan)]
    found = sample_points(table(dimension), where)
    inside = np.clip(np.nan_to_num(where, nan=-np.inf), low, high)
    np.testing.assert_allclose(found, sample_points(table(dimension), inside), atol=1e-9)


@pytest.mark.parametrize(
    ("values", "spacing", "text"),
    [
        (np.zeros((3, 3)), 1.0, "must have 2 axes of points"),
        (np.zeros((1, 3, 1)), 1.0, "at least 2 points"),
        (np.zeros((3, 3, 1)), 0.0, "spacing = 0, must be positive"),
        (np.full((3, 3, 1), np.nan), 1.0, "must be finite"),
    ],
)
def test_invalid_grids_are_refused(values: np.ndarray, spacing: float, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        pack_grid(values, (0.0, 0.0), spacing)
