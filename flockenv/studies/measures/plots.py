"""Pictures of measurements: flow over density, paths coloured by direction, tail of gaps, density over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure
from flockenv.studies.measures import JUELICH, Tail, survival, weidmann_flow, weidmann_speed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["name_axes", "new_figure", "write_flow_density", "write_gaps", "write_lanes", "write_space_time"]

Floats = NDArray[np.float64]

FORWARD, BACKWARD = COLOURS[0], COLOURS[1]
MOST_WAYS = 400
"""Most paths that are drawn; of a larger crowd, paths at equal intervals of the table of agents."""
MOST_POINTS = 500
"""Most points of a path that are drawn."""


def write_flow_density(path: str | Path, density: Floats, speed: Floats, title: str) -> None:
    """Draw flow, and speed, over density, (S,) each, with Weidmann's curves and the corridor data of ug-180."""
    figure = new_figure(9.6, 4.2, title)
    finite = np.isfinite(density) & np.isfinite(speed)
    rho, v = density[finite], speed[finite]
    curve = np.linspace(0.0, 5.4, 300)
    low, high, mean, spread = np.array(JUELICH).T
    middle = (low + high) / 2
    for axes, data, reference, factor, label in zip(
        figure.subplots(1, 2), (rho * v, v), (weidmann_flow(curve), weidmann_speed(curve)), (middle, np.ones(7)),
        ("specific flow, 1/(m s)", "speed, m/s"), strict=True,
    ):  # fmt: skip
        axes.plot(curve, reference, color=INK, lw=1.2, label="Weidmann 1993", zorder=2)
        axes.errorbar(
            middle, factor * mean, factor * spread, (high - low) / 2, fmt="none", ecolor=COLOURS[3], elinewidth=1.2,
            label="Jülich ug-180, ± one deviation", zorder=3,
        )  # fmt: skip
        axes.scatter(rho, data, s=12, color=FORWARD, alpha=0.35, linewidths=0, label="this run, by cells", zorder=4)
        axes.set_xlim(0, max(5.4, 1.05 * float(rho.max(initial=0))))
        axes.set_ylim(0, 1.15 * max(float(reference.max()), float(data.max(initial=0))))
        name_axes(axes, "density, 1/m²", label)
    figure.axes[0].legend(fontsize=7.5, frameon=False, loc="upper right")
    save_figure(path, figure)


