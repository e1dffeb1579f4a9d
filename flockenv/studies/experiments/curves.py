"""The picture of an experiment whose cases are numbers: its first column over them, a curve for each variant."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flockenv.evaluation.plots import COLOURS, FAINT, INK, save_figure
from flockenv.studies.measures.plots import name_axes, new_figure

if TYPE_CHECKING:
    from flockenv.studies.experiments import Experiment, Trial

__all__ = ["write_order"]


def write_order(path: str | Path, experiment: Experiment, trials: Mapping[tuple[str, str], Trial]) -> None:
    """Draw the first column with the second as its deviation, the third as a bound, the fourth as reference values."""
    assert experiment.curve is not None
    value, spread, bound, seen = list(experiment.columns)[:4]
    figure = new_figure(6.0, 4.4, experiment.title)
    axes = figure.subplots()
    x = np.array([float(case) for case in experiment.cases])
    for k, variant in enumerate(experiment.variants):
        rows = [trials[case, variant].numbers for case in experiment.cases]
        column = {name: np.array([row[name] for row in rows]) for name in experiment.columns}
        axes.errorbar(
            x, column[value], column[spread], fmt="o-", color=COLOURS[k], ms=4, lw=1.2, elinewidth=0.8, label=variant
        )
        axes.plot(x, column[bound], color=FAINT, lw=1, ls=(0, (4, 3)), label=bound if k == 0 else None, zorder=1)
        if np.isfinite(column[seen]).any():
            axes.plot(x, column[seen], "x", color=INK, ms=8, mew=1.6, label=seen, zorder=5)
    axes.legend(fontsize=8, frameon=False)
    axes.set_ylim(bottom=0)
    name_axes(axes, *experiment.curve)
    save_figure(path, figure)
