"""World: batches, seeds, episodes, copies, threads and refused arguments, for every task of the catalogue."""

from __future__ import annotations

import ast
import copy
import inspect
import pickle
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import AT_HAND, PAST, Step, World, _chunks
from flockenv.jit.section import without_dispatch
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.maths.counter_rng import key_of, keys_of
from flockenv.model.divergence import SimulationDiverged
from flockenv.tasks import Crossing, Flock, Obstacles, Pursuit
from flockenv.tasks.play import _play
from tests.catalogue import TASKS, TaskRow

EVERY = pytest.mark.parametrize(
    "row", [pytest.param(r, id=r.name, marks=pytest.mark.slow if r.variant else ()) for r in TASKS[::-1]]
)
"""In reverse order: test_tasks.py, which may run in parallel, compiles the kernels of the first tasks first."""

ARRAYS = ("x", "v", "alive", "tick", "key", "obstacle_x", "obstacle_radius", "work")


def actions_for(world: World, steps: int, seed: int = 0) -> Any:
    shape = (steps, world.worlds, world.learners, world.action_size)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def everything(world: World) -> dict[str, Any]:
    """Return copies of all arrays of a world, and its metrics."""
    kept = {name: getattr(world.state, name).copy() for name in ARRAYS}
    return kept | {"memory": world._memory.copy(), "steps": world.steps.copy(), **world.measure()}


def assert_same(a: dict[str, Any], b: dict[str, Any], but: tuple[str, ...] = ()) -> None:
    assert a.keys() == b.keys()
    for name in a.keys() - set(but):
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def fields(step: Step) -> dict[str, Any]:
    names = ("observation", "reward", "terms", "terminated", "truncated", "success", "alive", "ended")
    return {name: getattr(step, name) for name in names}