def write_lanes(
    path: str | Path, pos: NDArray[np.floating[Any]], alive: NDArray[np.bool_],
    direction: NDArray[np.int64], region: tuple[Floats, Floats],
    title: str, solids: Sequence[Floats] = (), line: Floats | None = None, area: Floats | None = None,
) -> None:  # fmt: skip
    """Draw the path of each agent, (T, N, 2) m, coloured by its `direction` (N,), and a dot at its end.

    region: corners of what is shown, m; solids: polygons. A path that jumps by half of the region is cut there.
    """
    low, high = region
    wide = float(high[0] - low[0])
    tall = float(high[1] - low[1])
    figure = new_figure(9.6, min(9.0, max(1.0, 8.6 * tall / wide)) + 1.2, title)
    axes = figure.subplots()
    _draw_solids(axes, solids)
    every = -(-pos.shape[0] // MOST_POINTS)
    jump = 0.5 * np.array([wide, tall])
    for k in range(0, pos.shape[1], -(-pos.shape[1] // MOST_WAYS)):
        places = np.where(alive[::every, k, None], pos[::every, k], np.nan).astype(np.float64)
        far = (np.abs(np.diff(places, axis=0)) > jump).any(axis=1)
        places = np.insert(places, np.flatnonzero(far) + 1, np.nan, axis=0)
        axes.plot(*places.T, color=_colour(int(direction[k])), lw=0.6, alpha=0.5, zorder=2)
    here = alive[-1]
    axes.scatter(
        pos[-1, here, 0],
        pos[-1, here, 1],
        s=14,
        color=[_colour(int(w)) for w in direction[here]],
        linewidths=0,
        zorder=4,
    )
    if area is not None:
        axes.plot(*np.concatenate([area, area[:1]]).T, color=COLOURS[3], lw=1.4, zorder=5)
    if line is not None:
        axes.plot(*line.T, color=INK, lw=2.2, zorder=6)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    name_axes(axes, "x, m", "y, m")
    axes.grid(False)
    save_figure(path, figure)


def write_gaps(path: str | Path, gaps: Floats, fit: Tail, p: float, title: str) -> None:
    """Draw the survival of gaps (G,), s, both axes logarithmic, with the power law of their tail; needs one gap > 0.

    p: goodness of that fit, see `measures.goodness`.
    """
    figure = new_figure(5.6, 4.4, title)
    axes = figure.subplots()
    times, share = survival(gaps[gaps > 0])
    axes.step(times, share, where="pre", color=INK, lw=1.2, zorder=3)
    axes.scatter(times, share, s=9, color=INK, linewidths=0, zorder=3)
    if np.isfinite(fit.alpha):
        tail = np.geomspace(fit.start, max(times[-1], 1.2 * fit.start), 50)
        at = float((times >= fit.start).mean())
        text = fit.verdict if p >= 0.1 else "no power law"
        label = f"α = {fit.alpha:.2f} ± {fit.error:.2f}, from {fit.start:.2g} s on, p = {p:.2g}: {text}"
        axes.plot(tail, at * (tail / fit.start) ** (1 - fit.alpha), color=FORWARD, lw=2, label=label, zorder=4)
        limit = at * (tail / fit.start) ** -1.0
        axes.plot(tail, limit, color=FAINT, lw=1, ls=(0, (4, 3)), label="α = 2: the mean gap diverges", zorder=2)
        axes.legend(fontsize=7.5, frameon=False, loc="lower left")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.5 / len(times), 1.3)
    name_axes(axes, "gap τ between two passages, s", "share of gaps ≥ τ")
    save_figure(path, figure)


def write_space_time(
    path: str | Path, time: Floats, place: Floats, density: Floats, title: str, where: float | None = None
) -> None:
    """Draw density (T, X), 1/m^2, over time (T + 1,) s and place along the axis (X + 1,) m; a line at `where`."""
    figure = new_figure(7.6, 4.2, title)
    axes = figure.subplots()
    mesh = axes.pcolormesh(time, place, density.T, cmap="viridis", vmin=0, rasterized=True)
    bar = figure.colorbar(mesh, ax=axes, pad=0.02)
    bar.set_label("density, 1/m²", fontsize=9, color=FAINT)
    bar.ax.tick_params(length=0, labelsize=8, labelcolor=INK)
    bar.outline.set_visible(False)
    if where is not None:
        axes.axhline(where, color="white", lw=1.2, ls=(0, (4, 3)))
    name_axes(axes, "time, s", "along the way of walking, m")
    axes.grid(False)
    save_figure(path, figure)


def new_figure(wide: float, tall: float, title: str) -> Figure:
    """Return an empty figure of wide x tall inches with a title."""
    # Figure and not pyplot: no global state, no window, nothing to close
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(wide, tall), facecolor="white", layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11, fontweight="bold", color=INK, x=0.02, ha="left", parse_math=False)
    return figure


def name_axes(axes: Axes, x: str, y: str) -> None:
    """Name the axes, and keep of the frame only what carries information."""
    axes.set_xlabel(x, fontsize=9, color=FAINT)
    axes.set_ylabel(y, fontsize=9, color=FAINT)
    axes.tick_params(length=0, labelsize=8, labelcolor=INK)
    axes.grid(color=GRID, linewidth=0.8, zorder=0)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color(GRID)


def _draw_solids(axes: Axes, polygons: Sequence[Floats]) -> None:
    from matplotlib.patches import Polygon

    for corners in polygons:
        axes.add_patch(Polygon(corners, closed=True, facecolor=GRID, edgecolor=FAINT, lw=0.6, zorder=1))


def _colour(direction: int) -> str:
    return {1: FORWARD, -1: BACKWARD}.get(direction, FAINT)
