"""The picture of agents.transfer: the change of a policy's return by setting, and all returns over computing time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.report import Results
from flockenv.core.atomic_files import replace_file
from flockenv.evaluation.plots import FAINT, FIXED, GRID, INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_chart", "write_chart"]

MARKS = "osD^vP*X<>"
OTHERS = ("#009E73", "#CC79A7", "#56B4E9")  # of Okabe and Ito's palette, for players that are not in FIXED


def write_chart(path: str | Path, results: Results) -> None:
    """Write the picture as a PNG file, whole or not at all."""
    figure = draw_chart(results)
    with replace_file(path) as file:
        figure.savefig(file, format="png", dpi=150, metadata={"Software": "flockenv"})


def draw_chart(results: Results) -> Figure:
    """Return the picture, a row per task: left, changes of the last player's return; right, all returns over time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tasks = results["tasks"]
    figure = Figure(figsize=(13.5, 1.5 + 3.7 * len(tasks)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(tasks), 2, squeeze=False, width_ratios=(1.05, 1.0))
    colours = _colours(tasks)
    for row, (task, about) in zip(grid, tasks.items(), strict=True):
        _draw_heat_map(row[0], task, about)
        _draw_returns(row[1], about, colours)
    legend = {}
    for axes in grid[:, 1]:
        handles, labels = axes.get_legend_handles_labels()
        legend |= dict(zip(labels, handles, strict=True))
    figure.legend(legend.values(), legend.keys(), loc="outside lower right", ncols=5, frameon=False, fontsize=9)
    pilots = " and ".join(dict.fromkeys(list(about["again"])[-1] for about in tasks.values()))
    figure.suptitle(f"What accuracy buys {pilots}", x=0.01, ha="left", fontsize=15, fontweight="bold", color=INK)
    return figure


def _drawn_players(results: Results) -> list[str]:
    """Return the players whose returns are drawn: all but random, whose returns are too low to share an axis."""
    return [name for name in results["again"] if name != "random"] or list(results["again"])


def _colours(tasks: Results) -> dict[str, str]:
    """Return a colour for each player, the same in every task."""
    players = dict.fromkeys(name for about in tasks.values() for name in _drawn_players(about) if name not in FIXED)
    return dict(zip(players, OTHERS * len(players), strict=False)) | FIXED


def _solver(about: Results) -> str:
    return str(about["method"]) + (" f32" if about["dtype"] == "float32" else "")


def _draw_heat_map(axes: Axes, task: str, results: Results) -> None:
    """Draw a heat map, method by dt, of the last player's return minus that under its trained setting; white = 0."""
    settings = results["settings"]
    pilot = list(results["again"])[-1]
    solvers = list(dict.fromkeys(_solver(about) for about in settings.values()))
    steps = sorted({about["substeps"] for about in settings.values()})
    table = np.full((len(solvers), len(steps)), np.nan)
    for about in settings.values():
        place = solvers.index(_solver(about)), steps.index(about["substeps"])
        table[place] = about["players"][pilot]["difference"]
    bound = float(np.nanmax(np.abs(table))) or 1.0
    shades = axes.imshow(table, cmap="RdBu", vmin=-bound, vmax=bound, aspect="auto")
    for name, about in settings.items():
        y, x = solvers.index(_solver(about)), steps.index(about["substeps"])
        _write_number(axes, x, y, about["players"][pilot], bound, name == results["trained"])
    assert axes.figure is not None
    axes.figure.colorbar(shades, ax=axes, pad=0.015, aspect=22).set_label(f"{pilot}: return minus trained", fontsize=9)
    axes.set_yticks(range(len(solvers)), solvers)
    axes.set_xticks(range(len(steps)), [f"{results['control_dt'] / n:.4g}" for n in steps])
    axes.set_xlabel("dt, s")
    axes.set_title(task, loc="left", fontsize=12.5, fontweight="bold", color=INK)
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)


def _write_number(axes: Axes, x: int, y: int, player: Results, bound: float, trained: bool) -> None:
    """Write a cell's number: the difference, with (level) if its interval holds 0; a frame marks the trained one."""
    from matplotlib.patches import Rectangle

    value = player["difference"]
    light = abs(value) > 0.62 * bound
    size = f"{value:+.2g}" if abs(value) >= 5e-5 else "0"
    text = "trained" if trained else size if player["separated"] else f"{size}\n(level)"
    colour = "white" if light else INK
    axes.text(x, y, text, ha="center", va="center", fontsize=9, color=colour, linespacing=1.1)
    if trained:
        axes.add_patch(Rectangle((x - 0.48, y - 0.47), 0.96, 0.94, fill=False, edgecolor=INK, linewidth=1.6))


def _draw_returns(axes: Axes, results: Results, colours: dict[str, str]) -> None:
    """Draw the mean return of each player over the time that a simulated second takes, a mark per method."""
    settings, players = results["settings"], _drawn_players(results)
    solvers = list(dict.fromkeys(_solver(about) for about in settings.values()))
    for k, solver in enumerate(solvers):
        about_solver = sorted((a for a in settings.values() if _solver(a) == solver), key=lambda a: a["substeps"])
        times = [about["us_per_s"] for about in about_solver]
        for name in players:
            heights = [about["players"][name]["mean"] for about in about_solver]
            axes.plot(times, heights, color=colours[name], linewidth=0.7, alpha=0.35, zorder=1)
            style: dict[str, Any] = {"marker": MARKS[k % len(MARKS)], "s": 30, "linewidths": 0, "alpha": 0.85}
            axes.scatter(times, heights, color=colours[name], zorder=2, **style)
        axes.scatter([], [], color=FAINT, label=solver, **style)
    trained = settings[results["trained"]]
    for name in players:
        place = [trained["us_per_s"]], [trained["players"][name]["mean"]]
        axes.scatter(*place, s=130, facecolors="none", edgecolors=INK, linewidths=1.3, zorder=3)
        axes.plot([], [], color=colours[name], linewidth=4, label=name)
    axes.scatter([], [], s=110, facecolors="none", edgecolors=INK, linewidths=1.3, label="trained setting")
    axes.set_xlabel("time per simulated second and world, µs")
    axes.set_ylabel("mean return")
    axes.grid(color=GRID, linewidth=0.8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
