"""Kill trainings at random moments and resume them: `python -m benchmarks.kills --times 200`.

Two short trainings alternate: Pursuit with the defaults of agents.ppo, and School with every setting that adds state to
a checkpoint (a central critic, care, held actions, imitation of the rules, staggered worlds). Each is killed by SIGKILL
and resumed up to eight times, at random moments of its duration; every third kill is timed to hit a checkpoint while it
is being written. A training that then ends must have the weights and the checkpoint of one that was never killed: the
same SHA-256. Processes are forked from a server that has already imported torch, which is the slowest part of a start.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from agents import checkpoint as files
from agents.experiment import Experiment
from flockenv.core.atomic_files import LEFTOVERS

__all__ = ["Count", "app", "kill_and_resume"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)

FEW = {"minibatch": 64, "epochs": 2, "rollout": 16, "evaluate_worlds": 4, "hidden": (8, 8), "threads": 1}
TRAININGS = (
    Experiment(task="pursuit", ppo={**FEW, "worlds": 16, "steps": 4096, "evaluate_every": 512}),
    Experiment(
        task="school",
        arguments={"fish": 3, "patches": 2, "horizon": 20},
        ppo={
            **FEW, "worlds": 4, "steps": 3456, "evaluate_every": 576, "central_critic": True, "care": 1.0, "hold": 3,
            "taught": 8, "critic_first": 1000, "stagger": True,
        },
    ),
)  # fmt: skip
WEIGHTS, REFUSED = "weights.safetensors", "refused.txt"
LARGEST = 2**26  # bytes, most that is read of a checkpoint; those of these trainings have a thousandth of it
POLL = 2e-4  # s, between two checks for a checkpoint that is being written
AIMED = 3  # every third kill is timed to hit one
CHAIN = 8  # most kills of one training; with more, few would ever end on a busy machine, and be compared


@dataclass
class Count:
    """Counts of kills, and of how the trainings ended."""

    kills: int = 0
    writing: int = 0  # kills that left a half-written checkpoint
    same: int = 0  # trainings that ended with the digests of an undisturbed one
    different: list[str] = field(default_factory=list)  # those that did not, a line each
    refused: list[str] = field(default_factory=list)  # trainings that failed, most by a refused checkpoint, a line each

    def __str__(self) -> str:
        lines = [
            f"{self.kills} kills, {self.writing} of them while a checkpoint was being written",
            f"{self.same} trainings ended, killed or not, as one that never was: the same SHA-256",
            f"{len(self.different)} ended otherwise, {len(self.refused)} resumptions were refused",
        ]
        return "\n".join([*lines, *self.different, *self.refused])


def train_and_export(experiment: Experiment, folder: str) -> None:
    """Train to the end, from the checkpoint if there is one, and export the weights; run this in a separate process.

    If the checkpoint is refused, its message is written to a file, and the exit code is 2.
    """
    from agents import ppo

    ppo.console.quiet = True
    try:
        ppo.export(ppo.train(experiment, Path(folder), go_on=True), Path(folder, WEIGHTS))
    except ValueError as error:
        Path(folder, REFUSED).write_text(str(error), encoding="utf-8")
        raise SystemExit(2) from None


def digests(folder: Path) -> str:
    """Return the digests of the exported weights and of the last checkpoint in a folder."""
    parts = files.read(folder, LARGEST)
    weights = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
    return f"weights {weights}, checkpoint {files.digest(parts or {})}"


class TrainingServer:
    """Starter of training processes, which are forked from a process that has imported torch."""

    def __init__(self) -> None:
        self._context = get_context("forkserver")
        self._context.set_forkserver_preload(["agents.ppo", "torch._dynamo"])  # Adam imports the second

    def begin(self, experiment: Experiment, folder: Path) -> BaseProcess:
        """Start a training in a folder, from the checkpoint there if there is one."""
        process = self._context.Process(target=train_and_export, args=(experiment, str(folder)))
        process.start()
        return process

    def run_undisturbed(self, experiment: Experiment, folder: Path) -> tuple[float, str]:
        """Run a training that is not killed; return its duration, s, and its digests."""
        began = time.perf_counter()
        process = self.begin(experiment, folder)
        process.join()
        if process.exitcode:
            raise RuntimeError(f"{experiment.task}: a training that was not killed ended with {process.exitcode}")
        return time.perf_counter() - began, digests(folder)


def _is_being_written(folder: Path) -> bool:
    """Return True if a folder has a checkpoint that is being written, or was when its process was killed."""
    return any(folder.glob(LEFTOVERS))


def _kill(process: BaseProcess, folder: Path, moment: float, aimed: bool) -> bool:
    """Kill a training `moment` s from now; return False if it ends before.

    aimed: wait longer, until it writes its next checkpoint, and kill it during that.
    """
    process.join(moment)
    while aimed and process.is_alive() and not _is_being_written(folder):
        time.sleep(POLL)
    if not process.is_alive():
        process.join()
        return False
    process.kill()
    process.join()
    return True


def kill_and_resume(times: int, seed: int, folder: Path, say: bool = False) -> Count:
    """Kill trainings `times` times in all, at most CHAIN times each, let each of them end, and count the outcomes."""
    server, rng, count = TrainingServer(), np.random.default_rng(seed), Count()
    undisturbed = [
        _measure_undisturbed(server, experiment, folder / f"undisturbed{k}") for k, experiment in enumerate(TRAININGS)
    ]
    number = 0
    while count.kills < times:
        which = number % len(TRAININGS)
        experiment, (seconds, expected) = TRAININGS[which], undisturbed[which]
        _kill_until_it_ends(server, experiment, folder / f"killed{number}", seconds, expected, times, rng, count)
        number += 1
        if say:
            typer.echo(f"{number}: {experiment.task}, {count.kills} kills so far", err=True)
    return count


def _measure_undisturbed(server: TrainingServer, experiment: Experiment, folder: Path) -> tuple[float, str]:
    """Return the duration, s, and the digests of a training that is not killed.

    It is run twice: the first run also compiles, and its duration does not count; the digests must be equal.
    """
    _, first = server.run_undisturbed(experiment, Path(f"{folder}.first"))
    seconds, second = server.run_undisturbed(experiment, folder)
    if first != second:
        raise RuntimeError(f"{experiment.task}: two trainings that were not killed differ: {first}; {second}")
    return seconds, second


def _kill_until_it_ends(
    server: TrainingServer, experiment: Experiment, folder: Path, seconds: float, expected: str, times: int,
    rng: np.random.Generator, count: Count,
) -> None:  # fmt: skip
    """Kill and resume one training until it ends, then count whether its digests are the `expected` ones."""
    folder.mkdir()
    last = min(times, count.kills + CHAIN)
    while True:
        process, moment = server.begin(experiment, folder), rng.uniform(0, seconds)
        if count.kills < last and _kill(process, folder, moment, count.kills % AIMED == 0):
            count.kills += 1
            count.writing += _is_being_written(folder)
            continue
        process.join()
        break
    if process.exitcode:
        message = folder / REFUSED
        text = message.read_text(encoding="utf-8") if message.exists() else f"ended with {process.exitcode}"
        count.refused.append(f"{folder.name}: {text}")
    elif (found := digests(folder)) == expected and not _is_being_written(folder):
        count.same += 1
    else:
        count.different.append(f"{folder.name}: {found}, expected {expected}")


@app.command()
def main(
    times: Annotated[int, typer.Option(min=1, help="number of kills")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="seed of their moments")] = 0,
) -> None:
    """Kill short trainings at random moments, resume them, and count how they end."""
    with tempfile.TemporaryDirectory() as folder:
        count = kill_and_resume(times, seed, Path(folder), say=True)
    typer.echo(str(count))
    raise typer.Exit(1 if count.different or count.refused else 0)


if __name__ == "__main__":
    app()
