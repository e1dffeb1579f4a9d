"""Learning curves of several settings, side by side: `python -m agents.curves configs/training/obstacles.yaml ...`.

A config may list further settings (`curves: {name: differences}`). Each is trained as by agents.ppo, into
RUNS/TASK/NAME, one after the other, so that wall times are comparable. A finished training is not repeated, an
interrupted one continues, and one of another recipe starts again. The picture shows the mean return on the tuning
worlds over wall time, s, with the tuned rules as a line: so it shows which setting learns fastest on this machine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from agents.experiment import Experiment, PpoSettings, load_experiment, one_line_errors
from flockenv.cli.terminal import report_errors, run_program
from flockenv.core.atomic_files import replace_file, write_all_or_none
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK
from flockenv.players.rules import load_tuned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["app", "draw"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True, soft_wrap=True)

ROOM = 2**20
"""Largest size of a picture, bytes."""

Curve = list[dict[str, float]]
Numbers = Mapping[str, Any]
"""Results of a task, as stored: the mean return of its rules, and the curve and recipe of each setting."""


def experiments_of(configs: Sequence[Path]) -> dict[str, Experiment]:
    """Read the configs, by task; ValueError if one cannot be used, or two are of one task and share its folder."""
    out: dict[str, Experiment] = {}
    for path in configs:
        experiment = load_experiment(path)
        task = experiment.build().name
        if task in out:
            raise ValueError(f"{path}: task = {task!r}: another config is of that task; compare settings under curves")
        out[task] = experiment
    return out


def label(name: str, p: PpoSettings) -> str:
    """Return the name of a setting, with its numbers that affect speed."""
    return f"{name}: {p.epochs} epoch{'s' * (p.epochs > 1)}, minibatch {p.minibatch:,}, rate {p.learning_rate:g}"


def learning_curve(experiment: Experiment, name: str, runs: Path) -> Curve:
    """Return the curve of one setting, from its checkpoint if training is finished; otherwise train it to the end."""
    from agents import ppo  # with torch
    from agents.run import OtherRecipe, load_checkpoint

    p = experiment.settings()[name]
    wanted, folder = experiment.model_copy(update={"ppo": p}), runs / experiment.task / name
    run, how = None, "begins"
    try:
        run = load_checkpoint(wanted, folder)
    except OtherRecipe as other:
        how = f"begins anew ({other})"
    if run is None or run.steps < p.steps:
        how = f"goes on after {run.steps:,} steps" if run is not None else how
        console.print(f"{experiment.task}, {label(name, p)}: {how}", markup=False, highlight=False)
        run = ppo.train(wanted, folder, go_on=run is not None)
    return run.curve


def measure_task(experiment: Experiment, runs: Path) -> Numbers:
    """Return the results of a task, once all of its settings are trained."""
    rules = load_tuned(experiment.task).found.get("tuning_mean")
    rows = {}
    for name, p in experiment.settings().items():
        curve = learning_curve(experiment, name, runs)
        past = next((point["seconds"] for point in curve if rules is not None and point["mean"] > rules), None)
        rows[name] = {"ppo": p.model_dump(mode="json"), "past_the_rules_s": past, "curve": curve}
    return {"rules": rules, "settings": rows}


def draw(path: Path, tasks: Mapping[str, Numbers], note: str = "One seed each; policies play without noise.") -> None:
    """Write the picture: for each task the mean return of the rules, and the curve of each setting."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.0 + 5.0 * len(tasks), 4.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(1, len(tasks), squeeze=False)[0]
    for axes, (task, numbers) in zip(grid, tasks.items(), strict=True):
        _curves(axes, task, numbers)
    figure.suptitle("Learning, by the clock", x=0.01, ha="left", fontsize=14, fontweight="bold", color=INK)
    figure.supxlabel(note, x=0.01, ha="left", fontsize=8, color=FAINT)
    with replace_file(path) as file:
        figure.savefig(file, format="png", dpi=150, metadata={"Software": "flockenv"})


def _curves(axes: Axes, task: str, numbers: Numbers) -> None:
    rules, settings = numbers["rules"], {name: PpoSettings(**row["ppo"]) for name, row in numbers["settings"].items()}
    curves: dict[str, Curve] = {name: row["curve"] for name, row in numbers["settings"].items()}
    best = max(point["mean"] for curve in curves.values() for point in curve)
    for k, (name, curve) in enumerate(curves.items()):
        seconds, means = [point["seconds"] for point in curve], [point["mean"] for point in curve]
        axes.plot(
            seconds, means, color=COLOURS[k % len(COLOURS)], linewidth=1.8, label=label(name, settings[name]),
        )  # fmt: skip
    level = best if rules is None else rules
    if rules is not None:
        axes.axhline(rules, color=INK, linewidth=1, linestyle=(0, (4, 3)), label=f"the rules, tuned: {rules:.2f}")
    worst = min(max(point["mean"] for point in curve) for curve in curves.values())
    # show the range near the rules, and the end of every curve
    room = max(0.15 * abs(level), 4 * abs(best - level), 1.5 * (level - worst))
    axes.set_ylim(level - room, max(best, level) + 0.25 * room)
    axes.set_title(task, loc="left", fontsize=12, fontweight="bold", color=INK)
    axes.set_xlabel("seconds of training")
    worlds = " or ".join(str(count) for count in sorted({p.evaluate_worlds for p in settings.values()}))
    axes.set_ylabel(f"mean return, {worlds} tuning worlds")
    axes.grid(color=GRID, linewidth=0.8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.legend(fontsize=8, edgecolor="none", loc="best")


@app.command()
def main(
    configs: Annotated[list[Path], typer.Argument(help="experiments, such as configs/training/obstacles.yaml")],
    out: Annotated[str, typer.Option(help="picture; numbers are written beside it")] = "results/learning.png",
    runs: Annotated[Path, typer.Option(help="folder of checkpoints")] = Path("runs/curves"),
) -> None:
    """Train several settings of each task, and draw their learning curves side by side."""
    with one_line_errors():
        picture = valid_file(out, (".png",), force=True, beside=".json")
        folder = valid_path(str(runs), "--runs")
        experiments = experiments_of(configs)
        check_room(picture, ROOM)
    stays = f"interrupted; what is trained stays in {runs}, the same command goes on"
    with report_errors("curves", stays), one_line_errors((FloatingPointError,)):
        tasks = {task: measure_task(experiment, folder) for task, experiment in experiments.items()}
        write_all_or_none(picture.parent, {
            picture.name: lambda path: draw(path, tasks),
            picture.with_suffix(".json").name: lambda path: path.write_bytes(json.dumps(tasks).encode()),
        })  # fmt: skip
    for task, numbers in tasks.items():
        for name, row in numbers["settings"].items():
            last, past = row["curve"][-1], row["past_the_rules_s"]
            text = f"past the rules after {past:.0f} s" if past is not None else "not past the rules"
            line = f"{task:10} {name:28} {last['seconds']:6.0f} s  {text}; ends at {last['mean']:.3f}"
            console.print(line, markup=False, highlight=False)


if __name__ == "__main__":
    run_program("curves", app)
