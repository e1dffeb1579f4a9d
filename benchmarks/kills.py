"""Kill trainings at random moments and resume them: `python -m benchmarks.kills --times 200`.

Two short trainings take turns: Pursuit as agents.ppo trains by default, and School with everything that has a memory of
its own (a central critic, care, held actions, teaching, staggered worlds). Each is killed with SIGKILL again and again,
at moments uniform over its whole life, up to eight times; every third kill waits for the next checkpoint to be written,
and comes in the middle of that. A training that ends must have exported the weights, and left the checkpoint, of one
that was never killed: the same SHA-256. Processes are forked from a server that has imported torch, since that takes
longest.
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
LARGEST = 2**26  # bytes of a checkpoint; of these trainings it has a thousandth of that
POLL = 2e-4  # s, between looks for a checkpoint that is being written
AIMED = 3  # one kill in three is aimed at one
CHAIN = 8  # most kills of one training: on a busy machine hardly any would end, and none would be compared


@dataclass
class Count:
    """Outcomes of the kills."""

    kills: int = 0
    writing: int = 0  # of them, those that left a half-written checkpoint
    same: int = 0  # trainings that ended with the digests of one that was never killed
    different: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)  # in one line

    def __str__(self) -> str:
        lines = [
            f"{self.kills} kills, {self.writing} of them while a checkpoint was being written",
            f"{self.same} trainings ended, killed or not, as one that never was: the same SHA-256",
            f"{len(self.different)} ended otherwise, {len(self.refused)} resumptions were refused",
        ]
        return "\n".join([*lines, *self.different, *self.refused])


def live(experiment: Experiment, folder: str) -> None:
    """Train, or go on, to the end and export; what is refused is written down. To be run in a process of its own."""
    from agents import ppo

    ppo.console.quiet = True
    try:
        ppo.export(ppo.train(experiment, Path(folder), go_on=True), Path(folder, WEIGHTS))
    except ValueError as error:
        Path(folder, REFUSED).write_text(str(error), encoding="utf-8")
        raise SystemExit(2) from None


def digests(folder: Path) -> str:
    """Return the digests of the weights and of the last checkpoint that a training came to."""
    parts = files.read(folder, LARGEST)
    weights = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
    return f"weights {weights}, checkpoint {files.digest(parts or {})}"


class Lives:
    """Starts the lives of trainings, one at a time."""

    def __init__(self) -> None:
        self._context = get_context("forkserver")
        self._context.set_forkserver_preload(["agents.ppo", "torch._dynamo"])  # Adam imports the second

    def begin(self, experiment: Experiment, folder: Path) -> BaseProcess:
        """Start one in a folder, from what an earlier one left there."""
        process = self._context.Process(target=live, args=(experiment, str(folder)))
        process.start()
        return process

    def whole(self, experiment: Experiment, folder: Path) -> tuple[float, str]:
        """Return how long a training takes that is never killed, s, and its digests."""
        began = time.perf_counter()
        process = self.begin(experiment, folder)
        process.join()
        if process.exitcode:
            raise RuntimeError(f"{experiment.task}: a training that was not killed ended with {process.exitcode}")
        return time.perf_counter() - began, digests(folder)


def _being_written(folder: Path) -> bool:
    return any(folder.glob(LEFTOVERS))


def _killed(process: BaseProcess, folder: Path, moment: float, aimed: bool) -> bool:
    """Kill a life at a moment, s, aimed: in the next checkpoint after it; return False if it ended before."""
    process.join(moment)
    while aimed and process.is_alive() and not _being_written(folder):
        time.sleep(POLL)
    if not process.is_alive():
        process.join()
        return False
    process.kill()
    process.join()
    return True


def kill_and_resume(times: int, seed: int, folder: Path, say: bool = False) -> Count:
    """Kill trainings `times` times in all, at most CHAIN times each, and let each end; return the counts."""
    lives, rng, count = Lives(), np.random.default_rng(seed), Count()
    known = [_known(lives, experiment, folder / f"whole{k}") for k, experiment in enumerate(TRAININGS)]
    number = 0
    while count.kills < times:
        which = number % len(TRAININGS)
        experiment, (seconds, expected) = TRAININGS[which], known[which]
        _chain(lives, experiment, folder / f"killed{number}", seconds, expected, times, rng, count)
        number += 1
        if say:
            typer.echo(f"{number}: {experiment.task}, {count.kills} kills so far", err=True)
    return count


def _known(lives: Lives, experiment: Experiment, folder: Path) -> tuple[float, str]:
    """Return the duration, s, and the digests of a training that is not killed; a first one compiles."""
    _, first = lives.whole(experiment, Path(f"{folder}.first"))
    seconds, second = lives.whole(experiment, folder)
    if first != second:
        raise RuntimeError(f"{experiment.task}: two trainings that were not killed differ: {first}; {second}")
    return seconds, second


def _chain(
    lives: Lives, experiment: Experiment, folder: Path, seconds: float, expected: str, times: int,
    rng: np.random.Generator, count: Count,
) -> None:  # fmt: skip
    """Let one training live until it ends, killed on the way, and compare its digests."""
    folder.mkdir()
    last = min(times, count.kills + CHAIN)
    while True:
        process, moment = lives.begin(experiment, folder), rng.uniform(0, seconds)
        if count.kills < last and _killed(process, folder, moment, count.kills % AIMED == 0):
            count.kills += 1
            count.writing += _being_written(folder)
            continue
        process.join()
        break
    if process.exitcode:
        said = folder / REFUSED
        text = said.read_text(encoding="utf-8") if said.exists() else f"ended with {process.exitcode}"
        count.refused.append(f"{folder.name}: {text}")
    elif (found := digests(folder)) == expected and not _being_written(folder):
        count.same += 1
    else:
        count.different.append(f"{folder.name}: {found}, expected {expected}")


@app.command()
def main(
    times: Annotated[int, typer.Option(min=1, help="kills")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="of their moments")] = 0,
) -> None:
    """Kill short trainings at random moments, resume them, and count how they end."""
    with tempfile.TemporaryDirectory() as folder:
        count = kill_and_resume(times, seed, Path(folder), say=True)
    typer.echo(str(count))
    raise typer.Exit(1 if count.different or count.refused else 0)


if __name__ == "__main__":
    app()
