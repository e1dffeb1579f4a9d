"""A run of training: its state so far, which is written to a checkpoint, and read and checked again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from agents import checkpoint as files
from agents.checkpoint import CheckpointError, CheckpointParts
from agents.drawn import drawn_settings
from agents.experiment import Experiment
from flockenv.core.errors import KeyPath, key_path, printable
from flockenv.core.record import ResultRecord
from flockenv.players import ALL_SEEDS, known_name, policy_file
from flockenv.players.hybrid import FORCE, Hybrid
from flockenv.players.policy import MlpPolicy
from flockenv.players.rules import as_dict, player
from flockenv.tasks import Task

__all__ = [
    "OtherRecipe", "Run", "differences", "expected_bytes", "first_difference", "load_checkpoint", "recipe_of",
    "save_checkpoint", "start_path",
]  # fmt: skip

STATE = ("policy", "optimizer", "worlds", "rollout", "random")
"""The parts of a checkpoint that are the model's, see agents.training_state."""

ALWAYS = ("best", "notes", files.TIMES)
"""The other parts: the actor of the best policy so far, the notes, and wall times."""


class OtherRecipe(CheckpointError):  # noqa: N818  # not an error for a caller that starts anew then
    """A checkpoint of another recipe than that of the training."""


def recipe_of(experiment: Experiment) -> dict[str, Any]:
    """Return the recipe, all that training depends on: if any value differs, it is another training."""
    task, recipe = experiment.build(), experiment.model_dump(mode="json", include={"task", "arguments", "ppo"})
    if experiment.ppo.taught:
        recipe["rules"] = as_dict(player(task).rules)  # the policy that it imitated first
    if experiment.ppo.start is not None:
        recipe["start"] = MlpPolicy.load(start_path(experiment.ppo.start, task, experiment.ppo.seed)).card["sha256"]
    if experiment.ppo.action != FORCE:
        recipe["hybrid"] = Hybrid.of(task, experiment.ppo.action, experiment.ppo.base, experiment.ppo.bound).card
    return {**recipe, "layout": task.layout.digest}


def start_path(spec: str, task: Task, seed: int) -> Path:
    """Return the file of the policy with which learning begins (`ppo.start`); seed: of the training, for ppo@*."""
    if known_name(spec) != "ppo":
        return Path(spec)
    return policy_file(spec.replace(ALL_SEEDS, f"@{seed}"), task)


@dataclass
class Run:
    """The state of training so far: all that a checkpoint holds."""

    recipe: dict[str, Any]
    surroundings: dict[str, str]  # versions and machine at the start
    resumed: list[dict[str, Any]] = field(default_factory=list)  # later changes of these, and from which step
    steps: int = 0
    wall: float = 0.0  # s, imitation included
    curve: list[dict[str, float]] = field(default_factory=list)
    best: float | None = None
    tensors: dict[str, np.ndarray] = field(default_factory=dict)
    state: CheckpointParts = field(default_factory=dict)  # of the model, see agents.training_state
    ended_by: str = ""  # for the card, if it does not follow from the budgets; not in a checkpoint


class Point(ResultRecord):
    """A point of the learning curve, as a checkpoint holds it; its wall time is in Times."""

    steps: int = Field(ge=0, description="agent-steps so far")
    mean: float = Field(description="mean return on the tuning worlds")
    success: float = Field(ge=0, le=1, description="success rate on the tuning worlds")


class Resumption(ResultRecord):
    """A resumption under other versions, or on another machine, than before."""

    steps: int = Field(ge=0, description="agent-steps until then")
    surroundings: dict[str, str] = Field(description="versions and parts of the machine that changed")


class Notes(ResultRecord):
    """The part of a checkpoint with texts and numbers, in addition to its arrays."""

    recipe: dict[str, Any] = Field(description="all that training depends on")
    surroundings: dict[str, str] = Field(description="versions and machine at the start")
    resumed: tuple[Resumption, ...] = Field(description="resumptions under other versions, or on another machine")
    steps: int = Field(ge=0, description="agent-steps so far")
    best: float | None = Field(description="mean return of the best policy so far")
    curve: tuple[Point, ...] = Field(description="the learning curve")


class Times(ResultRecord):
    """Wall times, in a part of their own: no other part of a checkpoint depends on the clock."""

    wall: float = Field(ge=0, description="s, wall time in all, imitation included")
    seconds: tuple[float, ...] = Field(description="s, wall time at each point of the curve")


def save_checkpoint(folder: Path, run: Run) -> None:
    """Write the run so far as a checkpoint in a folder."""
    notes = {name: getattr(run, name) for name in Notes.model_fields}
    curve = [{name: point[name] for name in Point.model_fields} for point in run.curve]
    times = {"wall": run.wall, "seconds": [point["seconds"] for point in run.curve]}
    words = {"notes": files.json_part({**notes, "curve": curve}), files.TIMES: files.json_part(times)}
    files.write(folder, {**run.state, "best": run.tensors, **words})