@pytest.fixture(params=[False, True], ids=["fresh", "recycled"])
def recycled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Return new memory for each result, or memory from a buffer pool, for worlds of any size."""
    monkeypatch.setattr("flockenv.envs.world.RECYCLE", 0 if request.param else 2**62)
    return bool(request.param)


# --- batches ----------------------------------------------------------------------------------------------------------


@EVERY
def test_a_world_of_a_batch_equals_that_world_alone_bit_for_bit(row: TaskRow) -> None:
    batch = World(row.task, 16, time_limit=250)
    first = batch.reset(100)
    actions = actions_for(batch, 300)
    steps = [fields(batch.step(a)) for a in actions]
    measured = batch.measure()
    for k in range(16):
        alone = World(row.task, time_limit=250)
        np.testing.assert_array_equal(alone.reset(100 + k)[0], first[k])
        found = [fields(alone.step(actions[t, k : k + 1])) for t in range(300)]
        for name in found[0]:  # all steps in one comparison, which is much faster than one each
            ours, theirs = (np.array(each) for each in ([s[name][0] for s in found], [s[name][k] for s in steps]))
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{name}, world {k}, step by step")
        for name, value in alone.measure().items():
            np.testing.assert_array_equal(value[0], measured[name][k])


@EVERY
def test_worlds_in_one_process_and_in_threads_do_not_interact(row: TaskRow, recycled: bool) -> None:
    def run(seed: int) -> list[Any]:
        world = World(row.task, 2)
        world.reset(seed)
        # every other result is dropped at once, so that its memory is reused
        return [world.step(a).observation.copy() if t % 2 else world.step(a).observation for t, a in plan(world, seed)]

    def plan(world: World, seed: int) -> Any:
        return enumerate(actions_for(world, 60, seed))

    serial = [run(seed) for seed in range(6)]
    with ThreadPoolExecutor(3) as pool:
        for ours, theirs in zip(serial, pool.map(run, range(6)), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    worlds = [World(row.task, 2) for _ in range(2)]
    for seed, world in enumerate(worlds):
        world.reset(seed)
    plans = [actions_for(world, 60, seed) for seed, world in enumerate(worlds)]
    for t in range(60):  # alternately
        for seed, world in enumerate(worlds):
            np.testing.assert_array_equal(world.step(plans[seed][t]).observation, serial[seed][t])


@EVERY
def test_results_and_arguments_share_no_memory_with_the_world(row: TaskRow, recycled: bool) -> None:
    world, other = World(row.task, 2), World(row.task, 2)
    held = [world.reset(5)]
    other.reset(5)
    actions = actions_for(world, 20)
    given = actions.copy()
    for t in range(20):
        step = world.step(given[t])
        held += [step.observation, step.reward, step.terms, step.terminated, step.success, step.alive, step.truncated]
        for array in held:
            array[...] = 1  # must not change the world
        for array in world.measure().values():
            array[...] = 77
        reference = other.step(actions[t])
    np.testing.assert_array_equal(given, actions)
    assert_same(everything(world), everything(other))
    assert not np.array_equal(reference.observation, step.observation)


@EVERY
@pytest.mark.usefixtures("recycled")
def test_streaming_stores_give_the_same_results(row: TaskRow, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = World(row.task, 5, time_limit=7)
    monkeypatch.setattr("flockenv.envs.world.PAST", 0)
    past = World(row.task, 5, time_limit=7)
    assert (direct._streaming, past._streaming) == (False, True)
    np.testing.assert_array_equal(past.reset(5), direct.reset(5))
    for k, actions in enumerate(actions_for(direct, 20)):
        one, other = past.step(actions), direct.step(actions)
        assert_same(fields(one), fields(other))
        if one.ended.any():
            into = [step.observation for step in (one, other)] if k % 2 else [None, None]
            begun = [world.reset(mask=one.ended, into=at) for world, at in zip((past, direct), into, strict=True)]
            np.testing.assert_array_equal(*begun)
    assert_same(everything(past), everything(direct))


def test_a_fence_follows_all_streaming_stores() -> None:
    """Without it other threads nearly always see the same results. The source is checked, as `play` may be cached."""
    (play,) = (node for node in ast.walk(ast.parse(inspect.getsource(_play))) if getattr(node, "name", "") == "play")
    *_, fence, last = play.body
    assert ast.unparse(fence) == "if streaming:\n    store_fence()" and isinstance(last, ast.Return)


def test_streaming_stores_are_used_for_large_results_only() -> None:
    """Except if one world's observations exceed a core's cache: they would go to memory twice."""
    size = 4 * Obstacles().layout.size
    few, many = World(Obstacles(), (PAST - 1) // size), World(Obstacles(), -(-PAST // size))
    assert (few._streaming, many._streaming) == (False, True)
    agents = AT_HAND // (4 * Flock().layout.size) + 1
    assert not World(Flock(agents=agents, size=400), -(-PAST // (4 * Flock().layout.size * agents)))._streaming


@EVERY
@pytest.mark.usefixtures("recycled")
def test_terms_can_be_limited_to_worlds_that_end(row: TaskRow) -> None:
    every, ends = World(row.task, 4, time_limit=9), World(row.task, 4, time_limit=9)
    every.reset(5)
    ends.reset(5)
    written = 0
    for actions in actions_for(every, 30):
        one, other = every.step(actions), ends.step(actions, terms="ends")
        over = one.truncated | one.terminated.any(axis=1)
        written += int(over.sum())
        np.testing.assert_array_equal(other.terms[over], one.terms[over])
        assert_same(fields(one), fields(other), but=("terms",))
        if one.ended.any():
            np.testing.assert_array_equal(every.reset(mask=one.ended), ends.reset(mask=one.ended))
    assert written >= 8
    assert_same(everything(every), everything(ends))


def test_an_unknown_choice_of_terms_is_refused() -> None:
    world = World(Pursuit())
    world.reset(0)
    kept = everything(world)
    with pytest.raises(ValueError, match=r"terms: 'end' is unknown, did you mean `ends`.*allowed: steps, ends"):
        world.step(np.zeros((1, 1, 2)), terms="end")  # type: ignore[arg-type]
    assert_same(everything(world), kept)


@EVERY
def test_results_that_are_kept_do_not_change(row: TaskRow, recycled: bool) -> None:
    """Whole results, single arrays and views of them, some released at once and some later."""
    world, held, was = World(row.task, 3, time_limit=20), [], []
    held.append(world.reset(5))
    was.append(held[-1].copy())
    for t, a in enumerate(actions_for(world, 60)):
        step = world.step(a)
        held += [step.observation[1:], step.terms[..., 0], step.reward, step.terminated, step.alive.T][: t % 6]
        was += [array.copy() for array in held[len(was) :]]
        if step.ended.any():
            held.append(world.reset(mask=step.ended))
            was.append(held[-1].copy())
        if t % 9 == 8:  # release every other one
            del held[::2], was[::2]
    for array, copied in zip(held, was, strict=True):
        np.testing.assert_array_equal(array, copied)


def test_a_large_world_reuses_its_memory() -> None:
    world = World(Flock(agents=32), 64)
    world.reset(0)
    actions = actions_for(world, 12)
    blocks = {id(step.observation.base) for step in map(world.step, actions)}
    assert len(blocks) == 2  # one that the caller holds, and one being written
    assert id(None) not in blocks


# --- episodes ---------------------------------------------------------------------------------------------------------


@EVERY
def test_episodes_differ_and_depend_on_the_seed_alone(row: TaskRow) -> None:
    world, other = World(row.task, 3), World(row.task, 3)
    ours = [world.reset(7), world.reset(), world.reset()]
    theirs = [other.reset([7, 8, 9]), other.reset(), other.reset()]
    np.testing.assert_array_equal(ours, theirs)
    rows = np.concatenate(ours)
    assert len({r.tobytes() for r in rows}) == 9
    np.testing.assert_array_equal(world.reset(7), ours[0])
    np.testing.assert_array_equal(world.reset(), ours[1])
    assert world.seeds == (7, 8, 9)


def test_a_world_without_a_seed_draws_one_and_reports_it() -> None:
    world, other = World(Pursuit()), World(Pursuit())
    first = world.reset()
    assert not np.array_equal(first, other.reset())
    again = World(Pursuit())
    np.testing.assert_array_equal(again.reset(list(world.seeds)), first)


@EVERY
def test_scripted_agents_do_not_depend_on_observations_and_snapshots(row: TaskRow) -> None:
    """Another reset to the same seed, and observations in between, do not change what follows."""
    world, other = World(row.task, 2), World(row.task, 2)
    world.reset(1)
    other.reset(9)
    for a in actions_for(other, 17):
        other.step(a)
    other.reset(1)
    for a in actions_for(world, 40):
        np.testing.assert_array_equal(world.step(a).observation, other.step(a).observation)
        other.reset(mask=np.zeros(2, bool))
        other.snapshot()


@EVERY
def test_a_masked_reset_changes_the_masked_worlds_only(row: TaskRow) -> None:
    world = World(row.task, 4)
    world.reset(20)
    for a in actions_for(world, 15):
        step = world.step(a)
    kept = everything(world)
    mask = np.array([False, True, False, True])
    seen = world.reset(mask=mask)
    now = everything(world)
    np.testing.assert_array_equal(seen[~mask], step.observation[~mask])
    for name, value in now.items():
        axis = 1 if name in ("x", "v", "obstacle_x", "memory") else 0
        np.testing.assert_array_equal(
            np.compress(~mask, value, axis), np.compress(~mask, kept[name], axis), err_msg=name
        )
    np.testing.assert_array_equal(world.steps, [15, 0, 15, 0])
    fresh = World(row.task, 4)
    fresh.reset(20)
    np.testing.assert_array_equal(fresh.reset()[mask], seen[mask])  # the second episode of the same seeds
    seen = world.reset([1, 2, 3, 4], mask=~mask)
    assert world.seeds == (1, 21, 3, 23)
    np.testing.assert_array_equal(seen[0], World(row.task).reset(1)[0])


@pytest.fixture
def checking_types(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let numba check the types of every call, so that it would compile for new ones."""
    monkeypatch.setattr("flockenv.envs.world.without_dispatch", lambda function: function)


