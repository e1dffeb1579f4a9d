"""Try cases with presets, one after another; what a trial raises is its verdict."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter

from flockenv.divergence import SimulationDiverged
from flockenv.kernels import laws_digest
from flockenv.refusals import nearest, shown
from flockenv.validation.case import Case, Value, quietly
from flockenv.validation.results import Finding, Results, Verdict

__all__ = ["cases_named", "fingerprint", "run", "trials"]


def cases_named(cases: Sequence[Case], names: Sequence[str]) -> tuple[Case, ...]:
    """Return the cases of some names, all for none; the first word is enough (rimea, nist); ValueError for another."""
    known = {case.name for case in cases} | {case.name.split()[0] for case in cases}
    for name in names:
        if name not in known:
            raise ValueError(f"case {shown(name)}: unknown{nearest(name, known)}; {', '.join(sorted(known))}")
    return tuple(c for c in cases if not names or c.name in names or c.name.split()[0] in names)


def trials(cases: Sequence[Case], presets: Sequence[str]) -> int:
    """Return how many trials there are of these cases with these presets."""
    return sum(case.under(preset) for case in cases for preset in presets)


def fingerprint() -> str:
    """Return what tells findings from those of other sources: laws and cases."""
    digest = hashlib.sha256(laws_digest().encode())
    for path in sorted(path for path in Path(__file__).parent.glob("*.py") if path.stem != "page"):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:20]


def run(
    cases: Sequence[Case],
    presets: Sequence[str],
    known: Results | None = None,
    progress: Callable[[int], None] = lambda done: None,
    keep: Callable[[Results], None] = lambda results: None,
) -> Results:
    """Try every case with every preset, and return that beside what is known.

    What is known from the same sources is not tried again, and not lost; of other sources nothing is taken over.
    `progress` is called with how many are done, `keep` with all there is after each: whoever is interrupted has that.
    """
    sources = fingerprint()
    found = {(f.case, f.preset): f for f in known.findings} if known and known.sources == sources else {}
    place = {case.name: k for k, case in enumerate(cases)}

    def all_() -> Results:
        ordered = sorted(found.values(), key=lambda f: (place.get(f.case, len(place)), f.case))
        return Results(findings=tuple(ordered), sources=sources)

    pairs = [(preset, case) for preset in presets for case in cases if case.under(preset)]
    for done, (preset, case) in enumerate(pairs):
        progress(done)
        if (case.name, preset) not in found:
            found[case.name, preset] = _tried(case, preset)
            keep(all_())
    return all_()


def _tried(case: Case, preset: str) -> Finding:
    """Return what one case came to with one preset."""
    began = perf_counter()
    value = Value(math.nan, False)
    verdict: Verdict
    try:
        with quietly():
            value = case.trial(preset)
    except SimulationDiverged as error:
        verdict, note = "diverges", str(error)
    except ValueError as error:
        verdict, note = "refused", str(error)
    else:
        note = value.note
        verdict = "reported" if value.holds is None else ("pass" if value.holds else "misses")
    return Finding(
        case=case.name, title=case.title, preset=preset, bound=case.bound, value=_known(value.number), verdict=verdict,
        note=note, seconds=perf_counter() - began, series=_rounded(value.series),
    )  # fmt: skip


def _known(number: float) -> float | None:
    """Return a number; none for what is no number."""
    return float(number) if math.isfinite(number) else None


def _rounded(series: Mapping[str, Sequence[float]]) -> dict[str, tuple[float | None, ...]]:
    """Return numbers as they are written: six digits are enough for a picture."""
    return {
        name: tuple(None if (x := _known(v)) is None else float(f"{x:.6g}") for v in values)
        for name, values in series.items()
    }
