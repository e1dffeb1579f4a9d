"""A training as a job: the same experiment with other training seeds, on several processes or machines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.drawn import drawn_settings
from agents.experiment import Experiment
from agents.run import recipe_of
from flockenv.envs.world import bytes_per_world, first_step
from flockenv.jobs import Job, records
from flockenv.tasks import Task

__all__ = ["file_name", "learned", "memory", "policy_of_bytes", "training_job", "with_seed"]

TRAINING = 700 * 2**20
"""Bytes that a process needs to train, besides worlds and rollout: torch and other libraries, and compiling."""


def with_seed(experiment: Experiment, seed: int) -> Experiment:
    """Return the experiment with another training seed."""
    return experiment.model_copy(update={"ppo": experiment.ppo.model_copy(update={"seed": seed})})


def training_job(
    experiment: Experiment, runs: Path, go_on: bool = True, name: str | None = None, at_a_time: int | str | None = None
) -> Job:
    """Return the job that trains an experiment; go_on: continue from the checkpoint that a killed process left.

    The record is read by `policy_of_bytes`. The checkpoint is in `runs`, in a folder named by the job's key: another
    recipe or other code begins anew. name: of the job (default: "ppo/TASK/seed-N"). at_a_time: how many trainings run
    at the same time, if its wall time is a result: a training among others has another key.
    """
    task, about = learned(experiment), recipe_of(experiment)
    unplaced = Job(
        name or f"ppo/{experiment.build().name}/seed-{experiment.ppo.seed}", _train, (),
        about if at_a_time is None else [about, at_a_time], memory(experiment, task), (first_step, (task,)),
    )  # fmt: skip
    folder = runs / unplaced.key.partition("/")[2].replace("/", "-")
    return replace(unplaced, arguments=(experiment.model_dump_json(), str(folder), go_on))


def learned(experiment: Experiment) -> Task:
    """Return the task as it is learnt, in the precision of the training worlds."""
    return experiment.build().model_copy(update={"dtype": experiment.ppo.dtype})


def memory(experiment: Experiment, task: Task) -> int:
    """Return the memory of a training, bytes: libraries, worlds, and the rollout twice, as minibatches are drawn."""
    p = experiment.ppo
    row = 4 * (task.layout.size + task.action_layout.size + 6)  # float32: also rewards, values and the like
    drawn = [each for _, each, _ in drawn_settings(task, p.disturbance, p.draw)]
    of_worlds = [bytes_per_world(each) + 2 * p.rollout * each.learners * row for each in drawn]
    return TRAINING + p.worlds * sum(of_worlds) // len(of_worlds)


def file_name(job: Job) -> str:
    """Return the name of the policy's file: pursuit-seed-3.safetensors."""
    return f"{job.name.partition('/')[2].replace('/', '-')}.safetensors"


def _train(experiment: str, folder: str, go_on: bool) -> bytes:
    """Train to the end of the budget; return the best policy with its card as bytes."""
    from agents.ppo import train  # with torch
    from agents.training import card_of

    run = train(Experiment.model_validate_json(experiment), Path(folder), go_on)
    return records.to_bytes({"tensors": dict(run.tensors), "card": card_of(run)})


def policy_of_bytes(data: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tensors and the card of a trained policy."""
    found = records.from_bytes(data, ())
    return found["tensors"], found["card"]
