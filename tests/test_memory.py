"""Streaming stores, prefetches and arrays aligned to cache lines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from flockenv.jit.cpu import LINE
from flockenv.jit.memory import prefetch, store_fence, stream_store, zeros


@njit(nogil=True)
def stored(to: Any, at: int, source: Any) -> None:
    """Call `stream_store` as a kernel does."""
    stream_store(to, np.uint64(at), source)
    store_fence()


def aligned(count: int, kind: Any, past: int) -> Any:
    """Return `count` numbers -7 that begin `past` bytes behind the beginning of a cache line."""
    room = np.empty(count * np.dtype(kind).itemsize + 2 * LINE, np.uint8)
    start = -room.__array_interface__["data"][0] % LINE + past
    array = room[start : start + count * np.dtype(kind).itemsize].view(kind)
    array[:] = -7
    return array


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("past", [0, 8, 16, 56])
@pytest.mark.parametrize("count", [0, 1, 7, 8, 15, 16, 17, 31, 33, 64, 1001])
def test_a_streaming_store_writes_exactly_its_numbers_for_any_alignment(count: int, past: int, kind: Any) -> None:
    source = np.random.default_rng(count).normal(size=count).astype(kind)
    for at in (0, 1, 5, 16, 19):
        room = aligned(count + 40, kind, past)
        stored(room, at, source)
        np.testing.assert_array_equal(room[at : at + count], source)
        assert (room[:at] == -7).all() and (room[at + count :] == -7).all()


def test_a_streaming_store_writes_a_table_row_by_row() -> None:
    source = np.arange(12, dtype=np.float32).reshape(4, 3)
    room = np.zeros((3, 4, 3), np.float32)
    stored(room, 12, source)
    np.testing.assert_array_equal(room, [np.zeros((4, 3)), source, np.zeros((4, 3))])


def test_streaming_stores_refuse_another_dtype_and_arrays_with_gaps() -> None:
    with pytest.raises(TypingError, match="differ"):
        stored(np.zeros(4), 0, np.zeros(4, np.float32))
    for to, source in ((np.zeros((4, 4))[:, :2], np.zeros(4)), (np.zeros(4), np.zeros(8)[::2])):
        with pytest.raises(TypingError, match="contiguous"):
            stored(to, 0, source)


def test_streaming_stores_bypass_the_caches_and_a_fence_follows() -> None:
    """The LLVM code is tested because ordinary stores would give the same results."""
    stored(np.zeros(40, np.float32), 0, np.zeros(40, np.float32))
    texts = stored.inspect_llvm().values()
    assert texts and all("!nontemporal" in text and "fence seq_cst" in text for text in texts)


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32])
def test_zeros_begin_at_a_cache_line(kind: Any) -> None:
    kept = []
    for shape in (0, 1, 7, (3, 5), (2, 0, 4), (100, 33)):
        array = zeros(shape, kind)
        assert (array.shape, array.dtype) == (np.zeros(shape).shape, kind)
        assert array.ctypes.data % LINE == 0 and array.flags.carray and not array.any()
        array[...] = 1
        kept.append(array)
    assert all((array == 1).all() for array in kept)


@njit
def prefetched(array: Any, part: int, parts: int) -> None:
    """Call `prefetch` as a kernel does."""
    prefetch(array, part, parts)


def test_prefetching_does_not_change_memory() -> None:
    for size in (0, 1, 100):
        array = np.arange(size, dtype=np.float32)
        for part in range(4):
            prefetched(array, part, 4)
        np.testing.assert_array_equal(array, np.arange(size))
