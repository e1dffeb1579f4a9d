"""The comparison as one chart: per task, where each player lies between random actions and the best player."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from flockenv.evaluation.report import Results

__all__ = ["draw_summary", "write_summary"]

SHOWN = {"textbook": "textbook rules", "rules": "tuned rules", "ppo": "PPO"}
"""Players in the chart, and their names in its legend."""

HEIGHT, WIDTH = 4.2, 9.0
"""Inches."""


def write_summary(path: str | Path, results: Results) -> None:
    """Write the chart of a comparison as PNG; the file appears whole or not at all."""
    save_figure(path, draw_summary(results), 130)


def draw_summary(results: Results) -> Figure:
    """Return the chart. A score is (mean - random's) / (best mean - random's), its interval scaled in the same way."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes: Any = figure.add_subplot()
    for row, about in enumerate(results["tasks"].values()):
        players = about["players"]
        low, best = players["random"]["mean"], max(player["mean"] for player in players.values())
        for k, name in enumerate(SHOWN):
            value, left, right = (
                (players[name][key] - low) / (best - low) for key in ("mean", "mean_low", "mean_high")
            )
            y = row + (k - 1) * 0.22
            axes.plot([left, right], [y, y], color=COLOURS[k], linewidth=2.5)
            axes.plot(value, y, "o", color=COLOURS[k], markersize=6, label=SHOWN[name] if row == 0 else None)
        axes.axhline(row + 0.5, color=GRID, linewidth=0.8)
    names = list(results["tasks"])
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(0.0, 1.04)
    axes.set_xlabel("score: 0 = random actions, 1 = best player of the task (lines: 95 % intervals)", color=INK)
    axes.tick_params(colors=INK, length=0)
    for side in axes.spines.values():
        side.set_color(FAINT)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.1), ncols=len(SHOWN), frameon=False)
    return figure
