"""What an error of a cloth costs, by the stiffness of its springs: `python -m benchmarks.cloth_error`.

The sheet of `benchmarks.cloth` falls for a second. Error: root-mean-square distance of the particles from those of
velocity Verlet with a quarter of the longest stable step, as a share of the sheet's edge. Time: of the same second, by
a linearly implicit step, and by semi-implicit Euler, each with several steps. A picture shows both.
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
STIFFNESS = (1e2, 1e4, 1e6, 1e8)  # N/m
LINEAR = (1, 2, 4, 8, 16, 32, 64)  # steps in a frame
EXPLICIT = (1, 2, 4)  # steps in a frame, in units of the smallest stable number
MOST = 100_000  # steps in a second, of the linearly implicit method too
REFINED = 4
LINES = {"linear": ("linearly implicit Euler", COLOURS[1]), "explicit": ("semi-implicit Euler", COLOURS[0])}

Numbers = dict[str, Any]


def errors(cells: int, stiffness: float, runs: Sequence[tuple[Integrator, int]]) -> list[float]:
    """Return the error of each run, a method with a number of steps in a frame, as a share of the edge."""

    def end(method: Integrator, steps: int) -> Any:
        scene = sheet(cells, stiffness, method, FRAME / steps)
        return scene.run(scene.start(0), FRAMES * steps).pos[0]

    exact = end(VelocityVerlet(), REFINED * substeps(cells, stiffness))
    gaps = [end(method, steps) - exact for method, steps in runs]
    return [float(np.sqrt((gap**2).sum(axis=1).mean())) / EDGE for gap in gaps]


def _contestant(name: str, scene: Scene, steps: int) -> Contestant:
    call = step_from_start(scene, scene.start(0), FRAMES * steps)
    return Contestant(name, call, SECONDS, note=f"{scene.integrator.kind}, {steps} steps a frame")


def main(
    cells: Annotated[int, typer.Option(min=1, help="Cells along each side; 12: 169 particles.")] = 12,
    picture: Annotated[str | None, typer.Option(metavar="X.png", help="Where to draw it. [not drawn]")] = None,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure error against computing time for springs of 1e2 to 1e8 N/m."""
    path = valid_file(picture, (".png",), force=True) if picture is not None else None
    found: dict[float, list[Numbers]] = {}
    with Bench("cloth_error", quick, rounds, out, unit="s of the world per second", scale=1.0) as bench:
        for stiffness in STIFFNESS:
            shortest = substeps(cells, stiffness)
            runs: list[tuple[str, Integrator, int]] = [("linear", LinearlyImplicitEuler(), n) for n in LINEAR]
            runs += [("explicit", SemiImplicitEuler(), n * shortest) for n in EXPLICIT]
            share = errors(cells, stiffness, [(method, steps) for _, method, steps in runs])
            contestants = [
                _contestant(f"{name} {steps}", sheet(cells, stiffness, method, FRAME / steps), steps)
                for name, method, steps in runs
            ]
            results = bench.race(f"k = {stiffness:g} N/m", contestants, baseline="linear 1")
            found[stiffness] = [
                _point(name, steps, error, result)
                for (name, _, steps), error, result in zip(runs, share, results, strict=False)
            ]
            bench.note(f"k = {stiffness:g} N/m: {_cheapest(found[stiffness])}")
        bench.extra["points"] = {f"{k:g}": points for k, points in found.items()}
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
    """Draw error against time, a panel for each stiffness and a line for each method."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.0 * len(found), 3.4), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(found), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (stiffness, points) in zip(panels, found.items(), strict=True):
        _draw_panel(axes, stiffness, points)
    panels[0].set_ylabel("error after 1 s, share of the edge", color=FAINT)
    panels[0].legend(frameon=False, fontsize=8, loc="lower left")
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
    axes.set_xlabel("ms of computing per second", color=FAINT)
    axes.grid(color=GRID, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    command_line(main)()
