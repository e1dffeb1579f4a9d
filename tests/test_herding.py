"""Sheep and shepherd: the laws of Strombom et al. 2014."""

from __future__ import annotations

import numpy as np
import pytest

from flockenv import steering
from flockenv.steering.vectorize import rows

heed, behind, herd_from = rows(steering.sheep_direction), rows(steering.point_behind), rows(steering.herding_offset)

ZERO = np.zeros(2)
PAPER = (0.5, 1.05, 2.0, 1.0, 0.3)  # h, c, rho_a, rho_s, e


def test_each_vector_alone_sets_the_direction() -> None:
    """Only the direction of a vector counts, not its length."""
    vector = np.array([3.0, -4.0])
    for place in range(5):
        vectors = [vector if k == place else ZERO for k in range(5)]
        np.testing.assert_allclose(heed(*vectors, *PAPER), [0.6, -0.8], atol=1e-12)
    np.testing.assert_array_equal(heed(*[ZERO] * 5, *PAPER), ZERO)


def test_directions_add_up_by_their_weights() -> None:
    """Dog behind (rho_s = 1 along x), flock to the left (c = 1.05 along y): the angle is atan(1.05)."""
    vector = heed(ZERO, [0.0, 7.0], ZERO, [0.2, 0.0], ZERO, *PAPER)
    np.testing.assert_allclose(vector, np.array([1.0, 1.05]) / np.hypot(1.0, 1.05), atol=1e-12)
    crowded = heed(ZERO, ZERO, [-1.0, 0.0], [1.0, 0.0], ZERO, *PAPER)
    np.testing.assert_allclose(crowded, [-1.0, 0.0], atol=1e-12)  # rho_a > rho_s: sheep outweigh the dog


def test_behind_is_on_the_line_from_the_goal_through_it() -> None:
    np.testing.assert_allclose(behind([3.0, 0.0], [0.0, 4.0], 5.0), [3.0 + 3.0, -4.0], atol=1e-12)
    np.testing.assert_allclose(behind([3.0, 1.0], [3.0, 1.0], 5.0), [3.0, 1.0])  # at the goal no direction is behind


@pytest.mark.parametrize(("stray", "place"), [(4.9, (-2.0, 0.0)), (5.1, (0.0, 6.1))])
def test_a_stray_is_collected_and_a_flock_without_strays_is_driven(stray: float, place: tuple[float, float]) -> None:
    """The dog is at the centre, the pen 10 m along x, the farthest sheep `stray` m along y; 5 m is together."""
    found = herd_from(ZERO, [0.0, stray], [10.0, 0.0], 5.0, 1.0, 2.0)
    np.testing.assert_allclose(found, place, atol=1e-12)
