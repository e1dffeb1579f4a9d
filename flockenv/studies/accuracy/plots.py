"""Work-precision pictures: error against wall time and against force evaluations, a line per method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flockenv.studies.accuracy.results import Cost, Curve, Report

__all__ = ["draw_precision", "write_precision"]

COLUMNS = 4
"""Problems side by side in one band."""

MARKERS = "osD^vPX<>*hp"
LINES = ("-", "--")
AXES: dict[Cost, str] = {"seconds": "wall time of the whole run, s", "evaluations": "force evaluations"}
DECADES = 13
"""The picture shows at most this number of decades below the largest error."""


LABEL = 0.035
"""Height of a number at the end of a line, as a share of the panel's."""


def write_precision(path: str | Path, reports: Sequence[Report]) -> None:
    """Write the picture as a PNG file, whole or not at all; the same numbers give the same bytes."""
    save_figure(path, draw_precision(reports), 150 if len(reports) <= COLUMNS else 75)


def draw_precision(reports: Sequence[Report]) -> Figure:
    """Return the picture: per problem errors at the end against wall time, below them against force evaluations.

    The number at the end of a line is the measured order; grey slopes show what orders 1, 2 and 4 would look
    like. Hollow points are not clearly above the reference's own error, whose size is below the title; the shaded band
    begins where errors are not trusted. The legend of a single problem also has the orders.

    Raises:
        ValueError: nothing to draw.
    """
    if not any(curve.points for report in reports for curve in report.curves):
        raise ValueError("precision: needs at least one problem with at least one method that arrived")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(curve.method for report in reports for curve in report.curves))
    bands = [reports[k : k + COLUMNS] for k in range(0, len(reports), COLUMNS)]
    wide = len(bands[0])
    figure = Figure(figsize=(1.0 + 4.6 * max(wide, 2), 1.3 + 7.4 * len(bands)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2 * len(bands), wide, squeeze=False)
    styles = {name: _style(k) for k, name in enumerate(names)}
    for row, axes_row in enumerate(grid):
        by: Cost = "evaluations" if row % 2 else "seconds"
        for column, axes in enumerate(axes_row):
            if column < len(bands[row // 2]):
                _draw_panel(axes, bands[row // 2][column], by, styles)
            else:
                axes.set_axis_off()
    _draw_legend(figure, styles, reports)
    figure.supxlabel(_note_text(reports), x=0.01, ha="left", fontsize=9, color=FAINT)
    return figure


def _style(k: int) -> dict[str, Any]:
    colours = (*COLOURS, INK, FAINT)
    return {
        "color": colours[k % len(colours)], "marker": MARKERS[k % len(MARKERS)],
        "linestyle": LINES[k // len(colours) % len(LINES)],
    }  # fmt: skip


def _draw_panel(axes: Axes, report: Report, by: Cost, styles: dict[str, dict[str, Any]]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    high = 10.0 ** math.ceil(math.log10(3 * report.reach)) if report.reach > 0 else 1.0
    low = max(report.floor / 3, high * 10.0**-DECADES, _smallest_error(report) / 3)
    axes.set_ylim(low, high)
    for curve in report.curves:
        _draw_line(axes, curve, by, styles[curve.method], report.floor, low)
    axes.axhspan(low, max(low, report.floor), color=GRID, zorder=0, linewidth=0)
    if by == "evaluations":
        _draw_slopes(axes, report, low, high)
        _draw_orders(axes, report, styles, low, high)
    else:
        axes.set_title(report.title, loc="left", fontsize=13, fontweight="bold", color=INK, pad=22)
        axes.annotate(
            _reference_text(report), (0, 1), (0, 6), xycoords="axes fraction", textcoords="offset points", fontsize=9.5,
            color=FAINT,
        )  # fmt: skip
    axes.set_xlabel(AXES[by], fontsize=10.5, color=INK)
    axes.set_ylabel("error at the end, m", fontsize=10.5, color=INK)
    axes.yaxis.set_major_locator(LogLocator(numticks=8))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(which="major", color=GRID, linewidth=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", labelsize=9.5, labelcolor=INK, color=GRID)
    for side in axes.spines:
        axes.spines[side].set_color(GRID)


def _drawable_points(curve: Curve, by: Cost) -> list[tuple[float, float]]:
    """Return (cost, error) of the points that have both."""
    return [(cost, p.error) for p in curve.points if (cost := p.cost(by)) is not None and p.error is not None]


def _smallest_error(report: Report) -> float:
    """Return the smallest error."""
    errors = [p.error for curve in report.curves for p in curve.points if p.error]
    return min(errors, default=report.reach)


def _reference_text(report: Report) -> str:
    """Return the reference of errors, its own error, and the growth rate of a difference, in a line."""
    wrong = "" if report.reference_error == 0 else f", \u00b1 {report.reference_error:.0e} m"
    grows = f"; differences grow {report.growth:.0e}-fold" if report.sensitive else ""
    return f"against {report.reference}{wrong}{grows}"


def _draw_line(axes: Axes, curve: Curve, by: Cost, style: dict[str, Any], floor: float, low: float) -> None:
    """Draw a curve; points below the range of the picture lie on its lower edge."""
    shown = [(cost, max(error, low)) for cost, error in _drawable_points(curve, by)]
    if shown:
        axes.plot(*zip(*shown, strict=True), markersize=5, linewidth=1.8, zorder=3, **style)
    doubtful = [(cost, error) for cost, error in shown if error <= floor]
    if doubtful:
        hollow = {**style, "linestyle": "none", "markerfacecolor": "white"}
        axes.plot(*zip(*doubtful, strict=True), markersize=5, zorder=3, clip_on=False, **hollow)


def _draw_orders(axes: Axes, report: Report, styles: dict[str, dict[str, Any]], low: float, high: float) -> None:
    """Write the measured orders at the ends of the lines, pushed apart so that each can be read."""
    ends = []
    for curve in report.curves:
        inside = [(x, y) for x, y in _drawable_points(curve, "evaluations") if low < y < high]
        if curve.order is not None and inside:
            ends.append((math.log(inside[-1][1]), inside[-1], curve))
    gap, above = LABEL * math.log(high / low), math.inf
    for at, (x, y), curve in sorted(ends, key=lambda end: -end[0]):
        above = min(at, above - gap)
        axes.annotate(
            f"{curve.order:.1f}", (x, y), (x * 1.25, math.exp(above)), textcoords="data", va="center", fontsize=8.5,
            color=styles[curve.method]["color"], fontweight="bold", annotation_clip=False, zorder=4,
        )  # fmt: skip


def _draw_slopes(axes: Axes, report: Report, low: float, high: float) -> None:
    """Draw what orders 1, 2 and 4 look like, from one corner."""
    costs = [x for curve in report.curves for x, _ in _drawable_points(curve, "evaluations")]
    if not costs:
        axes.annotate(
            "no method arrives in these steps", (0.5, 0.5), xycoords="axes fraction", ha="center", color=FAINT
        )
        return
    left, right = min(costs), max(costs)
    corner = math.sqrt(high * report.reach) if report.reach > 0 else high
    axes.set_xlim(left / 1.5, right * 3)
    for order in (1, 2, 4):
        end = min(right, left * (corner / low) ** (1 / order))
        axes.plot((left, end), (corner, corner * (left / end) ** order), color=FAINT, linewidth=0.9, alpha=0.6,
                  linestyle=(0, (1, 2)), zorder=1)  # fmt: skip
        plain = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
        at = left * (end / left) ** 0.93
        axes.annotate(
            f"order {order}", (at, corner * (left / at) ** order), (0, 0), textcoords="offset points", fontsize=8,
            color=FAINT, ha="center", va="center", zorder=2, bbox=plain,
        )  # fmt: skip


def _draw_legend(figure: Figure, styles: dict[str, dict[str, Any]], reports: Sequence[Report]) -> None:
    from matplotlib.lines import Line2D

    orders = {curve.method: _order_text(curve, reports[0]) for curve in reports[0].curves} if len(reports) == 1 else {}
    handles = [
        Line2D(
            [],
            [],
            markersize=6,
            linewidth=2,
            label=name.replace("_", " ").replace(":", ", ") + orders.get(name, ""),
            **style,
        )
        for name, style in styles.items()
    ]
    figure.legend(
        handles=handles, loc="outside upper left", ncols=4 if orders else 5, frameon=False, fontsize=11.5,
        labelcolor=INK, handlelength=2.6, columnspacing=1.6,
    )  # fmt: skip


def _order_text(curve: Curve, report: Report) -> str:
    """Return the measured order as the legend has it, "exact" for a method whose errors are all too small to trust."""
    if curve.order is not None:
        return f" ({curve.order:.1f})"
    arrived = [point for point in curve.points if point.error is not None]
    return " (exact)" if arrived and not any(report.trusts(point) for point in arrived) else ""


def _note_text(reports: Sequence[Report]) -> str:
    first = reports[0]
    load = "" if first.machine.load is None else f", load {first.machine.load:.1f} on {first.machine.cores} cores"
    times = f"median of {first.repetitions} runs" if first.repetitions else "no times taken"
    return (
        f"{first.machine.cpu}{load}; {times}; {first.dtype}. Number at a line's end: measured order.\n"
        "Shaded band and hollow points: not clearly above rounding and the reference's own error."
    )
