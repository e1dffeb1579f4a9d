"""Hard cases: scenes that break naive simulators, under every method, each with a bound, a value and a verdict.

from flockenv.stress import CASES, run
results = run(CASES, methods)

Cases are functions from a method to a `Value`; see `bodies`, `bonded`, `crowds`, `contacts`; for bodies that collide
there is a case per response, see `impacts`, `heaps`, `gatherings`. An error that a case raises is also a verdict: a
scene refused because its step must blow up, a simulation that diverges with a message. No case ends in NaN without one.
"""

from __future__ import annotations

from flockenv.findings import VERDICTS, Case, Finding, Results, Value, cases_named, trials
from flockenv.stress.bodies import BODIES
from flockenv.stress.bonded import BONDED
from flockenv.stress.contacts import CONTACTS
from flockenv.stress.crowds import CROWDS
from flockenv.stress.gatherings import GATHERINGS
from flockenv.stress.heaps import HEAPS
from flockenv.stress.impacts import IMPACTS
from flockenv.stress.runner import fingerprint, run, usual_methods

__all__ = [
    "CASES", "VERDICTS", "Case", "Finding", "Results", "Value", "cases_named", "fingerprint", "run", "trials",
    "usual_methods",
]  # fmt: skip

CASES: tuple[Case, ...] = (*BODIES, *BONDED, *CROWDS, *CONTACTS, *IMPACTS, *HEAPS, *GATHERINGS)
"""Every hard case, in the order of shared/reference/numerics.md, section 6.2, within each kind of scene."""
