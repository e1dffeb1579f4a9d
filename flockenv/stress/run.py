"""Try cases under methods, one after another; what a trial raises is its verdict."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from time import perf_counter

from flockenv.divergence import SimulationDiverged
from flockenv.integrators import INTEGRATORS, Integrator
from flockenv.refusals import nearest, shown
from flockenv.stability import UnstableStepWarning
from flockenv.stress.case import Case
from flockenv.stress.results import Finding, Results, Verdict

__all__ = ["cases_named", "methods_named", "run", "usual_methods"]


def usual_methods() -> tuple[Integrator, ...]:
    """Return every method, explicit ones first."""
    return tuple(sorted((kind() for kind in INTEGRATORS.values()), key=lambda m: (m.solves, m.adaptive, m.order)))


def methods_named(names: Sequence[str]) -> tuple[Integrator, ...]:
    """Return the methods of these kinds, all for none; ValueError with the nearest name for an unknown one."""
    for name in names:
        if name not in INTEGRATORS:
            raise ValueError(f"method {shown(name)}: unknown{nearest(name, INTEGRATORS)}; {', '.join(INTEGRATORS)}")
    return tuple(INTEGRATORS[name]() for name in names) or usual_methods()


def cases_named(cases: Sequence[Case], names: Sequence[str]) -> tuple[Case, ...]:
    """Return the cases whose names begin so, all for none; ValueError with the nearest name for an unknown one."""
    known = {case.name for case in cases} | {case.name.split()[0] for case in cases}
    for name in names:
        if name not in known:
            raise ValueError(f"case {shown(name)}: unknown{nearest(name, known)}; {', '.join(sorted(known))}")
    return tuple(c for c in cases if not names or c.name in names or c.name.split()[0] in names)


def run(
    cases: Sequence[Case],
    methods: Sequence[Integrator],
    known: Sequence[Finding] = (),
    progress: Callable[[int, str], None] = lambda done, text: None,
    keep: Callable[[Results], None] = lambda results: None,
) -> Results:
    """Try every case under every method; findings that are `known` are not tried again.

    `progress` is called with how many are done and what is tried next, `keep` with what there is after each: whoever is
    interrupted has that.
    """
    old = {(f.case, f.method): f for f in known}
    found: list[Finding] = []
    for method in methods:
        for case in cases:
            progress(len(found), f"{case.name}, {method.kind}")
            finding = old.get((case.name, method.kind)) or _tried(case, method)
            found.append(finding)
            keep(_in_order(found, cases))
    return _in_order(found, cases)


def _in_order(found: Sequence[Finding], cases: Sequence[Case]) -> Results:
    """Return findings case by case."""
    place = {case.name: k for k, case in enumerate(cases)}
    return Results(findings=tuple(sorted(found, key=lambda f: place[f.case])))


def _tried(case: Case, method: Integrator) -> Finding:
    """Return what one case came to under one method."""
    began = perf_counter()
    number: float | None = None
    verdict: Verdict
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnstableStepWarning)
        try:
            value = case.trial(method)
        except SimulationDiverged as error:
            verdict, note = "diverges", str(error)
        except ValueError as error:
            verdict, note = "refused", str(error)
        else:
            number = value.number if math.isfinite(value.number) else None
            # a bound that is asked the other way round holds for what is no number
            verdict, note = ("pass" if value.holds and not math.isnan(value.number) else "fails"), value.note
    told = next((str(w.message) for w in caught if issubclass(w.category, UnstableStepWarning)), "")
    if told and verdict == "pass":
        verdict = "warned"
    return Finding(
        case=case.name, title=case.title, method=method.kind, bound=case.bound, value=number, verdict=verdict,
        note="; ".join(text for text in (note, told) if text), seconds=perf_counter() - began,
    )  # fmt: skip