def test_after_a_reset_the_kernel_is_called_without_type_checks() -> None:
    world = World(Pursuit(), 2)
    world.reset(1)
    play = world._entries[0]
    assert world._enter is without_dispatch(play) is not play
    again = copy.deepcopy(world)
    assert again._enter is play
    for a in actions_for(world, 3):
        np.testing.assert_array_equal(world.step(a).observation, again.step(a).observation)
    for several in (0, 2):
        function = SimpleNamespace(overloads=dict.fromkeys(range(several)))
        assert without_dispatch(function) is function


@pytest.mark.usefixtures("checking_types")
@pytest.mark.parametrize("first", [False, True])
def test_masks_of_any_memory_layout_compile_nothing(first: bool) -> None:
    task = TASKS[0].task
    world, other = World(task, 4), World(task, 4)
    for w in (world, other):
        w.reset(20)
    mask, stretched = np.array([first, True, False, not first]), np.zeros(8, bool)
    stretched[::2] = mask
    fixed = mask.copy()
    fixed.flags.writeable = False
    for strange in (stretched[::2], fixed, mask[::-1].copy()[::-1]):
        np.testing.assert_array_equal(world.reset(mask=strange), other.reset(mask=mask))
        assert_same(everything(world), everything(other))
    assert len(world._entries[0].overloads) == 1


