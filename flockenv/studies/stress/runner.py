"""Runs of hard cases under methods."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from flockenv.core.warnings import UnsolvedContactsWarning
from flockenv.jit.sources import laws_digest
from flockenv.physics.integrators import INTEGRATORS, Integrator
from flockenv.studies import trial_log
from flockenv.studies.stress.setup import TOO_LONG
from flockenv.studies.trial_log import Case, Results

__all__ = ["fingerprint", "run", "usual_methods"]

TOLD = (*TOO_LONG, UnsolvedContactsWarning)
"""Warnings that are part of a verdict."""


def usual_methods() -> tuple[Integrator, ...]:
    """Return every method, explicit ones first."""
    return tuple(sorted((kind() for kind in INTEGRATORS.values()), key=lambda m: (m.solves, m.adaptive, m.order)))


def fingerprint() -> str:
    """Return a digest of the sources that findings depend on: laws, methods, and the cases themselves."""
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
    """Run every case under every method, and return the findings with the known ones; see `findings.run`."""
    return trial_log.run(cases, {m.kind: m for m in methods}, fingerprint(), known, progress, keep, TOLD)
