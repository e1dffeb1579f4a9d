"""The picture of agents.transfer: what each setting costs a policy, in shares of its lead over random, on one scale."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.cost_chart import method_name
from agents.transfer_verdict import SURVIVES
from flockenv.evaluation.plots import FAINT, GRID, INK, save_figure
from flockenv.evaluation.report import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["SCALE", "draw_chart", "write_chart"]

SCALE = 0.25
"""Change of the lead over random at the ends of the colour scale; larger ones have the colours of the ends."""

COLOURS = "RdBu"
"""Colour map: losses are red, gains are blue."""

ABREAST = 4
"""Most panels side by side."""


def write_chart(path: str | Path, results: Results) -> None:
    """Write the picture as a PNG file, whole or not at all."""
    save_figure(path, draw_chart(results), 110)


def draw_chart(results: Results) -> Figure:
    """Return the picture: a heat map per task, method by dt, of the last player; all have the same colour scale."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    tasks = results["tasks"]
    solvers = list(dict.fromkeys(_solver(about) for each in tasks.values() for about in each["settings"].values()))
    wide = min(ABREAST, len(tasks))
    high = -(-len(tasks) // wide)
    figure = Figure(figsize=(2.6 + 2.6 * wide, 1.7 + (0.75 + 0.36 * len(solvers)) * high), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(high, wide, squeeze=False, sharey=True)
    colours = ScalarMappable(Normalize(-SCALE, SCALE), COLOURS)
    for axes, (task, about) in zip(grid.flat, tasks.items(), strict=False):
        _draw_heat_map(axes, task, about, solvers)
    for axes in grid.flat[len(tasks) :]:
        axes.set_axis_off()
    pilots = " and ".join(dict.fromkeys(list(about["again"])[-1] for about in tasks.values()))
    bar = figure.colorbar(colours, ax=grid, location="bottom", aspect=60, shrink=0.6, extend="both")
    bar.set_label(f"gain or loss of {pilots}, % of its lead over random actions (frame: setting of training)")
    ticks = [k * SCALE / 5 for k in range(-5, 6)]
    bar.set_ticks(ticks, labels=[_percent_text(tick) for tick in ticks])
    bar.outline.set_visible(False)
    figure.suptitle(_title(tasks, pilots), x=0.01, ha="left", fontsize=15, fontweight="bold", color=INK)
    return figure


def _title(tasks: Results, pilots: str) -> str:
    """Return the message of the picture: in how many tasks nothing matters."""
    safe = sum(not any(_is_lost(about, name) for name in about["settings"]) for about in tasks.values())
    return f"{pilots} keeps {100 * SURVIVES:.0f} % of its lead in every setting in {safe} of {len(tasks)} tasks"


def _is_lost(results: Results, setting: str) -> bool:
    return _kept(results, setting) < SURVIVES


def _kept(results: Results, setting: str) -> float:
    """Return the share of its lead that the last player keeps; NaN without random."""
    return float(results["settings"][setting]["players"][list(results["again"])[-1]].get("kept", np.nan))


def _solver(about: Results) -> str:
    return method_name(about["method"]) + (" float32" if about["dtype"] == "float32" else "")


def _draw_heat_map(axes: Axes, task: str, results: Results, solvers: list[str]) -> None:
    """Draw the changes of the last player's lead, method by dt; white: none. Bold: the setting is not survived."""
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle

    settings = results["settings"]
    steps = sorted({about["substeps"] for about in settings.values()})
    table = np.full((len(solvers), len(steps)), np.nan)
    for name, about in settings.items():
        y, x = solvers.index(_solver(about)), steps.index(about["substeps"])
        table[y, x] = _kept(results, name) - 1.0
        if np.isfinite(table[y, x]):
            tone, weight = _tone(table[y, x]), "bold" if _is_lost(results, name) else "normal"
            text = _percent_text(table[y, x])
            axes.text(x, y, text, ha="center", va="center", fontsize=10, color=tone, fontweight=weight)
        if name == results["trained"]:
            axes.add_patch(Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, fill=False, edgecolor=INK, linewidth=1.6))
    for y, x in np.argwhere(np.isnan(table)):
        axes.text(x, y, "–", ha="center", va="center", fontsize=10, color=FAINT)
    axes.imshow(table, cmap=COLOURS, norm=Normalize(-SCALE, SCALE), aspect="auto")
    axes.set_yticks(range(len(solvers)), solvers)
    axes.set_xticks(range(len(steps)), [f"{results['control_dt'] / n:.4g}" for n in steps])
    axes.set_xlabel("dt, s", fontsize=9, labelpad=1)
    axes.set_title(task, loc="left", fontsize=12, fontweight="bold", color=INK)
    axes.tick_params(length=0, labelsize=10, colors=INK)
    axes.set_facecolor(GRID)
    for side in axes.spines.values():
        side.set_visible(False)


def _percent_text(change: float) -> str:
    """Return a change as text, in percent: '-14', '+3' or '0'."""
    percent = round(100 * change)
    return f"{percent:+d}" if percent else "0"


def _tone(change: float) -> str:
    """Return the colour of a number that can be read on the colour of its change."""
    return "white" if abs(change) > 0.62 * SCALE else INK
