"""Hard cases: scenes that break naive simulators, under every method, each with a bound, a value and a verdict.

from flockenv.studies.stress import CASES, run
results = run(CASES, methods)

Cases are functions from a method to a `Value`; see `bodies`, `bonded`, `dice`, `sheets`, `crowds`, `contacts`; for
bodies that collide there is a case per response, see `impacts`, `heaps`, `gatherings`. An error that a case raises is
also a verdict: a scene refused because its step must blow up, a simulation that diverges with a message. No case ends
in NaN without one.
"""

from __future__ import annotations

from flockenv.studies.stress.bodies import BODIES
from flockenv.studies.stress.bonded import BONDED
from flockenv.studies.stress.contacts import CONTACTS
from flockenv.studies.stress.crowds import CROWDS
from flockenv.studies.stress.dice import DICE
from flockenv.studies.stress.gatherings import GATHERINGS
from flockenv.studies.stress.heaps import HEAPS
from flockenv.studies.stress.impacts import IMPACTS
from flockenv.studies.stress.runner import fingerprint, run, usual_methods
from flockenv.studies.stress.sheets import SHEETS
from flockenv.studies.trial_log import VERDICTS, Case, Finding, Results, Value, select_cases, trials

__all__ = [
    "CASES",
    "VERDICTS",
    "Case",
    "Finding",
    "Results",
    "Value",
    "fingerprint",
    "run",
    "select_cases",
    "trials",
    "usual_methods",
]  # fmt: skip

CASES: tuple[Case, ...] = (*BODIES, *BONDED, *DICE, *SHEETS, *CROWDS, *CONTACTS, *IMPACTS, *HEAPS, *GATHERINGS)
"""Every hard case, by kind of scene."""
