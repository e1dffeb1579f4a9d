"""Experiments: questions about steering, each a file of scenes and variants, of which a table and a picture are made.

To ask another one, write a plan (configs/experiments/). To measure something else: a file here with COLUMNS, SHOWN and
`trial(plan, case, variant)`, and its name in `Plan.measure`.
"""

from __future__ import annotations

from flockenv.experiments.base import Cell, Experiment, Results, Trial, experiment_of, run
from flockenv.experiments.plan import Case, Plan, Variant

__all__ = ["Case", "Cell", "Experiment", "Plan", "Results", "Trial", "Variant", "experiment_of", "run"]
