"""Pictures of a validation: speed over density, flow over width, lanes, evacuation time over desired speed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure
from flockenv.studies.measures import weidmann_flow, weidmann_speed
from flockenv.studies.measures.plots import name_axes, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from flockenv.studies.validation import Finding, Results

__all__ = ["write_pictures"]

TONES = (*COLOURS, "#8a929c", "#000000")
MARKS = "osD^vP*X"


def write_pictures(folder: Path, results: Results) -> list[Path]:
    """Write every picture that has numbers into an existing folder; return their paths."""
    drawn = []
    for name, case, write in (
        ("fundamental_diagram.png", "rimea 4", _write_diagrams),
        ("bottleneck.png", "rimea 12", _write_widths),
        ("lanes.png", "lanes", _write_lanes),
        ("faster_is_slower.png", "faster is slower", _write_evacuation_times),
    ):
        found = [f for f in results.findings if f.case == case and f.series]
        if found:
            write(folder / name, found)
            drawn.append(folder / name)
    return drawn


def _preset_title(preset: str) -> str:
    return preset.replace("_", " ")


def _colour(preset: str) -> str:
    from flockenv.scene.presets import PRESETS

    return TONES[list(PRESETS).index(preset) % len(TONES)]


def _preset_marker(preset: str) -> str:
    from flockenv.scene.presets import PRESETS

    return MARKS[list(PRESETS).index(preset) % len(MARKS)]


def _numbers(finding: Finding, name: str) -> np.ndarray:
    return np.array([np.nan if x is None else x for x in finding.series[name]], float)


def _write_diagrams(path: Path, found: Sequence[Finding]) -> None:
    """Draw, for each preset, the cloud of 4 x 4 m of corridor, its means, and Weidmann's curve with its bounds."""
    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure = new_figure(3.1 * columns, 2.7 * rows + 0.5, "Speed over density in a corridor without ends (RiMEA 4)")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    curve = np.linspace(0.05, 5.4, 300)
    inside = curve[(curve >= 0.5) & (curve <= 3.0)]
    for axes in grid.ravel()[len(found) :]:
        axes.axis("off")
    for finding, axes in zip(found, grid.ravel(), strict=False):
        speed = weidmann_speed(inside)
        axes.fill_between(inside, speed - 0.25, speed + 0.25, color=GRID, zorder=1, label="within .25 m/s")
        axes.plot(curve, weidmann_speed(curve), color=INK, lw=1.2, zorder=2, label="Weidmann 1993")
        axes.scatter(
            _numbers(finding, "density"), _numbers(finding, "speed"), s=5, color=_colour(finding.under), alpha=0.25,
            linewidths=0, zorder=3,
        )  # fmt: skip
        axes.plot(
            _numbers(finding, "densities"), _numbers(finding, "speeds"), "o-", color=_colour(finding.under), ms=4, lw=1,
            zorder=4, label="means",
        )  # fmt: skip
        name_axes(axes, "density, 1/m²", "speed forward, m/s")
        axes.set_title(f"{_preset_title(finding.under)}: {finding.verdict}", fontsize=8, color=INK)
        axes.set_xlim(0, 5.4)
        axes.set_ylim(-0.6, 1.7)
    grid[0, 0].legend(fontsize=6.5, frameon=False, loc="upper right")
    for axes in grid[:, 1:].ravel():
        axes.set_ylabel("")
    save_figure(path, figure)


def _write_widths(path: Path, found: Sequence[Finding]) -> None:
    """Draw the flow through a passage by its width, with measurements and Weidmann's largest flow."""
    from flockenv.studies.validation.doors import DATA

    figure = new_figure(6.4, 4.4, "Flow through a passage of 5 m, 150 people (RiMEA 12)")
    axes = figure.subplots()
    for k, (width, (low, high)) in enumerate(DATA.items()):
        axes.fill_between(
            [width - 0.03, width + 0.03], 0.85 * low, 1.15 * high, color=GRID, zorder=1,
            label="the same and 15 %" if k == 0 else None,
        )  # fmt: skip
        axes.plot(
            [width, width], [low, high], color=INK, lw=5, solid_capstyle="butt", zorder=2,
            label="three experiments" if k == 0 else None,
        )  # fmt: skip
    widths = np.array([0.7, 1.3])
    axes.plot(widths, 1.9 * widths, color=FAINT, lw=1, ls=(0, (4, 3)), label="J = 1.9 w", zorder=2)
    axes.plot(
        widths, float(weidmann_flow(1.75)) * widths, color=FAINT, lw=1, ls=":", label="Weidmann's largest", zorder=2
    )
    for finding in found:
        axes.plot(
            _numbers(finding, "width"), _numbers(finding, "flow"), marker=_preset_marker(finding.under), ms=5, lw=1,
            color=_colour(finding.under), label=_preset_title(finding.under), zorder=3,
        )  # fmt: skip
    name_axes(axes, "width, m", "flow, 1/s")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save_figure(path, figure)


def _write_lanes(path: Path, found: Sequence[Finding]) -> None:
    """Draw one world of each preset at its end, coloured by direction, with the paths of the last seconds."""
    figure = new_figure(9.6, 1.05 * len(found) + 0.6, "48 + 48 people in a corridor without ends, after a minute")
    for finding, axes in zip(found, figure.subplots(len(found), 1, squeeze=False).ravel(), strict=True):
        _draw_lanes(axes, finding)
    save_figure(path, figure)


def _draw_lanes(axes: Axes, finding: Finding) -> None:
    from flockenv.studies.validation.corridors import EACH_WAY, EDGE, WIDTH

    x, y = (_numbers(finding, name).reshape(-1, 2 * EACH_WAY) for name in ("x", "y"))
    for k in range(2 * EACH_WAY):
        colour = COLOURS[0] if k < EACH_WAY else COLOURS[1]
        cut = np.insert(x[:, k], np.flatnonzero(np.abs(np.diff(x[:, k])) > EDGE / 2) + 1, np.nan)
        cut_y = np.insert(y[:, k], np.flatnonzero(np.abs(np.diff(x[:, k])) > EDGE / 2) + 1, np.nan)
        axes.plot(cut, cut_y, color=colour, lw=0.8, alpha=0.5)
        axes.plot(x[-1, k], y[-1, k], "o", color=colour, ms=3.5)
    for side in (-1, 1):
        axes.axhline(EDGE / 2 + side * WIDTH / 2, color=INK, lw=1)
    axes.set_xlim(0, EDGE)
    axes.set_ylim(EDGE / 2 - WIDTH / 2 - 0.1, EDGE / 2 + WIDTH / 2 + 0.1)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(
        f"{_preset_title(finding.under)}: {finding.verdict}, {finding.note.split(';')[0]}", fontsize=7.5, color=INK
    )
    for spine in axes.spines.values():
        spine.set_color(GRID)


def _write_evacuation_times(path: Path, found: Sequence[Finding]) -> None:
    """Draw the time that a room takes to empty by the desired speed: medians and quartiles."""
    figure = new_figure(5.6, 4.0, "200 people, 15 x 15 m, a door of 1 m")
    axes = figure.subplots()
    for finding in found:
        speed, time, low, high = (_numbers(finding, name) for name in ("speed", "time", "low", "high"))
        axes.errorbar(
            speed, time, (time - low, high - time), fmt="o-", color=_colour(finding.under), ms=4, lw=1.2, capsize=2,
            label=_preset_title(finding.under),
        )  # fmt: skip
    name_axes(axes, "desired speed, m/s", "until all are out, s")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7.5, frameon=False)
    save_figure(path, figure)
