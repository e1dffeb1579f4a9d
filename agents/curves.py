"""Learning curves of several settings, side by side: `python -m agents.curves configs/obstacles.yaml ...`.

A config names settings beside its own (`curves: {name: what differs}`). Each is trained like agents.ppo trains, into
runs/curves/TASK/NAME, one after the other, so that seconds compare; what is finished is not trained again, and what was
interrupted goes on. The picture has seconds along and the mean return on the tuning worlds up, with the tuned rules as
a line: more steps with fewer epochs, or fewer with more, whichever learns faster on this machine.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from agents.experiment import Experiment, PpoSettings, load_experiment
from flockenv.outputs import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["app", "draw", "settings_of"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)

RUNS = Path("runs/curves")
OWN = "the config's own"
INK, GRID = "#22272e", "#e4e7eb"
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00")  # Okabe and Ito

Curve = list[dict[str, float]]


def settings_of(experiment: Experiment) -> dict[str, PpoSettings]:
    """Return the settings to compare by name, the config's own first; ValueError if one cannot be read."""
    own = experiment.ppo
    out = {OWN: own}
    for name, changes in experiment.curves.items():
        unknown = sorted(set(changes) - set(PpoSettings.model_fields))
        if unknown:
            allowed = ", ".join(PpoSettings.model_fields)
            raise ValueError(f"curves.{name}.{unknown[0]}: unknown; allowed: {allowed}")
        out[name] = PpoSettings(**{**own.model_dump(), **changes})
    return out


def in_words(p: PpoSettings) -> str:
    """Say what matters of some settings for speed."""
    return f"{p.epochs} epoch{'s' * (p.epochs > 1)}, minibatches of {p.minibatch:,}, rate {p.learning_rate:g}"


def learned(experiment: Experiment, name: str, p: PpoSettings) -> Curve:
    """Return the curve of one setting: read if it is there, else trained to the end."""
    from agents.ppo import train

    folder = RUNS / experiment.task / name.replace(" ", "_").replace("'", "")
    done = folder / "curve.json"
    recipe = p.model_dump(mode="json")
    if done.exists():
        kept = json.loads(done.read_text(encoding="utf-8"))
        if kept["ppo"] == recipe:
            return list(kept["curve"])
    console.print(f"{experiment.task}, {name}: {in_words(p)}", highlight=False)
    run = train(experiment.model_copy(update={"ppo": p}), folder, go_on=True)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(done) as file:
        file.write_text(json.dumps({"ppo": recipe, "curve": run.curve}), encoding="utf-8")
    return run.curve


def draw(path: Path, tasks: dict[str, tuple[float | None, dict[str, Curve]]], note: str = "") -> None:
    """Write the picture: for each task the mean return of the rules, and the curve of each setting by its label."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.0 + 5.0 * len(tasks), 4.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (task, (rules, curves)) in zip(
        figure.subplots(1, len(tasks), squeeze=False)[0], tasks.items(), strict=True
    ):
        _curves(axes, task, rules, curves)
    figure.suptitle("Learning, by the clock", x=0.01, ha="left", fontsize=14, fontweight="bold", color=INK)
    figure.supxlabel(note, x=0.01, ha="left", fontsize=8, color="#6b7480")
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=150, metadata={"Software": "flockenv"})


def _curves(axes: Axes, task: str, rules: float | None, curves: dict[str, Curve]) -> None:
    best = max(point["mean"] for curve in curves.values() for point in curve)
    for colour, (label, curve) in zip(COLOURS * 3, curves.items(), strict=False):
        axes.plot([p["seconds"] for p in curve], [p["mean"] for p in curve], color=colour, linewidth=1.8, label=label)
    level = best if rules is None else rules
    if rules is not None:
        axes.axhline(rules, color=INK, linewidth=1, linestyle=(0, (4, 3)), label=f"the rules, tuned: {rules:.2f}")
    room = max(0.15 * abs(level), 4 * abs(best - level))  # what happens near the rules is what matters
    axes.set_ylim(level - room, max(best, level) + 0.25 * room)
    axes.set_title(task, loc="left", fontsize=12, fontweight="bold", color=INK)
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("mean return, tuning worlds")
    axes.grid(color=GRID, linewidth=0.8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.legend(fontsize=8, frameon=False, loc="lower right")


@app.command()
def main(
    configs: Annotated[list[Path], typer.Argument(help="experiments, such as configs/obstacles.yaml")],
    out: Annotated[Path, typer.Option(help="picture; the numbers go beside it")] = Path("results/learning.png"),
) -> None:
    """Train several settings of each task, and draw their learning curves side by side."""
    try:
        experiments = [load_experiment(path) for path in configs]
        wanted = [settings_of(experiment) for experiment in experiments]
        for experiment in experiments:
            experiment.build()
    except (ValueError, OSError) as error:
        console.print(f"error: {error}", style="red", markup=False, highlight=False)
        raise typer.Exit(2) from None
    tasks: dict[str, tuple[float | None, dict[str, Curve]]] = {}
    numbers: dict[str, Any] = {}
    try:
        for experiment, settings in zip(experiments, wanted, strict=True):
            curves = {name: learned(experiment, name, p) for name, p in settings.items()}
            rules = experiment.reynolds.found.get("tuning_mean")
            tasks[experiment.task] = (rules, {in_words(settings[name]): curve for name, curve in curves.items()})
            numbers[experiment.task] = {
                name: {
                    "ppo": settings[name].model_dump(mode="json"),
                    "curve": curve,
                    "past_the_rules_s": _past(curve, rules),
                }
                for name, curve in curves.items()
            }
    except KeyboardInterrupt:
        console.print(f"interrupted; what is trained stays in {RUNS}, the same command goes on")
        raise typer.Exit(130) from None
    out.parent.mkdir(parents=True, exist_ok=True)
    draw(out, tasks, "One seed each. A point is 256 worlds without noise.")
    with replacing(out.with_suffix(".json")) as file:
        file.write_text(json.dumps(numbers, indent=1), encoding="utf-8")
    for task, settings in numbers.items():
        for name, row in settings.items():
            last, past = row["curve"][-1], row["past_the_rules_s"]
            text = f"past the rules after {past:.0f} s" if past is not None else "not past the rules"
            console.print(
                f"{task:10} {name:20} {last['seconds']:6.0f} s  {text}; ends at {last['mean']:.3f}", highlight=False
            )


def _past(curve: Curve, rules: float | None) -> float | None:
    """Return after how many seconds a curve first lies above the rules."""
    return next((p["seconds"] for p in curve if rules is not None and p["mean"] > rules), None)


if __name__ == "__main__":
    app()
