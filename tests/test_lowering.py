"""Shorter LLVM code for arrays, loops and calls: results equal those of numba's own code and of numpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from flockenv.jit.decorators import kernel
from flockenv.jit.numba_patches import front_end, lowering
from flockenv.jit.pipeline import Whole

PLACES = {
    1: ["i", "u", "-i", "0", "-1", "k", ":", ":0", ":2", "2:", "1:3", "5:2", "9:", ":99", "i:", ":-1", "::2"],
    2: [
        "i, j", "u, i", "-i, u", "0, i", "k, u", ":, i", "i, :", "i", "u", "0", ":", ":0", "1:", ":2, 1:3", "0, :",
        ":, u", "1:, -1", "..., i", "i, j:",
    ],
    3: ["i, u, i", ":, i", "i, j", ":, :, i", "i", "i, :, u", ":0", "1:, i, :2", ":, 0", "0, 1, 2", "0, 1", ":, 1:, i"],
}  # fmt: skip
"""Indices by the dimensions of the array; for the last ones of a row, numba's own code is used."""

ARRAYS = {
    "contiguous": np.arange(7.0),
    "strided": np.arange(14.0)[::2],
    "of_integers": np.arange(6, dtype=np.int32),
    "table": np.arange(12.0).reshape(3, 4),
    "every_second_column": np.arange(24.0).reshape(3, 8)[:, ::2],
    "of_single_precision": np.arange(12, dtype=np.float32).reshape(3, 4),
    "box": np.arange(24.0).reshape(2, 3, 4),
    "of_flags": np.arange(24).reshape(2, 3, 4) > 5,
    "box_without_its_middle": np.arange(40.0).reshape(2, 5, 4)[:, ::2],
}

REPORTS = {
    0: """
    out[{n}, 0] = r
""",
    1: """
    for q in range(r.shape[0]):
        out[{n}, 4 + q] = r[q]
""",
    2: """
    for q in range(r.shape[0]):
        for w in range(r.shape[1]):
            out[{n}, 4 + 9 * q + w] = r[q, w]
""",
    3: """
    for q in range(r.shape[0]):
        for w in range(r.shape[1]):
            for z in range(r.shape[2]):
                out[{n}, 4 + 81 * q + 9 * w + z] = r[q, w, z]
""",
}
"""Code that records a part of an array, by its dimensions."""


def compiled_whole(function: Callable[..., Any]) -> Any:
    """Return the function compiled as an entry point."""
    options: Any = {"pipeline_class": Whole, "error_model": "numpy", "_nrt": False}
    return numba.njit(**options)(function)


def looking_at(array: Any) -> Callable[..., None]:
    """Return a function that reads all parts PLACES of an array and records them."""
    text = "def looking(a, i, j, k, u, out):\n"
    for n, places in enumerate(PLACES[array.ndim]):
        dimension = np.ndim(eval(f"a[{places}]", {"a": array, "i": 1, "j": 1, "k": np.int32(1), "u": np.uint64(1)}))  # noqa: S307
        text += f"    r = a[{places}]\n"
        if dimension:
            for k, known in enumerate(("size", "shape[-1]", "strides[0]", "itemsize")):
                text += f"    out[{n}, {k}] = r.{known}\n"
        text += REPORTS[dimension].format(n=n)
    made: dict[str, Any] = {}
    exec(text, made)  # noqa: S102
    looking: Callable[..., None] = made["looking"]
    return looking


@pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS)
def test_parts_of_arrays_are_those_of_numpy(array: Any) -> None:
    looking = looking_at(array)
    compiled = compiled_whole(looking)
    for i, j in ((1, 1), (0, 2), (-1, 0)):
        expected, seen = np.full((2, len(PLACES[array.ndim]), 200), np.nan)
        looking(array, i, j, np.int32(-i), np.uint64(1), expected)
        compiled(array, i, j, np.int32(-i), np.uint64(1), seen)
        np.testing.assert_array_equal(seen, expected)


def writing(line: Any, table: Any, flags: Any, i: int, u: Any) -> None:
    line[i] = 1
    line[-1] = 2.5
    line[u] = flags[0]
    table[i, u] = 3
    table[-1, -1] = line[0] > 0
    table[0] = 7
    table[1, 1:] = 8
    flags[u] = True
    flags[i - 1] = table[0, 0] > 100


