"""Runs of crowds in cases, by preset."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from flockenv.jit.sources import laws_digest
from flockenv.studies import trial_log
from flockenv.studies.trial_log import Case, Results
from flockenv.studies.validation.quiet import quietly

__all__ = ["fingerprint", "run"]

BESIDE = ("presets.py", "spread.py", "targets.py", "ways.py", "eikonal.py")
"""Other files that findings depend on, without laws: models, people, floor fields."""


def fingerprint() -> str:
    """Return a digest of the sources that findings depend on: laws, models, measures and cases."""
    here = Path(__file__).parent
    paths = [path for path in here.glob("*.py") if path.stem != "page"]
    paths += [*(here.parent / "measures").glob("*.py"), *(here.parent / name for name in BESIDE)]
    digest = hashlib.sha256(laws_digest().encode())
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:20]


def run(
    cases: Sequence[Case],
    presets: Sequence[str],
    known: Results | None = None,
    progress: Callable[[int], None] = lambda done: None,
    keep: Callable[[Results], None] = lambda results: None,
) -> Results:
    """Run every case with every preset, and return the findings with the known ones; see `findings.run`."""
    with quietly():
        return trial_log.run(cases, {name: name for name in presets}, fingerprint(), known, progress, keep)
