"""Loops over lanes become vector code, and all loops give the results of Python."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

from flockenv.jit.decorators import kernel
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.pipeline import Whole

LANES = 8


def literal_count(x: Any, y: Any, n: int) -> None:
    for l in range(np.uint64(8)):  # noqa: E741  # as in generated files
        y[l + np.uint64(1)] = y[l] * x[l]  # each element needs the one before: LLVM cannot vectorize it


def module_constant(x: Any, y: Any, n: int) -> None:
    lanes = np.uint64(LANES)
    for lane in range(lanes):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def nested(x: Any, y: Any, n: int) -> None:
    k = 0
    while k < n:
        for lane in range(np.uint64(LANES)):
            if x[lane] > 0.0:
                y[lane + np.uint64(1)] = y[lane] * x[lane]
        k += 1


def with_continue(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(LANES)):
        if x[lane] > 0.0:
            continue
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def signed(x: Any, y: Any, n: int) -> None:
    for lane in range(LANES):
        y[lane + 1] = y[lane] * x[lane]


def variable_count(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(n)):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def too_few(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(2)):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def starting_at_one(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(1), np.uint64(LANES)):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def over_an_array(x: Any, y: Any, n: int) -> None:
    for number in x:
        y[0] = y[1] * number


def compiled(part: Callable[..., None]) -> Any:
    """Return an entry point that calls one kernel."""
    inner: Any = kernel(part)

    def entry(x: Any, y: Any, n: int) -> None:
        unaliased()
        inner(x, y, n)

    entry_point: Any = numba.njit(entry, pipeline_class=Whole, error_model="numpy", fastmath={"contract"}, _nrt=False)
    entry_point.compile((numba.float64[::1], numba.float64[::1], numba.int64))
    return entry_point


LOOPS = (
    literal_count, module_constant, nested, with_continue, signed, variable_count, too_few, starting_at_one,
    over_an_array,
)  # fmt: skip


@pytest.mark.parametrize("part", LOOPS)
def test_a_compiled_loop_gives_the_results_of_python(part: Callable[..., None]) -> None:
    x, y = np.linspace(-0.5, 1.5, 10), np.linspace(1, 2, 10)
    expected = y.copy()
    part(x, expected, 2)
    compiled(part)(x, y, 2)
    np.testing.assert_array_equal(y, expected)


def in_lanes(x: Any, y: Any, n: int) -> None:
    """Divide with a guard; LLVM would unroll a loop as short as this before it vectorizes."""
    for lane in range(np.uint64(LANES)):
        square = x[lane] * x[lane]
        y[lane] = 1.0 / np.sqrt(square) if square > 0.0 else 0.0


def test_a_loop_over_lanes_becomes_vector_instructions() -> None:
    text = next(iter(compiled(in_lanes).inspect_llvm().values()))
    assert re.search(r"fdiv (contract )?<\d+ x double>", text)
    assert not re.search(r"fdiv (contract )?double", text)
    x, y = np.array([0.0, 1, 2, -4, 0, 5, 6, 8]), np.full(8, np.nan)
    compiled(in_lanes)(x, y, 0)
    np.testing.assert_array_equal(y, [0, 1, 0.5, 0.25, 0, 1 / 5, 1 / 6, 1 / 8])


def chain(length: int) -> Callable[[float], float]:
    """Return a kernel that calls a kernel, and so on, like the sum over the effects of a scene."""
    before: Any = chain(length - 1) if length > 1 else None

    def add_one(x: float) -> float:
        return x + 1.0 if before is None else before(x) + 1.0

    return kernel(add_one)


def test_deeply_nested_kernels_compile() -> None:
    add_all: Any = chain(60)
    compiled: Any = numba.njit(lambda x: add_all(x), pipeline_class=Whole)
    assert compiled(0.5) == 60.5
