"""Threads: results and counters are the same bits for any number of threads, and no thread waits for ever.

Worlds are divided among threads. A large world is shared by a team of threads, which divide its agents and wait for
each other several times in every evaluation of the forces.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flockenv
import flockenv.engine.stepper as steppers
from flockenv.behaviours import Alignment, Separation
from flockenv.envs.world import World
from flockenv.geometry.cell_list import FEWEST_ARRANGED, STEPS_ARRANGED, WORTH_ARRANGING
from flockenv.geometry.space import Box, Torus
from flockenv.jit import thread_pool
from flockenv.jit.cache_folder import cache_folder
from flockenv.jit.thread_pool import run_parallel, threads, use_threads
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Drag
from flockenv.physics.integrators import ImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.tasks import Flock
from tests.catalogue import VARIANTS, Variant

ROOT = Path(__file__).resolve().parent.parent
NAMED = {variant.name: variant for variant in VARIANTS}
ARRAYS = ("x", "v", "alive", "tick", "work")
PATIENCE = 120.0
"""s: far longer than any test here takes; a longer wait counts as a deadlock."""


@pytest.fixture(autouse=True)
def one_thread_afterwards() -> Iterator[None]:
    before = threads()
    yield
    use_threads(before)


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """List of the number of threads that shared each step."""
    seen: list[int] = []

    def spy(jobs: Any) -> list[Any]:
        seen.append(len(jobs))
        return run_parallel(jobs)

    monkeypatch.setattr(steppers, "run_parallel", spy)
    return seen


def assert_same(a: State, b: State) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def started(scene: Scene, worlds: int = 1, dead: float = 0.1) -> State:
    """Return a start with some dead agents, most of them in the first quarter: the threads' parts differ in work."""
    state = scene.start(7, worlds)
    chance = np.random.default_rng(0).random((worlds, scene.agents))
    quarter = scene.agents // 4
    state.alive[...] = chance > dead
    state.alive[:, :quarter] = chance[:, :quarter] > min(1.0, 8 * dead)
    return state


# --- one large world --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Large:
    variant: str
    count: int
    edge: float  # m
    sorts: bool = True  # False: a reach too wide for a grid

    @property
    def name(self) -> str:
        """Name by which tests/conftest.py finds kernels that only slow tests compile."""
        return self.variant

    def __str__(self) -> str:
        return f"{self.variant}-{self.count}-{'grid' if self.sorts else 'brute'}"

    @property
    def scene(self) -> Scene:
        return NAMED[self.variant].make(self.count, self.edge)


LARGE = [
    Large("torus", 4096, 60.0),
    Large("torus_3", 5000, 24.0),
    Large("torus_single", 20_000, 140.0),
    Large("torus_single_rk4", 6000, 70.0),
    Large("box", 4500, 45.0),
    Large("plane_3_single", 5003, 24.0),
    Large("nearest_plane", 4111, 60.0),
    Large("nearest_plane_3", 4096, 24.0),
    Large("nearest_torus_single", 4999, 60.0),
    Large("torus", 4099, 9.0, sorts=False),
    Large("plane_3_single", 4096, 3.0, sorts=False),
    Large("nearest_torus_single", 4096, 9.0, sorts=False),
]


@pytest.mark.parametrize("large", LARGE, ids=str)
@pytest.mark.parametrize("dead", [0.0, 0.1])
def test_a_team_of_threads_gives_the_same_bits_as_one_thread(large: Large, dead: float, shared: list[int]) -> None:
    scene = large.scene
    start = started(scene, dead=dead)
    expected = scene.run(start, 2)
    assert shared == []
    tested, alive = int(expected.work[0, 2]), int(start.alive.sum())
    all_pairs = int(expected.work[0, 1]) * alive**2
    assert tested < 0.5 * all_pairs if large.sorts else tested == all_pairs
    for count in (2, 3):
        use_threads(count)
        for _ in range(3):  # a race need not show every time
            assert_same(scene.run(start, 2), expected)
    assert shared == [2] * 3 + [3] * 3
    assert not np.array_equal(expected.x, start.x)


