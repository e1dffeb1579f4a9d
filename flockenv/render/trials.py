"""The picture of an experiment: a row for each case, a column for each variant, and where everybody went."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flockenv.outputs import replacing
from flockenv.render.chart import COLOURS, FAINT, GRID, INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flockenv.experiments import Experiment, Trial

__all__ = ["draw_trials", "write_trials"]


def write_trials(path: str | Path, experiment: Experiment, trials: Mapping[tuple[str, str], Trial]) -> None:
    """Write the picture as a PNG file, whole or not at all; the same trials give the same bytes."""
    figure = draw_trials(experiment, trials)
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=120, metadata={"Software": "flockenv"})


def draw_trials(experiment: Experiment, trials: Mapping[tuple[str, str], Trial]) -> Figure:
    """Return the picture; ValueError if there is nothing to draw."""
    if not trials:
        raise ValueError("trials: needs at least one")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cases, variants = list(experiment.cases), list(experiment.variants)
    figure = Figure(figsize=(1.2 + 1.9 * len(variants), 0.8 + 1.7 * len(cases)), facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(experiment.title, fontsize=12, fontweight="bold", color=INK, x=0.02, ha="left")
    grid = figure.subplots(len(cases), len(variants), squeeze=False)
    for row, case in enumerate(cases):
        low, high = _region([trials[case, variant] for variant in variants])
        for column, variant in enumerate(variants):
            axes, trial = grid[row, column], trials[case, variant]
            _draw_trial(axes, trial)
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
            axes.set_title(variant.replace("_", " ") if row == 0 else "", fontsize=8, color=INK)
            axes.set_xlabel(_caption(experiment, trial), fontsize=6.5, color=FAINT)
        grid[row, 0].set_ylabel(case.replace("_", " "), fontsize=8, fontweight="bold", color=INK)
    figure.subplots_adjust(left=0.04, right=0.99, bottom=0.07, top=0.86, wspace=0.08, hspace=0.3)
    return figure


def _region(trials: list[Trial]) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of where anybody went, with the obstacles, m."""
    points = [trial.path[..., :2].reshape(-1, 2) for trial in trials]
    points += [np.array([c.centre[:2]]) + s * c.radius for c in trials[0].scene.circles for s in (-1, 1)]
    points += [shape.extremes[:, :2] for shape in trials[0].scene.shapes]
    every = np.concatenate(points)
    return every.min(axis=0) - 0.5, every.max(axis=0) + 0.5


def _draw_trial(axes: Axes, trial: Trial) -> None:
    """Draw obstacles and paths; a dot where each ended."""
    from matplotlib.patches import Circle, Polygon

    low, high = _region([trial])
    for circle in trial.scene.circles:
        axes.add_patch(Circle((circle.centre[0], circle.centre[1]), circle.radius, color=GRID, ec=FAINT, lw=0.5))
    for outline in trial.scene.outlines(tuple(low), tuple(high)):
        axes.add_patch(Polygon(outline, closed=True, color=GRID, ec=FAINT, lw=0.5))
    colour = COLOURS[1]
    for k in range(trial.path.shape[1]):
        axes.plot(trial.path[:, k, 0], trial.path[:, k, 1], color=colour, lw=0.7, alpha=0.8)
    axes.plot(trial.path[-1, :, 0], trial.path[-1, :, 1], ".", color=colour, markersize=3)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(GRID)


def _caption(experiment: Experiment, trial: Trial) -> str:
    """Return the numbers that go below a picture."""
    return ", ".join(f"{name} {trial.numbers[name]:.2g}" for name in experiment.shown)
