"""A study, configs/studies/NAME.yaml: which settings of each task are varied, and which players play them.

    title: Players away from home
    worlds: 64
    players: {random: random, rules: rules, ppo: "ppo@*"}
    everywhere:
      noise: [0.05]                # of every task: sensors and actions
    tasks:
      crossing:
        agents: [4, 8, 16]         # an argument of the task
        room:                      # or several at once, under a name of their own
          - {agents: 48, circle: 12}
        walkers: {agents: [4, 8], circle: [6, 9]}   # or all combinations: rows "walkers 4", "walkers 8" of the map
        partners: [same, rules, {partners: rules, share: 0.5}]   # what all agents but one, or but a share, play

Every value changes one thing: all else is as in configs/training/TASK.yaml, which is the setting called home. With
`partners`, one agent of each world plays the player that is evaluated, and all others the player named there, or the
same one; return and success are those of that one agent (agents/invasion.py).
"""

from __future__ import annotations

import glob
import itertools
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from agents.compare import experiment_of
from flockenv.core.errors import key_path, nearest, printable
from flockenv.core.record import Record
from flockenv.core.warnings import UnstableStepWarning
from flockenv.envs.disturbance import Disturbance
from flockenv.evaluation import WORLDS_PER_SEED
from flockenv.players import known_name, other_tasks
from flockenv.studies.play_jobs import NAME, Player, members_of
from flockenv.tasks import TASKS, Task

__all__ = [
    "HOME", "INTEGRATOR", "PARTNERS", "Contender", "Partners", "Setting", "Study", "contenders_of", "setting_name",
    "settings_of",
]  # fmt: skip

HOME = "home"
"""The setting of a task that its players were made for."""

TASK_PLACE = "{task}"
"""Stands for the task's name in the files of a player."""

PARTNERS, SHARE, SAME = "partners", "share", "same"
"""Axis of the player of all other agents; share of the agents that are evaluated; the value for the same player."""

INTEGRATOR = "integrator"
"""Axis of the solver whose values are kinds."""

Value = bool | int | float | str | None
Values = tuple[Value | dict[str, Value], ...] | dict[str, tuple[Value, ...]]
"""Values of an axis: one after another, or (by name) all combinations."""


class Study(Record):
    """A plan of agents.sweep."""

    title: str = Field(description="title of the page")
    worlds: int = Field(
        default=64, ge=2, le=WORLDS_PER_SEED, description="worlds per setting, the same for all players"
    )
    seed: int = Field(default=0, ge=0, lt=1000, description="block of the evaluation and tuning worlds")
    players: dict[str, str] = Field(
        min_length=1,
        description="players by name: a known name, with @3 for the run of that seed and @* for those of all seeds; or"
        " a file, with {task} in place of the task's name and * for the files of several training seeds",
    )
    seeds: int | None = Field(
        default=None,
        ge=1,
        description="most runs of a player of several seeds; the one that ships comes first (all)",
    )
    everywhere: dict[str, tuple[Value, ...]] = Field(
        default_factory=dict,
        description="values to play, by name, in every task that has it: noise, delay, dropped, range, seen, dt, "
        "integrator (its kind), partners",
    )
    left_out: str = Field(default="", description="settings that a reader may miss, and why; on the page")
    tasks: dict[str, dict[str, Values]] = Field(
        min_length=1,
        description="values to play in single tasks: arguments of the task, or names of several at once; a mapping of "
        "lists: all combinations",
    )

    @model_validator(mode="after")
    def _names_are_known(self) -> Study:
        for task in self.tasks:
            if task not in TASKS:
                raise ValueError(
                    f"{key_path(('tasks', task))}: unknown{nearest(task, TASKS)}; allowed: {', '.join(TASKS)}"
                )
        for name in self.players:
            if not NAME.fullmatch(name):
                raise ValueError(f"{key_path(('players', name))}: a name is up to 40 letters, digits and _ . @ + -")
        return self

    @model_validator(mode="after")
    def _everywhere_applies_somewhere(self) -> Study:
        """Raise ValueError for a name or a disturbance that no task has; `settings_of` leaves out what one refuses."""
        known = {name for task in self.tasks if task in TASKS for name in TASKS[task].model_fields}
        for axis, values in self.everywhere.items():
            if axis in Disturbance.model_fields:
                for value in values:
                    Disturbance(**_changes(axis, value))
            elif axis not in known and axis != PARTNERS:
                allowed = [*Disturbance.model_fields, PARTNERS, *sorted(known)]
                raise ValueError(f"{key_path(('everywhere', axis))}: unknown{nearest(axis, allowed)}")
        return self


@dataclass(frozen=True)
class Partners:
    """What the agents that are not evaluated play: a player, None for the same one; number of agents evaluated."""

    player: Player | None
    egos: int


@dataclass(frozen=True, eq=False)
class Setting:
    """One setting of a task: what is varied (`axis`), its value as text, and what is played."""

    axis: str
    value: str
    task: Task
    disturbance: Disturbance
    partners: Partners | None = None  # None: all learners are evaluated

    @property
    def name(self) -> str:
        """The text of what is varied, "agents=4", or "home"."""
        return setting_name(self.axis, self.value)


@dataclass(frozen=True)
class Contender:
    """A player of a study: one, or the same with several training or search seeds."""

    name: str
    members: tuple[Player, ...]


def setting_name(axis: str, value: str) -> str:
    """Return "agents=4", or "home", which has no value."""
    return f"{axis}={value}" if value else axis


