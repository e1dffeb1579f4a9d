"""Tiles: agents that have left their home tile are listed, and the cells that they are in now are sorted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.geometry.cell_list import count_cells
from flockenv.geometry.spatial_sort import HOME, TILE, count_from_home_tiles, count_tiles, find_home_tiles, order_cells
from flockenv.jit.section import entry

LANES, AGENTS = 16, 5003


def in_blocks(x: Any) -> Any:
    """Return positions (N, D) in the layout of kernels: blocks of (D, LANES)."""
    n, d = x.shape
    padded = np.zeros((-(-n // LANES) * LANES, d), x.dtype)
    padded[:n] = x
    return padded.reshape(-1, LANES, d).transpose(0, 2, 1).reshape(-1).copy()


@pytest.mark.parametrize("stride", [0.0, 0.2, 3.0, 100.0])  # m, largest distance along an axis since agents were sorted
@pytest.mark.parametrize("empty", [0.0, 0.8])  # share of the box with few agents: there a block has many tiles
@pytest.mark.parametrize("size", [(70.0, 50.0), (17.0, 15.0, 16.0)])
def test_cells_with_agents_from_other_tiles_are_sorted_by_agent_number(size: Any, empty: float, stride: float) -> None:
    rng = np.random.default_rng(7)
    n, d, blocks = AGENTS, len(size), -(-AGENTS // LANES)
    x = rng.uniform(0, size, (n, d)).astype(np.float32)
    few = rng.random(n) < 0.97
    x[few, 0] *= 1 - empty
    living = np.r_[np.ones(n), np.zeros(blocks * LANES - n)].astype(np.float32)

    def counted(kernel: Any, at: Any, *more: Any) -> tuple[Any, Any, Any]:
        cell, start = np.zeros(blocks * LANES, np.int32), np.zeros(n + 1, np.int32)
        shape = entry(kernel)(
            in_blocks(at), living, 0, blocks, LANES, 0, 1, np.zeros(8, np.int64), np.zeros((1, 6)), size, 2.0, True,
            True, n, *more, cell, start, np.zeros((1, n), np.int32),
        )  # fmt: skip
        return shape, cell[:n], start

    shape, tile, start = counted(count_tiles, x)
    nx, ny, nz, fine, _ = shape
    edge = max(1, round((TILE * nx * ny * nz / n / fine) ** (1 / (2 if nz == 1 else 3))))
    along, up = -(-nx // (edge * fine)), -(-ny // edge)
    assert min(along, up) > 1
    whose = counted(count_cells, x)[1]
    x_of, y_of, z_of = whose % nx // (edge * fine), whose // nx % ny // edge, whose // nx // ny // edge
    np.testing.assert_array_equal(tile, (z_of * up + y_of) * along + x_of)
    ident = np.argsort(tile, kind="stable")
    home = tile[ident]
    home_tiles, displaced = np.zeros(blocks * HOME, np.int32), np.full(n + 1, -7, np.int32)
    entry(find_home_tiles)(0, blocks, LANES, n, shape, start, home_tiles)
    moved = ((x[ident] + rng.uniform(-stride, stride, (n, d))) % size).astype(np.float32)
    tally = np.zeros(2, np.int64)
    again, cell, start = counted(count_from_home_tiles, moved, home_tiles, displaced, tally)
    plain, expected, begins = counted(count_cells, moved)
    assert shape == again == plain
    np.testing.assert_array_equal(cell, expected)
    np.testing.assert_array_equal(start, begins)
    many = [len(set(home[k : k + LANES])) > 2 for k in range(0, n, LANES)]  # such a block has no home tile
    away = (counted(count_tiles, moved)[1] != home) | np.repeat(many, LANES)[:n]
    assert any(many) == (empty > 0)
    np.testing.assert_array_equal(displaced[: tally[1]], cell[away])

    place = np.argsort(cell, kind="stable")  # the order in which agents are put into cells
    numbers = ident.astype(np.float32)
    records = np.column_stack([place, place + 0.5, -place]).astype(np.float32)
    ends = start[1:][None].copy()
    flat = records.reshape(-1).copy()
    entry(order_cells)(flat, 3, numbers, start, ends, 0, displaced, 0, int(tally[1]))
    np.testing.assert_array_equal(flat.reshape(n, 3), records[np.lexsort((ident[place], cell[place]))])
    assert (flat != records.reshape(-1)).any() == (stride > 0)
    assert (ends[0, displaced[: tally[1]]] == -1).all()  # each cell is sorted once, for any number of displaced agents
