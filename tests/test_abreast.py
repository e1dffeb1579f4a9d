"""Agents abreast: columns of all agents' numbers become rows, of every size; views are what they say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from flockenv.abreast import SIDE, apart, columns, into_rows, packed


@njit
def turned(rows: Any, flat: Any, many: int, distance: int) -> None:
    """Number what agent i has in column k as 1000 k + i, and make rows of it."""
    beside = columns(flat, rows.shape[0], many, distance)
    for k in range(many):
        for i in range(rows.shape[0]):
            beside[i, k] = 1000 * k + i
    into_rows(rows, flat, many, distance)


@njit
def strides(array: Any, world: int) -> tuple[Any, Any, Any]:
    """Return strides of a packed view, and of one world in it, and what that holds."""
    view = packed(array)
    return view.strides, view[:, world].strides, view[:, world].copy()


@pytest.mark.parametrize("agents", [1, 2, 15, 16, 17, 31, 32, 33, 64, 65, 100])
@pytest.mark.parametrize("many", [1, 15, 16, 17, 32, 47, 50])
def test_columns_become_rows_and_nothing_else_is_touched(agents: int, many: int) -> None:
    distance = apart(agents)
    flat = np.full(many * distance + 7, -3, np.float32)
    room = np.full((3, agents, many + 5), -7, np.float32)
    turned(room[1], flat, many, distance)
    expected = 1000 * np.arange(many) + np.arange(agents)[:, None]
    np.testing.assert_array_equal(room[1, :, :many], expected)
    assert (room[1, :, many:] == -7).all() and (room[[0, 2]] == -7).all()
    written = np.zeros(flat.shape, bool)
    written[np.arange(many)[:, None] * distance + np.arange(agents)] = True
    assert (flat[~written] == -3).all()


def test_columns_have_room_and_do_not_lie_a_power_of_two_apart() -> None:
    for agents in (1, 24, 63, 64, 65, 1024, 1025, 100_000):
        distance = apart(agents)
        assert agents <= distance <= max(2 * agents, 64) + SIDE
        assert distance & (distance - 1) and distance % SIDE == 0
    assert apart(24) == apart(32) == apart(64)  # one kernel for all of them


def test_an_array_with_gaps_is_not_compiled_for() -> None:
    with pytest.raises(TypingError, match="one piece"):
        turned(np.zeros((20, 40), np.float32)[:, :20], np.zeros(20 * apart(20), np.float32), 20, apart(20))
    with pytest.raises(TypingError, match="one piece"):
        strides(np.zeros((2, 5, 8))[:, :, ::2], 3)


def test_a_packed_array_is_the_same_array() -> None:
    array = np.random.default_rng(1).normal(size=(2, 5, 7))
    whole, one, held = strides(array, 3)
    assert whole == array.strides
    assert one == array[:, 3].strides
    np.testing.assert_array_equal(held, array[:, 3])
