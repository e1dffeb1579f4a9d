"""An experiment, configs/training/<task>.yaml: how PPO trains on a task, and how its hand-written players are tuned."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import typer
from pydantic import Field, ValidationError, model_validator

from agents.learner_settings import CloningSettings, OffPolicySettings, RecurrentSettings
from flockenv.core.address_space import shortage
from flockenv.core.errors import key_path, printable, refusals
from flockenv.core.record import Record
from flockenv.envs.disturbance import Disturbance
from flockenv.scene.yaml_io import load
from flockenv.tasks import TASKS, Task

__all__ = [
    "AS_CONFIGURED", "CONFIGS", "Experiment", "PpoSettings", "SearchSettings", "load_experiment", "one_line_errors",
    "seeds_of",
]  # fmt: skip

CONFIGS = Path(__file__).resolve().parent.parent / "configs" / "training"

AS_CONFIGURED = "as configured"
"""Name of a config's own settings among others."""

_NAME = re.compile(r"\w[\w ,-]{0,39}")
"""A setting's name is a folder of checkpoints and part of a picture's legend."""


SEEDS = 1000
"""Number of training and of search seeds: each has a block of worlds."""


class PpoSettings(Record):
    """Settings of PPO; the defaults suit two cores: many rows per step, large minibatches, few epochs."""

    steps: int = Field(default=20_000_000, ge=1, description="agent-steps in all")
    seconds: float | None = Field(
        default=None,
        gt=0,
        exclude_if=lambda seconds: seconds is None,
        description="wall time in all, with imitation and evaluation, s; the first budget that is spent ends training",
    )
    worlds: int = Field(default=2048, ge=1, description="worlds stepped together; rows = worlds x learners")
    rollout: int = Field(default=32, ge=1, description="actions per row and update")
    minibatch: int = Field(default=8192, ge=1, description="rows per gradient step")
    epochs: int = Field(default=4, ge=1, description="passes over a rollout")
    learning_rate: float = Field(
        default=2e-3, gt=0, description="at the start; falls linearly to a tenth as the budget is spent"
    )
    gamma: float = Field(default=0.99, gt=0, le=1, description="discount per action, whether it is held or not")
    gae_lambda: float = Field(default=0.95, ge=0, le=1, description="lambda of the advantage estimate")
    clip: float = Field(default=0.2, gt=0, description="PPO's clip range")
    entropy: float = Field(default=0.0, ge=0, description="weight of the entropy bonus")
    log_std: float = Field(default=-0.5, description="logarithm of the first standard deviation of actions")
    reward_scale: float = Field(default=0.1, gt=0, description="rewards are multiplied by this while learning")
    hold: int = Field(default=1, ge=1, le=100, description="decisions of the world for which an action is repeated")
    care: float = Field(default=0.0, ge=0, le=1, description="weight of the others' advantages; its own has 1")
    central_critic: bool = Field(
        default=False,
        description="True if the critic also gets its world's mean observation and the memory of non-learners",
    )
    taught: int = Field(
        default=0, ge=0, description="gradient steps of imitation of the tuned rules, before PPO begins"
    )
    start: str | None = Field(
        default=None,
        exclude_if=lambda start: start is None,
        description="trained policy with which learning begins: ppo (the shipped one), ppo@3 (that of a seed), ppo@* "
        "(that of this training's seed), or a .safetensors file",
    )
    critic_first: int = Field(default=0, ge=0, description="agent-steps in which only the critic learns, then")
    stagger: bool = Field(default=False, description="begin worlds at different times of their first episode")
    hidden: tuple[int, ...] = Field(default=(64, 64), min_length=1, description="units per layer")
    activation: str = Field(default="relu", pattern="^(relu|tanh)$", description="relu or tanh")
    threads: int = Field(default=2, ge=1, le=64, description="of torch and of the worlds; 1 if cores are shared")
    dtype: Literal["float32", "float64"] = Field(default="float32", description="precision of the training worlds")
    seed: int = Field(default=0, ge=0, lt=1000, description="seed of the weights and of the training worlds")
    disturbance: Disturbance = Field(
        default_factory=Disturbance,
        exclude_if=lambda disturbance: not disturbance,  # so recipes without one stay equal to those from before
        description="noise, delay, dropped, range, seen of the worlds for learning and for the curve, not of imitation",
    )
    draw: dict[str, tuple[bool | int | float | str, ...]] = Field(
        default_factory=dict,
        exclude_if=lambda draw: not draw,
        description="values of the task's arguments and of disturbances; all combinations are trained at once",
    )
    action: Literal["force", "residual", "mixture", "weights", "priorities", "gate"] = Field(
        default="force",
        exclude_if=lambda action: action == "force",
        description="what the network decides: the force, an addition to the rules' force, a share of it, the rules' "
        "parameters, the priorities of their behaviours, or whose force it is",
    )
    base: str = Field(
        default="rules",
        exclude_if=lambda base: base == "rules",
        description="hand-written player under the network; queueing@5: that of a search seed",
    )
    bound: float = Field(
        default=0.5,
        gt=0,
        le=2,
        exclude_if=lambda bound: bound == 0.5,
        description="largest residual, as a share of max_force; of a mixture, the share of the network's force",
    )
    evaluate_every: int = Field(default=1_000_000, ge=1, description="agent-steps between points of the curve")
    evaluate_worlds: int = Field(default=256, ge=1, description="tuning worlds per point of the curve")

    @model_validator(mode="after")
    def _parts_fit(self) -> PpoSettings:
        """Raise ValueError for settings that exclude each other."""
        for name, value in (("care", self.care), ("central_critic", self.central_critic), ("taught", self.taught)):
            if self.draw and value and name != "care":
                raise ValueError(f"draw: not together with {name}")
            if self.action != "force" and value and name != "care":
                raise ValueError(f"action = {self.action!r}: not together with {name}")
        for name, given in (
            ("action", self.action not in ("force", "mixture")),
            ("central_critic", self.central_critic),
            ("taught", self.taught),
        ):
            if self.start is not None and given:
                raise ValueError(f"start: not together with {name}")
        return self


