"""Runs of crowds in cases, by preset."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flockenv.jobs import Engine
from flockenv.studies import sources, trial_log
from flockenv.studies.sources import SIMULATOR
from flockenv.studies.trial_log import Case, Results
from flockenv.studies.validation.quiet import ignore_contact_warnings

__all__ = ["fingerprint", "run"]


def fingerprint() -> str:
    """Return a digest of the code that findings depend on: the simulator, measures and cases."""
    return sources.fingerprint((*SIMULATOR, "studies/measures", "studies/validation"), but=("page.py", "plots.py"))


def run(
    cases: Sequence[Case],
    presets: Sequence[str],
    known: Results | None = None,
    progress: Callable[[int], None] = lambda done: None,
    keep: Callable[[Results], None] = lambda results: None,
    engine: Engine | None = None,
) -> Results:
    """Run every case with every preset, and return the findings with the known ones; see `trial_log.run`.

    cases: such as those of `validation.CASES`; presets: names of `PRESETS`; known: findings that are not computed
    again; progress, keep and engine: as of `trial_log.run`.
    """
    with ignore_contact_warnings():
        return trial_log.run(cases, {name: name for name in presets}, fingerprint(), known, progress, keep, (), engine)
