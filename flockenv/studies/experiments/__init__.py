"""Experiments on steering, each a file of cases and variants that gives a table and a picture.

For a new experiment, write a plan (configs/experiments/). For a new measure, add a module here that computes it, and
the class of its plan to PLANS.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from flockenv.core.errors import nearest, printable
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
"""Classes of plans, by their `measure`."""


class _Named(BaseModel):
    """The one key that is read first: `measure`, which selects a plan's class."""

    model_config = ConfigDict(extra="allow")
    measure: str


def load_plan(source: str | Path) -> Plan:
    """Return the plan that a YAML file or text describes; see `yaml_io.load`.

    source: as of `yaml_io.load`.
    """
    measure = load(source, _Named).measure
    if measure not in PLANS:
        raise ConfigError(
            f"measure = {printable(measure)}: unknown{nearest(measure, PLANS) or ';'} allowed: {', '.join(PLANS)}"
        )
    return load(source, PLANS[measure])
