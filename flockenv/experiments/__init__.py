"""Experiments: questions about steering, each a command that prints a table and draws a picture.

To add one: a file with an `EXPERIMENT`; `flockenv experiment NAME` finds it here.
"""

from __future__ import annotations

import importlib
import pkgutil

from flockenv.experiments.base import Cell, Experiment, Results, Trial, run

__all__ = ["EXPERIMENTS", "Cell", "Experiment", "Results", "Trial", "run"]

_modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]

EXPERIMENTS: dict[str, Experiment] = {
    module.EXPERIMENT.name: module.EXPERIMENT for module in _modules if hasattr(module, "EXPERIMENT")
}
"""Every experiment by its name."""
