"""Learning curves of several settings, side by side: `python -m agents.curves configs/training/obstacles.yaml ...`.

A config may list further settings (`curves: {name: differences}`). Each is trained as by agents.ppo, as a job in a
process of its own; by default one after the other, so that wall times are comparable. A finished training is not
repeated, an interrupted one continues, and one of another recipe, other code or another number of trainings at a time
begins anew. The picture shows the mean return on the tuning worlds over wall time, s, with the tuned rules as a line:
so it shows which setting learns fastest on this machine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from agents.drawn import check_settings
from agents.experiment import Experiment, PpoSettings, load_experiment, one_line_errors
from agents.run import expected_bytes
from agents.training_job import policy_of_bytes, training_job
from flockenv.cli.jobs import EngineName, Fresh, ShardText, end_of_shard, shard_of
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.evaluation.plots import COLOURS, FAINT, GRID, INK, save_figure
from flockenv.jobs import Job, Store, Work, engine_of, run_jobs
from flockenv.players.rules import load_tuned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["app", "draw"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True, soft_wrap=True)

ROOM = 2**20
"""Largest size of a picture, bytes."""

SEEDS = "One seed each; policies play without noise."
NOTE = f"{SEEDS} One training at a time."
STOPPED = "interrupted; checkpoints and finished trainings are stored, the same command goes on"

Curve = list[dict[str, float]]
Numbers = Mapping[str, Any]
"""Results of a task, as stored: the mean return of its rules, and the curve and recipe of each setting."""


def experiments_of(configs: Sequence[Path]) -> dict[str, Experiment]:
    """Read the configs, by task; ValueError if one cannot be used, or two are of one task and share its folder."""
    out: dict[str, Experiment] = {}
    for path in configs:
        experiment = load_experiment(path)
        task = experiment.build().name
        for p in experiment.settings().values():
            check_settings(experiment.model_copy(update={"ppo": p}))
        if task in out:
            raise ValueError(f"{path}: task = {task!r}: another config is of that task; compare settings under curves")
        out[task] = experiment
    return out


def label(name: str, p: PpoSettings) -> str:
    """Return the name of a setting, with its numbers that affect speed."""
    return f"{name}: {p.epochs} epoch{'s' * (p.epochs > 1)}, minibatch {p.minibatch:,}, rate {p.learning_rate:g}"


def curve_jobs(
    experiments: Mapping[str, Experiment], runs: Path, at_a_time: int | str, go_on: bool
) -> dict[tuple[str, str], Job]:
    """Return the trainings by task and setting; at_a_time, go_on: as of `training_job`."""
    return {
        (task, name): training_job(
            experiment.model_copy(update={"ppo": p}), runs, go_on, f"curves/{task}/{name.replace(' ', '-')}", at_a_time
        )
        for task, experiment in experiments.items() for name, p in experiment.settings().items()
    }  # fmt: skip


def task_numbers(experiment: Experiment, curves: Mapping[str, Curve]) -> Numbers:
    """Return the results of a task from the curves of its settings."""
    rules = load_tuned(experiment.task).found.get("tuning_mean")
    rows = {}
    for name, p in experiment.settings().items():
        past = next((point["seconds"] for point in curves[name] if rules is not None and point["mean"] > rules), None)
        rows[name] = {"ppo": p.model_dump(mode="json"), "past_the_rules_s": past, "curve": curves[name]}
    return {"rules": rules, "settings": rows}


def note_of(at_a_time: int | str) -> str:
    """Return the note of the picture: how many trainings ran at a time, and whether wall times are comparable."""
    if at_a_time == 1:
        return NOTE
    together = "one per core of a Ray cluster" if at_a_time == "ray" else f"up to {at_a_time}"
    return f"{SEEDS} Trainings at a time: {together}; wall times are comparable only with one thread and core for each."


def draw(path: Path, tasks: Mapping[str, Numbers], note: str = NOTE) -> None:
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
    save_figure(path, figure)


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
    jobs: Annotated[Path, typer.Option(help="folder for the records of jobs")] = Path("results/jobs"),
    engine: EngineName = "local",
    processes: Annotated[
        int,
        typer.Option(
            min=1, max=256, help="trainings at a time; more than 1 slow each other down, unless each has one thread"
        ),
    ] = 1,
    fresh: Fresh = False,
    shard: ShardText = None,
) -> None:
    """Train several settings of each task, one after the other, and draw their learning curves side by side."""
    with one_line_errors():
        picture = valid_file(out, (".png",), force=True, beside=".json")
        folder, store = valid_path(str(runs), "--runs"), Store(valid_path(str(jobs), "--jobs"))
        experiments = experiments_of(configs)
        check_room(picture, ROOM)
        for experiment in experiments.values():
            check_room(folder / "checkpoint", expected_bytes(experiment))
        runner, part = engine_of(engine, processes, renew=True), shard_of(shard)
    at_a_time = processes if engine == "local" else engine
    trainings = curve_jobs(experiments, folder, at_a_time, not fresh)
    with report_errors("curves", STOPPED), end_of_shard():
        with job_bar("training") as progress:
            run_jobs(list(trainings.values()), Work(store, runner, fresh, progress, part))
        curves = {key: store.read(job, policy_of_bytes)[1]["curve"] for key, job in trainings.items()}
        tasks = {
            task: task_numbers(experiment, {name: curve for (of, name), curve in curves.items() if of == task})
            for task, experiment in experiments.items()
        }
        write_all_or_none(picture.parent, {
            picture.name: lambda path: draw(path, tasks, note_of(at_a_time)),
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
