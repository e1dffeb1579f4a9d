"""Observations, reward terms, measures and metrics are written by name: their order is the task's to choose."""

from __future__ import annotations

import functools
import itertools
from typing import Any, ClassVar

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.tasks import Crossing, Layout, Task
from tests.catalogue import TASKS, TaskRow

QUICK = ("pursuit_both",)
"""Rows of the default run; each row compiles a kernel of its own."""
ROWS = {type(row.task): row for row in sorted(TASKS, key=lambda row: row.name in QUICK or not row.variant)}.values()
"""One row of each task: the names that it writes are the same in its variants."""
EVERY = pytest.mark.parametrize(
    "row", [pytest.param(row, id=row.name, marks=() if row.name in QUICK else pytest.mark.slow) for row in ROWS]
)


def reversed_layout(task: Task) -> Layout:
    """Return the slots in the opposite order; those that `abreast` writes stay in front of the others."""
    ends = list(itertools.accumulate(slot.size for slot in task.layout.slots))
    first = ends.index(task.abreast) + 1 if task.abreast else 0
    return Layout((*task.layout.slots[:first][::-1], *task.layout.slots[first:][::-1]))


def permuted(task: Task) -> Task:
    """Return the same task with its slots, terms, measures and metrics in the opposite order."""
    kind, layout = type(task), reversed_layout(task)
    names = ("terms", "measures", "metric_names")
    fields: dict[str, Any] = {name: getattr(kind, name)[::-1] for name in names}
    fields["layout"] = functools.cached_property(lambda self: layout)
    fields["layout"].__set_name__(kind, "layout")
    annotations = dict.fromkeys(names, ClassVar[tuple[str, ...]])
    other = type(kind.__name__, (kind,), {**fields, "__annotations__": annotations, "__module__": kind.__module__})
    made: Task = other(**task.model_dump())
    return made


@EVERY
def test_a_permuted_layout_gives_permuted_rows(row: TaskRow) -> None:
    task, other = row.task, permuted(row.task)
    worlds, rng = (World(task, 3, time_limit=12), World(other, 3, time_limit=12)), np.random.default_rng(5)
    rows = [world.reset(5) for world in worlds]
    for _ in range(12):
        for name, start in task.layout.places.items():
            size = next(slot.size for slot in task.layout.slots if slot.name == name)
            there = other.layout.places[name]
            np.testing.assert_array_equal(rows[1][..., there : there + size], rows[0][..., start : start + size], name)
        actions = rng.uniform(-1, 1, (3, task.learners, task.action_layout.size))
        one, two = (world.step(actions) for world in worlds)
        np.testing.assert_array_equal(two.terms[..., ::-1], one.terms)
        np.testing.assert_allclose(two.reward, one.reward, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(two.terminated, one.terminated)
        np.testing.assert_array_equal(two.success, one.success)
        assert worlds[1].metrics() == worlds[0].metrics()
        rows = [one.observation, two.observation]
        if one.ended.any():
            rows = [world.reset(mask=one.ended) for world in worlds]


@pytest.mark.parametrize("what", ["terms", "measures", "metric_names"])
@pytest.mark.parametrize("name", ["two words", "_hidden", "class", "a__b", "progress"])
def test_a_name_that_is_no_field_name_is_refused(what: str, name: str) -> None:
    fields = {what: ("progress", "progress" if name == "progress" else name), "__module__": Crossing.__module__}
    task = type("Named", (Crossing,), {**fields, "__annotations__": {what: ClassVar[tuple[str, ...]]}})()
    with pytest.raises(TypeError, match=rf"Named.{what}: '{name}' must be a valid field name, and unique"):
        World(task, 1)
