"""Stress cases of solid bodies: each response to contacts stays within its bounds, or is known to fail."""

from __future__ import annotations

import warnings

import pytest

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.physics.integrators import RK4, Integrator, SemiImplicitEuler, VelocityVerlet
from flockenv.studies.stress import CASES, Case, Finding, Value, run, trials
from flockenv.studies.stress.gatherings import GATHERINGS
from flockenv.studies.stress.heaps import HEAPS, funnel
from flockenv.studies.stress.impacts import IMPACTS

CASE = {case.name: case for case in CASES}
ONCE = tuple(case.name for case in (*IMPACTS, *HEAPS) if not case.only)
QUICK = (
    "N05 earliest", "N06 back_up", "N07 earliest", "N07 impulses", "N08 earliest", "N08 impulses", "N17 earliest",
    "N22 earliest", "N22 impulses", "P19 earliest", "P19 back_up", "P19 impulses", "P24 earliest", "P28 impulses",
)  # fmt: skip
"""Cases that the default run tries under semi-implicit Euler."""

FAIL = {
    "N05 impulses", "N05 project",  # impacts at the end of a step also remove the speed gained since by falling
    "N08 project", "N22 project", "P19 project",  # a single pass
}  # fmt: skip
"""Cases that fail under every method, see docs/stress.md."""


WARNED = {"N27 project"}  # bodies that are held back leave contacts unsolved in some steps
"""Cases that hold their bounds but warn: bodies are held back that would be pushed past others."""


def found(name: str, method: Integrator | None = None) -> Finding:
    (finding,) = run((CASE[name],), (method or SemiImplicitEuler(),)).findings
    return finding


def as_known(name: str, method: Integrator | None = None) -> None:
    finding = found(name, method)
    assert finding.verdict == ("fails" if name in FAIL else "pass"), finding.note


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in ONCE if name not in QUICK)]
)
def test_semi_implicit_euler_has_the_known_verdicts(name: str) -> None:
    as_known(name)


def test_ninety_discs_in_the_funnel_overlap_little_and_do_not_leave() -> None:
    """The first second of N23; all of it, 1,000 discs for 60 s, is in docs/stress.md."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsolvedContactsWarning)
        value = funnel(SemiImplicitEuler(), "impulses", seconds=1.0, count=90)
    assert value.holds, value.note


def test_a_case_is_tried_only_under_its_own_methods() -> None:
    some = (Case("X01", "made up", "none", lambda method: Value(1.0, True), ("rk4",)),)
    methods = (SemiImplicitEuler(), RK4())
    assert trials(some, [method.kind for method in methods]) == 1
    assert [f.under for f in run(some, methods).findings] == ["rk4"]


def test_a_warning_of_unsolved_contacts_makes_the_verdict_warned() -> None:
    def trial(method: Integrator) -> Value:
        warnings.warn("not solved within passes = 1", UnsolvedContactsWarning, stacklevel=1)
        return Value(1.0, True)

    (finding,) = run((Case("X01", "made up", "none", trial),), (SemiImplicitEuler(),)).findings
    assert (finding.verdict, finding.note) == ("warned", "not solved within passes = 1")


@pytest.mark.slow
@pytest.mark.parametrize("name", ONCE[::3])  # of each case another response
def test_rk4_has_the_known_verdicts(name: str) -> None:
    as_known(name, RK4())


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ONCE if name.startswith(("N05", "N22"))])
def test_verlet_has_the_known_verdicts_of_a_drop_and_a_heap(name: str) -> None:
    """Responses act between steps and know no method; RK4 tries all of them."""
    as_known(name, VelocityVerlet())


@pytest.mark.slow
@pytest.mark.parametrize("name", [case.name for case in GATHERINGS if case.name != "N11 64 project"])
def test_gatherings_stay_within_their_bounds(name: str) -> None:
    assert found(name).verdict == ("warned" if name in WARNED else "pass")