@pytest.mark.slow
def test_implicit_steps_of_a_large_world_do_not_depend_on_the_number_of_threads() -> None:
    scene = Scene(
        space=Box(size=(60.0, 60.0)),
        effects=(Drag(rate=0.4),),
        integrator=ImplicitEuler(),
        groups=(Group(count=4200, max_speed=1.3, spawn=Spawn(speed=(0.2, 1.5))),),
        dt=0.05,
    )
    start = started(scene, worlds=2)
    expected = scene.run(start, 3)
    assert not np.array_equal(expected.x, start.x)
    for count in (2, 3):
        use_threads(count)
        assert_same(scene.run(start, 3), expected)


@pytest.mark.slow
def test_a_small_batch_of_large_worlds_is_stepped_by_a_team(shared: list[int]) -> None:
    scene = NAMED["torus_single"].make(4200, 60.0)
    start = started(scene, worlds=2)
    drive = np.random.default_rng(0).normal(size=start.shape)
    expected = scene.step(start, drive=drive, steps=3)
    for count, parts in ((2, 2), (3, 3)):  # a world per thread, or a team of three for each world in turn
        use_threads(count)
        shared.clear()
        assert_same(scene.step(start, drive=drive, steps=3), expected)
        assert shared == [parts]


@pytest.mark.parametrize("name", ["torus", "box"])
@pytest.mark.parametrize("count", [steppers.FEWEST_TOGETHER, 333])
def test_a_team_gives_the_same_bits_for_few_agents(name: str, count: int, shared: list[int]) -> None:
    """Some threads get no block of agents, or no row of cells."""
    scene = NAMED[name].make(count, 20.0)
    start = started(scene)
    expected = scene.run(start, 5)
    for team in (2, 3, 9):
        use_threads(team)
        assert_same(scene.run(start, 5), expected)
    assert shared == [2, 3, 9]


