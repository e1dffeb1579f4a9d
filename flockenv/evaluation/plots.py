"""Interval plots: scores, success rates and paired differences of players, one column per task."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flockenv.core.atomic_files import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flockenv.evaluation import Interval

__all__ = ["COLOURS", "FAINT", "GRID", "INK", "Column", "Row", "draw_chart", "save_figure", "write_chart"]

INK, FAINT, GRID = "#22272e", "#6b7480", "#e4e7eb"
COLOURS = ("#D55E00", "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9")
"""Okabe and Ito's palette, distinct for any colour vision."""
COLOURS_OF_FILE = 64
"""Most colours of a PNG file with a palette."""
ABREAST = 4
"""Most tasks side by side; further ones go below."""

FIXED = {"random": "#8a929c", "textbook": "#E69F00", "rules": "#0072B2", "ppo": "#D55E00"}


@dataclass(frozen=True, eq=False)
class Row:
    """One player: intervals of its score and its success rate, and the scores of single worlds, drawn behind."""

    name: str
    score: Interval
    success: Interval
    scores: NDArray[np.float64]  # (worlds,)


@dataclass(frozen=True, eq=False)
class Column:
    """One task: its players from top to bottom, and the pairs to show, name -> interval of the difference."""

    title: str
    rows: Sequence[Row]
    pairs: Mapping[str, Interval] = field(default_factory=dict)


def write_chart(path: str | Path, columns: Sequence[Column], title: str, note: str = "") -> None:
    """Write the plot as a PNG file, atomically and without a display; the same numbers give the same bytes."""
    save_figure(path, draw_chart(columns, title, note))