def test_numbers_are_written_to_the_same_places_as_by_numpy() -> None:
    compiled = compiled_whole(writing)
    for kind in (np.float32, np.float64):
        for step in (1, 2):
            given: list[Any] = [
                np.zeros(4 * step, kind)[::step],
                np.zeros((3, 4 * step), kind)[:, ::step],
                np.zeros(4, bool),
            ]
            expected = [array.copy() for array in given]
            writing(expected[0], expected[1], expected[2], 1, np.uint64(2))
            compiled(*given, 1, np.uint64(2))
            for array, wanted in zip(given, expected, strict=True):
                np.testing.assert_array_equal(array, wanted)


def looping(out: Any, low: int, high: int, u: Any) -> int:
    n = 0
    for i in range(high):
        out[n] = i
        n += 1
    for i in range(low, high):
        out[n] = i
        n += 1
    for i in range(high, low, -2):
        out[n] = i
        n += 1
    for v in range(u):
        out[n] = v
        n += 1
    for v in range(np.uint64(2), u):
        for i in range(low if v > np.uint64(3) else high):
            if i == 4:
                break
            out[n] = i
            n += 1
        else:
            out[n] = -100
            n += 1
    several = range(low, high)
    for i in several:
        for k in several:
            out[n] = i + k
            n += 1
    return n + len(several)


@pytest.mark.parametrize(("low", "high", "u"), [(0, 5, 6), (2, 2, 2), (-3, 3, 5), (4, 1, 0), (-5, -8, 1)])
def test_loops_run_as_in_python(low: int, high: int, u: int) -> None:
    compiled = compiled_whole(looping)
    expected, seen = np.full((2, 400), np.nan)
    assert compiled(seen, low, high, np.uint64(u)) == looping(expected, low, high, u)
    np.testing.assert_array_equal(seen, expected)


class Crowd(NamedTuple):
    """A namedtuple of arrays, numbers and another tuple."""

    x: Any
    alive: Any
    many: int
    more: tuple[Any, float, bool]


@kernel
def shifted(crowd: Crowd, by: tuple[float, float], loud: bool) -> tuple[Crowd, float]:
    """Return the given crowd, and a number."""
    total = 0.0
    for i in range(crowd.many):
        if crowd.alive[i] and not loud:
            crowd.x[0, i] += by[0] * crowd.more[1]
            total += crowd.more[0][i]
    return crowd, total if crowd.more[2] else by[1]


@kernel
def either(k: int, x: Any) -> float | None:
    """Return None, or a number."""
    if k > 1:
        return float(x[0, k])
    return None


@kernel
def refuses(k: int) -> int:
    """Raise an error for some numbers."""
    if k > 2:
        raise ValueError("more than two")
    return k + 1


def calling(x: Any, alive: Any, heights: Any, k: int) -> tuple[float, float, int]:
    crowd, total = shifted(Crowd(x, alive, 3, (heights, 0.5, True)), (1.0, 9.0), False)
    again, other = shifted(Crowd(crowd.x, alive, 2, (heights, 2.0, False)), (1.0, 9.0), k > 0)
    found = either(k, again.x)
    return total + other, -1.0 if found is None else found, refuses(k)


def test_kernels_take_and_return_namedtuples() -> None:
    compiled = compiled_whole(calling)
    for k in (0, 1, 2):
        x, alive, heights = np.arange(8.0).reshape(2, 4), np.array([True, False, True, True]), np.array([5.0, 6, 7, 8])
        assert compiled(x, alive, heights, k) == (12.0 + 9.0, [-1.0, -1.0, 2.5][k], k + 1)
        np.testing.assert_array_equal(x[0], [0.5 + (k == 0) * 2, 1, 2.5, 3])


def test_an_error_of_a_kernel_reaches_the_caller() -> None:
    compiled = compiled_whole(calling)
    with pytest.raises(ValueError, match="more than two"):
        compiled(np.zeros((2, 4)), np.ones(4, bool), np.ones(4), 3)


def test_with_reference_counts_results_are_those_of_numba() -> None:
    def tail(x: Any) -> Any:
        kept = x[1:]
        for k in range(2):
            kept = np.zeros(5)[k:] + kept[0]
        return kept, x[:2]

    compiled: Any = numba.njit(tail, pipeline_class=Whole)
    for _ in range(100):
        first, second = compiled(np.arange(4.0))
        np.testing.assert_array_equal(first, [1, 1, 1, 1])
        np.testing.assert_array_equal(second, [0, 1])


