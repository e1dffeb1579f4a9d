"""Stress cases: their verdicts under several methods, and how findings are kept and reported."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest

from flockenv.core.warnings import UnstableStepWarning
from flockenv.model.divergence import SimulationDiverged
from flockenv.physics.integrators import (
    INTEGRATORS,
    RK4,
    ExplicitEuler,
    ExponentialDrag,
    Heun,
    ImplicitEuler,
    ImplicitMidpoint,
    Integrator,
    LinearlyImplicitEuler,
    SemiImplicitEuler,
    VelocityVerlet,
    methods_of,
)
from flockenv.studies.stress import CASES, Case, Finding, Results, Value, fingerprint, run, select_cases, usual_methods
from flockenv.studies.stress.gatherings import GATHERINGS
from flockenv.studies.stress.heaps import HEAPS
from flockenv.studies.stress.impacts import IMPACTS

pytestmark = pytest.mark.slow
"""Many kernels are compiled: only slow runs include these tests."""

NAMES = tuple(case.name for case in CASES)


def case(trial: Any, name: str = "X01") -> Case:
    return Case(name, "made up", "none", trial)


def tried(trial: Any, method: Integrator | None = None) -> Finding:
    (finding,) = run((case(trial),), (method or SemiImplicitEuler(),)).findings
    return finding


def named(name: str) -> Case:
    return next(case for case in CASES if case.name == name)


# --- verdicts ---------------------------------------------------------------------------------------------------------


def warned(value: Value) -> Any:
    def trial(method: Integrator) -> Value:
        warnings.warn("dt = 1 s: too long", UnstableStepWarning, stacklevel=1)
        return value

    return trial


def raised(error: Exception) -> Any:
    def trial(method: Integrator) -> Value:
        raise error

    return trial


def test_the_verdict_is_what_a_trial_returns_warns_or_raises() -> None:
    diverged = SimulationDiverged(0, 3, 17, 0.34, "springs", 0.02, "rk4")
    for trial, verdict, value, note in (
        (lambda method: Value(0.5, True, "fine"), "pass", 0.5, "fine"),
        (lambda method: Value(0.5, False, "too much"), "fails", 0.5, "too much"),
        (warned(Value(0.5, True, "fine")), "warned", 0.5, "fine; dt = 1 s: too long"),
        (warned(Value(0.5, False)), "fails", 0.5, "dt = 1 s: too long"),
        (raised(ValueError("dt = 1 s: at most")), "refused", None, "dt = 1 s: at most"),
        (raised(diverged), "diverges", None, str(diverged)),
        (lambda method: Value(math.inf, True), "pass", None, ""),
        (lambda method: Value(math.nan, False), "fails", None, ""),
        (lambda method: Value(0.5, None, "fine"), "reported", 0.5, "fine"),
        (warned(Value(0.5, None)), "reported", 0.5, "dt = 1 s: too long"),
    ):
        finding = tried(trial)
        assert (finding.verdict, finding.value, finding.note) == (verdict, value, note)
        assert (finding.case, finding.title, finding.bound, finding.under) == (
            "X01", "made up", "none", "semi_implicit_euler",
        )  # fmt: skip
        assert finding.seconds >= 0


def test_other_errors_and_warnings_are_raised() -> None:
    def deprecated(method: Integrator) -> Value:
        warnings.warn("old", DeprecationWarning, stacklevel=1)
        return Value(0.0, True)

    with pytest.raises(RuntimeError, match=r"^X01 under \w+: ZeroDivisionError: division by zero$"):
        tried(lambda method: Value(1 / 0, True))
    with pytest.raises(RuntimeError, match=r"^X01 under \w+: DeprecationWarning: old$"):
        tried(deprecated)


def test_nan_never_passes() -> None:
    """nan <= bound is False; a bound in the form `not value > bound` must not let it pass."""
    assert tried(lambda method: Value(math.nan, math.nan <= 1.0)).verdict == "fails"
    assert tried(lambda method: Value(math.nan, True)).verdict == "fails"


# --- kept results -----------------------------------------------------------------------------------------------------


def test_known_findings_are_not_tried_again() -> None:
    calls: list[tuple[str, str]] = []

    def trial(name: str) -> Any:
        return lambda method: calls.append((name, method.kind)) or Value(1.0, True)

    cases, methods = tuple(case(trial(name), name) for name in ("A", "B")), (SemiImplicitEuler(), RK4())
    kept: list[Results] = []
    counts: list[int] = []
    whole = run(cases, methods, progress=counts.append, keep=kept.append)
    assert calls == [("A", "semi_implicit_euler"), ("B", "semi_implicit_euler"), ("A", "rk4"), ("B", "rk4")]
    assert counts == [0, 1, 2, 3, 4]
    assert [len(results.findings) for results in kept] == [1, 2, 3, 4]
    assert kept[-1] == whole
    assert [(f.case, f.under) for f in whole.findings] == [
        ("A", "semi_implicit_euler"), ("A", "rk4"), ("B", "semi_implicit_euler"), ("B", "rk4"),
    ]  # fmt: skip
    calls.clear()
    again = run(cases, methods, known=kept[2])
    assert calls == [("B", "rk4")]
    assert [f.cell() for f in again.findings] == [f.cell() for f in whole.findings]
    assert run(cases, methods, known=whole) == whole


def test_known_findings_of_other_cases_stay_and_of_other_sources_are_dropped() -> None:
    calls: list[str] = []

    def trial(name: str) -> Case:
        return case(lambda method: calls.append(name) or Value(1.0, True), name)

    first = run((trial("A"),), (RK4(),))
    assert first.sources == fingerprint()
    both = run((trial("B"),), (RK4(),), known=first)
    assert [f.case for f in both.findings] == ["B", "A"]
    assert both.only({"B"}, {"rk4"}).cases == ["B"]
    assert not both.only({"B"}, {"heun"}).findings
    calls.clear()
    old = both.model_copy(update={"sources": "those of yesterday"})
    assert run((trial("A"),), (RK4(),), known=old).cases == ["A"]
    assert calls == ["A"]


def test_results_become_a_table_and_json() -> None:
    results = Results(
        findings=(
            tried(lambda method: Value(0.123456, True, "so")), tried(raised(ValueError("no")), RK4()),
            tried(lambda method: Value(math.inf, True), Heun()),
            tried(lambda method: Value(0.123456, None), ExplicitEuler()),
            tried(lambda method: Value(0.123456, False), VelocityVerlet()),
        )
    )  # fmt: skip
    assert results.unders == ["semi_implicit_euler", "rk4", "heun", "explicit_euler", "velocity_verlet"]
    assert results.cases == ["X01"]
    assert results.rows() == [["X01", "made up", "none", "0.12 ok", "refused", "ok", "0.12", "0.12 FAILS"]]
    assert results.rows(3)[0][3] == "0.123 ok"
    assert [verdict for verdict, _ in results.legend()] == ["pass", "reported", "refused", "fails"]
    assert results.at("X01", "rk4") is results.findings[1]
    assert results.at("X01", "midpoint") is None
    assert Results.model_validate_json(results.model_dump_json()) == results
    gap = Results(findings=(results.findings[0], results.findings[1].model_copy(update={"case": "X02"})))
    assert gap.rows() == [["X01", "made up", "none", "0.12 ok", ""], ["X02", "made up", "none", "", "refused"]]


def test_cases_and_methods_are_found_by_name_and_unknown_names_are_refused() -> None:
    assert len(set(NAMES)) == len(NAMES)
    assert select_cases(CASES, ()) == CASES
    assert [case.name for case in select_cases(CASES, ("N14",))] == [f"N14 {power}" for power in range(3, 9)]
    assert [case.name for case in select_cases(CASES, ("N20 10", "N04"))] == ["N04", "N20 10"]
    assert methods_of(("rk4", "heun", "rk4")) == (RK4(), Heun())
    assert {method.kind for method in usual_methods()} == set(INTEGRATORS)
    solving = [method.solves for method in usual_methods()]
    assert solving == sorted(solving)
    with pytest.raises(ValueError, match=r"^case 'N41': unknown; the nearest of \d+: N") as caught:
        select_cases(CASES, ("N41",))
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"^methods: 'rk44': unknown.*rk4") as caught:
        methods_of(("rk44",))
    assert "\n" not in str(caught.value)


# --- the cases --------------------------------------------------------------------------------------------------------

SOLID = {case.name for case in (*IMPACTS, *HEAPS, *GATHERINGS)}  # tested in tests/test_stress_solids.py
BOUNDED = tuple(name for name in NAMES if not name.startswith(("N14", "N20", "N48", "N49")) and name not in SOLID)
HEAVY = ("N09 crowd", "N10", "N18", "N09 centre", "N43", "N44", "N47", "N51", "N52", "N53", "N54", "N55")
"""Cases whose kernels take long to compile."""
LIGHT = tuple(name for name in BOUNDED if name not in HEAVY)


def within(method: Integrator, name: str) -> None:
    (finding,) = run((named(name),), (method,)).findings
    assert finding.verdict == "pass", finding.note


@pytest.mark.parametrize("name", LIGHT)
def test_semi_implicit_euler_stays_within_the_bounds(name: str) -> None:
    within(SemiImplicitEuler(), name)


@pytest.mark.slow
@pytest.mark.parametrize("name", HEAVY)
def test_semi_implicit_euler_stays_within_the_bounds_of_crowds(name: str) -> None:
    within(SemiImplicitEuler(), name)


# Each method compiles each case anew: here two share the cases; `flockenv stress` tries all pairs (docs/stress.json).


@pytest.mark.slow
@pytest.mark.parametrize("name", LIGHT[::2])
def test_velocity_verlet_stays_within_the_bounds(name: str) -> None:
    within(VelocityVerlet(), name)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(BOUNDED) - set(LIGHT[::2])))
def test_rk4_stays_within_the_bounds(name: str) -> None:
    within(RK4(), name)


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith(("N14", "N48"))])
@pytest.mark.parametrize("method", [SemiImplicitEuler(), VelocityVerlet(), RK4()], ids=lambda method: method.kind)
def test_a_stiff_cloth_is_refused_before_anything_runs(method: Integrator, name: str) -> None:
    """N14, P16: the message names step, method, effect and limit."""
    (finding,) = run((named(name),), (method,)).findings
    assert finding.verdict == "refused"
    effect = "springs" if name.startswith("N14") else "membrane"
    for part in ("dt = 0.0166667 s", f"{method.kind} with {effect}", "s is stable"):
        assert part in finding.note


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fields", "verdict"),
    [
        ("N14 3", {}, "pass"), ("N14 4", {}, "pass"), ("N48 3", {}, "pass"), ("N48 6", {}, "pass"), ("N49", {}, "pass"),
        # one solve leaves a link that turns in the step too long; `strain` halves such steps
        ("N14 5", {}, "fails"), ("N14 8", {}, "fails"), ("N14 5", {"strain": 1e-3}, "pass"),
        ("N14 6", {"strain": 1e-4}, "pass"), ("N14 8", {"strain": 1e-4}, "fails"),
        # a second solve shortens it
        ("N14 6", {"linearisations": 2}, "pass"), ("N14 7", {"linearisations": 2}, "fails"),
        ("N14 7", {"linearisations": 3}, "pass"), ("N14 8", {"linearisations": 3}, "fails"),
        ("N05 earliest", {}, "fails"),  # the last bounces are cut short: see docs/stress.md
    ],
    ids=str,
)  # fmt: skip
def test_linearly_implicit_euler_has_its_known_verdicts(name: str, fields: dict[str, Any], verdict: str) -> None:
    (finding,) = run((named(name),), (LinearlyImplicitEuler(**fields),)).findings
    assert finding.verdict == verdict, finding.note


@pytest.mark.parametrize(("name", "expected"), [("N20 1.9", "pass"), ("N20 2.1", "warned"), ("N20 10", "refused")])
def test_stiff_drag_is_bounded_then_warned_of_then_refused(name: str, expected: str) -> None:
    """The case N20 2.1 catches the warning itself and passes; its note mentions it."""
    (finding,) = run((named(name),), (SemiImplicitEuler(),)).findings
    assert finding.verdict == ("pass" if expected == "warned" else expected)
    assert ("warned" in finding.note) == (expected == "warned")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["N01", "N02", "N03", "N09 centre", "N16", "N20 1.9", "N20 2.1", "N20 10"])
def test_exponential_drag_stays_within_the_bounds(name: str) -> None:
    """Drag that it integrates exactly sets no limit; other damping does."""
    within(ExponentialDrag(), name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["N03", "N15", "N20 10", "N14 3", "N14 8"])
def test_implicit_euler_stays_within_the_bounds(name: str) -> None:
    within(ImplicitEuler(), name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "verdicts"),
    [
        ("N03", {"pass"}), ("N14 3", {"pass"}),
        # stable at any step, but motion that is too fast for the step changes sign in each step and is hardly damped
        ("N15", {"fails"}), ("N20 10", {"fails"}),
        ("N14 8", {"pass", "diverges"}),  # there may be no solution nearby, but energy never grows unnoticed
    ],
)  # fmt: skip
def test_implicit_midpoint_has_its_known_verdicts(name: str, verdicts: set[str]) -> None:
    (finding,) = run((named(name),), (ImplicitMidpoint(),)).findings
    assert finding.verdict in verdicts, finding.note
    assert finding.verdict != "diverges" or "Newton's method" in finding.note or "not finite" in finding.note


@pytest.mark.slow
@pytest.mark.parametrize("name", ["N01", "N04"])
def test_explicit_euler_has_its_known_verdicts(name: str) -> None:
    """Its energy grows as in the formula, with a warning; its orbit fails (N04)."""
    (finding,) = run((named(name),), (ExplicitEuler(),)).findings
    assert finding.verdict == ("fails" if name == "N04" else "warned")