@EVERY
def test_a_reset_into_given_observations_writes_the_masked_worlds_only(row: TaskRow) -> None:
    world, other = World(row.task, 4), World(row.task, 4)
    for w in (world, other):
        w.reset(20)
    for a in actions_for(world, 9):
        step, _ = world.step(a), other.step(a)
    mask = np.array([True, False, False, True])
    given = step.observation.copy()
    given[~mask] = 7.0
    assert world.reset(mask=mask, into=given) is given
    seen = other.reset(mask=mask)
    np.testing.assert_array_equal(given[mask], seen[mask])
    np.testing.assert_array_equal(given[~mask], 7.0)
    assert_same(everything(world), everything(other))
    for bad in (given[:2], given.astype(np.float64), given[:, :, 1:]):
        with pytest.raises(ValueError, match=r"^into has shape [^\n]*$"):
            world.reset(mask=mask, into=bad)
    gaps = np.repeat(given, 2, axis=2)[:, :, ::2]
    with pytest.raises(ValueError, match="contiguous: "):
        world.reset(mask=mask, into=gaps)
    assert_same(everything(world), everything(other))


@EVERY
def test_paid_is_the_sum_of_the_terms_so_far(row: TaskRow) -> None:
    world = World(row.task, 3)
    world.reset(6)
    steps = [world.step(a) for a in actions_for(world, 15)]
    for step in steps:
        np.testing.assert_array_equal(step.reward, step.terms.sum(axis=2))
    np.testing.assert_array_equal(world.paid, np.cumsum([step.terms for step in steps], axis=0)[-1])
    kept = world.paid.copy()
    world.reset(mask=np.array([False, True, False]))
    assert not world.paid[1].any()
    np.testing.assert_array_equal(world.paid[[0, 2]], kept[[0, 2]])


@EVERY
def test_metrics_of_one_world_are_those_of_all(row: TaskRow) -> None:
    world = World(row.task, 3)
    world.reset(6)
    for a in actions_for(world, 15):
        world.step(a)
    columns = world.measure()
    for k in range(3):
        found = world.metrics(k)
        assert found == {name: column[k] for name, column in columns.items() if not np.isnan(column[k])}
        assert all(type(value) is float for value in found.values())
    assert world.metrics(-1) == world.metrics(2)
    for missing in (3, -4):
        with pytest.raises(IndexError):
            world.metrics(missing)


@pytest.mark.slow
def test_metrics_are_doubles_in_a_world_of_single_precision() -> None:
    world = World(Crossing(dtype="float32"))
    world.steps[:] = 7
    assert world.metrics()["time_to_goal"] == 7 * 0.1  # not 7 times the nearest float32


def test_keys_of_many_worlds_are_the_keys_of_each() -> None:
    seeds = [0, 1, 77, 2**31, 2**63 - 1, 2**64 - 1]
    for episode in (0, 1, 2**40):
        found = keys_of(np.array(seeds, np.uint64), np.full(len(seeds), episode, np.uint64))
        assert found.dtype == np.uint64
        assert found.tolist() == [int(key_of(seed, episode)) for seed in seeds]


@EVERY
@pytest.mark.usefixtures("checking_types")
def test_time_limits_truncate_and_never_terminate(row: TaskRow) -> None:
    world = World(row.task, 2, time_limit=5)
    world.reset(3)
    for t in range(7):
        step = world.step(np.zeros((2, world.learners, world.action_size)))
        np.testing.assert_array_equal(step.truncated, t >= 4)
        np.testing.assert_array_equal(step.ended, step.truncated | step.terminated.all(axis=1))
    assert not step.terminated.any()
    endless = World(row.task)
    endless.reset(3)
    assert not any(endless.step(a).truncated.any() for a in actions_for(endless, 50))
    compiled = len(endless._entries[0].overloads)
    for limit in (np.int32(51), 2**70):  # neither type is compiled for
        endless.time_limit = limit
        np.testing.assert_array_equal(endless.step(actions_for(endless, 1)[0]).truncated, limit == 51)
    assert len(endless._entries[0].overloads) == compiled


