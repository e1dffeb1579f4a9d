"""Accuracy of solids: implicit methods, altitude springs, springs that yield, contacts with faces."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockenv.physics.integrators import LinearlyImplicitEuler, methods_of
from flockenv.studies.accuracy import Problem, Report, benchmark, measure, methods_named, select_problems
from flockenv.studies.accuracy.methods import method_name
from flockenv.studies.accuracy.table import headlines

EXPLICIT = methods_of(["semi_implicit_euler", "velocity_verlet", "rk4"])
TWICE = "linearly_implicit_euler:linearisations=2"


def one(name: str, first: int = 6, last: int = 14) -> Problem:
    """Return a problem of the suite in 2^first to 2^last steps."""
    return replace(select_problems([name])[0], steps=tuple(2**k for k in range(first, last + 1)))


def measured(problem: Problem, *names: str, **more: Any) -> Report:
    return measure(problem, methods_named(names), repetitions=0, **more)


def along(report: Report, name: str) -> list[float]:
    """Return the largest error in each number of steps."""
    return [point.along or np.nan for point in report.curve(name).points]


# --- names of methods -------------------------------------------------------------------------------------------------


def test_names_of_methods_have_the_fields_that_are_not_the_default() -> None:
    names = ["rk4", TWICE, "linearly_implicit_euler:tolerance=1e-05:linearisations=3", "dormand_prince", "rk4"]
    found = methods_named(names)
    assert [method_name(method) for method in found] == names[:-1]
    assert found[1] == LinearlyImplicitEuler(linearisations=2)
    assert method_name(methods_of(["dormand_prince"])[0].model_copy(update={"tolerance": 1e-5})) == "dormand_prince"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rk44", "did you mean `rk4`"),
        ("linearly_implicit_euler:linearisations", "must be FIELD=NUMBER"),
        ("linearly_implicit_euler:linearisations=two", "must be FIELD=NUMBER"),
        ("linearly_implicit_euler:linearisation=2", "did you mean `linearisations`"),
        ("linearly_implicit_euler:linearisations=0", "methods: 'linearly_implicit_euler:linearisations=0': "),
        ("dormand_prince:tolerance=1e-3", "several tolerances are measured"),
    ],
)
def test_invalid_names_of_methods_are_refused_in_one_line(name: str, text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)) as caught:
        methods_named([name])
    assert "\n" not in str(caught.value)


# --- implicit methods -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bar", "sheet"])
def test_linearly_implicit_euler_has_order_1_for_springs_and_membranes(name: str) -> None:
    report = measured(one(name, 8, 11), "linearly_implicit_euler", TWICE)
    for curve in report.curves:
        assert curve.order == pytest.approx(1, abs=0.07), curve.method
        solves = 2 if curve.method == TWICE else 1
        assert [point.evaluations for point in curve.points] == [solves * point.steps for point in curve.points]
        assert all(point.iterations > 0 for point in curve.points)
    assert any(line.startswith("linear iterations in a step, which are no evaluations") for line in headlines(report))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "order"), [("implicit_euler", 1), ("implicit_midpoint", 2)])
def test_implicit_methods_have_their_orders_for_membranes_and_bending(name: str, order: int) -> None:
    report = measured(one("sheet", 6 + (order == 1), 9 + (order == 1)), name)
    assert report.curve(name).order == pytest.approx(order, abs=0.15)


@pytest.mark.slow
def test_linearly_implicit_euler_is_implicit_euler_for_linear_springs() -> None:
    exactly = "linearly_implicit_euler:tolerance=1e-12"
    report = measured(one("bar", 6, 7), "implicit_euler", exactly)
    np.testing.assert_allclose(along(report, exactly), along(report, "implicit_euler"), rtol=1e-9)


@pytest.mark.slow
def test_linearly_implicit_euler_is_semi_implicit_for_forces_without_a_derivative() -> None:
    report = measured(one("jelly", 8, 9), "semi_implicit_euler", "linearly_implicit_euler")
    np.testing.assert_allclose(
        along(report, "linearly_implicit_euler"), along(report, "semi_implicit_euler"), rtol=1e-9
    )


@pytest.mark.slow
def test_implicit_methods_end_once_they_take_too_many_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "MOST_SOLVED", 500)
    report = measured(one("yielding", 5, 9), "implicit_euler", "rk4")
    costs = [point.evaluations for point in report.curve("implicit_euler").points]
    assert costs[-1] > 500 and all(cost <= 500 for cost in costs[:-1]) and len(costs) < 5
    assert len(report.curve("rk4").points) == 5


# --- springs ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_springs_that_yield_reduce_every_method_to_order_1() -> None:
    """Rest lengths change after each step, so that the stages of a step all have the one before."""
    problem = one("yielding", 8, 13)
    report = measure(problem, EXPLICIT, repetitions=0)
    assert report.reference == "closed form"
    for curve in report.curves:
        assert curve.order == pytest.approx(1, abs=0.02), curve.method
    np.testing.assert_allclose(along(report, "rk4"), along(report, "velocity_verlet"), rtol=0.05)
    scene, state = problem.prepare(EXPLICIT[-1], 1024)
    kept = scene.step(state, steps=1024).bonds[0, 0]
    assert problem.exact is not None
    longest = max(np.max(problem.exact(t)[0]) for t in np.linspace(0.0, problem.seconds, 1000))
    assert kept == pytest.approx(longest / 1.1, rel=5e-3)


@pytest.mark.slow
def test_springs_that_break_do_so_at_the_end_of_a_step_whatever_the_method() -> None:
    """The spring acts up to a step too long, so the velocity is off by up to h k (l - L) / m."""
    report = measure(one("breaking", 7, 12), EXPLICIT[1:], repetitions=0)
    assert report.reference == "closed form"
    for curve in report.curves:
        for point in curve.points:
            assert 0 < (point.along or 0) <= 1.1 * point.dt * 10.0 * 0.55, curve.method
    np.testing.assert_allclose(along(report, "rk4"), along(report, "velocity_verlet"), rtol=0.02)


# --- contacts with faces ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_ball_lands_and_slides_on_a_face_exactly_under_methods_of_order_2() -> None:
    """Coulomb's friction takes as much of the motion along the face, times 0.2, as the face takes of that across."""
    report = measure(one("slope", 6, 9), EXPLICIT, repetitions=0)
    assert report.reference == "closed form"
    assert report.curve("semi_implicit_euler").order == pytest.approx(1, abs=0.01)
    for name in ("velocity_verlet", "rk4"):
        assert max(along(report, name)) < 1e-12


