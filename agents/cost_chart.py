"""The picture of agents.cost_of_accuracy: error against time in three scenes, and below it the scores of players."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.transfer_verdict import SURVIVES
from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure
from flockenv.evaluation.report import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

__all__ = ["METHODS", "draw_chart", "method_name", "write_chart"]

METHODS = {
    "explicit_euler": ("explicit Euler", COLOURS[2]), "semi_implicit_euler": ("semi-implicit Euler", COLOURS[0]),
    "midpoint": ("midpoint", FAINT), "velocity_verlet": ("velocity Verlet", COLOURS[3]), "rk4": ("RK4", COLOURS[1]),
    "implicit_euler": ("implicit Euler", COLOURS[4]), "implicit_midpoint": ("implicit midpoint", INK),
    "linearly_implicit_euler": ("linearly implicit Euler", COLOURS[5]),
}  # fmt: skip
"""Name and colour of each method, the same in every panel."""

PLAYERS = {"ppo": ("PPO", "o", 10.0), "rules": ("tuned rules", "D", 5.5)}
"""Name, mark and size of each player."""

TOP, LOW = 1.0, 1e-6
"""Errors between which the upper panels are drawn."""

LABEL = 0.05
"""Height of a label at the end of a line, as a share of the panel's."""

RIGHT = 0.36
"""Part of an upper panel that is left free at its right, for labels."""


def write_chart(path: str | Path, results: Results) -> None:
    """Write the picture as a PNG file, whole or not at all."""
    save_figure(path, draw_chart(results), 110)


def draw_chart(results: Results) -> Figure:
    """Return the picture: upper row, errors of methods in scenes; lower row, scores of players in tasks."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes, tasks = results["scenes"], results["tasks"]
    figure = Figure(figsize=(15.0, 9.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.4, 1.0), hspace=0.04)
    upper, lower = parts
    aim = f"{100 * results['aim']:.0f} %"
    _write_heading(
        upper, f"Error against computing time. Ring: cheapest for {aim}. Dotted: unstable with longer steps."
    )
    for axes, about in zip(upper.subplots(1, len(scenes), squeeze=False)[0], scenes.values(), strict=True):
        _draw_scene(axes, about, results["aim"])
    _write_heading(lower, "Score of players with the same methods, against computing time")
    for axes, (task, about) in zip(lower.subplots(1, len(tasks), squeeze=False)[0], tasks.items(), strict=True):
        _draw_scores(axes, task, about)
    return figure


def _write_heading(part: SubFigure, text: str) -> None:
    part.suptitle(text, x=0.01, ha="left", fontsize=17, fontweight="bold", color=INK)


def method_name(method: str) -> str:
    """Return the name of an integrator as text: 'velocity Verlet'."""
    return METHODS[method][0] if method in METHODS else method.replace("_", " ")


# --- scenes -----------------------------------------------------------------------------------------------------------


def _draw_scene(axes: Axes, about: Results, aim: float) -> None:
    """Draw a line per method, and a ring where the cheapest one reaches the aim; dotted: longer steps are unstable."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(LOW, TOP)
    axes.axhline(aim, color=INK, linewidth=1.2, linestyle=(0, (4, 3)), zorder=1)
    ends = {}
    for method, points in about["methods"].items():
        places = [(p["ms_per_s"], p["error"]) for p in points if p["ms_per_s"] and p["error"] and p["error"] < TOP]
        if not places:
            continue
        colour = METHODS[method][1]
        axes.plot(*zip(*places, strict=True), color=colour, linewidth=2.4, marker="o", markersize=5, zorder=3)
        if len(places) < len(points):
            cost, error = places[0]
            axes.plot((cost, cost), (error, TOP), color=colour, linewidth=1.6, linestyle=":", zorder=2)
        ends[method] = [place for place in places if place[1] > LOW][-1]
    _set_times(axes, [place[0] for place in _places(about)])
    _write_names(axes, ends)
    if (best := about["cheapest"]) is not None:
        _draw_ring(axes, best, about["to_aim"][best])
    axes.set_title(about["title"], loc="left", fontsize=14, color=INK)
    axes.set_xlabel("computing time per simulated second", fontsize=12, color=INK)
    axes.set_yticks([1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6],
                    ["100 %", "10 %", "1 %", "0.1 %", "0.01 %", "0.001 %", ""])  # fmt: skip
    axes.minorticks_off()
    _finish(axes)


