"""Runs of hard cases under methods."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.jobs import Engine
from flockenv.physics.integrators import INTEGRATORS, Integrator
from flockenv.studies import sources, trial_log
from flockenv.studies.sources import SIMULATOR
from flockenv.studies.stress.setup import TOO_LONG
from flockenv.studies.trial_log import Case, Results

__all__ = ["fingerprint", "run", "usual_methods"]

TOLD = (*TOO_LONG, UnsolvedContactsWarning)
"""Warnings that are part of a verdict."""


def usual_methods() -> tuple[Integrator, ...]:
    """Return every method, explicit ones first."""
    return tuple(sorted((kind() for kind in INTEGRATORS.values()), key=lambda m: (m.solves, m.adaptive, m.order)))


def fingerprint() -> str:
    """Return a digest of the code that findings depend on: the simulator, and the cases themselves."""
    return sources.fingerprint((*SIMULATOR, "studies/stress"), but=("plots.py",))


def run(
    cases: Sequence[Case],
    methods: Sequence[Integrator],
    known: Results | None = None,
    progress: Callable[[int], None] = lambda done: None,
    keep: Callable[[Results], None] = lambda results: None,
    engine: Engine | None = None,
) -> Results:
    """Run every case under every method, and return the findings with the known ones; see `trial_log.run`.

    cases: such as those of `stress.CASES`; methods: instances; known: findings that are not computed again; progress,
    keep and engine: as of `trial_log.run`.
    """
    return trial_log.run(cases, {m.kind: m for m in methods}, fingerprint(), known, progress, keep, TOLD, engine)
