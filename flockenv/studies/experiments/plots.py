"""The picture of an experiment: a row for each case, a column for each variant, with the paths of all agents."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flockenv.studies.experiments import Experiment, Trial

__all__ = ["draw_trials", "write_trials"]


WIDE, GAP = 1.9, 0.35
"""Inches: the width of a picture, and the height of the text below it."""


def write_trials(path: str | Path, experiment: Experiment, trials: Mapping[tuple[str, str], Trial]) -> None:
    """Write the picture as a PNG file, whole or not at all; the same trials give the same bytes."""
    save_figure(path, draw_trials(experiment, trials), 120)


def draw_trials(experiment: Experiment, trials: Mapping[tuple[str, str], Trial]) -> Figure:
    """Return the picture; ValueError if there is nothing to draw."""
    if not trials:
        raise ValueError("trials: needs at least one")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cases, variants = list(experiment.cases), list(experiment.variants)
    regions = [_region([trials[case, variant] for variant in variants]) for case in cases]
    shapes = [float((high[1] - low[1]) / (high[0] - low[0])) for low, high in regions]
    heights = [WIDE * min(max(shape, 0.25), 1.0) for shape in shapes]
    tall = 1.0 + sum(heights) + GAP * len(cases)
    figure = Figure(figsize=(0.5 + 1.08 * WIDE * len(variants), tall), facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.02, 1 - 0.3 / tall, experiment.title, fontsize=12, fontweight="bold", color=INK, va="center")
    grid = figure.subplots(len(cases), len(variants), squeeze=False, height_ratios=heights)
    for row, case in enumerate(cases):
        low, high = regions[row]
        for column, variant in enumerate(variants):
            axes, trial = grid[row, column], trials[case, variant]
            _draw_trial(axes, trial)
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
            axes.set_title(variant.replace("_", " ") if row == 0 else "", fontsize=8, color=INK)
            axes.set_xlabel(_caption(experiment, trial), fontsize=6.5, color=FAINT)
        grid[row, 0].set_ylabel(case.replace("_", " "), fontsize=8, fontweight="bold", color=INK)
    between = GAP * len(cases) / sum(heights)
    figure.subplots_adjust(
        left=0.35 / figure.get_figwidth(),
        right=0.995,
        bottom=0.4 / tall,
        top=1 - 0.75 / tall,
        wspace=0.08,
        hspace=between,
    )
    return figure


def _region(trials: list[Trial]) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the region of all paths and obstacles, m."""
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
    for outline in trial.scene.view.outlines(tuple(low), tuple(high)):
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
    """Return the numbers below a picture, as text."""
    numbers = {name: trial.numbers[name] for name in experiment.shown}
    return ", ".join(f"{name} {x:.2g}" if x == x else f"{name} -" for name, x in numbers.items())
