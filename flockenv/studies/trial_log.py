"""Findings: results of cases under methods or models, run one after another; an interrupted run can be resumed.

Hard cases of the simulator (`flockenv.studies.stress`) and crowds against guidelines (`flockenv.studies.validation`)
are run this way. An error that a case raises is its verdict: a scene that is refused, a simulation that diverges.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Literal

from pydantic import Field

from flockenv.core.errors import nearest_few, printable
from flockenv.core.record import ResultRecord
from flockenv.jobs import Engine, Failure, Job
from flockenv.jobs.local_engine import LocalEngine
from flockenv.model.divergence import SimulationDiverged

__all__ = ["VERDICTS", "Case", "Finding", "Results", "Value", "Verdict", "run", "select_cases", "trials"]

Verdict = Literal["pass", "warned", "reported", "refused", "fails", "diverges"]
"""Verdict on one trial; VERDICTS explains each."""

VERDICTS: dict[Verdict, str] = {
    "pass": "within the bound",
    "warned": "within the bound, after a warning: of a step that is too long, of contacts that were not solved",
    "reported": "there is no bound, only a number",
    "refused": "the scene was refused, the message says why; of a step that must blow up, the largest that does not",
    "fails": "beyond the bound; the number is the result",
    "diverges": "no longer finite, and reported: world, agent, step, effect",
}
"""Meaning of each verdict."""

MEMORY = 700 * 2**20
"""Bytes that a process of trials needs: 420 MiB for libraries and to compile contacts, then some MiB for each case."""

MARKS: dict[Verdict, str] = {"pass": "ok", "reported": "", "fails": "FAILS"}
"""Text of a verdict in a table, if it is not its name."""


@dataclass(frozen=True)
class Value:
    """Result of a case, and whether it is within its bound; `holds` is None without a bound: it is only reported."""

    number: float  # what the case measures, in the unit of its bound
    holds: bool | None
    note: str = ""  # remark beside the number
    series: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Data for pictures."""


