"""Try cases under methods, one after another; what a trial raises is its verdict."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from time import perf_counter

from flockenv.constraints.collisions import UnsolvedContactsWarning
from flockenv.divergence import SimulationDiverged
from flockenv.integrators import INTEGRATORS, Integrator
from flockenv.kernels import laws_digest
from flockenv.refusals import nearest, shown
from flockenv.stress.case import TOO_LONG, Case
from flockenv.stress.results import Finding, Results, Verdict

__all__ = ["cases_named", "fingerprint", "run", "trials", "usual_methods"]

TOLD = (*TOO_LONG, UnsolvedContactsWarning)
"""Warnings that are part of a verdict."""


def usual_methods() -> tuple[Integrator, ...]:
    """Return every method, explicit ones first."""
    return tuple(sorted((kind() for kind in INTEGRATORS.values()), key=lambda m: (m.solves, m.adaptive, m.order)))


def cases_named(cases: Sequence[Case], names: Sequence[str]) -> tuple[Case, ...]:
    """Return the cases whose names begin so, all for none; ValueError with the nearest name for an unknown one."""
    known = {case.name for case in cases} | {case.name.split()[0] for case in cases}
    for name in names:
        if name not in known:
            raise ValueError(f"case {shown(name)}: unknown{nearest(name, known)}; {', '.join(sorted(known))}")
    return tuple(c for c in cases if not names or c.name in names or c.name.split()[0] in names)


def trials(cases: Sequence[Case], methods: Sequence[Integrator]) -> int:
    """Return how many trials there are of these cases under these methods."""
    return sum(case.under(method) for case in cases for method in methods)


def fingerprint() -> str:
    """Return what tells findings from those of other sources: laws, methods, and the cases themselves."""
    here = Path(__file__).parent
    paths = [*here.glob("*.py"), *(here.parent / "integrators").glob("*.py")]
    paths += [here.parent / "implicit.py", here.parent / "stability.py"]
    digest = hashlib.sha256(laws_digest().encode())
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:20]


def run(
    cases: Sequence[Case],
    methods: Sequence[Integrator],
    known: Results | None = None,
    progress: Callable[[int], None] = lambda done: None,
    keep: Callable[[Results], None] = lambda results: None,
) -> Results:
    """Try every case under every method, and return that beside what is known.

    A case that says under which methods it is tried is tried under no others.
    What is known from the same sources is not tried again, and not lost; of other sources nothing is taken over.
    `progress` is called with how many are done, `keep` with all there is after each: whoever is interrupted has that.
    """
    sources = fingerprint()
    found = {(f.case, f.method): f for f in known.findings} if known and known.sources == sources else {}
    place = {case.name: k for k, case in enumerate(cases)}

    def all_() -> Results:
        ordered = sorted(found.values(), key=lambda f: (place.get(f.case, len(place)), f.case))
        return Results(findings=tuple(ordered), sources=sources)

    pairs = [(method, case) for method, case in product(methods, cases) if case.under(method)]
    for done, (method, case) in enumerate(pairs):
        progress(done)
        if (case.name, method.kind) not in found:
            found[case.name, method.kind] = _tried(case, method)
            keep(all_())
    return all_()


def _tried(case: Case, method: Integrator) -> Finding:
    """Return what one case came to under one method."""
    began = perf_counter()
    number: float | None = None
    verdict: Verdict
    with warnings.catch_warnings(record=True) as caught:
        for kind in TOLD:
            warnings.simplefilter("always", kind)
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
    told = next((str(w.message) for w in caught if issubclass(w.category, TOLD)), "")
    if told and verdict == "pass":
        verdict = "warned"
    return Finding(
        case=case.name, title=case.title, method=method.kind, bound=case.bound, value=number, verdict=verdict,
        note="; ".join(text for text in (note, told) if text), seconds=perf_counter() - began,
    )  # fmt: skip
