"""Experiments: questions about steering, each a file of cases and variants, of which a table and a picture are made.

To ask another one, write a plan (configs/experiments/). To measure something else: a file here with what is measured,
and its plan's class in PLANS.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from flockenv.core.errors import nearest, shown
from flockenv.scene.yaml_io import ConfigError, load
from flockenv.studies.experiments.experiment import Cell, Experiment, Results, Trial, run
from flockenv.studies.experiments.plan import Case, Plan, SteerPlan, Variant
from flockenv.studies.experiments.vicsek import NoisePlan

__all__ = [
    "PLANS",
    "Case",
    "Cell",
    "Experiment",
    "NoisePlan",
    "Plan",
    "Results",
    "SteerPlan",
    "Trial",
    "Variant",
    "load_plan",
    "run",
]

PLANS: dict[str, type[Plan]] = {"avoidance": SteerPlan, "arbitration": SteerPlan, "vicsek": NoisePlan}
"""The kinds of plans, by what is measured."""


class _Named(BaseModel):
    """Any plan: what it measures says which."""

    model_config = ConfigDict(extra="allow")
    measure: str


def load_plan(source: str | Path) -> Plan:
    """Return the plan that a YAML file or text describes; see `config.load`."""
    measure = load(source, _Named).measure
    if measure not in PLANS:
        raise ConfigError(
            f"measure = {shown(measure)}: unknown{nearest(measure, PLANS) or ';'} allowed: {', '.join(PLANS)}"
        )
    return load(source, PLANS[measure])
