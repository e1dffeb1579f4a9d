"""What an error of a cloth costs, by the stiffness of its springs: `python -m benchmarks.cloth_error`.

The sheet of `benchmarks.cloth` falls for a second. Error: root-mean-square distance of the particles from those of
velocity Verlet with a quarter of the longest stable step, as a share of the sheet's edge. Time: of the same second, by
a linearly implicit step of one linearisation, of two, and by semi-implicit Euler, each with several steps. A picture
shows both.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from benchmarks.cloth import FRAME, sheet, substeps
from benchmarks.measure import Bench, Contestant, Out, Quick, Result, Rounds, command_line
from benchmarks.scenes import step_from_start
from flockenv.core.output_paths import valid_file
from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure
from flockenv.physics.integrators import Integrator, LinearlyImplicitEuler, SemiImplicitEuler, VelocityVerlet
from flockenv.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw", "errors"]

SECONDS, EDGE, AIM = 1.0, 5.0, 0.01
FRAMES = round(SECONDS / FRAME)
STIFFNESS = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)  # N/m
LINEAR = (1, 2, 3, 4, 6, 8, 16, 32)  # steps in a frame
EXPLICIT = (1, 2, 4)  # steps in a frame, in units of the smallest stable number
COLUMNS = 4  # of panels in the picture
REFINED = 4
TOLERANCE = 0.01
"""Of the linear equations; the default, 1e-3, takes about twice as many iterations."""
METHODS: dict[str, Integrator] = {
    "once": LinearlyImplicitEuler(tolerance=TOLERANCE),
    "twice": LinearlyImplicitEuler(tolerance=TOLERANCE, linearisations=2),
    "explicit": SemiImplicitEuler(),
}
LINES = {
    "once": ("linearly implicit Euler", COLOURS[1]),
    "twice": ("with 2 linearisations", COLOURS[2]),
    "explicit": ("semi-implicit Euler", COLOURS[0]),
}
"""Name and colour of each method's line."""

Numbers = dict[str, Any]


def errors(cells: int, stiffness: float, runs: Sequence[tuple[Integrator, int]]) -> list[float]:
    """Return the error of each run, a method with a number of steps in a frame, as a share of the edge."""

    def end(method: Integrator, steps: int) -> Any:
        scene = sheet(cells, stiffness, method, FRAME / steps)
        return scene.run(scene.start(0), FRAMES * steps).pos[0]

    exact = end(VelocityVerlet(), REFINED * substeps(cells, stiffness))
    gaps = [end(method, steps) - exact for method, steps in runs]
    return [float(np.sqrt((gap**2).sum(axis=1).mean())) / EDGE for gap in gaps]


def _contestant(method: str, scene: Scene, steps: int) -> Contestant:
    call = step_from_start(scene, scene.start(0), FRAMES * steps)
    return Contestant(f"{method} {steps}", call, SECONDS, note=f"{LINES[method][0]}, {steps} steps a frame")


def main(
    cells: Annotated[int, typer.Option(min=1, help="Cells along each side; 12: 169 particles.")] = 12,
    stiffness: Annotated[list[float] | None, typer.Option(help="N/m; may be repeated. [1e2 to 1e8]")] = None,
    steps: Annotated[
        list[int] | None, typer.Option(min=1, help="Linearly implicit steps in a frame; may be repeated. [1 to 32]")
    ] = None,
    picture: Annotated[str | None, typer.Option(metavar="X.png", help="Where to draw it. [not drawn]")] = None,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure error against computing time for springs of 1e2 to 1e8 N/m."""
    path = valid_file(picture, (".png",), force=True) if picture is not None else None
    found: dict[float, list[Numbers]] = {}
    with Bench("cloth_error", quick, rounds, out, unit="s of the world per second", scale=1.0) as bench:
        for k in stiffness or STIFFNESS:
            shortest = substeps(cells, k)
            runs = [(name, METHODS[name], n) for name in ("once", "twice") for n in steps or LINEAR]
            runs += [("explicit", METHODS["explicit"], n * shortest) for n in EXPLICIT]
            share = errors(cells, k, [(method, n) for _, method, n in runs])
            contestants = [_contestant(name, sheet(cells, k, method, FRAME / n), n) for name, method, n in runs]
            results = bench.race(f"k = {k:g} N/m", contestants, baseline=contestants[0].name)
            found[k] = [
                _point(name, n, error, result)
                for (name, _, n), error, result in zip(runs, share, results, strict=False)
            ]
            bench.note(f"k = {k:g} N/m: {_cheapest(found[k])}")
        bench.extra["points"] = {f"{each:g}": points for each, points in found.items()}
        bench.note(f"{(cells + 1) ** 2:,} particles, {SECONDS:g} s, float64, one thread")
    if path is not None:
        draw(path, found)


def _point(name: str, steps: int, error: float, result: Result) -> Numbers:
    return {"method": name, "steps": steps, "error": error, "ms_per_s": 1e3 / result.rate}


def _cheapest(points: Sequence[Numbers]) -> str:
    """Return, as text, the least time of each method for the aim."""
    parts = []
    for name, (title, _) in LINES.items():
        reached = [p for p in points if p["method"] == name and p["error"] <= AIM]
        best = min(reached, key=lambda p: p["ms_per_s"]) if reached else None
        text = f"{best['ms_per_s']:.3g} ms ({best['steps']} steps a frame)" if best else "not reached"
        parts.append(f"{title} {text}")
    return f"{100 * AIM:g} % costs: {', '.join(parts)}"


def draw(path: Path, found: dict[float, list[Numbers]]) -> None:
    """Draw error against time, a panel for each stiffness and a line for each method; four panels in a row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-len(found) // COLUMNS)
    figure = Figure(figsize=(2.8 * COLUMNS, 2.6 * rows), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
    for axes, (stiffness, points) in zip(panels.flat, found.items(), strict=False):
        _draw_panel(axes, stiffness, points)
    for axes in panels.flat[len(found) :]:
        axes.set_axis_off()
    figure.supylabel("error after 1 s, share of the edge", color=FAINT, fontsize=9)
    figure.supxlabel("ms of computing per second; beside the ends of a line: steps in a frame", color=FAINT, fontsize=9)
    figure.legend(
        *panels.flat[0].get_legend_handles_labels(), loc="outside upper left", ncols=len(LINES), frameon=False
    )
    save_figure(path, figure, 100)


def _draw_panel(axes: Axes, stiffness: float, points: Sequence[Numbers]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axhline(AIM, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
    for name, (title, colour) in LINES.items():
        mine = [p for p in points if p["method"] == name]
        axes.plot(
            [p["ms_per_s"] for p in mine], [p["error"] for p in mine], "o-", color=colour, markersize=4, label=title
        )
        for p in mine[:: max(1, len(mine) - 1)]:
            axes.annotate(
                str(p["steps"]),
                (p["ms_per_s"], p["error"]),
                (0, 5),
                textcoords="offset points",
                fontsize=7,
                color=colour,
            )
    axes.set_title(f"k = {stiffness:g} N/m", color=INK, fontsize=10)
    axes.grid(color=GRID, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    command_line(main)()