def sliced(x: Any, t: Any, out: Any) -> None:
    for n, part in enumerate((x[first_two()], x[slice(*t)], x[True:], x[:FLAG], x[: np.uint64(2**64 - 1)])):
        out[n] = part.size


FLAG = True


@kernel
def first_two() -> slice:
    """Return a slice."""
    return slice(0, 2)


def test_slices_without_integers_give_the_results_of_numba() -> None:
    compiled, seen = compiled_whole(sliced), np.zeros(5)
    compiled(np.arange(5.0), (1, 4), seen)
    np.testing.assert_array_equal(seen[:4], [2, 3, 4, 1])
    theirs = numba.njit(error_model="numpy")(lambda x: x[:18446744073709551615].size)
    ours = compiled_whole(lambda x: x[:18446744073709551615].size)
    assert ours(np.arange(5.0)) == theirs(np.arange(5.0))


@kernel
def next_but(k: int, most: int = 9) -> int:
    """Raise an error for some numbers; one argument is optional."""
    if k > most:
        raise ValueError("more")
    return k + 1


@kernel
def soothed(k: int) -> int:
    """Return a number, also after an error."""
    r = 0
    try:
        r = next_but(k)
    except Exception:  # numba supports no other
        r = -1000
    return r


@kernel
def troubled(k: int) -> int:
    """Raise an error for 1."""
    if k == 1:
        raise ValueError("one")
    return soothed(k)


def soothing(n: int) -> int:
    s = 0
    for i in range(n):
        try:
            s += troubled(i)
        except Exception:
            s += 100
    return s


def test_an_error_that_was_caught_is_not_raised_again() -> None:
    compiled = compiled_whole(soothing)
    assert compiled(5) == 1 + 100 + 3 + 4 + 5
    assert compiled(11) == 1 + 100 + sum(range(3, 11)) - 1000


@kernel
def halved(x: Any, n: int, odd: bool) -> float:
    """Call itself with an array and a flag."""
    if n < 1:
        return 1.0 if odd else 0.0
    return float(x[n]) + halved(x, n - 1, not odd) / 2


def test_a_kernel_may_call_itself() -> None:
    def entry(x: Any, n: int, odd: bool) -> float:
        return float(halved(x, n, odd))

    for odd in (True, False):
        assert compiled_whole(entry)(np.arange(5.0), 4, odd) == 4 + 3 / 2 + 2 / 4 + 1 / 8 + odd / 16


@kernel
def is_between(x: Any, low: float, high: float, inside: bool) -> bool:
    """Return whether x lies between two numbers, or the opposite."""
    return bool(((low < x) & (x < high)) == inside)


@pytest.mark.parametrize("inside", [True, False])
def test_flags_that_a_kernel_returns_select_count_and_branch(inside: bool) -> None:
    def entry(x: Any, inside: bool) -> tuple[float, int, int, bool]:
        total, count, branches, last = 0.0, 0, 0, False
        for k in range(x.shape[0]):
            last = is_between(x[k], 2.0, 6.0, inside)
            total += x[k] if last else -0.0
            count += last
            if not last:
                branches += 1
        return total, count, branches, last

    x = np.arange(10.0)
    chosen = ((x > 2.0) & (x < 6.0)) == inside
    expected = (x[chosen].sum(), chosen.sum(), (~chosen).sum(), bool(chosen[-1]))
    assert compiled_whole(entry)(x, inside) == expected


def test_an_unknown_version_of_numba_is_not_patched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front_end, "digest", lambda owner, name: "")
    front_end.is_known_source.cache_clear()
    lowering.is_brief.cache_clear()
    try:
        assert not lowering.is_brief()
        test_parts_of_arrays_are_those_of_numpy(ARRAYS["table"])
        part: Any = kernel(lambda crowd, by: (crowd.x[0, 1] + by[1], crowd.more[2]))  # not compiled before

        def entry(x: Any, alive: Any) -> tuple[float, bool]:
            moved: tuple[float, bool] = part(Crowd(x, alive, 3, (x, 0.5, True)), (1.0, 9.0))
            return moved

        assert compiled_whole(entry)(np.arange(8.0).reshape(2, 4), np.ones(4, bool)) == (10.0, True)
    finally:
        monkeypatch.undo()
        front_end.is_known_source.cache_clear()
        lowering.is_brief.cache_clear()