# --- copies -----------------------------------------------------------------------------------------------------------


@EVERY
@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda world: pickle.loads(pickle.dumps(world))], ids=["deep", "pickle"]
)
def test_a_copy_continues_like_the_original(row: TaskRow, copied: Any) -> None:
    world = World(row.task, 3, time_limit=90)
    world.reset(11)
    actions = actions_for(world, 120)
    for a in actions[:40]:
        world.step(a)
    other = copied(world)
    ours = [fields(world.step(a)) for a in actions[40:]] + [{"reset": world.reset()}]  # the original goes first
    theirs = [fields(other.step(a)) for a in actions[40:]] + [{"reset": other.reset()}]
    for a, b in zip(ours, theirs, strict=True):
        assert_same(a, b)
    assert_same(everything(world), everything(other))
    assert world.seeds == other.seeds


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda world: pickle.loads(pickle.dumps(world))], ids=["deep", "pickle"]
)
def test_a_copy_has_its_own_memory(copied: Any) -> None:
    world = World(Flock(agents=32), 64)
    world.reset(0)
    a, b = actions_for(world, 2)
    world.step(a)
    held = [world.step(b).observation]
    other = copied(world)
    assert other._make_results[0] is not world._make_results[0]
    assert len(pickle.dumps(world)) < 2 * len(pickle.dumps(World(Flock(agents=32), 64)))  # without results
    held += [other.step(a).observation, world.step(a).observation]
    assert not any(np.shares_memory(held[i], held[k]) for i, k in ((0, 1), (0, 2), (1, 2)))
    np.testing.assert_array_equal(held[1], held[2])


def test_a_copy_of_a_world_that_was_never_reset_needs_a_reset() -> None:
    other = copy.deepcopy(World(Pursuit(), 2))
    with pytest.raises(RuntimeError, match="reset"):
        other.step(np.zeros((2, 1, 2)))
    other.reset(1)


@pytest.mark.parametrize("team", [1, 2, 3, 16])
@pytest.mark.parametrize("worlds", [1, 2, 3, 31, 1024, 4097])
def test_portions_cover_all_worlds_and_never_grow(worlds: int, team: int) -> None:
    portions = np.array(_chunks(worlds, team))
    first, end = portions.T
    assert first[0] == 0 and end[-1] == worlds and (first[1:] == end[:-1]).all()
    size = end - first
    assert (size > 0).all() and (np.diff(size) <= 0).all()
    assert len(size) <= 8 * team + 8
    assert size[-min(team, len(size)) :].sum() <= max(worlds / 8, team)  # small at last: threads end together


# --- actions ----------------------------------------------------------------------------------------------------------


@EVERY
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_action_that_is_not_finite_is_named_and_changes_nothing(row: TaskRow, value: float, dtype: Any) -> None:
    world, other = World(row.task, 3), World(row.task, 3)
    world.reset(2)
    other.reset(2)
    actions = actions_for(world, 3).astype(dtype)
    for w in (world, other):
        w.step(actions[0])
    kept, bad = everything(world), actions[1].copy()
    bad[1, -1, 1] = value
    with pytest.raises(ValueError, match="action 1 of") as caught:
        world.step(bad)
    line = str(caught.value)
    assert row.task.agent_names[-1] in line
    assert "world 1" in line
    assert "\n" not in line
    assert_same(everything(world), kept)
    for a in actions[1:]:  # the refused step leaves no trace
        np.testing.assert_array_equal(world.step(a).observation, other.step(a).observation)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [(0, 0, 0), (199, 23, 1)])
