"""Distances around obstacles on a grid, against closed forms and against scikit-fmm."""

from __future__ import annotations

import numpy as np
import pytest
import skfmm
from numpy.typing import NDArray
from scipy import ndimage

from flockenv.geometry.eikonal import distances_around

Array = NDArray[np.float64]


def plane(spacing: float, size: float = 20.0) -> tuple[Array, Array]:
    """Return the coordinates of a square grid, m."""
    axis = np.arange(round(size / spacing) + 1) * spacing
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return x, y


def about(distance: Array, radius: float) -> Array:
    """Return the known distances, those up to `radius`, m; inf elsewhere."""
    return np.where(distance <= radius + 1e-9, distance, np.inf)


def behind_a_wall(spacing: float) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return the free points of a plane with a wall, straight distances from (5, 5), and those around the wall.

    The wall is at x = 10 m, from y = 0 to 12 m.
    """
    x, y = plane(spacing)
    free = ~((abs(x - 10) < 1.5 * spacing) & (y < 12 + spacing / 2))
    by_air, left, right = np.hypot(x - 5, y - 5), 10 - spacing, 10 + spacing  # the tip has two corners
    to_left = float(np.hypot(left - 5, 7))
    seen = (x <= left + 1e-9) | (y >= 5 + 7 / (left - 5) * (x - 5))
    around = np.where(seen, by_air, to_left + np.hypot(x - left, y - 12))
    shadow = (x > right) & (y < 12)
    return free, by_air, np.where(shadow, to_left + 2 * spacing + np.hypot(x - right, y - 12), around)


def test_errors_in_the_open_plane_are_of_second_order() -> None:
    """Half the spacing gives about a quarter of the error; the goal is the same disc of 0.8 m on each grid."""
    errors = []
    for spacing in (0.2, 0.1, 0.05):
        x, y = plane(spacing)
        exact = np.hypot(x - 7, y - 3)
        found = distances_around(np.ones(x.shape, bool), spacing, about(exact, 0.8))
        errors.append(abs(found - exact).max())
    assert errors[0] / errors[1] > 3
    assert errors[1] / errors[2] > 3


@pytest.mark.parametrize("goal", [(10.0, 10.0), (3.0, 7.0)])
def test_errors_in_the_open_plane_do_not_exceed_those_of_scikit_fmm(goal: tuple[float, float]) -> None:
    x, y = plane(0.05)
    exact, known = np.hypot(x - goal[0], y - goal[1]), 0.2
    found = distances_around(np.ones(x.shape, bool), 0.05, about(exact, known))
    theirs = skfmm.distance(exact - known, dx=0.05, order=2) + known
    assert abs(found - exact).max() <= abs(theirs - exact).max()
    assert abs(found - exact).max() < 0.01  # first order: 0.07


def test_errors_behind_a_wall_are_about_those_of_scikit_fmm() -> None:
    free, by_air, exact = behind_a_wall(0.05)
    found = distances_around(free, 0.05, about(by_air, 0.2))
    theirs = np.asarray(skfmm.distance(np.ma.MaskedArray(by_air - 0.2, ~free), dx=0.05, order=2)) + 0.2
    errors, their_errors = abs(found - exact)[free], abs(theirs - exact)[free]
    assert errors.max() <= 1.05 * their_errors.max()
    assert errors.mean() <= 1.05 * their_errors.mean()
    assert errors.max() < 0.16  # first order: 0.27


def test_errors_in_open_space_are_of_second_order() -> None:
    errors = []
    for spacing in (0.4, 0.2):
        axis = np.arange(round(8 / spacing) + 1) * spacing
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"))
        exact = np.linalg.norm(grid - np.reshape((3, 4, 4), (3, 1, 1, 1)), axis=0)
        found = distances_around(np.ones(exact.shape, bool), spacing, about(exact, 1.2))
        errors.append(abs(found - exact).max())
    assert errors[0] / errors[1] > 3


def test_unreachable_points_are_infinitely_far_and_walls_are_not_crossed() -> None:
    x, y = plane(0.1, 4.0)
    free = abs(x - 2) > 0.05
    found = distances_around(free, 0.1, about(np.hypot(x - 1, y - 2), 0.3))
    assert np.isinf(found[x > 1.95]).all()
    assert np.isfinite(found[x < 1.95]).all()


def test_all_connected_points_are_reached_and_no_path_cuts_an_obstacle() -> None:
    """Obstacles are random discs; a stencil across one would give less than the straight distance, by up to 0.4 m."""
    rng = np.random.default_rng(3)
    x, y = plane(0.1, 12.0)
    by_air = np.hypot(x - 6.05, y - 6.05)
    free = np.ones(x.shape, bool)
    for cx, cy, r in zip(*rng.uniform(0, 12, (2, 30)), rng.uniform(0.2, 0.8, 30), strict=True):
        free &= np.hypot(x - cx, y - cy) > r
    free |= by_air < 0.4
    found = distances_around(free, 0.1, about(by_air, 0.3))
    there = np.isfinite(found)
    pieces, _ = ndimage.label(free)
    np.testing.assert_array_equal(there, pieces == pieces[60, 60])
    assert (found - by_air)[there].min() > -0.05


def test_distances_are_found_to_the_end_of_a_long_maze() -> None:
    """The maze has 1,000 corridors, one point wide; a round of sweeps passes two corners."""
    corridors = 1000
    free = np.zeros((2 * corridors + 1, 5), bool)
    free[1::2, 1:4] = True
    free[2 * np.arange(1, corridors), np.where(np.arange(1, corridors) % 2, 3, 1)] = True
    begin = np.where(np.arange(free.size).reshape(free.shape) == 6, 0.0, np.inf)
    found = distances_around(free, 1.0, begin)
    assert np.isfinite(found[free]).all()
    assert 3 * (corridors - 1) < found[free].max() < 4 * corridors
