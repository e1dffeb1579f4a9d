"""Blocks of lanes to records and back: the same as numpy's transpose, for several lengths and both precisions."""

from typing import Any

import numba
import numpy as np
import pytest

from flockenv.jit.cpu import LINE
from flockenv.jit.transpose import out_of_records, put_lines, put_records

LENGTHS = [3, 8, 17, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 6, 9, 16, 20))]
WIDTHS = [("float32", 16), ("float32", 8), ("float64", 8), ("float64", 4), ("float64", 16)]


def compiled(length: int, width: int) -> Any:
    """Return `put_records` and `out_of_records` as functions of arrays, for records of that length."""
    numbers = range(length - 1)
    sources, places = "lanes, " * len(numbers), "".join(f"np.uint64(at + {k * width}), " for k in numbers)
    taken = "".join(f"np.uint64(at + {k * width}), " for k in range(-1, length - 1))
    namespace: dict[str, Any] = {"np": np, "put_records": put_records, "out_of_records": out_of_records}
    exec(  # noqa: S102  # the number of sources is part of a type
        "def put(records, lanes, at, cell, first, offset, spare):\n"
        f"    put_records(records, ({sources}), ({places}), {width}, cell, np.uint64(first), offset, np.uint64(spare)"
        ")\n"
        "def take(lanes, at, first, records):\n"
        f"    out_of_records(lanes, ({taken}), np.uint64(first), {width}, records)\n",
        namespace,
    )
    return numba.njit(namespace["put"]), numba.njit(namespace["take"])


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize(("dtype", "width"), WIDTHS)
def test_records_are_transposed_lanes(dtype: str, width: int, length: int) -> None:
    put, take = compiled(length, width)
    rng, n, rows = np.random.default_rng(length), 3 * width, 1 << (length - 1).bit_length()
    lanes = rng.random((length + 1) * width).astype(dtype)  # two rows that are not read, then the numbers
    cell, begin = rng.integers(-1, 4, n).astype(np.int32), np.arange(4, dtype=np.int32) * (n // 4)
    cell[width + 1] = -1  # its record goes to the spare place
    records = np.full((n + 1) * length + rows, -7, dtype)
    offset, expected = begin.copy(), np.full((n, length), -7, dtype)
    put(records, lanes, 2 * width, cell, width, offset, n)
    for lane, c in enumerate(cell[width : 2 * width]):  # the second block
        if c >= 0:
            expected[begin[c]] = [width + lane, *lanes.reshape(-1, width)[2:, lane]]
            begin[c] += 1
    np.testing.assert_array_equal(records[: n * length].reshape(n, length), expected)
    np.testing.assert_array_equal(records[(n + 1) * length :], -7)  # nothing is written beyond the spare place
    np.testing.assert_array_equal(offset, begin)
    records = rng.random(len(records)).astype(dtype)
    several = records[3 * length : (3 + width) * length].reshape(width, length)
    several[:, 0] = rng.integers(0, 2**24, width)
    before = lanes.copy()
    take(lanes, 2 * width, 3, records)
    np.testing.assert_array_equal(lanes.reshape(-1, width)[1:], several.T)  # the index of the agent, and its numbers
    np.testing.assert_array_equal(lanes[:width], before[:width])


@pytest.mark.parametrize("count", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 8, 11, 16)), 19, 33])
@pytest.mark.parametrize(("dtype", "width"), WIDTHS)
def test_lines_are_transposed_lanes(dtype: str, width: int, count: int) -> None:
    side = LINE // np.dtype(dtype).itemsize
    length = max(-(-count // side) * side, side)
    sources, places = "lanes, " * count, "".join(f"np.uint64(at + {k * width}), " for k in range(count))
    namespace: dict[str, Any] = {"np": np, "put_lines": put_lines}
    exec(  # noqa: S102  # the number of sources is part of a type
        "def put(lines, lanes, at, to, first, spare):\n"
        f"    put_lines(lines, ({sources}), ({places}), {width}, to, np.uint64(first), {length}, np.uint64(spare))\n",
        namespace,
    )
    rng, n = np.random.default_rng(count), 3 * width
    raw = np.full((n + 2) * length + side, -7, dtype)
    begin = -raw.ctypes.data % LINE // raw.itemsize
    lines = raw[begin : begin + (n + 1) * length]
    lanes = rng.random((count + 1) * width).astype(dtype)
    to = rng.permutation(n).astype(np.int32)
    to[width + 2] = -1  # its numbers go to the spare place
    numba.njit(namespace["put"])(lines, lanes, width, to, width, n)
    found = lines.reshape(n + 1, length)
    here = to[width : 2 * width]
    np.testing.assert_array_equal(found[here, :count], lanes.reshape(count + 1, width)[1:].T)
    others = np.setdiff1d(np.arange(n), here)
    np.testing.assert_array_equal(found[others], -7)
    np.testing.assert_array_equal(raw[:begin], -7)
    np.testing.assert_array_equal(raw[begin + (n + 1) * length :], -7)


def test_a_width_that_is_not_a_literal_is_refused() -> None:
    @numba.njit
    def take(numbers, records, width):
        out_of_records(numbers, (np.uint64(0),), np.uint64(0), width, records)

    with pytest.raises(numba.TypingError, match="must be an integer literal"):
        take(np.zeros(64), np.zeros(64), 8)
