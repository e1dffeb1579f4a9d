"""SIMD rows: columns of all sizes are transposed to rows, arrays viewed without copies, and table entries looked up."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from flockenv.jit import cpu
from flockenv.jit.simd_rows import PAIR, SIDE, as_contiguous, column_distance, columns, flatten, into_rows, take


@njit
def turned(rows: Any, flat: Any, many: int, distance: int) -> None:
    """Write 1000 k + i into column k of agent i, and transpose the columns to rows."""
    beside = columns(flat, rows.shape[0], many, distance)
    for k in range(many):
        for i in range(rows.shape[0]):
            beside[i, k] = 1000 * k + i
    into_rows(rows, flat, many, distance)


@njit
def strides(array: Any, world: int) -> tuple[Any, Any, Any]:
    """Return the strides of a packed view and of one world in it, and a copy of that world."""
    view = as_contiguous(array)
    return view.strides, view[:, world].strides, view[:, world].copy()


@pytest.mark.parametrize("agents", [1, 2, 15, 16, 17, 31, 32, 33, 64, 65, 100])
@pytest.mark.parametrize("many", [1, 15, 16, 17, 32, 47, 50])
def test_into_rows_transposes_columns_and_writes_nothing_else(agents: int, many: int) -> None:
    distance = column_distance(agents)
    flat = np.full(many * distance + 7, -3, np.float32)
    room = np.full((3, agents, many + 5), -7, np.float32)
    turned(room[1], flat, many, distance)
    expected = 1000 * np.arange(many) + np.arange(agents)[:, None]
    np.testing.assert_array_equal(room[1, :, :many], expected)
    assert (room[1, :, many:] == -7).all() and (room[[0, 2]] == -7).all()
    written = np.zeros(flat.shape, bool)
    written[np.arange(many)[:, None] * distance + np.arange(agents)] = True
    assert (flat[~written] == -3).all()


def test_columns_fit_all_agents_and_their_distance_is_no_power_of_two() -> None:
    for agents in (1, 24, 63, 64, 65, 1024, 1025, 100_000):
        distance = column_distance(agents)
        assert agents <= distance <= max(2 * agents, 64) + SIDE
        assert distance & (distance - 1) and distance % SIDE == 0
    assert column_distance(24) == column_distance(32) == column_distance(64)  # one kernel for all of them


def test_noncontiguous_arrays_are_refused_at_compile_time() -> None:
    with pytest.raises(TypingError, match="contiguous"):
        turned(
            np.zeros((20, 40), np.float32)[:, :20],
            np.zeros(20 * column_distance(20), np.float32),
            20,
            column_distance(20),
        )
    with pytest.raises(TypingError, match="contiguous"):
        strides(np.zeros((2, 5, 8))[:, :, ::2], 3)


def test_a_packed_array_keeps_its_strides_and_numbers() -> None:
    array = np.random.default_rng(1).normal(size=(2, 5, 7))
    whole, one, held = strides(array, 3)
    assert whole == array.strides
    assert one == array[:, 3].strides
    np.testing.assert_array_equal(held, array[:, 3])


@njit
def row_of(array: Any) -> tuple[int, Any]:
    """Return the length of the array in one row, and a copy of that row."""
    row = flatten(array)
    return row.shape[0], row.copy()


@pytest.mark.parametrize("shape", [(7,), (2, 0, 3), (4, 1), (3, 5, 2)])
def test_an_array_in_one_row_keeps_its_numbers_in_order(shape: tuple[int, ...]) -> None:
    array = np.random.default_rng(1).normal(size=shape)
    length, row = row_of(array)
    assert length == array.size
    np.testing.assert_array_equal(row, array.ravel())


@njit
def taken(to: Any, table: Any, indices: Any, count: int) -> None:
    """Call `take` from compiled code."""
    take(to, table, indices, count)


@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize("count", [1, 2, 15, 16, 17, 31, 32, 33, 63, 64, 65, 100, 128, 129, 300])
def test_take_returns_the_entries_at_the_indices(count: int, real: str) -> None:
    """Tables fill one pair of registers, several pairs, or more than the register form handles."""
    long, many, listed = -(-count // PAIR) * PAIR, 3, 2
    rng = np.random.default_rng(count)
    table = rng.normal(size=(many + 1, long)).astype(real)
    table[:, count:] = np.nan
    indices = rng.integers(0, count, (listed, long)).astype(np.int32)
    indices[0, 0], indices[-1, -1] = count - 1, 0
    room = np.full((3, many, listed, long), -7, real)
    taken(room[1], table, indices, count)
    np.testing.assert_array_equal(room[1], table[:many][:, indices])
    assert (room[[0, 2]] == -7).all()


def test_take_uses_permutations_of_registers_if_the_processor_has_them() -> None:
    """No other test would notice its loss: results are the same."""
    if "avx2" not in cpu.FEATURES:
        pytest.skip("the target processor has no AVX2")
    long = "avx512f" in cpu.FEATURES
    kinds = (np.float32, np.float64) if long else (np.float32,)  # AVX2: single precision only
    for real in kinds:
        room, table = np.zeros((3, 2, PAIR), real), np.zeros((3, PAIR), real)
        taken(room, table, np.zeros((2, PAIR), np.int32), PAIR)
    texts = [text for kind, text in taken.inspect_asm().items() if str(kind[0].dtype) in map(str, map(np.dtype, kinds))]
    assert len(texts) >= len(kinds)
    assert all(re.search("vperm[it]2p" if long else "vperm(ps|d)", text) for text in texts)


ONE_BY_ONE = """
import numpy as np
from flockenv.tasks import Flock
from flockenv.envs.world import World
world = World(Flock(agents=24, dtype="float32"), 3)
world.reset(0)
for actions in np.random.default_rng(0).uniform(-1, 1, (20, 3, 24, 2)):
    step = world.step(actions)
print(float(np.abs(step.observation).sum()), step.terms.sum().round(6), world.state.x.sum())
"""


@pytest.mark.slow
def test_a_processor_without_permutations_gives_the_same_results(tmp_path: Path) -> None:
    """The same flock runs compiled for this processor and for x86-64-v2."""
    printed, other = [], {"NUMBA_CPU_NAME": "x86-64-v2", "NUMBA_CPU_FEATURES": "", "FLOCKENV_CACHE": str(tmp_path)}
    for chosen in ({}, other):
        done = subprocess.run(
            [sys.executable, "-c", ONE_BY_ONE], env={**os.environ, **chosen},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        printed.append([float(word) for word in done.stdout.split()])
    assert printed[0] == pytest.approx(printed[1], rel=1e-5)
