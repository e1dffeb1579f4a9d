"""The documentation page of an environment, generated from its task so that text and code agree."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Sequence

import numpy as np

from flockenv.envs.common import reward_keys
from flockenv.envs.disturbance import Disturbance
from flockenv.envs.table import EnvInfo
from flockenv.tasks import Layout, Task
from flockenv.tasks.layout import THINGS

__all__ = ["page"]


def page(info: EnvInfo, task: Task) -> str:
    """Return the page of an environment in Markdown: its summary, its tables, its arguments, its history.

    The description is the docstring of the task's class; everything else is read from the task.
    """
    parts = [
        info.summary,
        _facts(task, info.id),
        "## Description\n\n" + inspect.cleandoc(type(task).__doc__ or ""),
        "## Action space\n\n" + _layout(task.action_layout),
        "## Observation space\n\n" + _layout(task.layout),
        "## Rewards\n\n" + _rewards(task),
        "## Infos\n\n" + _infos(task),
        "## Episode end\n\n" + _end(task),
        "## Arguments\n\n" + _arguments(task),
        "## Version history\n\n" + info.history,
    ]
    return "\n\n".join(parts) + "\n"


def _rewards(task: Task) -> str:
    return f"The reward is the sum of these terms: {_quote(task.terms)}."


def _infos(task: Task) -> str:
    rows = [
        (_quote(reward_keys(task)), "each term of the reward of this step"),
        ("`is_success`", "True if the episode so far is a success"),
        (_quote(task.metric_names), "metrics of the episode so far, if they have a value"),
        ("`seed`", "the seed of the world, only in the info of a reset"),
    ]
    return "Infos are flat: each value is one number or bool.\n\n" + _table(("key", "value"), rows)


def _quote(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _end(task: Task) -> str:
    return (
        f"Termination: see the description. Truncation: after {task.horizon} decisions "
        f"({task.horizon * task.control_dt:g} s), unless `max_episode_steps` is given.\n\n"
        "`gymnasium.make_vec` resets a world in the step after its end, as gymnasium does by default "
        "(`AutoresetMode.NEXT_STEP`): that step ignores the action, and returns the first observation, reward 0 "
        'and no end. `autoreset_mode="SameStep"` resets it in the step that ends it, `"Disabled"` never.'
    )


def _facts(task: Task, env_id: str) -> str:
    rows = [
        ("Make", f'`gymnasium.make("{env_id}")`'),
        ("In another process", f'`gymnasium.make("flockenv:{env_id}")`, which imports flockenv first'),
        ("Action space", f"`Box(-1, 1, ({task.action_layout.size},), float32)`"),
        ("Observation space", f"`Box({_range(task.layout)}, ({task.layout.size},), float32)`"),
        ("One decision", f"{task.control_dt:g} s"),
        ("Agents", f"{task.agents}, of which {task.learners} learns"),
    ]
    return _table(("", ""), rows)


def _range(layout: Layout) -> str:
    return f"{np.min(layout.low):g}, {np.max(layout.high):g}"


def _layout(layout: Layout) -> str:
    """Return the table of a row of numbers: index, meaning, unit and bounds of each quantity."""
    rows, start = [], 0
    slots = (slot for slot in layout.slots if slot.size)
    for (index, name, unit, meaning), slot in zip(layout.table(), slots, strict=True):
        stop = start + slot.size
        low, high = np.min(layout.low[start:stop]), np.max(layout.high[start:stop])
        rows.append((index, f"`{name}`", meaning, unit, f"{low:g}", f"{high:g}"))
        start = stop
    return _table(("index", "name", "meaning", "unit", "min", "max"), rows)


def _arguments(task: Task) -> str:
    fields = type(task).model_fields.items()
    rows = [
        (f"`{name}`", f"`{getattr(task, name)!r}`", field.description or "")
        for name, field in fields
        if name != "horizon"  # each API has its own name for the time limit
    ]
    rows += [
        (f"`{name}`", f"`{field.default!r}`", _disturbs(task, name, field.description or ""))
        for name, field in Disturbance.model_fields.items()
        if name not in type(task).model_fields
    ]
    rows.append(
        ("`render_mode`", "`None`", "`rgb_array` (headless), `human` (window, needs the extra `render`) or None")
    )
    return _table(("argument", "default", "meaning"), rows)


def _disturbs(task: Task, name: str, meaning: str) -> str:
    """Return the meaning of a field of Disturbance, with the entities that this task observes in slots."""
    if name not in ("dropped", "range", "seen"):
        return meaning
    kinds = dict.fromkeys(slot.entity for slot in task.layout.slots if slot.entity and slot.size)
    if name == "dropped":
        return f"{meaning}; here: {', '.join(kinds) or 'none, so that it must be 0'}"
    return f"{meaning}; here: {', '.join(k for k in kinds if k not in THINGS) or 'none, so that it must be None'}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
