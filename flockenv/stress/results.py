"""What was found: a finding for each case and method, as a table, as JSON, as a picture."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Literal

from pydantic import Field

from flockenv.records import Record

__all__ = ["VERDICTS", "Finding", "Results", "Verdict"]

Verdict = Literal["pass", "warned", "refused", "fails", "diverges"]

VERDICTS: dict[Verdict, str] = {
    "pass": "within the bound",
    "warned": "within the bound, after a warning: of a step that is too long, of contacts that were not solved",
    "refused": "the scene was refused: this step must blow up, and the message names the largest that does not",
    "fails": "beyond the bound",
    "diverges": "no longer finite, and reported: world, agent, step, effect",
}


class Finding(Record):
    """One method in one case."""

    case: str
    title: str
    method: str
    bound: str
    value: float | None = Field(description="what is bounded; none if it came to no number")
    verdict: Verdict
    note: str = ""
    seconds: float = Field(ge=0, description="s, wall time, compiling included")

    @property
    def cell(self) -> str:
        """Value and verdict, short."""
        mark = {"pass": "ok", "warned": "warned", "refused": "refused", "fails": "FAILS", "diverges": "diverges"}
        number = "" if self.value is None or not math.isfinite(self.value) else f"{self.value:.2g} "
        return f"{number}{mark[self.verdict]}"


class Results(Record):
    """All that was found, and by which sources."""

    findings: tuple[Finding, ...]
    sources: str = Field(default="", description="fingerprint of the laws, methods and cases")

    @property
    def methods(self) -> list[str]:
        """Kinds of methods, in the order in which they were tried."""
        return list(dict.fromkeys(f.method for f in self.findings))

    @property
    def cases(self) -> list[str]:
        """Names of cases, in order."""
        return list(dict.fromkeys(f.case for f in self.findings))

    def only(self, cases: Collection[str], methods: Collection[str]) -> Results:
        """Return what was found in some cases under some methods."""
        found = tuple(f for f in self.findings if f.case in cases and f.method in methods)
        return self.model_copy(update={"findings": found})

    def at(self, case: str, method: str) -> Finding | None:
        """Return one finding; none if that was not tried."""
        return next((f for f in self.findings if (f.case, f.method) == (case, method)), None)

    def rows(self) -> list[list[str]]:
        """Return the table: a row for each case, a column for each method."""
        out = []
        for case in self.cases:
            found = [self.at(case, method) for method in self.methods]
            first = next(f for f in found if f is not None)
            out.append([case, first.title, first.bound, *(f.cell if f else "" for f in found)])
        return out