def test_an_action_that_is_not_finite_is_refused_before_any_thread_moves_a_world(
    value: float, place: tuple[int, int, int]
) -> None:
    """All actions are checked before any thread changes a world."""
    world, before = World(Flock(), 200), threads()
    world.reset(2)
    actions, kept = np.zeros((200, 24, 2)), everything(world)
    actions[place] = value
    use_threads(2)
    try:
        with pytest.raises(ValueError, match=f"action {place[2]} of boid_{place[1]} in world {place[0]} is"):
            world.step(actions)
    finally:
        use_threads(before)
    assert len(world._scratch) == 2  # two threads did share the worlds
    assert_same(everything(world), kept)


@EVERY
def test_actions_of_another_shape_are_refused(row: TaskRow) -> None:
    world = World(row.task, 2)
    world.reset(2)
    kept, right = everything(world), (2, world.learners, 2)
    for shape in ((2, world.learners), (2, world.learners, 3), (1, world.learners, 2), (2, world.learners + 1, 2), ()):
        with pytest.raises(ValueError, match="actions have shape") as caught:
            world.step(np.zeros(shape))
        assert str(shape) in str(caught.value)
        assert str(right) in str(caught.value)
    assert_same(everything(world), kept)


@pytest.mark.parametrize("actions", [[[["left", "up"]]], [[[None, 0]]], [[[{}, 0]]]])
def test_actions_that_are_no_numbers_are_refused(actions: Any) -> None:
    world = World(Pursuit())
    world.reset(2)
    kept = everything(world)
    with pytest.raises((TypeError, ValueError), match="action") as caught:
        world.step(actions)
    assert "\n" not in str(caught.value)
    assert_same(everything(world), kept)


@EVERY
def test_actions_are_clipped_to_the_bounds(row: TaskRow) -> None:
    signs = np.sign(actions_for(World(row.task, 2), 30))
    ends = []
    for factor in (1.0, np.nextafter(np.float32(1), np.float32(2)), 1.7, 1e30, 1e300):
        world = World(row.task, 2)
        world.reset(4)
        for s in signs:
            step = world.step(s.astype(float) * factor)
        ends.append(everything(world) | fields(step))
    for end in ends[1:]:
        assert_same(end, ends[0])


@pytest.mark.slow
def test_single_precision_takes_doubles_and_rounded_actions_alike() -> None:
    """Doubles beyond the range of float32 are clipped to the bounds; only infinite ones are refused."""
    task = Pursuit(dtype="float32")
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 1, 1, 2))
    actions[3], actions[7, 0, 0, 1] = 1e300, -1e300
    rounded = np.clip(actions, -1, 1).astype(np.float32)
    frozen = rounded.copy()
    frozen.setflags(write=False)
    ends = []
    for given in (actions, rounded, frozen, rounded[..., ::-1].copy()[..., ::-1], rounded.tolist()):
        world = World(task)
        world.reset(0)
        for each in given:
            step = world.step(each)
        ends.append(everything(world) | fields(step))
    for end in ends[1:]:
        assert_same(end, ends[0])
    assert (rounded == frozen).all()
    kept = everything(world)
    for bad in (np.inf, -np.inf, np.nan):
        for kind in (float, np.float32):
            with pytest.raises(ValueError, match=f"action 1 of .* in world 0 is {bad}, must be a number"):
                world.step(np.array([[[1e30, bad]]], kind))
    assert_same(everything(world), kept)


@pytest.mark.usefixtures("checking_types")
def test_actions_of_any_type_and_layout_give_the_same_results() -> None:
    values = np.array([[[0.5, -0.25]], [[-1.0, 1.0]]])
    wide = np.zeros((2, 1, 4))
    wide[..., ::2] = values
    forms = [values, values.astype(np.float32), values.astype(np.float16), values.tolist(), wide[..., ::2]]
    forms += [np.asfortranarray(values), values.astype(object)]
    ends = []
    for form in forms:
        world = World(Pursuit(), 2)
        world.reset(4)
        world.step(form)
        ends.append(everything(world))
    for end in ends[1:]:
        assert_same(end, ends[0])
    world.step(np.ones((2, 1, 2), np.int64))
    world.step(np.ones((2, 1, 2), bool))
    world.step(np.broadcast_to(0.5, (2, 1, 2)))  # read-only
    assert len(world._entries[0].overloads) == 1  # none of these types was compiled for


# --- refused arguments ------------------------------------------------------------------------------------------------