class SearchSettings(Record):
    """Settings of the search for the parameters of hand-written players, by CMA-ES."""

    steps: int | None = Field(default=None, ge=1, description="agent-steps in all [as many as ppo.steps]")
    worlds: int = Field(default=96, ge=1, description="tuning worlds per candidate; others in each generation")
    candidates: int | None = Field(
        default=None, ge=4, description="parameter sets per generation [4 + 3 ln(number of parameters)]"
    )
    sigma: float = Field(default=0.25, gt=0, le=1, description="first standard deviation, as a share of each range")
    final_worlds: int = Field(
        default=512, ge=2, description="tuning worlds of the final choice, the same for all search seeds"
    )
    seed: int = Field(default=0, ge=0, lt=1000, description="search seed, if --seeds is not given")


class Experiment(Record):
    """One task, and the settings of its training and tuning; those of other learners than PPO are for agents.learn."""

    task: str = Field(description="name of the task")
    arguments: dict[str, Any] = Field(default_factory=dict, description="keyword arguments of the task")
    ppo: PpoSettings = Field(default_factory=PpoSettings)
    curves: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="further settings of PPO for comparison, by name: the fields that differ"
    )
    sac: OffPolicySettings = Field(default_factory=OffPolicySettings)
    tqc: OffPolicySettings = Field(default_factory=OffPolicySettings)
    recurrent_ppo: RecurrentSettings = Field(default_factory=RecurrentSettings)
    bc: CloningSettings = Field(default_factory=CloningSettings)
    search: SearchSettings = Field(default_factory=SearchSettings)

    @model_validator(mode="after")
    def _curves_are_settings(self) -> Experiment:
        """Raise ValueError for settings that cannot be trained when they are read, not hours later."""
        self.settings()
        return self

    def with_ppo(self, **changes: Any) -> Experiment:
        """Return the experiment with other settings under `ppo`, except those that are None, checked as when read."""
        given = {name: value for name, value in changes.items() if value is not None}
        return self.model_copy(update={"ppo": PpoSettings(**{**self.ppo.model_dump(), **given})})

    def settings(self) -> dict[str, PpoSettings]:
        """Return all settings of PPO by name: the config's own, and those of `curves`."""
        others = {name: self._other_settings(name, changes) for name, changes in self.curves.items()}
        return {AS_CONFIGURED: self.ppo, **others}

    def _other_settings(self, name: str, changes: dict[str, Any]) -> PpoSettings:
        place = key_path(("curves", name))
        if name == AS_CONFIGURED:
            raise ValueError(f"{place}: that is what the settings under ppo are called; choose another name")
        if not _NAME.fullmatch(name):
            raise ValueError(f"{place}: a name is up to 40 letters, digits, spaces and , _ -")
        data = {**self.ppo.model_dump(mode="json"), **changes}
        try:
            return PpoSettings.model_validate_json(json.dumps(data), strict=True)  # as strict as files are read
        except ValidationError as error:
            raise ValueError(f"{place}.{refusals(error, PpoSettings, data)[0]}") from None

    def build(self) -> Task:
        """Return the task; ValueError with the nearest name for an unknown one."""
        if self.task not in TASKS:
            near = difflib.get_close_matches(self.task, TASKS, n=1)
            hint = f", did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"task = {self.task!r}: unknown{hint} allowed: {', '.join(TASKS)}")
        return TASKS[self.task](**self.arguments)


def load_experiment(path: str | Path) -> Experiment:
    """Read an experiment from YAML; errors are one line with the key path."""
    return load(Path(path), Experiment)


def seeds_of(text: str) -> list[int]:
    """Return the seeds of "0-9" or "0,3,5-7"; raise ValueError, in one line, for anything else."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = (first, last if dash else first)
        if not all(end.isascii() and end.isdigit() and len(end) < 9 and int(end) < SEEDS for end in ends):
            allowed = f"each must be a number from 0 to {SEEDS - 1} or a range of them, such as 0-9"
            raise ValueError(f"--seeds {printable(text)}: {allowed}")
        if int(ends[0]) > int(ends[1]):
            raise ValueError(f"--seeds {printable(text)}: the first number of a range must be at most the last")
        found += range(int(ends[0]), int(ends[1]) + 1)
    return list(dict.fromkeys(found))


@contextmanager
def one_line_errors(kinds: tuple[type[Exception], ...] = (ValueError, OSError)) -> Iterator[None]:
    """End a command with status 2 and one unwrapped line if it raises one of `kinds`.

    Lack of memory is left to `run_program`.
    """
    try:
        yield
    except kinds as error:
        if shortage(error) is not None:
            raise
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