def _places(about: Results) -> list[tuple[float, float]]:
    """Return time and error of all points of a scene that are drawn."""
    points = [point for points in about["methods"].values() for point in points]
    return [(p["ms_per_s"], p["error"]) for p in points if p["ms_per_s"] and p["error"] and LOW < p["error"] < TOP]


def _set_times(axes: Axes, times: list[float]) -> None:
    """Set the limits of the time axis, with room for labels at its right, and ticks in ms or s."""
    low, high = min(times) / 1.6, max(times)
    axes.set_xlim(low, high * (high / low) ** (RIGHT / (1.0 - RIGHT)))
    ticks = [10.0**k for k in range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)]
    axes.set_xticks(ticks, [f"{t:g} ms" if t < 1000 else f"{t / 1000:g} s" for t in ticks])


def _write_names(axes: Axes, ends: dict[str, tuple[float, float]]) -> None:
    """Write the name of each method at the end of its line, pushed apart so that each can be read."""
    gap, above = LABEL * math.log(TOP / LOW), math.inf
    for method, (x, y) in sorted(ends.items(), key=lambda end: -end[1][1]):
        above = min(math.log(y), above - gap)
        name, colour = METHODS[method]
        axes.annotate(
            name, (x, y), (x * 1.3, math.exp(above)), textcoords="data", va="center", fontsize=12, color=colour,
            annotation_clip=False, zorder=4,
        )  # fmt: skip


def _draw_ring(axes: Axes, method: str, choice: Results) -> None:
    """Draw a ring at the cheapest choice for the aim, and write its method and its time in the lower right corner."""
    name, colour = METHODS[method]
    cost = choice["ms_per_s"]
    ring: dict[str, Any] = {"markerfacecolor": "none", "markeredgecolor": colour, "markeredgewidth": 3.2}
    axes.plot(cost, choice["error"], marker="o", markersize=18, zorder=5, **ring)
    text = f"{name}: {cost:.2g} ms" if cost < 1000 else f"{name}: {cost / 1000:.2g} s"
    axes.text(0.99, 0.03, text, transform=axes.transAxes, ha="right", fontsize=14, fontweight="bold", color=colour)


# --- scores -----------------------------------------------------------------------------------------------------------


def _draw_scores(axes: Axes, task: str, about: Results) -> None:
    """Draw the score of each player over time, a colour per method, a mark per player; the worst is named."""
    points = [(point, player) for player, found in about["players"].items() for point in found]
    for point, player in points:
        _, mark, size = PLAYERS[player]
        colour = METHODS[point["method"]][1]
        axes.plot(
            point["us_per_s"], point["score"], color=colour, marker=mark, markersize=size, markeredgewidth=1.8,
            markerfacecolor=colour if player == "ppo" else "white", zorder=3 if player == "ppo" else 4,
        )  # fmt: skip
    for name, mark, size in PLAYERS.values():
        axes.plot([], [], color=FAINT, linestyle="none", marker=mark, markersize=size, markeredgewidth=1.8, label=name,
                  markerfacecolor=FAINT if name == "PPO" else "white")  # fmt: skip
    worst = min((point for point, player in points if player == "ppo"), key=lambda point: point["score"])
    if worst["score"] < SURVIVES:
        name, colour = METHODS[worst["method"]]
        axes.annotate(f"{name}, dt {worst['dt']:.2g} s", (worst["us_per_s"], worst["score"]), (10, -16), fontsize=12,
                      textcoords="offset points", color=colour)  # fmt: skip
    axes.axhline(1.0, color=INK, linewidth=1.2, linestyle=(0, (4, 3)), zorder=1)
    axes.set_ylim(min(0.0, 1.1 * min(point["score"] for point, _ in points)), 1.2)
    axes.set_title(task, loc="left", fontsize=14, color=INK)
    axes.set_xlabel("computing time per simulated second, µs", fontsize=12, color=INK)
    axes.set_yticks([0.0, 0.5, 1.0], ["random 0", "0.5", "tuned rules 1"])
    axes.legend(loc="lower right", frameon=False, fontsize=12, labelcolor=INK)
    _finish(axes)


def _finish(axes: Axes) -> None:
    axes.grid(which="major", color=GRID, linewidth=0.9, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", labelsize=12, labelcolor=INK, color=GRID)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
