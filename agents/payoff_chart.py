"""Heat map of payoffs: what one agent gains by each player, among others of each player."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flockenv.evaluation.plots import FAINT, INK, save_figure

__all__ = ["draw_payoffs"]


def draw_payoffs(path: Path, content: Mapping[str, Any]) -> None:
    """Write the heat map of a task as PNG; content: of its file, as agents.best_response writes it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names, gains = content["players"], content["gain"]
    size, largest = len(names), max((abs(values[0]) for values in gains.values()), default=0.0) or 1.0
    figure = Figure(figsize=(2.2 + 1.7 * size, 1.6 + 0.75 * size), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    table = [[gains.get(f"{one} among {others}", [0.0])[0] for others in names] for one in names]
    axes.imshow(table, cmap="RdBu", vmin=-1.6 * largest, vmax=1.6 * largest, aspect="auto")
    for row, one in enumerate(names):
        for column, others in enumerate(names):
            text = _text(content, one, others)
            axes.text(column, row, text, ha="center", va="center", fontsize=8.5, color=INK, linespacing=1.35)
    axes.set_xticks(range(size), names)
    axes.set_yticks(range(size), names)
    axes.set_xlabel("all other agents play", color=INK)
    axes.set_ylabel("one agent plays", color=INK)
    axes.tick_params(colors=FAINT, labelcolor=INK, length=0)
    axes.spines[:].set_visible(False)
    title = f"{content['task']}: mean return of one agent, and its gain over playing as the others do"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
    save_figure(path, figure)


def _text(content: Mapping[str, Any], one: str, others: str) -> str:
    """Return the text of a cell: the mean, and off the diagonal the gain with its interval."""
    mean = f"{content['mean'][f'{one} among {others}'][0]:.3g}"
    if one == others:
        return mean
    value, low, high = content["gain"][f"{one} among {others}"]
    return f"{mean}\n{value:+.3g} [{low:.3g}, {high:.3g}]"
