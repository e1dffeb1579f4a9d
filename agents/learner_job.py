"""Which settings a learner of agents.learn uses, the memory that it needs, and its training as a job."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from agents.experiment import Experiment, PpoSettings
from agents.run import recipe_of
from agents.training_job import learned, memory
from flockenv.core.available_memory import available_memory
from flockenv.core.errors import nearest, printable
from flockenv.envs.world import first_step
from flockenv.jobs import Job, records
from flockenv.players.rules import as_dict, player

__all__ = ["ALGORITHMS", "SHARED", "check_memory", "effective", "learner_job", "learner_recipe"]

ALGORITHMS = ("sac", "tqc", "recurrent_ppo", "bc")

SHARED = (
    "seconds", "gamma", "reward_scale", "hold", "stagger", "hidden", "activation", "threads", "dtype", "seed",
    "disturbance", "draw", "action", "base", "bound", "evaluate_worlds",
)  # fmt: skip
"""Settings under `ppo` that all learners use; cloning, only some of them."""

OF_PPO = (
    "steps", "worlds", "rollout", "minibatch", "epochs", "learning_rate", "gae_lambda", "clip", "entropy", "log_std",
    "evaluate_every",
)  # fmt: skip
"""Those that RecurrentPPO uses as well."""

OF_CLONING = ("hidden", "activation", "threads", "seconds", "seed", "disturbance", "evaluate_worlds")


def _used(algo: str) -> tuple[str, ...]:
    """Return the settings under `ppo` that a learner uses."""
    return OF_CLONING if algo == "bc" else (*SHARED, *(OF_PPO if algo == "recurrent_ppo" else ()))


def effective(
    experiment: Experiment, algo: str, steps: int | None = None, seconds: float | None = None, seed: int | None = None
) -> Experiment:
    """Return an experiment whose `ppo` has the settings that a learner uses, and defaults for all others.

    Raises:
        ValueError: in one line, an unknown learner, or a setting that it cannot use.
    """
    if algo not in ALGORITHMS:
        hint = ": that is python -m agents.ppo" if algo == "ppo" else f": unknown{nearest(algo, ALGORITHMS)}"
        raise ValueError(f"--algo {printable(algo)}{hint}; allowed: {', '.join(ALGORITHMS)}")
    own = getattr(experiment, algo)
    if steps is not None and algo == "bc":
        raise ValueError("--steps: behaviour cloning has bc.updates, bc.worlds and bc.rounds instead")
    if steps is not None and algo in ("sac", "tqc"):
        own = type(own)(**{**own.model_dump(), "steps": steps})
        steps = None
    kept = {name: getattr(experiment.ppo, name) for name in _used(algo)}
    changed = {name: getattr(own, name) for name in type(own).model_fields if name in PpoSettings.model_fields}
    new = experiment.model_copy(update={"ppo": PpoSettings(**{**kept, **changed}), algo: own})
    new = new.with_ppo(steps=steps, seconds=seconds, seed=seed)
    _check(new, algo, experiment.ppo)
    return new


def _check(experiment: Experiment, algo: str, given: PpoSettings) -> None:
    """Raise ValueError for settings that a learner cannot use."""
    p, own = experiment.ppo, getattr(experiment, algo)
    if given.action != "force" and algo in ("recurrent_ppo", "bc"):
        raise ValueError(f"ppo.action = {given.action!r}: must be force with --algo {algo}")
    if algo == "bc":
        if given.draw:
            raise ValueError("ppo.draw: not with --algo bc, whose rules play the task as it is")
        player(experiment.build())
    if algo in ("sac", "tqc"):
        rows = p.worlds * experiment.build().learners
        if own.buffer < max(rows, own.minibatch):
            raise ValueError(f"{algo}.buffer = {own.buffer}: must be >= {max(rows, own.minibatch)}, rows and minibatch")
        if own.steps <= own.random_actions * p.hold:
            raise ValueError(f"{algo}.steps = {own.steps}: must be > {own.random_actions * p.hold}, the random actions")


def learner_recipe(experiment: Experiment, algo: str) -> dict[str, Any]:
    """Return all that a training depends on, for an experiment that `effective` made."""
    recipe, used = recipe_of(experiment), _used(algo)
    recipe["ppo"] = {name: value for name, value in recipe["ppo"].items() if name in used}
    recipe[algo] = getattr(experiment, algo).model_dump(mode="json")
    if algo == "bc":
        recipe["rules"] = as_dict(player(experiment.build()).rules)
    return recipe


def _extra_bytes(experiment: Experiment, algo: str) -> int:
    """Return the bytes of what a learner stores besides worlds and rollout, as float32."""
    task, p, own = experiment.build(), experiment.ppo, getattr(experiment, algo)
    seen, acted = task.layout.size, task.action_layout.size
    if algo == "recurrent_ppo":
        return (
            4 * 2 * 4 * p.rollout * p.worlds * task.learners * own.lstm
        )  # of actor and critic, output and cell, twice
    if algo == "bc":
        return 4 * 2 * own.worlds * own.rounds * task.horizon * task.learners * (seen + acted)
    return 4 * own.buffer * (2 * seen + acted + 3)  # before and after, action, reward, done, timeout


def _needed(experiment: Experiment, algo: str) -> int:
    return memory(experiment, learned(experiment)) + _extra_bytes(experiment, algo)


def check_memory(experiment: Experiment, algo: str) -> None:
    """Raise MemoryError, in one line, before anything is allocated, if a training would not fit into the memory."""
    needed, room = _needed(experiment, algo), available_memory()
    if room is not None and needed > room:
        stores = {"sac": "sac.buffer", "tqc": "tqc.buffer", "recurrent_ppo": "ppo.rollout", "bc": "bc.worlds"}[algo]
        part = f"{_extra_bytes(experiment, algo) / 1e9:.2g} GB of them for {stores}"
        raise MemoryError(f"training needs {needed / 1e9:.2g} GB, {part}; {room / 1e9:.2g} GB are available")


def learner_job(experiment: Experiment, algo: str, folder: Path) -> Job:
    """Return the job that trains an experiment which `effective` made; `policy_of_bytes` reads its record.

    folder: of logs; the job's is seed-N in it.
    """
    name, place = f"seed-{experiment.ppo.seed}", str(folder / f"seed-{experiment.ppo.seed}")
    return Job(
        f"{algo}/{experiment.build().name}/{name}", _train, (experiment.model_dump_json(), algo, place),
        learner_recipe(experiment, algo), _needed(experiment, algo), (first_step, (learned(experiment),)),
    )  # fmt: skip


def _train(experiment: str, algo: str, folder: str) -> bytes:
    """Train to the end of a budget; return the best policy with its card as bytes."""
    from agents import learn  # with torch

    given = Experiment.model_validate_json(experiment)
    run = learn.new_run(given, algo)
    learn.train(given, algo, run, Path(folder))
    return records.to_bytes({"tensors": dict(run.tensors), "card": learn.card(run, algo)})