def load_checkpoint(experiment: Experiment, folder: Path, state: tuple[str, ...] = STATE) -> Run | None:
    """Return the run whose checkpoint lies in a folder, if there is one; `state` names the parts that are the model's.

    Raises:
        OtherRecipe: it is not of this experiment.
        CheckpointError: it is damaged, or in an older format.
    """
    parts = files.read(folder, 16 * expected_bytes(experiment) + 2**26)
    if parts is None:
        return None
    wanted = (*state, *ALWAYS)
    for part in wanted:
        if part not in parts:
            raise files.Damaged(folder, f"{part}: is missing")
    if others := sorted(parts.keys() - set(wanted)):
        raise files.Damaged(folder, f"{others[0]}: is no part of a checkpoint")
    notes, times = files.from_json(Notes, parts, "notes", folder), files.from_json(Times, parts, files.TIMES, folder)
    _compare(notes.recipe, recipe_of(experiment), folder)
    best = parts["best"]
    if fault := _fault(notes, times, best, experiment):
        raise files.Damaged(folder, fault)
    fields = notes.model_dump(mode="json")
    seconds = [{"seconds": value} for value in times.seconds]
    fields["curve"] = [{"steps": p["steps"], **s, **p} for p, s in zip(fields["curve"], seconds, strict=True)]
    return Run(**fields, wall=times.wall, tensors=best, state={part: parts[part] for part in state})


def expected_bytes(experiment: Experiment) -> int:
    """Return the approximate size of an experiment's checkpoint, bytes: worlds, networks and moments of Adam."""
    task, p = experiment.build(), experiment.ppo
    settings = drawn_settings(task, p.disturbance, p.draw)
    each = [drawn.scene.bytes_per_world() + 4 * drawn.learners * task.layout.size for _, drawn, _ in settings]
    sizes = (task.layout.size, *p.hidden, task.action_layout.size)
    weights = 24 * sum(a * b for a, b in pairwise(sizes))  # of two networks: weights and two moments of each, float32
    return p.worlds * sum(each) // len(each) + weights + 2**20


def _compare(kept: dict[str, Any], wanted: dict[str, Any], folder: Path) -> None:
    """Raise OtherRecipe, with the first key, if two recipes differ."""
    if found := first_difference(kept, wanted):
        key, has, wants = found
        raise OtherRecipe(f"{key} = {wants}: the checkpoint in {folder} is of another recipe, with {has}")


def first_difference(first: dict[str, Any], second: dict[str, Any]) -> tuple[str, str, str] | None:
    """Return the key path of the first value in which two recipes differ, and the values; None if they are equal."""
    for key, values in differences(first, second).items():
        has, wants = ("nothing" if value is None else printable(value) for value in values)
        return key, has, wants
    return None


def differences(first: dict[str, Any], second: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the values in which two recipes differ, by key path; None for one that is missing."""
    of_first, of_second = dict(_values_by_path(first)), dict(_values_by_path(second))
    pairs = {key: (of_first.get(key), of_second.get(key)) for key in {**of_second, **of_first}}
    return {key: (has, wants) for key, (has, wants) in pairs.items() if has != wants}


def _fault(notes: Notes, times: Times, best: dict[str, np.ndarray], experiment: Experiment) -> str:
    """Return a description of the first contradiction between parts of a checkpoint; '' if there is none."""
    reached = [point.steps for point in notes.curve]
    if reached != sorted(reached) or any(steps > notes.steps for steps in reached):
        return f"notes: curve goes to {max(reached):,} steps in an order that {notes.steps:,} steps cannot have had"
    if len(times.seconds) != len(reached):
        return f"times: {len(times.seconds)} times for {len(reached)} points of the curve"
    if notes.best != max((point.mean for point in notes.curve), default=None):
        return f"notes: best = {notes.best} is not the best of the curve"
    if best or reached:
        try:
            policy = MlpPolicy.of_tensors(best, {"activation": experiment.ppo.activation})
        except (ValueError, KeyError) as error:
            return f"best: {error}"
        if policy.observation_size != experiment.build().layout.size:
            return f"best: a policy of {policy.observation_size} numbers"
    return ""


def _values_by_path(block: dict[str, Any], path: KeyPath = ()) -> Iterator[tuple[str, Any]]:
    """Yield every value of nested blocks by its key path."""
    for key, value in block.items():
        if isinstance(value, dict):
            yield from _values_by_path(value, (*path, key))
        else:
            yield key_path((*path, key)), value