@dataclass(frozen=True)
class Case:
    """A test case: its name, what happens in it, its bound, and a function that runs it under a method or model.

    Other processes find a case by its name in CASES of the package in which its trial is defined.
    """

    name: str
    title: str  # what happens in it
    bound: str
    trial: Callable[[Any], Value]
    only: tuple[str, ...] = ()
    """Names of the methods or models that it is run under (default: all)."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _find_case, (self.trial.__module__.rpartition(".")[0], self.name)

    def runs_under(self, name: str) -> bool:
        """Return True if the case is run under this method or model.

        name: of the method or model.
        """
        return not self.only or name in self.only


class Finding(ResultRecord):
    """Result of one case under one method or model."""

    case: str
    title: str
    under: str = Field(description="the method, or the model")
    bound: str
    value: float | None = Field(description="the bounded quantity; null if it is not finite")
    verdict: Verdict
    note: str = ""
    seconds: float = Field(ge=0, description="s, wall time, compiling included")
    series: dict[str, tuple[float | None, ...]] = Field(
        default_factory=dict, exclude_if=lambda series: not series, description="data for pictures"
    )

    def cell(self, digits: int = 2) -> str:
        """Return value and verdict, short.

        digits: significant ones of the value.
        """
        number = "" if self.value is None else f"{self.value:.{digits}g} "
        return f"{number}{MARKS.get(self.verdict, self.verdict)}".strip() or "-"


class Results(ResultRecord):
    """All findings, and a fingerprint of the sources that they depend on."""

    findings: tuple[Finding, ...]
    sources: str = Field(default="", description="fingerprint of the sources that the findings depend on")

    @property
    def unders(self) -> list[str]:
        """Names of methods or models, in the order in which they were run."""
        return list(dict.fromkeys(f.under for f in self.findings))

    @property
    def cases(self) -> list[str]:
        """Names of cases, in order."""
        return list(dict.fromkeys(f.case for f in self.findings))

    def only(self, cases: Collection[str], unders: Collection[str]) -> Results:
        """Return the findings of some cases under some methods or models.

        cases, unders: their names.
        """
        found = tuple(f for f in self.findings if f.case in cases and f.under in unders)
        return self.model_copy(update={"findings": found})

    def at(self, case: str, under: str) -> Finding | None:
        """Return one finding; None if that case was not run.

        case, under: their names.
        """
        return next((f for f in self.findings if (f.case, f.under) == (case, under)), None)

    def rows(self, digits: int = 2) -> list[list[str]]:
        """Return the table: a row for each case, a column for each method or model.

        digits: significant ones of each value.
        """
        out = []
        for case in self.cases:
            found = [self.at(case, under) for under in self.unders]
            first = next(f for f in found if f is not None)
            out.append([case, first.title, first.bound, *(f.cell(digits) if f else "" for f in found)])
        return out

    def legend(self) -> list[tuple[str, str]]:
        """Return the verdicts that occur, each with its meaning."""
        occurring = {f.verdict for f in self.findings}
        return [(verdict, text) for verdict, text in VERDICTS.items() if verdict in occurring]


def select_cases(cases: Sequence[Case], names: Sequence[str]) -> tuple[Case, ...]:
    """Return cases by name or first word of a name (no names: all); raise ValueError for an unknown one."""
    known = {case.name for case in cases} | {case.name.split()[0] for case in cases}
    for name in names:
        if name not in known:
            raise ValueError(f"case {printable(name)}: unknown{nearest_few(name, known)}")
    return tuple(c for c in cases if not names or c.name in names or c.name.split()[0] in names)


def trials(cases: Sequence[Case], unders: Collection[str]) -> int:
    """Return the number of trials of these cases under these methods or models.

    unders: the names of the methods or models.
    """
    return sum(case.runs_under(name) for case in cases for name in unders)


def run(
    cases: Sequence[Case],
    unders: Mapping[str, Any],
    sources: str,
    known: Results | None = None,
    progress: Callable[[int], None] = lambda done: None,
    keep: Callable[[Results], None] = lambda results: None,
    warning_kinds: tuple[type[Warning], ...] = (),
    engine: Engine | None = None,
) -> Results:
    """Run every case under every method or model in `unders`, by name; return these findings with the known ones.

    cases: each with its name and its trial; sources: digest of the code on which findings depend.

    A case with names in `only` is run under no others. `warning_kinds` lead to the verdict "warned".
    Known findings from the same sources are kept and not run again; those from other sources are dropped. `progress`
    is called with the number done, `keep` with all findings after each trial, so an interrupted run loses nothing.
    engine: runs the trials as jobs (default: one after another in this process).

    Raises:
        RuntimeError: a trial raises an error that is no verdict, or its process ends in every attempt.
    """
    found = {(f.case, f.under): f for f in known.findings} if known and known.sources == sources else {}
    place = {case.name: k for k, case in enumerate(cases)}
    order = {name: k for k, name in enumerate(dict.fromkeys([*(under for _, under in found), *unders]))}

    def results_so_far() -> Results:
        def position(finding: Finding) -> tuple[int, str, int]:
            return place.get(finding.case, len(place)), finding.case, order[finding.under]

        return Results(findings=tuple(sorted(found.values(), key=position)), sources=sources)

    pairs = [(name, case) for name in unders for case in cases if case.runs_under(name)]
    jobs = [
        Job(
            f"{case.name} under {name}", _try_as_job, (case, name, unders[name], warning_kinds), [case.name, name],
            MEMORY,
        )
        for name, case in pairs if (case.name, name) not in found
    ]  # fmt: skip
    stored = len(pairs) - len(jobs)
    progress(stored)
    with closing((engine or LocalEngine(1)).run(jobs, lambda job: None)) as results:
        for done, (job, record) in enumerate(results, stored + 1):
            if isinstance(record, Failure):
                raise RuntimeError(f"{job.name}: {record}")
            finding = Finding.model_validate_json(record)
            found[finding.case, finding.under] = finding
            keep(results_so_far())
            progress(done)
    return results_so_far()


def _find_case(package: str, name: str) -> Case:
    """Return a case of a package by its name."""
    cases: tuple[Case, ...] = importlib.import_module(package).CASES
    return next(case for case in cases if case.name == name)


def _try_as_job(case: Case, name: str, argument: Any, warning_kinds: tuple[type[Warning], ...]) -> bytes:
    """Return the finding of one case under one method or model as JSON."""
    return _try_case(case, name, argument, warning_kinds).model_dump_json().encode()


def _try_case(case: Case, name: str, argument: Any, warning_kinds: tuple[type[Warning], ...]) -> Finding:
    """Return the finding of one case under one method or model."""
    began, value = perf_counter(), Value(math.nan, False)
    verdict: Verdict
    with warnings.catch_warnings(record=bool(warning_kinds)) as caught:
        for kind in warning_kinds:
            warnings.simplefilter("always", kind)
        try:
            value = case.trial(argument)
        except SimulationDiverged as error:
            verdict, note = "diverges", str(error)
        except ValueError as error:
            verdict, note = "refused", str(error)
        else:
            verdict, note = _judge(value), value.note
    warning = next((str(w.message) for w in caught or () if issubclass(w.category, warning_kinds)), "")
    return Finding(
        case=case.name, title=case.title, under=name, bound=case.bound, value=_finite_or_none(value.number),
        verdict="warned" if warning and verdict == "pass" else verdict,
        note="; ".join(text for text in (note, warning) if text), seconds=round(perf_counter() - began, 3),
        series=_round_series(value.series),
    )  # fmt: skip


def _judge(value: Value) -> Verdict:
    """Return the verdict on a result; NaN is within no bound."""
    if value.holds is None:
        return "reported"
    return "pass" if value.holds and not math.isnan(value.number) else "fails"


def _finite_or_none(number: float) -> float | None:
    """Return a finite number; None for any other."""
    return float(number) if math.isfinite(number) else None


def _round_series(series: Mapping[str, Sequence[float]]) -> dict[str, tuple[float | None, ...]]:
    """Return numbers rounded to six digits, enough for a picture; None if not finite."""
    return {
        name: tuple(None if (x := _finite_or_none(v)) is None else float(f"{x:.6g}") for v in values)
        for name, values in series.items()
    }
