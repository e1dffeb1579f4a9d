"""Picture of a front: the share of worlds with harm against the return without harm, a point per player and price."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure

__all__ = ["draw_front"]

TONES = {"rules": COLOURS[1], "policy": COLOURS[0], "hybrid": COLOURS[3], "random": FAINT, "planner": COLOURS[4]}


def draw_front(path: Path, content: Mapping[str, Any]) -> None:
    """Write the front of a task as PNG; content: of its file, as agents.front writes it.

    Prices of one policy are joined by a line. Random actions, whose return would set the scale, are left out.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.6, 4.8), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    shown = {name: point for name, point in content["players"].items() if point["kind"] != "random"}
    for name, point in shown.items():
        (x, *x_ends), (y, *y_ends) = point["worlds_with_harm"], point["return_without_harm"]
        errors = [[[abs(ends[0] - at)], [abs(ends[1] - at)]] for at, ends in ((x, x_ends), (y, y_ends))]
        axes.errorbar(
            x, y, xerr=errors[0], yerr=errors[1], fmt="o", ms=6, color=TONES[point["kind"]], ecolor=GRID, zorder=3
        )  # fmt: skip
        label = name if point["price"] is None else f"{point['price']:g}"
        axes.annotate(label, (x, y), (6, 5), textcoords="offset points", fontsize=8.5, color=INK, zorder=4)
    for player in dict.fromkeys(point["player"] for point in shown.values() if point["price"] is not None):
        priced = [point for point in shown.values() if point["player"] == player]
        line = [[point[key][0] for point in priced] for key in ("worlds_with_harm", "return_without_harm")]
        axes.plot(*line, color=TONES[priced[0]["kind"]], lw=1.2, zorder=2, label=f"{player}, at each price")
        axes.legend(frameon=False, fontsize=9)
    axes.set_xlabel("share of worlds in which a learner is harmed", color=INK)
    axes.set_ylabel("return without harm", color=INK)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    axes.grid(color=GRID, lw=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=FAINT, labelcolor=INK)
    title = f"{content['task']}: harm against return (upper left is better)"
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold", color=INK)
    save_figure(path, figure)
