"""Pictures of a study: a map per task, of which kind of player is ahead and by how much, and all maps in small."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from agents.study import HOME
from agents.study_results import ALONE, GROUPS, KINDS, LEVEL, SettingResults, TaskResults
from flockenv.evaluation.plots import FAINT, INK, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_map", "draw_summary"]

SHADES = {"rules": "#9cc7e8", "policy": "#f2b48c", "hybrid": "#8fd3bd", "planner": "#dcb3cd", LEVEL: "#dde1e6",
          ALONE: "#f4f5f7"}  # fmt: skip
"""Light tones of Okabe and Ito's palette, so that text on them can be read."""

MEANING = {"rules": "hand-written rules", "policy": "learned policy", "hybrid": "learned on top of rules",
           "planner": "planner", LEVEL: "level", ALONE: "only one kind can play"}  # fmt: skip

ABREAST = 2
"""Success rates in one line of a box."""

MOST_LINES = 3
"""Lines for a name or a value in a box of the summary."""

LINE = 0.2
"""Height of a further line, inches."""


def draw_map(path: Path, results: TaskResults) -> None:
    """Write the map of a task as PNG: a row for each thing varied, a box for each value."""
    rows = [(HOME, [results.settings[0]])]
    rows += [(axis, [each for each in results.settings if each.axis == axis]) for axis in results.axes]
    wide = max(len(settings) for _, settings in rows)
    kinds = max(len(each.leaders) for each in results.settings)
    figure = _figure(2.2 + 1.75 * wide, 1.3 + (0.82 + LINE * max(kinds - ABREAST, 0)) * len(rows))
    axes = _blank_axes(figure, wide, len(rows))
    for at, (axis, settings) in enumerate(rows):
        label = axis.replace("_", " ") + (f"\n(home {_text(results.home[axis])})" if axis in results.home else "")
        axes.text(-0.08, at, label, ha="right", va="center", fontsize=9, color=INK)
        for place, each in enumerate(settings):
            _box(axes, place, at, each.winner)
            lines = "\n".join(text for text in (textwrap.fill(each.value, 26), _lead(each), _rates(each)) if text)
            axes.text(place + 0.5, at, lines, ha="center", va="center", fontsize=8, color=INK, linespacing=1.35)
    _legend(figure, results)
    title = f"{results.task}: which kind is ahead, by what difference in return, and success"
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold", color=INK)
    save_figure(path, figure)


def draw_summary(path: Path, results: Sequence[TaskResults], title: str) -> None:
    """Write all maps in small as PNG: a row per task; left what all tasks share, right what is varied in one."""
    shared = list(
        dict.fromkeys((s.axis, s.value) for group in GROUPS[1:-1] for each in results for s in each.groups[group])
    )
    axes_shared = list(dict.fromkeys(axis for axis, _ in shared))
    shared.sort(key=lambda pair: axes_shared.index(pair[0]))  # values of an axis side by side
    own = [each.groups[GROUPS[-1]] for each in results]
    first = 1 + len(shared)
    wide = first + max(map(len, own), default=0) + 0.4
    figure = _figure(2.0 + 0.78 * wide, 1.7 + 0.56 * len(results))
    axes = _blank_axes(figure, wide, len(results))
    for place, label in enumerate([HOME, *(f"{axis}\n{value}" for axis, value in shared)]):
        axes.text(place + 0.5, -0.62, label, ha="center", va="bottom", fontsize=7.5, color=INK)
    axes.text(first + 0.4, -0.62, "the task itself", ha="left", va="bottom", fontsize=7.5, color=INK)
    for at, each in enumerate(results):
        axes.text(-0.1, at, each.task, ha="right", va="center", fontsize=10, color=INK)
        found = {(s.axis, s.value): s for s in each.settings}
        for place, key in enumerate([(HOME, ""), *shared]):
            if key in found:
                _box(axes, place, at, found[key].winner)
        for place, setting in enumerate(own[at]):
            _box(axes, first + 0.4 + place, at, setting.winner)
            text = f"{setting.axis}\n{setting.value}".replace("_", " ")
            axes.text(
                first + 0.9 + place, at, _short(text), ha="center", va="center", fontsize=5.5, color=INK
            )  # fmt: skip
    _legend(figure, *results)
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    save_figure(path, figure)


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).replace("_", " ")


def _short(text: str, most: int = 17) -> str:
    """Return a text of few lines of at most `most` characters; what finds no room is cut."""
    lines = (textwrap.fill(line, most, max_lines=MOST_LINES, placeholder=" …") for line in text.split("\n"))
    return "\n".join(lines)


def _lead(setting: SettingResults) -> str:
    lead = setting.lead
    if lead is None:
        return ""
    name = setting.leaders[setting.first]
    return f"{name} {lead.value:+.2g}" if setting.winner != LEVEL else f"{name} {lead.value:+.2g}, level"


def _rates(setting: SettingResults) -> str:
    """Return the success rates of the players that stand for each kind, in one line if there is room."""
    rates = {name: setting.scores[name].success_rate.value for name in setting.leaders.values()}
    return (" / " if len(rates) <= ABREAST else "\n").join(f"{name} {rate:.0%}" for name, rate in rates.items())


def _box(axes: Axes, x: float, y: float, winner: str) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((x + 0.02, y - 0.46), 0.96, 0.92, facecolor=SHADES[winner], edgecolor="none"))


def _legend(figure: Figure, *results: TaskResults) -> None:
    from matplotlib.patches import Patch

    winners = {each.winner for task in results for each in task.settings}
    patches = [Patch(color=SHADES[kind], label=MEANING[kind]) for kind in (*KINDS, LEVEL, ALONE) if kind in winners]
    figure.legend(handles=patches, loc="outside lower left", ncols=len(patches), frameon=False, fontsize=9)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _blank_axes(figure: Figure, wide: float, high: int) -> Axes:
    axes = figure.subplots()
    axes.set(xlim=(0, wide), ylim=(high - 0.45, -0.55), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.tick_params(colors=FAINT)
    return axes