def settings_of(study: Study, name: str, changes: Mapping[str, Any] | None = None) -> list[Setting]:
    """Return the settings of a task: home, then one for each value.

    changes: other arguments of the task, or disturbances, that hold in every setting.

    Raises:
        ValueError: in one line, a value under `tasks` that the task does not accept, or a name that it does not have.
            Values under `everywhere` that it does not accept, and unstable time steps, are left out.
    """
    always = {**experiment_of(name).arguments, **(changes or {})}
    home = _setting(study, name, HOME, "", always, {})
    found = [home]
    for axis, values in study.tasks[name].items():
        settings = [_setting(study, name, row, text, always, each) for row, text, each in _values_of(axis, values)]
        found += [each for each in settings if isinstance(values, dict) or not _is_same(each, home)]
    for axis, values in study.everywhere.items():
        for value in values:
            if axis not in (*TASKS[name].model_fields, *Disturbance.model_fields, PARTNERS):
                continue
            with suppress(_DoesNotApply, UnstableStepWarning), warnings.catch_warnings():
                warnings.simplefilter("error", UnstableStepWarning)
                setting = _setting(study, name, axis, _text(value), always, _changes(axis, value))
                found += [] if _is_same(setting, home) else [setting]
    return found


def _is_same(a: Setting, b: Setting) -> bool:
    return (a.task, a.disturbance, a.partners) == (b.task, b.disturbance, b.partners)


class _DoesNotApply(ValueError):  # noqa: N818  # no error where a value is meant for all tasks that accept it
    """A task does not accept a value."""


def _values_of(axis: str, values: Values) -> Iterator[tuple[str, str, dict[str, Value]]]:
    """Yield each value of an axis: the row of the map that it is in, its text, and what it changes."""
    if not isinstance(values, dict):
        for value in values:
            yield axis, _text(value), _changes(axis, value)
        return
    first, *others = values
    for combination in itertools.product(*values.values()):
        changes = dict(zip(values, combination, strict=True))
        yield f"{axis} {_text(changes[first])}", _text({key: changes[key] for key in others}), changes


def _changes(axis: str, value: Value | dict[str, Value]) -> dict[str, Any]:
    """Return the arguments that a value changes; an integrator is named by its kind."""
    if isinstance(value, dict):
        return value
    return {axis: {"kind": value} if axis == INTEGRATOR and isinstance(value, str) else value}


def _setting(
    study: Study, name: str, axis: str, value: str, always: Mapping[str, Any], changes: Mapping[str, Any]
) -> Setting:
    arguments = {**always, **changes}
    disturbed = {key: arguments.pop(key) for key in Disturbance.model_fields if key in arguments}
    others, share = arguments.pop(PARTNERS, None), arguments.pop(SHARE, None)
    known = TASKS[name].model_fields
    for key in arguments:
        if key not in known:
            allowed = [*known, *Disturbance.model_fields, PARTNERS, SHARE]
            raise ValueError(f"{key_path(('tasks', name, key))}: unknown{nearest(key, allowed)}")
    try:
        task = TASKS[name](**arguments)
        partners = None if others is None and share is None else _partners(study, task, others, share)
        setting = Setting(axis, value, task, Disturbance(**disturbed), partners)
        setting.disturbance.check(setting.task)
        setting.task.scene  # noqa: B018  # it is made now, and refuses an unstable time step
    except ValueError as error:
        raise _DoesNotApply(f"tasks.{name}.{axis}: {error}") from None
    return setting


def _partners(study: Study, task: Task, others: Any, share: Any) -> Partners:
    """Return the partners of a setting; raise ValueError, in one line, if the task or the study has none such."""
    if task.learners < 2:
        law = "; the law of its scripted people is `crowd`" if task.name == "crowd_nav" else ""
        raise ValueError(f"{PARTNERS}: must be left out for {task.name}, whose worlds have one learner each{law}")
    if others is None:
        raise ValueError(f"share = {share!r}: needs partners, the player of the others")
    egos = 1
    if share is not None:
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 < share < 1:
            raise ValueError(f"share = {share!r}: must be a number > 0 and < 1")
        egos = min(max(round(share * task.learners), 1), task.learners - 1)
    if others == SAME:
        return Partners(None, egos)
    found = dict(_specs(study, task.name))
    if others in found:
        return Partners(found[others][0], egos)  # of several seeds, the one that ships
    if isinstance(others, str) and known_name(others) and not other_tasks(others, task.name):
        return Partners(members_of(Player(others, others), task.name)[0], egos)
    names = [SAME, *found]
    allowed = f"{', '.join(names)}, or another known player of {task.name}"
    raise ValueError(f"{PARTNERS} = {printable(str(others))}: unknown{nearest(str(others), names)}; allowed: {allowed}")


def _text(value: Value | dict[str, Value]) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(each)}" for key, each in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


def contenders_of(study: Study, task: str) -> list[Contender]:
    """Return the players of a task; hand-written ones of other tasks are left out.

    Raises:
        ValueError: in one line, a file that is not there.
    """
    return [Contender(name, members) for name, members in _specs(study, task)]


def _specs(study: Study, task: str) -> Iterator[tuple[str, tuple[Player, ...]]]:
    """Yield each player of a task: its name, and the player of each seed."""
    for name, spec in study.players.items():
        if known_name(spec):
            if not other_tasks(spec, task):
                yield name, members_of(Player(spec, name), task)[: study.seeds]
            continue
        pattern = spec.replace(TASK_PLACE, task)
        paths: Sequence[str] = sorted(glob.glob(pattern)) or [pattern]
        if not Path(paths[0]).is_file():
            if TASK_PLACE in spec:
                continue  # a player of some tasks only
            raise ValueError(f"players.{name}: {printable(pattern)}: no such file, and no player of that name")
        yield name, tuple(Player(path, name) for path in paths)[: study.seeds]