def crowded(scene: Scene) -> tuple[Scene, State]:
    """Return a scene with two kinds of bodies, mixed in space, and enough agents to be reordered during a call."""
    half = scene.groups[0].model_copy(update={"count": WORTH_ARRANGING // 2 + 3})
    heavy = half.model_copy(update={"mass": 3.0, "max_speed": 1.0, "max_force": 2.0, "radius": 0.05})
    scene = scene.model_copy(update={"groups": (half, heavy)})
    state = scene.start(3)
    state.x[...] = np.random.default_rng(1).permuted(state.x, axis=2)
    return scene, state


@pytest.mark.parametrize("name", ["torus_single", "torus_3", "box", "nearest_torus_single", "torus_single_rk4"])
def test_one_call_of_many_steps_equals_many_calls_of_one_step(name: str) -> None:
    """Agents of a large world are reordered in memory only in calls of several steps."""
    scene, start = crowded(NAMED[name].make(WORTH_ARRANGING, 140.0 if scene_is_flat(name) else 40.0))
    drive = np.random.default_rng(2).normal(size=start.shape)
    expected = start
    for _ in range(4):
        expected = scene.step(expected, drive=drive)
    assert_same(scene.step(start, drive=drive, steps=4), expected)
    use_threads(2)
    assert_same(scene.step(start, drive=drive, steps=4), expected)
    assert not np.array_equal(
        np.argsort(start.x[0, 0]), np.argsort(expected.x[0, 0])
    )  # their order in space has changed


@pytest.mark.slow
def test_a_team_reorders_smaller_worlds_than_one_thread_does() -> None:
    scene = NAMED["torus_single"].make(FEWEST_ARRANGED, 70.0)
    start = scene.start(3)
    start.x[...] = np.random.default_rng(1).permuted(start.x, axis=2)
    expected = scene.step(start, steps=STEPS_ARRANGED)
    for team, count in ((2, STEPS_ARRANGED - 1), (2, STEPS_ARRANGED), (3, STEPS_ARRANGED)):
        use_threads(team)
        found = scene.step(start, steps=count)
        buffer = scene.stepper.workspaces(1, team)[0].arrays["reorder_buffer"]
        assert buffer.any() == (count == STEPS_ARRANGED)
        assert_same(scene.step(found, steps=STEPS_ARRANGED - count), expected)
    assert not scene.stepper.workspaces(1, 1)[0].arrays["reorder_buffer"].any()


def scene_is_flat(name: str) -> bool:
    return NAMED[name].dimension == 2


def test_a_reordered_world_may_shrink_until_it_has_no_grid() -> None:
    """Without a grid, neighbours are visited in the order of their numbers, not by cell."""
    spawn = Spawn(low=(0, 0), high=(6.1, 6.1))
    scene = Scene(
        groups=(Group(count=WORTH_ARRANGING, spawn=spawn),), effects=(Separation(weight=1e-3, radius=1.0),), dt=0.02
    )
    start = scene.start(1)
    start.v[...] = -1.5 * (start.x - 3.05)
    assert_same(scene.step(start, steps=2), scene.step(scene.step(start)))


@pytest.mark.parametrize("absent", [(), (5_000,), (0, WORTH_ARRANGING)])
def test_values_shared_by_all_agents_give_the_same_bits_as_values_of_each(absent: tuple[int, ...]) -> None:
    """A large world reads what all agents share (body, alive, no drive) from its first block only."""
    most = WORTH_ARRANGING + 2  # one more agent follows: the last block is not full
    group = Group(count=most, max_speed=1e3, max_force=1e6, spawn=Spawn(low=(0, 0), high=(130.0, 130.0)))
    laws = {"effects": (Separation(weight=1e-3, radius=1.0),), "dt": 0.02}
    rng, ends = np.random.default_rng(4), []
    places, drive = rng.uniform(0, 130, (2, 1, most + 1)), rng.normal(size=(1, most + 1, 2))
    for strength in (1e6, 2e6):  # no agent reaches either limit: the results must be equal
        scene = Scene(groups=(group, group.model_copy(update={"count": 1, "max_force": strength})), **laws)
        state = scene.start(1)
        state.x[...] = places
        state.alive[0, list(absent)] = False
        for given in (None, drive, None):  # the drive of the call before must not be used again
            state = scene.step(state, drive=given, steps=2)
            once = scene.step(scene.step(state, drive=given), drive=given)
            assert_same(scene.step(state, drive=given, steps=2), once)
        ends.append(state)
        driven, alone = scene.step(state, drive=drive, steps=2), scene.step(state, steps=2)
        assert_same(alone, scene.step(state, drive=np.zeros_like(drive), steps=2))
        assert not np.array_equal(alone.x, driven.x)
    assert_same(*ends)


def test_a_single_heavy_agent_of_a_large_world_keeps_its_own_mass() -> None:
    group = Group(count=WORTH_ARRANGING, max_force=1e6, spawn=Spawn(low=(0, 0), high=(130.0, 130.0)))
    heavy = Group(count=1, max_force=1e6, mass=4.0, spawn=Spawn(low=(500, 0), high=(501, 1)))
    scene = Scene(groups=(group, heavy), effects=(Separation(weight=1e-3, radius=1.0),), dt=0.02)
    start = scene.start(1)
    start.v[...] = 0.0
    drive = np.zeros(start.shape)
    drive[0, -1] = 3.0, -2.0
    np.testing.assert_allclose(scene.step(start, drive=drive).vel[0, -1], 0.02 * drive[0, -1] / 4.0, rtol=1e-15)


@pytest.mark.slow
def test_nan_in_a_reordered_world_names_the_agent_by_its_number() -> None:
    scene, start = crowded(NAMED["torus_single"].make(WORTH_ARRANGING, 140.0))
    start.v[1, 0, 12_345] = np.inf
    world, agent, _ = scene.stepper.advance(start.copy(), np.zeros((2, 0, 0), np.float32), 3)
    apart = scene.space.displacement(start.pos[0, agent], start.pos[0, 12_345])
    assert world == 0 and agent < 12_345  # it spread to neighbours, and to theirs
    assert np.linalg.norm(apart) < 3 * 3.0
    kept = start.copy()
    with pytest.raises(FloatingPointError, match="world 0, agent "):
        scene.step(start, out=start, steps=3)
    assert_same(start, kept)


def test_surplus_threads_do_not_change_results() -> None:
    """Five threads, some without a row of cells, on fewer cores."""
    scene = NAMED["box"].make(4500, 45.0)
    start = scene.start(1)
    start.pos[0, :4400] = np.random.default_rng(0).uniform(20.0, 21.0, (4400, 2))  # nearly all in one row of cells
    expected = scene.run(start, 1)
    use_threads(5)
    assert_same(scene.run(start, 1), expected)
    start.alive[...] = False
    few = start.copy()
    few.alive[0, :3] = True
    use_threads(1)
    expected = scene.run(few, 2)
    use_threads(5)
    assert_same(scene.run(few, 2), expected)


# --- batches ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
@pytest.mark.parametrize("count", [33, 300])
def test_worlds_divided_among_threads_keep_their_bits(variant: Variant, count: int, shared: list[int]) -> None:
    scene = variant.make(count, 20.0)
    start = started(scene, worlds=7)
    expected = scene.run(start, 4)
    for threads_used in (2, 3, 7, 8):
        use_threads(threads_used)
        assert_same(scene.run(start, 4), expected)
    assert shared == [2, 3, 7, 8 if count >= steppers.FEWEST_TOGETHER else 7]  # a world per job, or a team of 8


@pytest.mark.slow
@pytest.mark.parametrize("used", [1, 3])
def test_long_calls_equal_short_ones_however_many_agents_leave_their_tiles(used: int) -> None:
    """3 m/s for 2 s, in tiles of 14 m: few agents have left their tile at first, over a quarter at the end."""
    use_threads(used)
    scene = Scene(
        dimension=2, space=Torus(size=(117.0, 117.0)), dt=0.05, dtype="float32",
        effects=(Separation(weight=0.1, radius=1.0), Alignment(weight=0.1, radius=2.0)),
        groups=(Group(count=WORTH_ARRANGING + 3, max_speed=3.0, spawn=Spawn(speed=(3.0, 3.0))),),
    )  # fmt: skip
    one_by_one = start = scene.start(5)
    for _ in range(40):
        one_by_one = scene.step(one_by_one)
    moved = np.abs((one_by_one.x - start.x + 58.5) % 117 - 58.5)
    assert (moved / 14).sum(axis=0).mean() > 0.3  # probability that an agent crossed an edge of its tile
    at_once = scene.step(start, steps=40)
    np.testing.assert_array_equal(at_once.x, one_by_one.x)
    np.testing.assert_array_equal(at_once.v, one_by_one.v)


class Clock:
    """Clock that stands still but for the durations that jobs add to it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(thread_pool, "perf_counter", lambda: self.now)
        monkeypatch.setattr(thread_pool.AutoTuner, "always", False)

    def done(
        self, choice: thread_pool.AutoTuner, alone: float, shared: float, pieces: int, surely: bool = False
    ) -> str:
        """Do `pieces` jobs of these durations, s; return a letter per piece: a (alone) or s (shared)."""
        by = []

        def job_of(letter: str, seconds: float) -> Callable[[], None]:
            def job() -> None:
                by.append(letter)
                self.now += seconds

            return job

        for _ in range(pieces):
            choice.run(job_of("a", alone), job_of("s", shared), surely)
        return "".join(by)


def test_both_alternatives_are_tried_and_the_faster_one_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    assert clock.done(thread_pool.AutoTuner(), 1.0, 0.6, 10) == "aaasss" + 4 * "s"
    assert clock.done(thread_pool.AutoTuner(), 1.0, 1.2, 10) == "aaasss" + 4 * "a"
    assert clock.done(thread_pool.AutoTuner(), thread_pool.SHORTEST / 2, 0.0, 200) == 200 * "a"  # too short to share
    assert clock.done(thread_pool.AutoTuner(), 0.0, 9.0, 5, surely=True) == 5 * "s"  # too long to try


def test_the_slower_alternative_is_retried_ever_more_seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    by = clock.done(thread_pool.AutoTuner(), 1.0, 1.2, 20_000)[2 * thread_pool.TRIAL :]
    waits = [len(part) for part in by.split(thread_pool.TRIAL * "s")]
    assert waits[:3] == [2 * thread_pool.AGAIN, 4 * thread_pool.AGAIN, 8 * thread_pool.AGAIN]
    assert set(waits[6:-1]) == {thread_pool.SELDOM}


@pytest.mark.parametrize("faster", [0, 1])
def test_a_single_measurement_does_not_decide_for_ever(faster: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A single slow run is forgotten, and the choice changes when the other alternative becomes faster."""
    clock, choice, wanted = Clock(monkeypatch), thread_pool.AutoTuner(), "as"[faster]
    usual, late = (0.5, 1.0) if faster == 0 else (1.0, 0.5), 100.0
    clock.done(choice, *usual, 100)
    for held_up in ((late, usual[1]), (usual[0], late)):
        clock.done(choice, *held_up, 1)
        assert (
            clock.done(choice, *usual, 3 * thread_pool.AGAIN).count(wanted)
            >= 3 * thread_pool.AGAIN - thread_pool.TRIAL - 1
        )
    clock.done(choice, *usual[::-1], 2 * thread_pool.SELDOM)
    assert clock.done(choice, *usual[::-1], 100).count(wanted) <= thread_pool.TRIAL
    for held_up in range(2 * thread_pool.TRIAL):  # during the first trials
        begun = thread_pool.AutoTuner()
        for k in range(2 * thread_pool.TRIAL):
            clock.done(begun, *((late, late) if k == held_up else usual), 1)
        assert clock.done(begun, *usual, thread_pool.AGAIN) == thread_pool.AGAIN * wanted


def test_the_time_of_failed_work_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, choice = Clock(monkeypatch), thread_pool.AutoTuner()
    clock.done(choice, 1.0, 0.6, 10)
    before = list(choice.took)

    def interrupted() -> None:
        clock.now += 50
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        choice.run(interrupted, interrupted)
    assert choice.took == before


def test_scenes_and_worlds_use_the_faster_number_of_threads(shared: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_pool.AutoTuner, "always", False)
    use_threads(2)
    scene = NAMED["torus"].make(640, 60.0)
    start = scene.start(0)
    expected = scene.run(start, 1)
    assert shared == []
    choice = scene.stepper.tuners.of("together", 640, 2)
    for took, by in (([1.0, 0.5], [2]), ([0.5, 1.0], [])):
        choice._left, choice._wait, choice.took = 0, 100, took
        shared.clear()
        assert_same(scene.run(start, 1), expected)
        assert shared == by
    world = World(Flock(), 200)
    world.reset(0)
    world.step(np.zeros((200, 24, 2)))
    assert [kind for kind, *_ in world._tuners] == ["beginning", "deciding"]


@pytest.mark.parametrize(("count", "worlds", "surely"), [(640, 1, False), (640, 2, True), (4096, 1, True)])
def test_long_calls_are_shared_at_once_if_threads_seldom_wait_for_each_other(
    count: int, worlds: int, surely: bool, shared: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a trial if each thread has its own world, or a world has many agents; a team for few agents is timed."""
    monkeypatch.setattr(thread_pool.AutoTuner, "always", False)
    use_threads(2)
    scene = NAMED["torus"].make(count, 60.0)
    start, steps = scene.start(0, worlds=worlds), 1 + steppers.LARGEST // (count * worlds)
    scene.run(start, steps - 2)
    assert shared == []
    scene.run(start, steps)
    assert shared == [2] * surely


def test_there_are_never_more_threads_at_work_than_cores(shared: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_pool, "_cores", 3)
    scene = NAMED["torus"].make(33, 20.0)
    start = scene.start(0, worlds=7)
    for requested, work in ((2, [2]), (8, [3]), (1, [])):
        shared.clear()
        use_threads(requested)
        scene.run(start, 1)
        assert shared == work
        assert threads() == requested


# --- NaN, found by any thread -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("agent", [0, 1, 1700, 3333, 4998])
def test_nan_found_by_any_thread_names_the_first_agent(agent: int, count: int) -> None:
    scene = NAMED["torus"].make(4999, 60.0)
    start = scene.start(0)
    start.pos[0, agent, 1] = np.nan
    kept = start.copy()
    use_threads(count)
    with pytest.raises(FloatingPointError, match=f"world 0, agent {agent}:"):
        scene.step(start)
    start.pos[0, 4998, 0] = np.inf
    with pytest.raises(FloatingPointError, match=f"world 0, agent {agent}:"):  # the first of the two
        scene.step(start)
    np.testing.assert_array_equal(kept.tick, start.tick)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3])
def test_nan_in_a_batch_is_found_in_its_first_world(count: int) -> None:
    scene = NAMED["plane_3_single"].make(33, 20.0)
    start = scene.start(0, worlds=40)
    for world, agent in ((39, 2), (17, 30), (18, 0)):
        start.pos[world, agent] = np.nan
    use_threads(count)
    with pytest.raises(FloatingPointError, match="world 17, agent 30:"):
        scene.run(start, 5)


# --- calls from several threads ---------------------------------------------------------------------------------------


def at_the_same_time(calls: list[Callable[[], Any]]) -> list[Any]:
    """Call each in its own thread and return the results; fail if one takes longer than PATIENCE."""
    pool = ThreadPoolExecutor(len(calls))
    try:
        return [future.result(PATIENCE) for future in [pool.submit(call) for call in calls]]
    finally:
        pool.shutdown(wait=False)


@pytest.mark.parametrize(
    ("name", "count", "edge", "worlds", "steps"),
    [("torus_single", 5000, 70.0, 1, 3), ("torus_single", 150, 20.0, 7, 10), ("nearest_plane", 4111, 60.0, 1, 2)],
)
def test_two_callers_can_step_one_scene_with_two_threads_each(
    name: str, count: int, edge: float, worlds: int, steps: int
) -> None:
    scene = NAMED[name].make(count, edge)
    starts = [scene.start(seed, worlds) for seed in range(2)]
    expected = [scene.run(start, steps * 4) for start in starts]
    use_threads(2)

    def run(state: State) -> State:
        for _ in range(4):
            state = scene.run(state, steps)
        return state

    found = at_the_same_time([lambda start=start: run(start) for start in starts])
    for a, b in zip(found, expected, strict=True):
        assert_same(a, b)


def test_simultaneous_callers_with_waiting_jobs_do_not_deadlock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine callers create pools at once, slowly: each gets as many threads as it has jobs."""

    class Slow(thread_pool._ThreadPool):
        def __init__(self, count: int) -> None:
            super().__init__(count)
            time.sleep(0.02 * (6 - count))  # the smallest pool is ready last, and stays

    monkeypatch.setattr(thread_pool, "_ThreadPool", Slow)
    monkeypatch.setattr(thread_pool, "_pool", None)

    def call(size: int) -> list[int]:
        meeting = threading.Barrier(size)

        def job(k: int) -> int:
            meeting.wait(20)
            return k

        return [sum(run_parallel([lambda k=k: job(k) for k in range(size)])) for _ in range(20)]

    sizes = (2, 5, 3) * 3
    answers: dict[int, list[int]] = {}
    callers = [
        threading.Thread(target=lambda n=n, size=size: answers.update({n: call(size)}), daemon=True)
        for n, size in enumerate(sizes)
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(30)
    assert answers == {n: [size * (size - 1) // 2] * 20 for n, size in enumerate(sizes)}


def test_the_error_of_a_job_is_raised_after_all_jobs_have_ended() -> None:
    ended = []

    def good() -> None:
        time.sleep(0.05)
        ended.append(1)

    def bad() -> None:
        raise OverflowError("too much")

    for jobs in ([bad, good, good], [good, bad, good]):
        ended.clear()
        with pytest.raises(OverflowError, match="too much"):
            run_parallel(jobs)
        assert ended == [1, 1]
    assert run_parallel([lambda: 1, lambda: 2, lambda: 3]) == [1, 2, 3]  # the pool still works


# --- a process that forks ---------------------------------------------------------------------------------------------

FORK = """
import os, sys
import numpy as np
from flockenv.jit.thread_pool import use_threads
from tests.catalogue import VARIANTS
variant = next(v for v in VARIANTS if v.name == "torus_single")
use_threads(2)
large, small = variant.make(5000, 70.0), variant.make(150, 20.0)
starts = large.start(0), small.start(0, worlds=7)
step = lambda: [large.run(starts[0], 2), small.run(starts[1], 10)]
expected = step()  # now there are threads, which a child does not inherit
children = []
for _ in range(2):
    child = os.fork()
    if child == 0:
        same = all(np.array_equal(a.x, b.x) for a, b in zip(step(), expected))
        os._exit(7 if same else 3)
    children.append(child)
again = step()
assert all(np.array_equal(a.x, b.x) for a, b in zip(again, expected))
print([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children])
"""


def in_another_process(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    own = {"FLOCKENV_CACHE": str(cache_folder()), "PYTHONPATH": str(Path(flockenv.__file__).parent.parent)}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=own | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE,
    )


LINUX = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="thread affinity cannot be set here")


@pytest.fixture
def new_crew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start without a thread pool, so that no thread has an affinity yet."""
    monkeypatch.setattr(thread_pool, "_pool", None)


@pytest.fixture
def cores(new_crew: None) -> set[int]:
    """Return the cores that this thread may run on; skip if there is only one."""
    given = os.sched_getaffinity(0)
    if len(given) < 2:
        pytest.skip("one core")
    return given


@LINUX
def test_pool_threads_avoid_the_core_of_the_calling_thread(cores: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
    assert thread_pool._current_core()[0] in cores
    for core in (*cores, *cores):
        monkeypatch.setattr(
            thread_pool, "_current_core_number", lambda core=core: core
        )  # the caller may be on any core
        assert run_parallel([lambda: None, lambda: os.sched_getaffinity(0)])[1] == cores - {core}
    assert os.sched_getaffinity(0) == cores  # the caller's own affinity is unchanged


@LINUX
@pytest.mark.usefixtures("new_crew")
def test_threads_run_on_any_core_if_there_are_more_threads_than_cores() -> None:
    cores = os.sched_getaffinity(0)
    found = run_parallel([lambda: os.sched_getaffinity(0)] * (len(cores) + 1))
    assert found == [cores] * (len(cores) + 1)


@LINUX
def test_pool_threads_stay_on_the_cores_of_a_pinned_caller(cores: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """With any affinity before. They avoid its core again once the caller may use several cores."""

    def calls() -> list[set[int]]:
        seen = []
        for core in cores:
            for allowed in (cores, {core}, cores):
                os.sched_setaffinity(0, allowed)
                monkeypatch.setattr(thread_pool, "_current_core_number", lambda core=core: core)
                seen.append(run_parallel([lambda: None, lambda: os.sched_getaffinity(0)])[1])
        return seen

    with ThreadPoolExecutor(1) as pool:
        seen = pool.submit(calls).result()
    assert seen == [found for core in cores for found in (cores - {core}, {core}, cores - {core})]


@LINUX
def test_after_a_call_with_surplus_threads_they_avoid_the_callers_core_again(
    cores: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    core = min(cores)
    monkeypatch.setattr(thread_pool, "_current_core_number", lambda: core)
    run_parallel([lambda: None] * (len(cores) + 2))
    assert run_parallel([lambda: None, lambda: os.sched_getaffinity(0)])[1] == cores - {core}


@pytest.mark.usefixtures("new_crew")
@pytest.mark.parametrize("forbidden", ["sched_setaffinity", "sched_getaffinity", "sched_getcpu"])
def test_work_is_shared_even_if_thread_affinity_is_unavailable(forbidden: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError

    monkeypatch.setattr(thread_pool, "_current_core_number", None if forbidden == "sched_getcpu" else lambda: 0)
    for name in ("sched_setaffinity", "sched_getaffinity"):
        monkeypatch.setattr(os, name, refuse if forbidden == name else lambda *_: {0, 1}, raising=False)
    assert run_parallel([lambda: 1, lambda: 2]) == [1, 2]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_child_steps_with_its_own_threads() -> None:
    done = in_another_process(FORK)
    assert done.stdout == "[7, 7]\n", done.stderr


# --- number of threads ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, -1, 257, 2.0, True, "2", None, float("nan")])
def test_an_invalid_number_of_threads_is_refused(count: Any) -> None:
    with pytest.raises(ValueError, match="threads is") as caught:
        use_threads(count)
    assert repr(count) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert threads() == 1


@pytest.mark.parametrize("text", ["0", "-1", "257", "2.0", "two", "", " ", "1e3", "²", "99999999999999999999"])
def test_an_invalid_number_of_threads_in_the_environment_is_refused(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLOCKENV_THREADS", text)
    with pytest.raises(ValueError, match="FLOCKENV_THREADS is") as caught:
        thread_pool._from_environment()
    assert repr(text) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert threads() == 1


def test_the_environment_sets_the_number_of_threads() -> None:
    code = "import flockenv.jit.thread_pool as c; print(c.threads())"
    assert in_another_process(code).stdout == "1\n"
    assert in_another_process(code, FLOCKENV_THREADS="3").stdout == "3\n"
    refused = in_another_process(code, FLOCKENV_THREADS="many")
    assert refused.returncode != 0
    assert refused.stderr.splitlines()[-1].startswith("ValueError: FLOCKENV_THREADS is 'many'")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="torch has another OpenMP there")
@pytest.mark.parametrize(
    ("given", "spins"), [({}, "10000"), ({"GOMP_SPINCOUNT": "77"}, "77"), ({"OMP_WAIT_POLICY": "passive"}, "0")]
)
def test_torch_spins_briefly_unless_the_environment_sets_how_threads_wait(given: dict[str, str], spins: str) -> None:
    done = in_another_process("import agents, torch", OMP_DISPLAY_ENV="verbose", **given)
    assert f"GOMP_SPINCOUNT = '{spins}'" in done.stderr
