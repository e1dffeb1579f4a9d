"""Vectorized laws, defined in a module, a function or a notebook, with arguments of many shapes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.jit.decorators import Law, Numbers, Vec, law
from flockenv.maths.vectors import scale
from flockenv.steering.vectorize import rows

ROOT = Path(__file__).resolve().parent.parent

NOTEBOOK = """
import numpy as np
from flockenv.jit.decorators import law
from flockenv.steering.vectorize import rows
from flockenv.maths.vectors import scale

@law
def stretched(x: "Vec", by: "float") -> "Vec":
    return scale(x, {factor} * by)

print(rows(stretched)([[1.0, 2.0], [3.0, 4.0]], 10.0).tolist())
"""


def stretching(factor: float) -> Law:
    """Return a law that is not an attribute of its module."""

    @law
    def stretched(x: Vec, by: float) -> Vec:
        return scale(x, factor * by)

    return stretched


@law
def blended(a: float, weights: Numbers, b: Vec, c: float, d: Vec, e: float) -> float:
    """Return a sum over six arguments of every kind."""
    total = a + c * b[0] + e * d[1]
    for k in range(len(weights)):
        total += weights[k]
    return total


def test_laws_from_one_factory_are_distinct() -> None:
    np.testing.assert_array_equal(rows(stretching(2.0))([1.0, 2.0], 10.0), [20.0, 40.0])
    np.testing.assert_array_equal(rows(stretching(3.0))([1.0, 2.0, 4.0], 10.0), [30.0, 60.0, 120.0])


@pytest.mark.parametrize("jit", ["0", "1"])
def test_a_law_of_a_notebook_runs_and_is_recompiled_after_an_edit(jit: str, tmp_path: Path) -> None:
    """The module has no source file, and the law keeps its name."""
    env = {**os.environ, "FLOCKENV_CACHE": str(tmp_path), "NUMBA_DISABLE_JIT": jit}
    for factor in (2, 5, 2):
        program = [sys.executable, "-c", NOTEBOOK.format(factor=factor)]
        done = subprocess.run(program, cwd=ROOT, env=env, capture_output=True, text=True, check=True)
        assert done.stdout == f"[[{10.0 * factor}, {20.0 * factor}], [{30.0 * factor}, {40.0 * factor}]]\n"


@pytest.mark.parametrize("length", [1, 2, 3, 7])
def test_a_law_takes_many_arguments_and_numbers_of_any_length(length: int) -> None:
    weights = np.arange(2.0 * length).reshape(2, length)
    b, d = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([5.0, 6.0])
    found = rows(blended)(1.0, weights, b, [10.0, 20.0], d, 100.0)
    np.testing.assert_array_equal(found, 1 + np.array([10.0, 60.0]) + 600 + weights.sum(axis=1))


def unannotated(x: Any, by: float) -> Vec:
    """Annotate x with a type that `rows` cannot use."""
    return scale(x, by)


def test_a_law_without_usable_annotations_is_refused_in_one_line() -> None:
    with pytest.raises(TypeError, match=r"\Aunannotated: x must be annotated as one of Vec, .*got 'Any'\Z"):
        rows(law(unannotated))