def test_a_step_before_the_first_reset_is_refused() -> None:
    world = World(Pursuit())
    with pytest.raises(RuntimeError, match="reset"):
        world.step(np.zeros((1, 1, 2)))
    with pytest.raises(RuntimeError, match="first reset"):
        World(Pursuit(), 2).reset(mask=np.array([True, False]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: World(Pursuit(), 0), "worlds is 0"),
        (lambda: World(Pursuit(), -3), "worlds is -3"),
        (lambda: World(Pursuit(), 2.5), "worlds is 2.5"),
        (lambda: World(Pursuit(), True), "worlds is True"),
        (lambda: World(Pursuit(), "two"), "worlds is 'two'"),
        (lambda: World(Pursuit(), 10**9), "GiB"),
        (lambda: World(Flock(agents=100_000), 10_000), "GiB"),
        (lambda: World(Pursuit(), time_limit=0), "time_limit is 0"),
        (lambda: World(Pursuit(), time_limit=2.5), "time_limit is 2.5"),
        (lambda: World(Pursuit(), time_limit=True), "time_limit is True"),
    ],
)
def test_a_bad_world_is_refused_in_one_line(make: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError)) as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        (-1, "-1"),
        (2**64, "18446744073709551616"),
        ([1, 2, 3], "3 seeds for 2 worlds"),
        ([1, 1.5], "seed of world 1 is 1.5"),
        ([1, -4], "seed of world 1 is -4"),
        (1.5, "1.5"),
        ("abc", "abc"),
        (True, "True"),
    ],
)
def test_bad_seeds_are_refused_in_one_line_and_change_nothing(seeds: Any, message: str) -> None:
    world = World(Obstacles(), 2)
    world.reset(3)
    kept = everything(world)
    with pytest.raises((ValueError, TypeError)) as caught:
        world.reset(seeds)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert_same(everything(world), kept)
    assert world.seeds == (3, 4)


@pytest.mark.parametrize("mask", [[True], [True, False, True], [1, 0], np.zeros((2, 1), bool), "yes"])
def test_a_bad_mask_is_refused(mask: Any) -> None:
    world = World(Obstacles(), 2)
    world.reset(3)
    kept = everything(world)
    with pytest.raises(ValueError, match="mask has shape") as caught:
        world.reset(mask=mask)
    assert "\n" not in str(caught.value)
    assert_same(everything(world), kept)


@EVERY
def test_divergence_names_the_world_and_the_agent(row: TaskRow) -> None:
    world = World(row.task, 3)
    world.reset(2)
    world.state.vel[1, 0] = np.nan
    with pytest.raises(
        SimulationDiverged, match=r"world 1, agent 0: .* in the decision that begins in step 1"
    ) as caught:
        world.step(np.zeros((3, world.learners, 2)))
    assert "\n" not in str(caught.value)
    assert (caught.value.world, caught.value.agent, caught.value.dt) == (1, 0, row.task.dt)


@EVERY
def test_a_snapshot_is_a_copy_of_one_world(row: TaskRow) -> None:
    world = World(row.task, 3)
    world.reset(2)
    for a in actions_for(world, 7):
        world.step(a)
    picture = world.snapshot(2)
    np.testing.assert_array_equal(picture.pos, world.state.pos[2])
    np.testing.assert_array_equal(picture.vel, world.state.vel[2])
    assert picture.time == pytest.approx(0.7)
    assert len(picture.roles) == row.task.agents
    kept = picture.pos.copy()
    world.step(actions_for(world, 1)[0])
    np.testing.assert_array_equal(picture.pos, kept)


@pytest.mark.slow
def test_neighbours_in_a_large_flock_are_those_of_brute_force() -> None:
    """Its nearest neighbours are those of brute force."""
    task = Flock(agents=130, learners=130, size=60.0)
    world = World(task, 2)
    world.reset(0)
    before = world.step(np.zeros((2, 130, 2)))
    assert np.isfinite(before.observation).all()
    d = task.scene.space.displacement(world.state.pos[:, :, None], world.state.pos[:, None])
    gaps = np.sqrt((d**2).sum(-1)) + 1e9 * np.eye(130)
    nearest = np.minimum(gaps.min(-1), task.sight).mean(-1)
    np.testing.assert_allclose(world.measure()["nearest_neighbour"], nearest, rtol=1e-9)
