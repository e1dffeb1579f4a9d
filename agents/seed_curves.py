"""Learning curves as bands over seeds: `python -m agents.seed_curves`.

Draws the curves in the cards of all training seeds, and those of all search seeds of hand-written players, on the same
axes: mean return on tuning worlds over agent-steps, and over seconds. A line is the median over seeds, a band goes from
the lowest to the highest. `--learners FOLDER` adds the cards FOLDER/ALGO/TASK-seed-N.json that `agents.learn --seeds`
writes, and draws their tasks alone. Trains and plays nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from agents.experiment import one_line_errors
from agents.learner_job import ALGORITHMS
from flockenv.cli.terminal import run_program
from flockenv.core.errors import printable_path
from flockenv.core.output_paths import valid_file
from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure
from flockenv.players import PUBLISHED, seeds_of_player, weights_file
from flockenv.players.policy import read_card
from flockenv.players.rules import load_tuned
from flockenv.tasks import TASKS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["app", "band", "curves_of", "draw", "with_learners"]

AXES = {"steps": "million agent-steps", "seconds": "seconds"}
ABREAST = 2
"""Most tasks side by side."""
SHOWN_FROM = 0.2
"""Share of the longest curve before which values may lie below the plot: all learning begins far below its end."""
COLOUR = dict(zip(("ppo", "rules", "orca", "heuristics", "queueing"), COLOURS, strict=False))
"""Of PPO and hand-written players."""
LEARNER_COLOUR = dict(zip(ALGORITHMS, COLOURS[2:], strict=False))
"""Of other learners, beside which PPO and the rules alone are drawn."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)

Curve = Mapping[str, Sequence[float]]
"""steps, seconds and mean of each point."""


def curves_of(task: str) -> dict[str, list[Curve]]:
    """Return the curves of a task by player, one for each seed; players without a stored curve are left out."""
    seeds = seeds_of_player("ppo", task)
    cards = [weights_file(task, None if number == 0 else seed) for number, seed in enumerate(seeds)]
    found: dict[str, list[Curve]] = {"ppo": [_columns(read_card(path.with_suffix(".json"))) for path in cards]}
    for name in reversed(PUBLISHED):
        found[name] = [each["curve"] for each in load_tuned(task, name).found.get("searches", {}).values()]
    return {name: curves for name, curves in found.items() if curves}


def _all_curves() -> dict[str, dict[str, list[Curve]]]:
    return {task: curves for task in TASKS if (curves := curves_of(task))}


def with_learners(folder: Path) -> dict[str, dict[str, list[Curve]]]:
    """Return the curves of PPO, of the rules and of other learners, by task and player.

    Raises ValueError, in one line, if the folder has no card of a learner.
    """
    found: dict[str, dict[str, list[Curve]]] = {}
    for name in ALGORITHMS:
        for path in sorted((folder / name).glob("*-seed-*.json")):
            card = read_card(path)
            found.setdefault(card["task"], {}).setdefault(name, []).append(_columns(card))
    if not found:
        expected = "FOLDER/ALGO/TASK-seed-N.json, as agents.learn --seeds writes with --out FOLDER/ALGO"
        raise ValueError(f"--learners {printable_path(folder)}: no card {expected}; ALGO: {', '.join(ALGORITHMS)}")
    for task, learners in found.items():
        curves = curves_of(task)
        found[task] = {**{name: curves[name] for name in ("ppo", "rules") if name in curves}, **learners}
    return {task: found[task] for task in TASKS if task in found}


def _columns(card: Mapping[str, Any]) -> Curve:
    return {key: [point[key] for point in card["curve"]] for key in ("steps", "seconds", "mean")}


def band(curves: Sequence[Curve], axis: str, points: int = 200) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places (P,) on an axis, and there the lowest, median and highest mean over seeds, (3, P).

    Between the points of a curve it is interpolated; the band ends with the shortest curve.
    """
    first, last = max(curve[axis][0] for curve in curves), min(curve[axis][-1] for curve in curves)
    places = np.linspace(first, max(first, last), points)
    means = np.array([np.interp(places, curve[axis], curve["mean"]) for curve in curves])
    return places, np.quantile(means, (0.0, 0.5, 1.0), axis=0)


def draw(path: Path, tasks: Mapping[str, Mapping[str, Sequence[Curve]]]) -> None:
    """Write the picture as PNG: for each task one plot over agent-steps and one over seconds."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    abreast = min(ABREAST, len(tasks))
    rows = -(-len(tasks) // abreast)
    figure = Figure(figsize=(7.0 * abreast, 0.9 + 2.3 * rows), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, abreast * len(AXES), squeeze=False).ravel()
    places = [(task, axis) for task in tasks for axis in AXES]
    for axes, (task, axis) in zip(grid, places, strict=False):
        _draw_task(axes, task, tasks[task], axis)
    for axes in grid[len(places) :]:
        axes.set_axis_off()
    figure.suptitle("Learning and search, over seeds", x=0.01, ha="left", fontsize=14, fontweight="bold", color=INK)
    note = (
        "Mean return on tuning worlds. Line: median over seeds; band: lowest to highest.\nIn brackets: number of seeds."
    )
    figure.supxlabel(note, x=0.01, ha="left", fontsize=9, color=FAINT)
    save_figure(path, figure)


def _draw_task(axes: Axes, task: str, players: Mapping[str, Sequence[Curve]], axis: str) -> None:
    scale, bands = 1e-6 if axis == "steps" else 1.0, {name: band(curves, axis) for name, curves in players.items()}
    for name, (places, (low, middle, high)) in bands.items():
        label, colour = f"{name} ({len(players[name])})", COLOUR.get(name) or LEARNER_COLOUR[name]
        axes.plot(scale * places, middle, color=colour, linewidth=1.6, label=label)
        axes.fill_between(scale * places, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.set_ylim(*_limits(players))
    axes.set_title(task, loc="left", fontsize=10, fontweight="bold", color=INK)
    axes.set_xlabel(AXES[axis], fontsize=8, color=FAINT)
    axes.tick_params(labelsize=8, colors=FAINT)
    axes.grid(color=GRID, linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    if axis == "steps":
        axes.legend(fontsize=7.5, edgecolor="none", loc="lower right")


def _limits(players: Mapping[str, Sequence[Curve]]) -> tuple[float, float]:
    """Return the lowest and highest value shown, the same over agent-steps and over seconds."""
    bands = [band(curves, "steps") for curves in players.values()]
    longest = max(places[-1] for places, _ in bands)
    late = [ends[:, places >= SHOWN_FROM * longest].ravel() for places, ends in bands]
    shown = np.concatenate([*late, *(ends[:, -1] for _, ends in bands)])  # also the ends of short curves
    margin = 0.05 * float(np.ptp(shown)) or 0.5
    return float(shown.min()) - margin, float(shown.max()) + margin


@app.command()
def main(
    out: Annotated[str, typer.Option(help="picture")] = "results/seed_curves.png",
    learners: Annotated[
        Path | None, typer.Option(help="Folder with cards of other learners: ALGO/TASK-seed-N.json.")
    ] = None,
) -> None:
    """Draw the learning curves of all seeds that are there."""
    with one_line_errors():
        path = valid_file(out, (".png",), force=True)
        draw(path, _all_curves() if learners is None else with_learners(learners))
    typer.echo(f"{path}: written")


if __name__ == "__main__":
    run_program("seed_curves", app)
