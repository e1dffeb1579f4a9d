"""Parts of a training that all learners share: budget in seconds, threads, score, progress and card."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from agents.divergence import LearningDiverged
from agents.drawn import played_returns, squash_of
from agents.experiment import CONFIGS, PpoSettings, load_experiment
from agents.run import Run, differences
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.players.policy import describe
from flockenv.tasks import TASKS, Task

__all__ = [
    "BudgetSpent", "add_point", "card_of", "command_of", "is_spent", "new_progress", "score", "share_of_time_left",
    "use_thread_count",
]  # fmt: skip


CHANGED_BY = ("steps", "seconds", "seed", "action")
"""Settings of a training that an option of its command changes."""


class BudgetSpent(Exception):  # noqa: N818  # the end of a training
    """Raised by a callback between two updates if the budget in seconds is spent."""


def share_of_time_left(p: PpoSettings, wall: float) -> float:
    """Return the share of the budget in seconds that is left after `wall` s, at most 1; 1 without such a budget."""
    return 1.0 if p.seconds is None else min(1.0, 1.0 - wall / p.seconds)


def is_spent(run: Run, p: PpoSettings) -> bool:
    """Return True if a budget is spent, and the last policy has been evaluated."""
    is_evaluated = bool(run.curve) and run.curve[-1]["steps"] == run.steps
    return run.steps >= p.steps or (share_of_time_left(p, run.wall) <= 0 and is_evaluated)


@contextmanager
def use_thread_count(count: int) -> Iterator[None]:
    """Set the number of threads of torch and of the worlds for a block; restore both afterwards."""
    before = torch.get_num_threads(), threads()
    torch.set_num_threads(count)
    use_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        use_threads(before[1])


def score(task: Task, p: PpoSettings, tensors: dict[str, np.ndarray]) -> tuple[float, float]:
    """Return the mean return and the success rate of a policy, without noise, on the tuning worlds.

    Raises:
        LearningDiverged: an action of the policy, or a reward, is not finite.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # a result that is not finite raises an error
            returns, success = played_returns(task, p, tensors)
    except ValueError as error:  # the message names the world
        raise LearningDiverged(f"on the tuning worlds: {error}") from error
    return float(np.mean(returns)), float(np.mean(success))


def add_point(run: Run, tensors: dict[str, np.ndarray], scored: tuple[float, float]) -> tuple[str, str]:
    """Add a point to the learning curve of a run, and keep the policy if it is the best so far.

    scored: mean return and success rate of the policy with these tensors. Returns a text for the progress bar, and a
    line for the console.
    """
    result, success = scored
    seconds = round(run.wall, 1)
    run.curve.append({"steps": run.steps, "seconds": seconds, "mean": result, "success": success})
    if run.best is None or result > run.best:
        run.best, run.tensors = result, tensors
    line = f"{run.steps:>12,} steps {seconds:7.1f} s  mean {result:8.3f}  success {success:.3f}"
    return f"{result:.2f}, success {success:.0%}, best {run.best:.2f}", line


def new_progress(console: Console) -> Progress:
    """Return the display of a training: a bar of agent-steps, times, and the last score."""
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[score]}"), console=console,
    )  # fmt: skip


def _recipe_of_config(path: Path) -> dict[str, Any]:
    """Return the part of a config's recipe that is in its file."""
    return load_experiment(path).model_dump(mode="json", include={"task", "arguments", "ppo"})


def command_of(
    recipe: dict[str, Any],
    module: str,
    options: Sequence[str] = (),
    of_config: Callable[[Path], dict[str, Any]] = _recipe_of_config,
) -> str:
    """Return the command that trains a recipe, with the task's config that has it, and options for what differs.

    Any other config is CONFIG.yaml: the card has its settings. options: further ones of the command. of_config: returns
    the recipe that the command makes of a config, or raises ValueError if it refuses it.
    """
    found: list[tuple[str, list[str]]] = []
    for path in sorted(CONFIGS.glob(f"{recipe['task']}*.yaml")):
        with suppress(ValueError):
            theirs = of_config(path)
            changes = _options_of(differences(theirs, {key: recipe.get(key, {}) for key in theirs}))
            found += [] if changes is None else [(f"configs/training/{path.name}", changes)]
    config, changes = min(found, key=lambda each: len(each[1]), default=("CONFIG.yaml", []))
    return " ".join([f"python -m {module} {config}", *options, *changes])


def _options_of(changed: dict[str, tuple[Any, Any]]) -> list[str] | None:
    """Return the options for values that differ from those of a config; None if there is none for one of them."""
    values = {key.rpartition(".")[2]: wants for key, (_, wants) in changed.items()}
    if any(name not in CHANGED_BY or wants is None for name, wants in values.items()):
        return None
    return [f"--{name} {values[name]}" for name in CHANGED_BY if name in values]


def _end_of(run: Run) -> dict[str, str]:
    """Return the card's entry on what ended a training; none if agent-steps are its only budget."""
    p = run.recipe["ppo"]
    if run.ended_by or p.get("seconds") is None:
        return {"ended_by": run.ended_by} if run.ended_by else {}
    if run.steps >= p["steps"]:
        return {"ended_by": "steps"}
    return {"ended_by": "seconds"} if run.wall >= p["seconds"] else {}


def card_of(run: Run, library: str = "stable-baselines3", command: str | None = None) -> dict[str, Any]:
    """Return the card of a run's policy: its recipe, from which it can be reproduced, and how it was trained.

    command: that trains it (default: that of agents.ppo).
    """
    recipe = run.recipe
    return {
        **describe(TASKS[recipe["task"]](**recipe["arguments"])),
        **{name: recipe[name] for name in ("rules", "hybrid") if name in recipe},
        "activation": recipe["ppo"]["activation"],
        **squash_of(run.tensors),
        "algorithm": f"PPO ({library})",
        "recipe": {"command": command or command_of(recipe, "agents.ppo"), "ppo": recipe["ppo"]},
        "seed": recipe["ppo"]["seed"],
        "steps": run.steps,
        **_end_of(run),
        "wall_time_s": round(run.wall, 1),
        "tuning_mean": run.best,
        "curve": run.curve,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": run.surroundings,
        **({"resumed": run.resumed} if run.resumed else {}),
    }