@pytest.mark.slow
def test_a_ball_that_falls_on_a_sheet_is_found_to_order_1() -> None:
    """The forces of a step do not include the impact within it, and agree with no other step about its instant."""
    report = measure(one("trampoline", 8, 13), EXPLICIT, repetitions=0)
    assert report.reference == "own steps"
    for curve in report.curves:
        assert curve.order == pytest.approx(1, abs=0.1), curve.method


# --- steps that reach an error ----------------------------------------------------------------------------------------

STEPS: dict[str, dict[float, tuple[int | None, ...]]] = {
    "bar": {1e-2: (64, 64, 64, 128, 128), 1e-3: (512, 64, 64, 2048, 2048), 1e-4: (4096, 256, 64, 16384, 16384)},
    "sheet": {1e-2: (128, 64, 64, 1024, 1024), 1e-3: (1024, 64, 64, 8192, 8192), 1e-4: (16384, 256, 64, None, None)},
    "jelly": {1e-2: (128, 64, 64, 128, 4096), 1e-3: (1024, 128, 64, 1024, None), 1e-4: (8192, 512, 64, 8192, None)},
    "altitudes": {1e-2: (128, 64, 64, 1024, 2048), 1e-3: (1024, 128, 64, 8192, 8192)},
}
"""Steps, in powers of two from 64 to 16,384, that reach an error in m, by method; None: more."""

TABULATED = ("semi_implicit_euler", "velocity_verlet", "rk4", "linearly_implicit_euler", TWICE)


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_errors_of_solids_are_reached_in_the_steps_of_the_table(name: str) -> None:
    report = measured(one(name), *TABULATED)
    for tolerance, expected in STEPS[name].items():
        for kind, steps in zip(TABULATED, expected, strict=True):
            good = [p.steps for p in report.curve(kind).points if p.error is not None and p.error < tolerance]
            assert min(good, default=None) == steps, (kind, tolerance)
