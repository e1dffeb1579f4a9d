"""Sheep and shepherd: the laws of Strombom et al. 2014, one sentence of the paper at a time."""

from __future__ import annotations

import numpy as np
import pytest

from flockenv import steering
from flockenv.steering.vectorize import rows

heed, behind, herd_from = rows(steering.heed), rows(steering.behind), rows(steering.herd_from)

ZERO = np.zeros(2)
PAPER = (0.5, 1.05, 2.0, 1.0, 0.3)  # h, c, rho_a, rho_s, e


def test_each_urge_alone_gives_its_own_direction() -> None:
    """To the centre, away from who is near, away from the dog, on as before: of any length, they count by direction."""
    way = np.array([3.0, -4.0])
    for place in range(5):
        urges = [way if k == place else ZERO for k in range(5)]
        np.testing.assert_allclose(heed(*urges, *PAPER), [0.6, -0.8], atol=1e-12)
    np.testing.assert_array_equal(heed(*[ZERO] * 5, *PAPER), ZERO)


def test_urges_add_up_by_their_weights() -> None:
    """Dog behind (rho_s = 1 along x), flock to the left (c = 1.05 along y): the angle is atan(1.05)."""
    way = heed(ZERO, [0.0, 7.0], ZERO, [0.2, 0.0], ZERO, *PAPER)
    np.testing.assert_allclose(way, np.array([1.0, 1.05]) / np.hypot(1.0, 1.05), atol=1e-12)
    crowded = heed(ZERO, ZERO, [-1.0, 0.0], [1.0, 0.0], ZERO, *PAPER)
    np.testing.assert_allclose(crowded, [-1.0, 0.0], atol=1e-12)  # rho_a > rho_s: nobody is trampled on


def test_behind_is_on_the_line_from_the_goal_through_it() -> None:
    np.testing.assert_allclose(behind([3.0, 0.0], [0.0, 4.0], 5.0), [3.0 + 3.0, -4.0], atol=1e-12)
    np.testing.assert_allclose(behind([3.0, 1.0], [3.0, 1.0], 5.0), [3.0, 1.0])  # at the goal it has no far side


@pytest.mark.parametrize(("stray", "place"), [(4.9, (-2.0, 0.0)), (5.1, (0.0, 6.1))])
def test_who_strays_is_collected_and_else_all_are_driven(stray: float, place: tuple[float, float]) -> None:
    """The centre is here, the pen 10 m along x, a sheep so far along y; within 5 m they are together."""
    found = herd_from(ZERO, [0.0, stray], [10.0, 0.0], 5.0, 1.0, 2.0)
    np.testing.assert_allclose(found, place, atol=1e-12)
