"""What was found: a finding for each case and preset, as a table and as JSON."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Literal

from pydantic import Field

from flockenv.records import Record

__all__ = ["VERDICTS", "Finding", "Results", "Verdict"]

Verdict = Literal["pass", "misses", "reported", "refused", "diverges"]

VERDICTS: dict[Verdict, str] = {
    "pass": "within the bound",
    "misses": "beyond the bound: the number is what came of it",
    "reported": "there is no bound, only a number",
    "refused": "the preset cannot be used here, and the scene says why",
    "diverges": "no longer finite, and reported",
}


class Finding(Record):
    """One preset in one case."""

    case: str
    title: str
    preset: str
    bound: str
    value: float | None = Field(description="what is bounded; none if it came to no number")
    verdict: Verdict
    note: str = ""
    seconds: float = Field(ge=0, description="s, wall time, compiling included")
    series: dict[str, tuple[float | None, ...]] = Field(default_factory=dict, description="what pictures show")

    @property
    def cell(self) -> str:
        """Value and verdict, short."""
        mark = {"pass": "ok", "misses": "MISSES", "reported": "", "refused": "refused", "diverges": "diverges"}
        number = "" if self.value is None or not math.isfinite(self.value) else f"{self.value:.3g} "
        return f"{number}{mark[self.verdict]}".strip() or "-"


class Results(Record):
    """All that was found, and by which sources."""

    findings: tuple[Finding, ...]
    sources: str = Field(default="", description="fingerprint of the laws, presets and cases")

    @property
    def presets(self) -> list[str]:
        """Names of presets, in the order in which they were tried."""
        return list(dict.fromkeys(f.preset for f in self.findings))

    @property
    def cases(self) -> list[str]:
        """Names of cases, in order."""
        return list(dict.fromkeys(f.case for f in self.findings))

    def only(self, cases: Collection[str], presets: Collection[str]) -> Results:
        """Return what was found in some cases with some presets."""
        found = tuple(f for f in self.findings if f.case in cases and f.preset in presets)
        return self.model_copy(update={"findings": found})

    def at(self, case: str, preset: str) -> Finding | None:
        """Return one finding; none if that was not tried."""
        return next((f for f in self.findings if (f.case, f.preset) == (case, preset)), None)

    def rows(self) -> list[list[str]]:
        """Return the table: a row for each case, a column for each preset."""
        out = []
        for case in self.cases:
            found = [self.at(case, preset) for preset in self.presets]
            first = next(f for f in found if f is not None)
            out.append([case, first.title, first.bound, *(f.cell if f else "" for f in found)])
        return out
