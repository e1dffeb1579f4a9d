"""The environments: one row a task. Only strings and numbers, so that importing it imports no simulator.

From a row come `flockenv/NAME-vVERSION` in `gymnasium.make`, `gymnasium.make_vec` and `pettingzoo.make`, and the
classes `envs.single.NAMEEnv`, `envs.vector.NAMEVectorEnv` and, for a task with several learners,
`envs.parallel.NAMEParallelEnv`; they are built when they are first used. `flockenv.envs.register` adds a row.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["ENVIRONMENTS", "EnvInfo", "class_of", "id_of"]

_FIRST = "v0: first version (flockenv 0.1.0)."
_LASTING = (
    "v1: success is judged over the episode (`settling`, `lasting`), not at its last instant; metrics `held` and "
    f"`success_at_end`.\n\n{_FIRST}"
)


@dataclass(frozen=True)
class EnvInfo:
    """The environments of a task: their ids, first lines, time limit, and defaults that differ from the task's."""

    name: str  # of the task's class
    summary: str  # first line of the page of the environment with one learner
    horizon: int  # decisions until truncation: `Task.horizon`, repeated so that no task is imported
    single: Mapping[str, Any] = field(default_factory=dict)  # parameters with one learner
    team: str = ""  # first line of the page of the PettingZoo environment; "": there is none
    parallel: Mapping[str, Any] = field(default_factory=dict)  # parameters of the PettingZoo environment
    version: int = 0  # raised when results change
    history: str = _FIRST  # what each version changed
    module: str = "flockenv.tasks"  # where the task's class is
    namespace: str = "flockenv"  # of the id

    @property
    def id(self) -> str:
        """The id: flockenv/Pursuit-v0."""
        return f"{self.namespace}/{self.name}-v{self.version}"

    @property
    def former(self) -> tuple[int, ...]:
        """Earlier versions."""
        return tuple(range(self.version))

    def task_type(self) -> Any:
        """Return the class of the task; its module is imported."""
        return getattr(importlib.import_module(self.module), self.name)


_ONE = {"learners": 1}

ENVIRONMENTS: dict[str, EnvInfo] = {
    info.name: info
    for info in (
        EnvInfo(
            "Pursuit", "A pursuer chases a scripted evader.", 300,
            team="Pursuit as a two-team game: three pursuers and two evaders, all of them agents; captured evaders "
            "leave.",
            parallel={"pursuers": 3, "evaders": 2, "sides": "both"},
        ),
        EnvInfo("Obstacles", "A walker crosses a random field of obstacles to its goal.", 250),
        EnvInfo(
            "Flock", "A learner travels in a flock of scripted flockmates.", 300, _ONE,
            team="A flock in which each boid is an agent (learners=k: only the first k; the rest are scripted).",
            version=1, history=_LASTING,
        ),
        EnvInfo(
            "Herd", "A dog gathers scripted sheep and drives them into a pen.", 600,
            team="Herding as a team: two dogs, both of them agents, with the same reward.", parallel={"dogs": 2},
        ),
        EnvInfo(
            "Crossing",
            "A learner crosses a circle among scripted walkers that avoid it and each other by ORCA.", 200, _ONE,
            team="Walkers swap places across a circle, all of them agents (learners=k: only the first k).",
        ),
        EnvInfo(
            "Evade", "An evader escapes three scripted pursuers among cover.", 300, version=1,
            history=f"v1: the forces of the scripted pursuers differ in their last bits.\n\n{_FIRST}",
        ),
        EnvInfo("PathFollow", "A runner follows a narrow winding track as far as possible.", 300),
        EnvInfo(
            "School",
            "A fish lives among scripted fish, patches of food that regrow, and a scripted hunter.", 400, _ONE,
            team="A school in which each fish is an agent, and leaves when caught or starved "
            "(learners=k: only the first k).",
        ),
        EnvInfo(
            "CrowdNav",
            "A robot crosses a crowd of pedestrians that swap places under a social force, and must touch none of "
            "them.",
            250,
        ),
        EnvInfo(
            "Corridor", "A learner walks in a corridor among two opposite streams of scripted walkers.", 300, _ONE,
            team="Two opposite streams in one corridor, all of them agents (learners=k: only the first k).",
            version=1, history=_LASTING,
        ),
        EnvInfo(
            "Bottleneck", "A person leaves a crowded room through one door, among scripted people.", 300, _ONE,
            team="A crowd leaves a room through one door; all are agents until they are out "
            "(learners=k: only the first k).",
        ),
    )
}  # fmt: skip
"""Every environment by the name of its task's class."""


def id_of(name: str) -> str:
    """Return the id of an environment: flockenv/Pursuit-v0 for "Pursuit"."""
    return ENVIRONMENTS[name].id


def class_of(base: type, suffix: str, name: str, team: bool = False) -> type:
    """Return the class `name`, a task's name and a suffix, derived from `base`; later uses find it in base's module.

    A module's `__getattr__` calls it; raises AttributeError if no row of the table has that class.
    """
    info = ENVIRONMENTS.get(name.removesuffix(suffix)) if name.endswith(suffix) else None
    if info is None or (team and not info.team):
        raise AttributeError(f"module {base.__module__!r} has no attribute {name!r}")
    fixed = info.parallel if team else info.single
    fields = {"info": info, "task_type": info.task_type(), "fixed": dict(fixed), "__module__": base.__module__}
    cls = type(base)(name, (base,), {**fields, "__doc__": info.team if team else info.summary})
    setattr(sys.modules[base.__module__], name, cls)
    return cls
