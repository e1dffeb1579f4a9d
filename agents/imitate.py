"""Train a network to imitate the hand-written player: `python -m agents.imitate configs/training/school.yaml`.

This distinguishes two reasons why a trained policy scores less than rules. The network is PPO's, of the same size, with
the same inputs; it learns the tuned rules' actions in training worlds, and then plays the tuning worlds alone. If it
scores as they do, it can represent them, and PPO failed to find them; if not, its observations may lack something.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from agents.dagger import WORLDS, teach
from agents.experiment import Experiment, load_experiment, one_line_errors
from agents.ppo import build, tensors_of
from agents.training import score, use_thread_count
from agents.training_log import open_log
from flockenv.cli.terminal import DIVERGED, run_program, show_progress
from flockenv.core.output_paths import valid_path
from flockenv.evaluation import rollout, worlds_for
from flockenv.players.rules import player

__all__ = ["Imitation", "app", "imitate"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)


@dataclass(frozen=True)
class Imitation:
    """Mean returns of the rules, and of the network that imitates them, on the same tuning worlds."""

    rules: float
    network: float
    rows: int  # observations that it was trained on
    missed: float  # mean square error of its actions, over the variance of the rules' actions


def imitate(
    experiment: Experiment, folder: Path, worlds: int = WORLDS, updates: int = 6000,
    advance: Callable[[int], None] = lambda n: None,
) -> Imitation:  # fmt: skip
    """Train PPO's actor to imitate the tuned rules in training worlds; evaluate both in tuning worlds.

    folder: of the log, which has a row for each round, and one with both mean returns.

    Raises:
        FloatingPointError: learning or a world diverged.
    """
    task, p = experiment.build(), experiment.ppo
    rules = player(task)
    with use_thread_count(p.threads), open_log(folder, console) as logger:

        def ended(steps: int, rows: int, missed: float) -> None:
            for name, value in (("time/gradient_steps", steps), ("train/rows", rows), ("train/missed", missed)):
                logger.record(name, value)
            logger.dump(steps)

        model = build(task, p)
        rows, missed = teach(model, task, rules, updates, worlds, advance, ended=ended)
        own = rollout(task, rules, p.evaluate_worlds, worlds_for("tuning", p.seed, p.evaluate_worlds))
        network, _ = score(task, p, tensors_of(model))
        found = Imitation(float(own.returns.mean()), network, rows, missed)
        logger.record("tuning/mean_return", found.network)
        logger.record("tuning/mean_return_of_rules", found.rules)
        logger.dump(updates)
    return found


@app.command()
def main(
    config: Annotated[Path, typer.Argument(help="an experiment, such as configs/training/school.yaml")],
    worlds: Annotated[
        int, typer.Option(min=1, help="training worlds of each of four rounds; rules act in the first")
    ] = WORLDS,
    updates: Annotated[int, typer.Option(min=1, help="gradient steps, each of 2,048 rows")] = 6000,
    runs: Annotated[Path, typer.Option(help="folder of logs")] = Path("runs/imitate"),
) -> None:
    """Train a network of PPO's size to imitate the tuned rules, and show how well it plays."""
    with one_line_errors():
        experiment = load_experiment(config)
        name = experiment.build().name
        folder = valid_path(str(runs / name), "--runs")
    try:
        with show_progress(Progress(console=console)) as progress:
            bar = progress.add_task(f"{name}: gradient steps", total=updates)
            found = imitate(experiment, folder, worlds, updates, lambda n: progress.advance(bar, n))
    except FloatingPointError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(DIVERGED) from None
    console.print(
        f"{name}: mean return {found.rules:.3f} (rules) -> {found.network:.3f} (taught by {found.rows:,} rows; "
        f"{found.missed:.1%} of the answers' variance missed)"
    )


if __name__ == "__main__":
    run_program("imitate", app)
