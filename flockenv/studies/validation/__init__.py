"""Validation: test scenes of pedestrian models, with every preset; each has a bound, a value and a verdict.

from flockenv.studies.validation import CASES, run
results = run(CASES, ("helbing_farkas_vicsek_2000",))

Names and bounds are those of RiMEA, NIST TN 1822 and JuPedSim's tests; values of presets are the published ones. A
missed bound is a verdict and not an error.
"""

from __future__ import annotations

from flockenv.core.errors import nearest, printable
from flockenv.scene.presets import PRESETS
from flockenv.studies.trial_log import VERDICTS, Case, Finding, Results, Value, select_cases, trials
from flockenv.studies.validation.alone import ALONE
from flockenv.studies.validation.corridors import CORRIDORS
from flockenv.studies.validation.doors import DOORS
from flockenv.studies.validation.runner import fingerprint, run

__all__ = [
    "CASES",
    "VALIDATED",
    "VERDICTS",
    "Case",
    "Finding",
    "Results",
    "Value",
    "fingerprint",
    "run",
    "select_cases",
    "select_presets",
    "trials",
]  # fmt: skip

CASES: tuple[Case, ...] = (*ALONE, *CORRIDORS, *DOORS)
"""Every case."""

VALIDATED = tuple(name for name in PRESETS if name != "moussaid_2010_groups")
"""Every preset of a whole model: the omitted one is moussaid_2009 plus forces that keep groups together."""


def select_presets(names: list[str]) -> tuple[str, ...]:
    """Return presets by name or alias (no names: all); raise ValueError with the nearest name for an unknown one."""
    from flockenv.scene.presets import ALIASES

    for name in names:
        if name not in PRESETS and name not in ALIASES:
            raise ValueError(
                f"--preset = {printable(name)}: unknown{nearest(name, [*PRESETS, *ALIASES])}; {', '.join(PRESETS)}"
            )
    return tuple(dict.fromkeys(ALIASES.get(name, name) for name in names)) or VALIDATED