def save_figure(path: str | Path, figure: Figure, dpi: int = 100) -> None:
    """Write a figure as a PNG file, whole or not at all; the same numbers give the same bytes.

    It has a palette of 64 colours, chosen by largest coverage, which keeps the colour of every line.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    drawn, about = io.BytesIO(), PngInfo()
    figure.savefig(drawn, format="png", dpi=dpi)
    about.add_text("Software", "flockenv")
    picture = (
        Image.open(drawn)
        .convert("RGB")
        .quantize(COLOURS_OF_FILE, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    )
    with replace_file(path) as file:
        picture.save(file, "PNG", optimize=True, pnginfo=about, dpi=(dpi, dpi))


def draw_chart(columns: Sequence[Column], title: str, note: str = "") -> Figure:
    """Return the plot: per task scores over their worlds, success rates, and differences against a line at zero.

    Raises:
        ValueError: there is no column, or one without rows.
    """
    if not columns or not all(column.rows for column in columns):
        raise ValueError("chart: needs at least one task, and at least one player in each")
    # Figure and not pyplot: no global state, no window, nothing to close
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    wide = -(-len(columns) // -(-len(columns) // ABREAST))  # bands of equal width, except the last
    bands = [columns[k : k + wide] for k in range(0, len(columns), wide)]
    heights = [h for band in bands for h in _plot_heights(band)]
    size = (1.2 + 4.2 * wide, sum(heights) + 0.85 * len(heights) + 1.0)
    figure = Figure(figsize=size, facecolor="white", layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08))
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(heights), wide, squeeze=False, height_ratios=heights)
    colours = _choose_colours([row.name for column in columns for row in column.rows])
    first = 0
    for band in bands:
        rows = grid[first : first + len(_plot_heights(band))]
        for k in range(wide):
            _draw_column(list(rows[:, k]), band[k] if k < len(band) else None, colours)
        first += len(rows)
    figure.suptitle(title, x=0.01, ha="left", fontsize=15, fontweight="bold", color=INK)
    figure.supxlabel(note, x=0.01, ha="left", fontsize=8.5, color=FAINT)
    return figure


def _plot_heights(band: Sequence[Column]) -> list[float]:
    """Return the heights of the plots of tasks side by side, inches: scores, success, differences if any."""
    players, pairs = max(len(c.rows) for c in band), max(len(c.pairs) for c in band)
    return [0.62 * players + 0.5, 0.34 * players + 0.4] + [0.34 * pairs + 0.4] * (pairs > 0)


def _draw_column(plots: Sequence[Axes], column: Column | None, colours: Mapping[str, str]) -> None:
    """Draw one task, from top to bottom; hide the plots if `column` is None, in a last band with fewer tasks."""
    for axes in plots:
        if column is None:
            axes.set_axis_off()
    if column is None:
        return
    _draw_scores(plots[0], column, colours)
    _draw_success(plots[1], column, colours)
    if len(plots) > 2:
        _draw_differences(plots[2], column)
    for axes in plots:
        _simplify_frame(axes)


def _choose_colours(names: Sequence[str]) -> dict[str, str]:
    names = list(dict.fromkeys(names))
    free = [c for c in COLOURS if c not in {FIXED.get(name) for name in names}] or list(COLOURS)
    others = [name for name in names if name not in FIXED]
    return {**FIXED, **{name: free[k % len(free)] for k, name in enumerate(others)}}


def _draw_scores(axes: Axes, column: Column, colours: Mapping[str, str]) -> None:
    """Draw each world as a faint dot, and the interval above them."""
    axes.set_title(column.title, loc="left", fontsize=12.5, fontweight="bold", color=INK, pad=10)
    axes.set_xlabel("return: mean, 95 % (dots: worlds)")
    for y, row in enumerate(column.rows):
        # fixed heights instead of random ones: dots of similar scores do not overlap, and the file is reproducible
        heights = y + 0.30 * (np.argsort(np.argsort(row.scores)) * 0.618034 % 1.0 * 2 - 1)
        axes.scatter(row.scores, heights, s=7, color=colours[row.name], alpha=0.22, linewidths=0, zorder=2)
        _draw_interval(axes, y, row.score, colours[row.name], f"{row.score.value:.3g}")
    _label_rows(axes, [row.name for row in column.rows])
    scores = np.concatenate([row.scores for row in column.rows])
    low, high = np.quantile(scores, (0.005, 0.995))  # one outlier must not compress all intervals
    low, high = min([low, *(r.score.low for r in column.rows)]), max([high, *(r.score.high for r in column.rows)])
    margin = 0.05 * (high - low) or 0.5
    axes.set_xlim(low - margin, high + margin)


def _draw_success(axes: Axes, column: Column, colours: Mapping[str, str]) -> None:
    axes.set_xlabel("success rate, 95 %")
    for y, row in enumerate(column.rows):
        axes.barh(y, row.success.value, height=0.56, color=colours[row.name], alpha=0.25, zorder=2)
        _draw_interval(axes, y, row.success, colours[row.name], f"{100 * row.success.value:.0f} %")
    _label_rows(axes, [row.name for row in column.rows])
    axes.set_xlim(0.0, 1.19)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "25", "50", "75", "100 %"])


def _draw_differences(axes: Axes, column: Column) -> None:
    axes.set_xlabel("difference in the same world: mean, 95 %")
    axes.axvline(0.0, color=FAINT, linewidth=1, linestyle=(0, (4, 3)), zorder=1)
    for y, interval in enumerate(column.pairs.values()):
        clear = interval.low > 0 or interval.high < 0
        _draw_interval(axes, y, interval, INK if clear else FAINT, f"{interval.value:+.3g}")
    _label_rows(axes, list(column.pairs))
    axes.margins(x=0.12)


def _draw_interval(axes: Axes, y: float, interval: Interval, colour: str, text: str) -> None:
    """Draw a bar from low to high, a dot at the value, and the number above it."""
    from matplotlib.patheffects import withStroke

    ends: dict[str, Any] = {"linewidth": 4.5, "solid_capstyle": "round", "zorder": 3, "clip_on": False}
    dot: dict[str, Any] = {"markeredgecolor": colour, "markeredgewidth": 2, "markersize": 7, "zorder": 4}
    axes.plot((interval.low, interval.high), (y, y), color=colour, **ends)
    axes.plot(interval.value, y, "o", color="white", clip_on=False, **dot)  # a rate of 0 lies on the frame's edge
    axes.annotate(
        text, (interval.value, y), (0, 7), textcoords="offset points", ha="center", va="bottom",
        fontsize=8.5, fontweight="bold", color=colour, zorder=5, parse_math=False,
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
    )  # fmt: skip


def _label_rows(axes: Axes, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), names, parse_math=False)
    axes.set_ylim(max(len(names), 1) - 0.45, -0.62)


def _simplify_frame(axes: Axes) -> None:
    """Remove the parts of the frame that carry no information."""
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(GRID)
    axes.grid(axis="x", color=GRID, linewidth=0.8, zorder=0)
    axes.set_axisbelow(True)
    style: dict[str, Any] = {"length": 0, "labelcolor": INK}
    axes.tick_params(axis="y", labelsize=10, pad=8, **style)
    axes.tick_params(axis="x", labelsize=8.5, **style)
    axes.xaxis.label.set(fontsize=8.5, color=FAINT, x=0.0, ha="left")
