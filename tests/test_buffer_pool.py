"""Buffer pool: memory is reused only when nothing refers to it any more."""

import itertools
import pickle

import numpy as np
import pytest
import torch

from flockenv.jit.buffer_pool import BufferPool

F4 = np.dtype(np.float32)


def address(array):
    return array.__array_interface__["data"][0]


def maker_of(recycler):
    """Return a function that makes arrays of any shape and dtype."""
    return lambda shape, dtype: recycler.maker(shape, dtype)()


def test_memory_of_released_arrays_is_reused():
    make = maker_of(BufferPool())
    first = make((3, 4), F4)
    second = make((3, 4), F4)
    addresses = {address(first), address(second)}
    assert len(addresses) == 2
    del first
    for _ in range(10):
        first = None
        first = make((3, 4), F4)
        assert {address(first), address(second)} == addresses


@pytest.mark.parametrize("line", [1, 16, 64, 4096])
def test_arrays_are_aligned_to_lines(line):
    make = maker_of(BufferPool(keep=2, line=line))
    for shape in ((0,), (1,), (3, 5), (1000,)):
        held = [make(shape, F4) for _ in range(4)]
        again = {address(array) for array in held[:2]}
        assert all(address(array) % line == 0 for array in held)
        assert all(array.flags.carray and array.shape == shape for array in held)
        del held
        assert {address(array) for array in [make(shape, F4), make(shape, F4)]} <= again


HOLDERS = {
    "array": lambda array: array,
    "view": lambda array: array.reshape(-1)[3:5],
    "view of a view": lambda array: array.T[::-1][1:][:, 2],
    "memoryview": memoryview,
    "from a buffer": lambda array: np.frombuffer(memoryview(array.reshape(-1)), F4),
    "torch": torch.from_numpy,
    "torch view": lambda array: torch.from_numpy(array).view(-1)[2:],
    "dlpack": torch.from_dlpack,
    "strided": lambda array: np.lib.stride_tricks.as_strided(array, (2, 2), (8, 4)),
    "iterator": lambda array: iter(array.reshape(-1)),
    "broadcast": lambda array: np.broadcast_to(array, (5, *array.shape)),
}


@pytest.mark.parametrize("hold", HOLDERS.values(), ids=HOLDERS)
def test_memory_is_not_reused_while_anything_refers_to_it(hold):
    make = maker_of(BufferPool(keep=2))
    array = make((3, 4), F4)
    place = address(array)
    held = hold(array)
    del array
    others = [make((3, 4), F4) for _ in range(5)]
    assert place not in map(address, others)
    assert not any(np.shares_memory(a, b) for a, b in itertools.combinations(others, 2))
    del held
    assert place in [address(other) for other in [make((3, 4), F4)]]


def test_pool_keeps_at_most_the_given_number_of_buffers():
    recycler = BufferPool(keep=3)
    many = [recycler.maker((2,), F4)() for _ in range(8)]
    places = [address(array) for array in many]
    assert len(set(places)) == 8
    assert [len(kept) for kept in recycler._kept.values()] == [3]
    del many
    again = [recycler.maker((2,), F4)() for _ in range(3)]
    assert {address(array) for array in again} == set(places[:3])


def test_arrays_of_each_shape_and_dtype_are_pooled_separately():
    make = maker_of(BufferPool())
    shapes = [((6,), F4), ((2, 3), F4), ((6,), np.dtype(np.int32)), ((6,), np.dtype(bool))]
    for shape, dtype in [*shapes, *shapes[::-1]]:
        array = make(shape, dtype)
        assert (array.shape, array.dtype) == (shape, dtype)
        assert array.flags.c_contiguous
        del array


def test_flags_set_on_an_array_do_not_persist_in_reused_memory():
    make = maker_of(BufferPool(keep=1))
    places = set()
    for _ in range(3):
        array = make((6,), F4)
        places.add(address(array))
        assert array.flags.writeable
        array.setflags(write=False)
        del array
    assert len(places) == 1


def test_arrays_can_be_pickled():
    array = BufferPool().maker((2, 3), F4)()
    array[:] = 4
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(array)), array)
