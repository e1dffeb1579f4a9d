"""The processor: results do not depend on how many numbers lie side by side, and code is made for what there is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from flockenv import inlining, processor
from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.config import load_scene
from flockenv.effects import Gravitation
from flockenv.group import Group
from flockenv.inlining import Whole
from flockenv.kernels import kernel, unaliased
from flockenv.scene import Scene
from flockenv.space import Plane, Torus
from flockenv.spawn import Spawn
from flockenv.tasks import TASKS, Flock, Task
from flockenv.tasks.sight import block_ways, compass
from flockenv.world import World
from tests.catalogue import everything

CONFIGS = Path(__file__).parent.parent / "configs"


def flock(agents: int, dtype: str, **sight: Any) -> Scene:
    rules = (Separation(weight=1.5, radius=1, **sight), Alignment(weight=1, radius=2), Cohesion(weight=1, radius=2))
    edge = float(np.sqrt(agents))
    return Scene(
        dimension=2, space=Torus(size=(edge, edge)), effects=rules, dt=0.05, dtype=dtype,
        groups=(Group(count=agents, max_speed=3.0, max_force=4.0, spawn=Spawn(speed=(1.0, 2.0))),),
    )  # fmt: skip


def heavy(agents: int) -> Scene:
    """Everybody pulls everybody, those far away as groups: what a group is must not follow from a register."""
    return Scene(
        dimension=2, space=Plane(), effects=(Gravitation(constant=1, softening=0.1, opening=0.5),), dt=0.01,
        groups=(Group(count=agents, spawn=Spawn(low=(0, 0), high=(30, 30))),),
    )  # fmt: skip


def stepped(make: Callable[[], Scene], steps: int = 7) -> tuple[Any, ...]:
    scene = make()
    after = scene.step(scene.start(seed=3), steps=steps)
    return after.x, after.v, after.alive, scene.parts.width


def played(task: Task, decisions: int = 12) -> tuple[Any, ...]:
    world = World(task, 3)
    world.reset(0)
    rng = np.random.default_rng(0)
    steps = [world.step(rng.uniform(-1, 1, (3, world.learners, world.action_size))) for _ in range(decisions)]
    seen = [np.stack([getattr(step, name) for step in steps]) for name in ("observation", "reward", "terms")]
    return (*seen, world.state.x, world.state.v, task.parts.width)


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Ask for the same with registers of 64 and of 32 bytes: other sources, the same bits."""

    def compare(run: Callable[[], tuple[Any, ...]], differs: bool = True) -> None:
        found = []
        for size in (64, 32):
            monkeypatch.setattr(processor, "REGISTER", size)
            found.append(run())
        (*wide, lanes), (*narrow, fewer) = found
        assert (lanes, fewer) == ((2 * fewer, lanes // 2) if differs else (16, 16))
        for a, b in zip(wide, narrow, strict=True):
            np.testing.assert_array_equal(a, b)

    return compare


@pytest.mark.parametrize(
    ("agents", "dtype"),
    [(37, "float32"), pytest.param(37, "float64", marks=pytest.mark.slow),
     pytest.param(900, "float32", marks=pytest.mark.slow), (900, "float64")],
)  # fmt: skip
def test_a_flock_has_the_same_bits_in_long_registers_and_short_ones(both: Any, agents: int, dtype: str) -> None:
    """Few agents, and many, who are sorted by cell, put in order for a call, and moved house."""
    both(lambda: stepped(lambda: flock(agents, dtype, fov=270)))


@pytest.mark.slow
def test_a_large_flock_moves_house_in_short_registers_too(both: Any) -> None:
    both(lambda: stepped(lambda: flock(20_000, "float32"), 3))


@pytest.mark.slow
def test_groups_that_are_met_as_one_are_the_same(both: Any) -> None:
    both(lambda: stepped(lambda: heavy(3000), 2), differs=False)


@pytest.mark.slow
def test_what_is_seen_and_paid_is_the_same(both: Any) -> None:
    both(lambda: played(Flock(agents=24, dtype="float32")))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_effects_of_all_forms_are_the_same(both: Any, dimension: int, dtype: str) -> None:
    both(lambda: stepped(lambda: everything(dimension, dtype=dtype)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cloth", "crowd_bottleneck", "fish", "flag", "obstacles_flow", "snow", "stampede"])
def test_scenes_are_the_same(both: Any, name: str) -> None:
    both(lambda: stepped(lambda: load_scene(CONFIGS / f"{name}.yaml"), 5))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", TASKS)
def test_tasks_are_the_same(both: Any, name: str, dtype: str) -> None:
    both(lambda: played(TASKS[name](dtype=dtype)))


# --- what it is found to be -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("told", "found"),
    [({"NUMBA_CPU_NAME": "generic"}, "32 False False"), ({"NUMBA_CPU_FEATURES": "+avx2,-avx512f"}, "32 True False"),
     ({"NUMBA_CPU_FEATURES": "+avx2,+avx512f"}, "64 True True")],
)  # fmt: skip
def test_what_numba_is_told_counts(told: dict[str, str], found: str) -> None:
    ask = "from flockenv.processor import *; print(REGISTER, *(name in FEATURES for name in ('avx2', 'avx512f')))"
    done = subprocess.run([sys.executable, "-c", ask], env={**os.environ, **told}, capture_output=True, text=True)
    assert done.stdout.strip() == found, done.stderr


# --- what LLVM makes ------------------------------------------------------------------------------------------------


def code(part: Callable[..., None], *arguments: Any, apart: bool = True) -> tuple[str, str]:
    """Return what LLVM is left with, and the machine code, of an entry point that calls a part of a kernel."""
    inner: Any = kernel(part)

    def entry(x: Any, y: Any) -> None:
        unaliased()
        inner(x, y)

    def overlapping(x: Any, y: Any) -> None:
        inner(x, y)

    own = entry if apart else overlapping
    made: Any = numba.njit(own, pipeline_class=Whole, error_model="numpy", fastmath={"contract"}, _nrt=False)
    made(*arguments)
    return next(iter(made.inspect_llvm().values())), next(iter(made.inspect_asm().values()))


def many_sums() -> Callable[..., None]:
    """Return a loop with more running sums than there are registers of any kind."""
    made: dict[str, Any] = {"np": np}
    sums = "\n".join(f"            y[np.uint64({16 * k}) + l] += x[j] * y[np.uint64(640) + l]" for k in range(40))
    source = f"def run(x, y):\n    for j in range(len(x)):\n        for l in range(np.uint64(16)):\n{sums}"
    exec(source, made)  # noqa: S102  # forty lines alike
    return made["run"]  # type: ignore[no-any-return]


@pytest.mark.skipif("avx" not in processor.FEATURES, reason="registers of 16 bytes always lie within a line")
def test_the_stack_begins_where_a_line_does() -> None:
    """Else what is put there for a while lies across two lines, in one process and not in the next."""
    x, y = np.arange(5, dtype=np.float32), np.ones(656, np.float32)
    left, machine = code(many_sums(), x, y)
    np.testing.assert_array_equal(y, [*[11] * 640, *[1] * 16])
    assert '"stackrealign"' in left
    assert re.search(r"and\w\s+\$-(32|64), %rsp", machine)


def short_loop(x: Any, y: Any) -> None:
    """Eight numbers a row, where nobody knows that y is not x."""
    for k in range(x.shape[0]):
        for l in range(np.uint64(8)):  # noqa: E741  # as in the files that are generated
            y[k, l] = x[k, l] * x[k, l]


def test_vectors_are_made_of_short_loops_and_of_nobody_elses(monkeypatch: pytest.MonkeyPatch) -> None:
    """What LLVM is told for that holds while our functions compile, parts within entry points, and not after."""
    told: list[str] = []
    tell = inlining.binding.set_option
    monkeypatch.setattr(inlining.binding, "set_option", lambda name, option: (told.append(option), tell(name, option)))
    x = np.full((5, 8), 3, np.float32)
    y = x.copy()
    left, _ = code(short_loop, x, y, apart=False)
    np.testing.assert_array_equal(y, 9)
    assert re.search(r"fmul [\w ]*<\d+ x float>", left)
    assert told == [f"--vectorizer-min-trip-count={count}" for count in (4, 16)]


def test_free_ways_are_not_stored_under_a_mask() -> None:
    def shorten(row: Any, table: Any) -> None:
        block_ways(row, 0, 16, table, (np.float32(1.0), np.float32(0.5)), (np.float32(1), np.float32(0)), 0.4, 6.0)

    row = np.ones(16, np.float32)
    _, machine = code(shorten, row, np.array(compass(16), np.float32))
    assert 0 < row.min() < row.max() == 1.0
    assert not re.search(r"vmaskmovps\s+%[xy]mm\d+, %[xy]mm\d+, [-\w]*\(", machine)
