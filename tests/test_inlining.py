"""Loops over lanes stay loops until LLVM comes to make vectors of them; no other loop is touched."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

from flockenv.jit import pipeline
from flockenv.jit.decorators import kernel
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.pipeline import Whole

LANES = 8


def written_down(x: Any, y: Any, n: int) -> None:
    for l in range(np.uint64(8)):  # noqa: E741  # as in the files that are generated
        y[l + np.uint64(1)] = y[l] * x[l]  # one after the other: it stays a loop to the end


def of_the_module(x: Any, y: Any, n: int) -> None:
    lanes = np.uint64(LANES)
    for lane in range(lanes):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def within_another(x: Any, y: Any, n: int) -> None:
    k = 0
    while k < n:
        for lane in range(np.uint64(LANES)):
            if x[lane] > 0.0:
                y[lane + np.uint64(1)] = y[lane] * x[lane]
        k += 1


def with_two_ways_back(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(LANES)):
        if x[lane] > 0.0:
            continue
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def signed(x: Any, y: Any, n: int) -> None:
    for lane in range(LANES):
        y[lane + 1] = y[lane] * x[lane]


def as_many_as_it_says(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(n)):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def too_few(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(2)):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def from_one_on(x: Any, y: Any, n: int) -> None:
    for lane in range(np.uint64(1), np.uint64(LANES)):
        y[lane + np.uint64(1)] = y[lane] * x[lane]


def over_what_is_given(x: Any, y: Any, n: int) -> None:
    for number in x:
        y[0] = y[1] * number


def compiled(part: Callable[..., None]) -> Any:
    """Return an entry point that is made of one part."""
    inner: Any = kernel(part)

    def entry(x: Any, y: Any, n: int) -> None:
        unaliased()
        inner(x, y, n)

    made: Any = numba.njit(entry, pipeline_class=Whole, error_model="numpy", fastmath={"contract"}, _nrt=False)
    made.compile((numba.float64[::1], numba.float64[::1], numba.int64))
    return made


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What LLVM was told to keep, as it reads then."""
    seen: list[str] = []
    keep = pipeline._LanesStay._keep

    def note(lowering: Any, ways_back: list[Any]) -> None:
        keep(lowering, ways_back)
        seen.append("\n".join(map(str, ways_back)))

    monkeypatch.setattr(pipeline._LanesStay, "_keep", note)
    return seen


@pytest.mark.parametrize("part", [written_down, of_the_module, within_another, with_two_ways_back])
def test_a_loop_over_lanes_is_kept(part: Callable[..., None], kept: list[str]) -> None:
    made = compiled(part)
    assert len(kept) == 1
    assert "br label" in kept[0]
    assert "!llvm.loop" in kept[0]
    text = next(iter(made.inspect_llvm().values()))
    assert "llvm.loop.unroll.disable" in text  # one agent after the other cannot be made a vector: it is there still


@pytest.mark.parametrize("part", [signed, as_many_as_it_says, too_few, from_one_on, over_what_is_given])
def test_no_other_loop_is(part: Callable[..., None], kept: list[str]) -> None:
    compiled(part)
    assert kept == []
    assert pipeline.FEWEST_LANES <= LANES


@pytest.mark.parametrize("part", [written_down, within_another, with_two_ways_back, signed])
def test_the_loop_does_what_it_says(part: Callable[..., None]) -> None:
    x, y = np.linspace(-0.5, 1.5, 10), np.linspace(1, 2, 10)
    expected = y.copy()
    part(x, expected, 2)
    compiled(part)(x, y, 2)
    np.testing.assert_array_equal(y, expected)


def in_lanes(x: Any, y: Any, n: int) -> None:
    """As short as a law that LLVM would unroll first: a guarded division."""
    for lane in range(np.uint64(LANES)):
        square = x[lane] * x[lane]
        y[lane] = 1.0 / np.sqrt(square) if square > 0.0 else 0.0


def test_what_is_made_of_it_is_vectors() -> None:
    text = next(iter(compiled(in_lanes).inspect_llvm().values()))
    assert re.search(r"fdiv (contract )?<\d+ x double>", text)
    assert not re.search(r"fdiv (contract )?double", text)
    x, y = np.array([0.0, 1, 2, -4, 0, 5, 6, 8]), np.full(8, np.nan)
    compiled(in_lanes)(x, y, 0)
    np.testing.assert_array_equal(y, [0, 1, 0.5, 0.25, 0, 1 / 5, 1 / 6, 1 / 8])


def chain(length: int) -> Callable[[float], float]:
    """Return a kernel that calls a kernel, and so on, as what a scene's effects come to is added up."""
    before: Any = chain(length - 1) if length > 1 else None

    def add_one(x: float) -> float:
        return x + 1.0 if before is None else before(x) + 1.0

    return kernel(add_one)


def test_calls_within_calls_compile_however_deep() -> None:
    add_all: Any = chain(60)
    compiled: Any = numba.njit(lambda x: add_all(x), pipeline_class=Whole)
    assert compiled(0.5) == 60.5
