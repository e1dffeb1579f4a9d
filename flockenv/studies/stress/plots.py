"""The picture of hard cases: a row for each, a column for each method, a colour for each verdict."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from flockenv.evaluation.plots import INK, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from flockenv.studies.trial_log import Results, Verdict

__all__ = ["draw_verdicts", "write_verdicts"]

FILL: dict[Verdict, str] = {
    "pass": "#b7e0c8", "warned": "#dfeab0", "refused": "#fbe3a6", "fails": "#f3a683", "diverges": "#c9b3e0",
}  # fmt: skip
"""Colours of verdicts; each cell also has its verdict as text."""


def write_verdicts(path: str | Path, results: Results) -> None:
    """Write the picture as a PNG file, whole or not at all; the same findings give the same bytes."""
    save_figure(path, draw_verdicts(results), 90)


def draw_verdicts(results: Results) -> Figure:
    """Return the picture; ValueError if there is nothing to draw."""
    if not results.findings:
        raise ValueError("verdicts: needs at least one finding")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    cases, methods = results.cases, results.unders
    wide, left = 1.15, 5.6
    figure = Figure(figsize=(left + wide * len(methods), 1.7 + 0.36 * len(cases)), facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, left + wide * len(methods))
    axes.set_ylim(len(cases) * 0.36 + 1.7, 0)
    axes.axis("off")
    axes.text(0.15, 0.35, "Hard cases", fontsize=14, fontweight="bold", color=INK)
    for k, method in enumerate(methods):
        label = method.replace("_", "\n")
        axes.text(left + wide * (k + 0.5), 1.2, label, fontsize=8, ha="center", va="bottom", color=INK)
    for row, case in enumerate(cases):
        y = 1.3 + 0.36 * row
        found = [results.at(case, method) for method in methods]
        title = next(f.title for f in found if f is not None)
        axes.text(0.15, y + 0.18, case, fontsize=8, va="center", fontweight="bold", color=INK)
        axes.text(1.55, y + 0.18, title, fontsize=8, va="center", color=INK)
        for k, finding in enumerate(found):
            if finding is None:
                continue
            x = left + wide * k
            axes.add_patch(Rectangle((x + 0.02, y + 0.02), wide - 0.04, 0.32, color=FILL[finding.verdict], linewidth=0))
            axes.text(x + wide / 2, y + 0.18, finding.cell(), fontsize=7, ha="center", va="center", color=INK)
    return figure
