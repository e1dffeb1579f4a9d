"""Disturbances: their distribution, what they leave as it is, and the same bits for any batch, thread and process."""

from __future__ import annotations

import copy
import functools
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from scipy.special import ndtri
from typer.testing import CliRunner

from agents.compare import app, compare
from agents.experiment import Experiment, PpoSettings
from agents.run import recipe_of
from flockenv.envs.disturbance import Disturbance, DisturbedWorld, make_world
from flockenv.envs.world import World
from flockenv.evaluation import report, rollout
from flockenv.jit.decorators import python_of
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.maths import counter_rng
from flockenv.players import load_player
from flockenv.players.rules import PLAYERS, player
from flockenv.studies.play_jobs import Player, play_job
from flockenv.tasks import TASKS, Crossing, Herd, Layout, Obstacles, PathFollow, Pursuit, Slot, Task

CROSSING = Crossing(agents=8)
FULL = Disturbance(noise=0.3, delay=3, dropped=0.3, range=5, seen=4)
EVERY = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in ("pursuit", "herd") else pytest.mark.slow) for name in TASKS]
)
"""All tasks; those of the default run have kernels that compile fast."""
SIGHT = Disturbance(noise=0.1, dropped=0.2)


def actions_of(task: Task, worlds: int, count: int = 12) -> NDArray[np.float64]:
    return np.random.default_rng(3).uniform(-1, 1, (count, worlds, task.learners, task.action_layout.size))


def play(world: World, actions: NDArray[Any], seed: int) -> list[NDArray[np.float32]]:
    """Return all observations of an episode from its first on, and of the next episode's start."""
    rows = [world.reset(seed), *(world.step(action).observation for action in actions)]
    return [*rows, world.reset()]


# --- what is disturbed --------------------------------------------------------------------------------------------


def test_without_a_disturbance_the_world_is_a_plain_one() -> None:
    assert type(make_world(Pursuit())) is World
    assert type(gymnasium.make("flockenv/Pursuit-v0", noise=0, delay=0).unwrapped.world) is World  # type: ignore[attr-defined]
    for field in ("noise", "delay", "dropped"):
        assert isinstance(make_world(Pursuit(), disturbance=Disturbance(**{field: 1})), DisturbedWorld)


def test_only_observations_change_without_delay() -> None:
    plain, disturbed = World(CROSSING, 3), make_world(CROSSING, 3, disturbance=SIGHT)
    assert not np.array_equal(plain.reset(5), disturbed.reset(5))
    for action in actions_of(CROSSING, 3):
        one, two = plain.step(action), disturbed.step(action)
        assert not np.array_equal(one.observation, two.observation)
        for a, b in zip(one[1:], two[1:], strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(plain.state.pos, disturbed.state.pos)
        assert plain.metrics(1) == disturbed.metrics(1)


def test_noise_is_normal_on_numbers_that_are_not_zero() -> None:
    task, sigma = Obstacles(), 0.02
    seen, noisy = (
        w.reset(0) for w in (World(task, 4000), make_world(task, 4000, disturbance=Disturbance(noise=sigma)))
    )
    assert (noisy[seen == 0] == 0).all()
    inside = (seen > 6 * sigma - 1) & (seen < 1 - 6 * sigma) & (seen != 0)
    inside &= (seen > 6 * sigma) | (task.layout.low < 0)
    z = (noisy - seen)[inside].astype(float) / sigma
    n = z.size
    assert n > 50_000
    assert abs(z.mean()) < 4 / n**0.5
    assert abs(z.var() - 1) < 4 * (2 / n) ** 0.5
    assert abs((z**4).mean() - 3) < 4 * (96 / n) ** 0.5
    assert abs(np.mean(abs(z) > 1.959964) - 0.05) < 4 * (0.05 / n) ** 0.5


def test_quick_normal_is_the_quantile_function_of_the_uniform_number(monkeypatch: pytest.MonkeyPatch) -> None:
    quantile = python_of(counter_rng.quick_normal)
    for p in (2.0**-53, 1e-12, 1e-8, 0.01, 0.0749, 0.0751, 0.3, 0.5, 0.7, 0.9249, 0.9251, 0.99, 1 - 1e-9, 1 - 2.0**-53):
        monkeypatch.setattr(counter_rng, "uniform", lambda *of, p=p: p)
        assert quantile(0, 0, 0, 0) == pytest.approx(ndtri(p), rel=3e-7, abs=1e-12)
    monkeypatch.setattr(counter_rng, "uniform", lambda *of: 0.0)
    assert quantile(0, 0, 0, 0) == pytest.approx(ndtri(2.0**-54), rel=3e-7)


def noise_of(disturbed: World, plain: World, zero: NDArray[Any]) -> NDArray[np.float64]:
    """Return the noise of a decision on numbers that are well within their bounds, NaN on others."""
    noisy, seen = (world.step(zero).observation.astype(float) for world in (disturbed, plain))
    return np.where((abs(seen) < 0.9) & (seen != 0) & (plain.task.layout.low < 0), noisy - seen, np.nan)


def test_noise_is_independent_between_numbers_learners_decisions_episodes_and_worlds() -> None:
    both = make_world(CROSSING, 40, disturbance=Disturbance(noise=0.01)), World(CROSSING, 40)
    episodes = []
    for seed in (7, None):
        for world in both:
            world.reset(seed)
        episodes.append([noise_of(*both, np.zeros((40, CROSSING.learners, 2))) for _ in range(3)])
    noise = np.array(episodes)  # (episode, decision, world, learner, number)
    for axis in range(5):
        first, second = (
            np.take(noise, k + (2 if axis == 4 else 0), axis).ravel() for k in (0, 1)
        )  # goal, not velocity
        there = np.isfinite(first * second)
        assert there.sum() > 200
        assert abs(np.corrcoef(first[there], second[there])[0, 1]) < 4 / there.sum() ** 0.5


@EVERY
def test_dropped_entities_have_the_numbers_of_an_empty_slot(name: str) -> None:
    task = TASKS[name]()
    entities = task.layout.entities
    if name == "path_follow":
        with pytest.raises(ValueError, match="must be 0 for path_follow"):
            make_world(task, 30, disturbance=Disturbance(dropped=0.4))
        return
    seen = World(task, 30).reset(1).reshape(-1, task.layout.size)
    found = make_world(task, 30, disturbance=Disturbance(dropped=0.4)).reset(1).reshape(seen.shape)
    np.testing.assert_array_equal(found[:, entities < 0], seen[:, entities < 0])
    there = dropped = 0
    for entity in range(entities.max() + 1):
        its = entities == entity
        gone, was = (found[:, its] == 0).all(axis=1), (seen[:, its] != 0).any(axis=1)
        np.testing.assert_array_equal(found[~gone][:, its], seen[~gone][:, its])
        there, dropped = there + was.sum(), dropped + (gone & was).sum()
    assert abs(dropped / there - 0.4) < 4 * (0.24 / there) ** 0.5


def test_the_slots_of_an_entity_share_its_index() -> None:
    layout = Layout((
        Slot("own", (2,), 1.0, "1", ""), Slot("a", (2, 2), 1.0, "m", "", entity="x"),
        Slot("b", (1,), 1.0, "m", "", entity="y"), Slot("c", (2,), 1.0, "m", "", entity="x"),
        Slot("d", (2,), 1.0, "m", "", entity="x", nearest=True),
    ))  # fmt: skip
    assert layout.entities.tolist() == [-1, -1, 0, 0, 1, 1, 2, 0, 1, 0, 0]


def test_the_direction_of_the_nearest_sheep_is_dropped_with_it() -> None:
    places, rows = Herd().layout.places, make_world(Herd(), 50, disturbance=Disturbance(dropped=0.5)).reset(0)[:, 0]
    without = rows[:, places["sheep_present"]] == 0
    assert 0 < without.sum() < 50
    assert (rows[without][:, places["bearing"] : places["bearing"] + 2] == 0).all()
    assert (rows[~without][:, places["bearing"] : places["bearing"] + 2] != 0).any(axis=1).all()


# --- agents that are out of range, or too many ---------------------------------------------------------------------


def offsets_of(task: Task, rows: NDArray[Any], kind: str) -> NDArray[np.float64]:
    """Return the offsets of the agents of a kind, (R, slots, 2), m."""
    return np.asarray(getattr(task.layout.unpack(rows.reshape(-1, task.layout.size)), kind))


LIMITED = ("bottleneck", "corridor", "crossing", "crowd_nav", "flock", "herd", "school")
"""Tasks with slots for several agents of a kind; each has the kind of its first list of agents here."""
KINDS = {"herd": "sheep", "school": "mates"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in ("crossing", "herd") else pytest.mark.slow) for name in LIMITED]
)
def test_agents_out_of_range_and_all_but_the_nearest_have_empty_slots(name: str) -> None:
    task, kind = TASKS[name](), KINDS.get(name, "neighbours")
    plain = World(task, 30).reset(3).reshape(-1, task.layout.size)
    offsets, entities = offsets_of(task, plain, kind), task.layout.entities
    distance, there = np.hypot(*np.moveaxis(offsets, -1, 0)), (offsets != 0).any(axis=-1)
    reach = float(np.median(distance[there]))
    first = entities[task.layout.places[kind]]
    place = np.arange(offsets.shape[1])
    many = np.broadcast_to(place >= 2, there.shape)
    for limit, hidden in (({"range": reach}, distance > reach), ({"seen": 2}, many)):
        rows = make_world(task, 30, disturbance=Disturbance(**limit)).reset(3).reshape(plain.shape)
        assert (hidden & there).any() and (~hidden & there).any()
        for k in place:
            columns = entities == first + k
            assert (rows[hidden[:, k]][:, columns] == 0).all()
            np.testing.assert_array_equal(rows[~hidden[:, k]][:, columns], plain[~hidden[:, k]][:, columns])
        of_agents = np.isin(entities, np.flatnonzero(task.layout.agent_slots[0] >= 0))
        np.testing.assert_array_equal(rows[:, ~of_agents], plain[:, ~of_agents])  # food and obstacles too


def test_range_is_that_of_the_true_distance_and_hides_no_more_with_noise() -> None:
    near, both = Disturbance(range=4.6), Disturbance(range=4.6, noise=0.2)
    plain, noisy = (make_world(CROSSING, 40, disturbance=each).reset(0) for each in (near, both))
    assert 0 < np.count_nonzero(plain[..., -6:]) < plain[..., -6:].size
    np.testing.assert_array_equal(plain != 0, noisy != 0)


def test_a_sensor_has_the_rules_act_on_fewer_agents() -> None:
    rows = _observed(CROSSING)
    far = np.where(np.isin(CROSSING.layout.entities, [2, 3, 4, 5]), 0.0, rows)
    assert (player(CROSSING).predict(far)[0] != player(CROSSING).predict(rows)[0]).any()
    fields = Disturbance(seen=2), Disturbance()
    returns = [
        rollout(CROSSING, player(CROSSING), 4, 0, make_world=functools.partial(make_world, disturbance=each)).returns
        for each in fields
    ]
    assert (returns[0] != returns[1]).all()


@pytest.mark.parametrize(
    ("name", "limit", "message"),
    [
        ("crossing", {"range": 6}, "range = 6: must be < 6 for crossing, which shows other agents up to 6 m away"),
        ("crossing", {"seen": 6}, "seen = 6: must be < 6 for crossing, which has slots for 6 agents of a kind"),
        ("school", {"seen": 3}, "seen = 3: must be < 3 for school, which has slots for 3 agents of a kind"),
        ("pursuit", {"seen": 1}, "seen = 1: must be None for pursuit, which has slots for 1 agent of a kind"),
        ("evade", {"range": 3}, "range = 3: must be None for evade, which has no slots of other agents to empty"),
        ("obstacles", {"seen": 2}, "seen = 2: must be None for obstacles, which has no slots of other agents to empty"),
        ("path_follow", {"range": 1}, "range = 1: must be None for path_follow, which has no slots of other agents"),
    ],
)
def test_a_limit_that_hides_no_agent_is_refused(name: str, limit: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match="must be") as caught:
        make_world(TASKS[name](), disturbance=Disturbance(**limit))
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


def test_records_without_a_limit_are_those_from_before_there_were_any() -> None:
    assert Disturbance(noise=0.1).model_dump() == {"noise": 0.1, "delay": 0, "dropped": 0.0}
    assert Disturbance(range=2, seen=1).model_dump(exclude_defaults=True) == {"range": 2, "seen": 1}


# --- late actions -----------------------------------------------------------------------------------------------------


def test_late_actions_equal_the_same_actions_shifted() -> None:
    plain, late = World(CROSSING, 2), make_world(CROSSING, 2, disturbance=Disturbance(delay=3))
    actions = actions_of(CROSSING, 2)
    np.testing.assert_array_equal(plain.reset(2), late.reset(2))
    for n, action in enumerate(actions):
        due = actions[n - 3] if n >= 3 else np.zeros_like(action)
        np.testing.assert_array_equal(plain.step(due).observation, late.step(action).observation)


def test_a_reset_world_forgets_its_pending_actions_and_others_keep_theirs() -> None:
    worlds, alone = (make_world(Pursuit(), n, disturbance=Disturbance(delay=3)) for n in (2, 1))
    actions = actions_of(Pursuit(), 2)
    expected = play(make_world(Pursuit(), 1, disturbance=Disturbance(delay=3)), actions[:, 1:], 3)
    worlds.reset(2)
    for action in actions[:5]:
        rows = worlds.step(action).observation
    worlds.reset(mask=[True, False], into=rows)
    alone.reset(2)
    np.testing.assert_array_equal(rows[0], alone.reset()[0])
    for n, action in enumerate(actions[5:], start=6):
        rows = worlds.step(action).observation
        np.testing.assert_array_equal(rows[0], alone.step(action[:1]).observation[0])
        np.testing.assert_array_equal(rows[1], expected[n][0])


def test_an_invalid_action_is_refused_at_once_and_changes_nothing() -> None:
    world = make_world(Pursuit(), 2, disturbance=Disturbance(noise=0.3, delay=3, dropped=0.3, range=5))
    with pytest.raises(RuntimeError, match="step before the first reset"):
        world.step(np.zeros((2, 1, 2)))
    world.reset(0)
    world.step(np.ones((2, 1, 2)))
    before = {name: array.copy() for name, array in world.arrays().items()}
    with pytest.raises(ValueError, match="action 1 of pursuer_0 in world 1 is nan"):
        world.step(np.array([[[0, 0]], [[0, np.nan]]]))
    with pytest.raises(ValueError, match="actions have shape"):
        world.step(np.zeros((1, 1, 2)))
    for name, array in world.arrays().items():
        np.testing.assert_array_equal(array, before[name])


# --- the same bits ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])  # another kernel
def test_a_world_of_a_batch_equals_that_world_alone_for_any_number_of_threads(dtype: str) -> None:
    task, before = Crossing(agents=8, dtype=dtype), threads()
    actions = actions_of(task, 5)
    rows = []
    try:
        for count in (1, 2):
            use_threads(count)
            rows.append(play(make_world(task, 5, disturbance=FULL), actions, 11))
    finally:
        use_threads(before)
    np.testing.assert_array_equal(np.array(rows[0]), np.array(rows[1]))
    for k in (0, 3):
        alone = play(make_world(task, 1, disturbance=FULL), actions[:, k : k + 1], 11 + k)
        np.testing.assert_array_equal(np.array(alone)[:, 0], np.array(rows[0])[:, k])


def _continue(world: World, actions: NDArray[Any]) -> NDArray[np.float32]:
    return np.array([world.step(action).observation for action in actions])


def test_copies_and_restored_worlds_continue_with_the_same_bits() -> None:
    actions, world = actions_of(CROSSING, 2), make_world(CROSSING, 2, disturbance=FULL)
    play(world, actions[:5], 1)
    world.step(actions[0])
    others = [copy.deepcopy(world), pickle.loads(pickle.dumps(world)), make_world(CROSSING, 2, disturbance=FULL)]
    others[2].reset(9)
    others[2].restore(world.arrays())
    expected = _continue(world, actions)
    for other in others:
        np.testing.assert_array_equal(_continue(other, actions), expected)


@pytest.mark.slow
def test_another_process_computes_the_same_bits() -> None:
    actions, world = actions_of(CROSSING, 2), make_world(CROSSING, 2, disturbance=FULL)
    world.reset(1)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        other = pool.submit(_continue, world, actions).result()
    np.testing.assert_array_equal(other, _continue(world, actions))


def test_a_masked_reset_disturbs_only_the_worlds_that_it_resets() -> None:
    world, whole = (make_world(CROSSING, 3, disturbance=FULL) for _ in range(2))
    action = actions_of(CROSSING, 3)[0]
    for each in (world, whole):
        each.reset(4)
    rows = world.step(action).observation
    expected = whole.step(action).observation
    mask = np.array([False, True, False])
    world.reset(mask=mask, into=rows)
    np.testing.assert_array_equal(rows[~mask], expected[~mask])
    np.testing.assert_array_equal(whole.reset(mask=mask), rows)  # a new array holds the others' rows again


# --- environments -----------------------------------------------------------------------------------------------------


@EVERY
def test_observations_stay_in_their_space_under_the_greatest_noise(name: str) -> None:
    task = TASKS[name]()
    world = make_world(task, 20, disturbance=Disturbance(noise=1.0, delay=20))
    rows = [world.reset(0), *(world.step(action).observation for action in actions_of(task, 20, 3))]
    for row in rows:
        assert ((row >= task.layout.low) & (row <= task.layout.high)).all()


SEVERAL: dict[str, dict[str, Any]] = {"pursuit": {"evaders": 3}, "school": {"hunters": 3, "fish": 12}}
"""Arguments with which a task observes several agents of each kind."""
FLAGS = ("_present", "_radius", "food_bearing")
"""Ends of the names of slots that are 0 if there is no entity."""


@pytest.mark.parametrize("name", [name for name in TASKS if name != "path_follow"])
def test_rules_act_as_if_an_undetected_entity_were_absent(name: str) -> None:
    task = TASKS[name](**SEVERAL.get(name, {}))
    rows, entities, flags = _observed(task), task.layout.entities, _are_flags(task)
    for base in [base for base in PLAYERS if name in PLAYERS[base]]:
        rules = player(task, base)
        for k in range(entities.max() + 1):
            action, _ = rules.predict(np.where(entities == k, 0.0, rows))
            for absent in (_without(task, rows, k), np.where(flags & (entities == k), 0.0, rows)):
                expected, _ = rules.predict(absent)
                np.testing.assert_allclose(action, expected, atol=1e-5, err_msg=f"{base}, entity {k}")


def _observed(task: Task) -> NDArray[np.float64]:
    """Return observations in which every slot is occupied, (R, O); their numbers are random."""
    rows = np.random.default_rng(0).uniform(task.layout.low, 1.0, (300, task.layout.size)) ** 3  # many are near
    present = np.concatenate([np.full(slot.size, slot.name.endswith("_present")) for slot in task.layout.slots])
    return np.where(present, 1.0, rows)


def _are_flags(task: Task) -> NDArray[np.bool_]:
    """Return True for the numbers of a row, (O,), that are 0 if there is no entity."""
    return np.concatenate([np.full(slot.size, slot.name.endswith(FLAGS)) for slot in task.layout.slots])


def _without(task: Task, rows: NDArray[Any], k: int) -> NDArray[np.float64]:
    """Return rows without entity k: those after it in the list of its kind move up, and the last slot is empty."""
    found, entities = np.array(rows, np.float64), task.layout.entities
    for slot in task.layout.slots:
        columns = task.layout.places[slot.name] + np.arange(slot.size)
        here = entities[columns] == k
        if here.any():
            left = found[:, columns[~here]]
            found[:, columns] = np.concatenate([left, np.zeros((len(rows), here.sum()))], axis=1)
    return found


def test_a_pursuer_that_detects_no_quarry_keeps_its_velocity() -> None:
    rows = make_world(Pursuit(), 20, disturbance=Disturbance(dropped=1.0)).reset(0)[:, 0]
    rows[:, :2] = 0.5
    assert (player(Pursuit()).predict(rows)[0] == 0.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(TASKS))
def test_rules_return_finite_actions_under_a_disturbance(name: str) -> None:
    task = TASKS[name](horizon=60)
    disturbance = Disturbance(noise=0.2, delay=1, dropped=0.0 if name == "path_follow" else 0.4)
    make = functools.partial(make_world, disturbance=disturbance)
    episodes = rollout(task, load_player("rules", task, 0), 8, 0, make_world=make)
    assert np.isfinite(episodes.returns).all()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_autoreset_begins_with_no_pending_actions_and_returns_the_last_observation(mode: AutoresetMode) -> None:
    kwargs: dict[str, Any] = {"noise": 0.2, "delay": 4}
    envs = gymnasium.make_vec("flockenv/Obstacles-v0", 2, max_episode_steps=6, autoreset_mode=mode, **kwargs)
    alone = gymnasium.make("flockenv/Obstacles-v0", max_episode_steps=6, **kwargs)
    envs.reset(seed=3)
    alone.reset(seed=4)
    actions = actions_of(Obstacles(), 2, 14)[:, :, 0].astype(np.float32)
    for action in actions[:6]:
        rows, _, _, truncated, info = envs.step(action)
        last = alone.step(action[1])[0]
    assert truncated.all()
    if mode is AutoresetMode.SAME_STEP:
        np.testing.assert_array_equal(info["final_obs"][1], last)
    else:
        np.testing.assert_array_equal(rows[1], last)
    if mode is AutoresetMode.NEXT_STEP:
        rows = envs.step(np.ones_like(actions[0]))[0]
    if mode is AutoresetMode.DISABLED:
        rows = envs.reset(options={"reset_mask": np.ones(2, np.bool_)})[0]
    np.testing.assert_array_equal(rows[1], alone.reset()[0])
    for action in actions[6:11]:
        np.testing.assert_array_equal(envs.step(action)[0][1], alone.step(action[1])[0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noise": 2}, "Disturbance: noise = 2: must be a number >= 0 and <= 1"),
        ({"delay": 1.5}, "Disturbance: delay = 1.5: must be an integer >= 0 and <= 20"),
        ({"dropped": -0.1}, "Disturbance: dropped = -0.1: must be a number >= 0 and <= 1"),
        ({"range": 0}, "Disturbance: range = 0: must be a number > 0"),
        ({"seen": 0}, "Disturbance: seen = 0: must be an integer >= 1"),
        ({"nois": 0.1}, "unexpected keyword argument 'nois', did you mean `noise`?"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError)) as caught:
        gymnasium.make("flockenv/Pursuit-v0", **arguments)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_dropping_is_refused_for_a_task_that_observes_no_entities() -> None:
    with pytest.raises(ValueError, match=r"dropped = 0\.1: must be 0 for path_follow"):
        make_world(PathFollow(), disturbance=Disturbance(dropped=0.1))


# --- comparisons and training -----------------------------------------------------------------------------------------


def test_a_disturbance_is_part_of_a_job_s_key_and_none_leaves_it_as_it_was() -> None:
    player, given = Player.of("random"), (None, Disturbance(), Disturbance(noise=0.1))
    jobs = [play_job("compare", Pursuit(), player, 2, 0, disturbance=disturbance) for disturbance in given]
    assert jobs[0].key == jobs[1].key != jobs[2].key
    assert "disturbance" not in jobs[0].about
    with pytest.raises(ValueError, match=r"dropped = 0\.1: must be 0 for path_follow"):
        play_job("compare", PathFollow(), player, 2, 0, disturbance=Disturbance(dropped=0.1))


def test_a_comparison_refuses_a_limit_that_hides_no_agent_before_it_plays(tmp_path: Path) -> None:
    options = ["--tasks", "crossing", "--players", "random", "--worlds", "2", "--out", str(tmp_path / "out")]
    for limit, text in ((["--range", "6"], "range = 6: must be < 6"), (["--seen", "7"], "seen = 7: must be < 6")):
        run = CliRunner().invoke(app, [*options, *limit])
        assert run.exit_code == 2 and text in run.output and len(run.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_comparison_is_played_under_its_disturbance_and_names_it() -> None:
    tasks, players, disturbance = [Pursuit(horizon=20)], [Player.of("rules")], Disturbance(noise=0.1, delay=2)
    results, episodes = compare(tasks, players, 4, resamples=10, disturbance=disturbance)
    plain, undisturbed = compare(tasks, players, 4, resamples=10)
    with_noise, without = (each["pursuit"]["rules"] for each in (episodes, undisturbed))
    assert all((one.returns != without[seed].returns).all() for seed, one in with_noise.items())
    assert results["disturbance"] == {"noise": 0.1, "delay": 2, "dropped": 0.0}
    assert report.conditions(results) == "4 worlds per task, noise 0.1, delay 2"
    assert report.conditions(plain) == "4 worlds per task"


def test_a_recipe_names_its_disturbance_and_none_leaves_it_as_it_was() -> None:
    settings = PpoSettings(disturbance={"noise": 0.05})
    assert "disturbance" not in recipe_of(Experiment(task="pursuit"))["ppo"]
    recipe = recipe_of(Experiment(task="pursuit", ppo=settings))
    assert recipe["ppo"]["disturbance"] == {"noise": 0.05, "delay": 0, "dropped": 0.0}
    assert PpoSettings(**recipe["ppo"]) == settings


def test_noise_does_not_depend_on_what_is_dropped() -> None:
    """The noise of numbers of detected entities has mean 0, whichever other entities are dropped."""
    task = Crossing()
    seeds, both = 400, Disturbance(noise=0.02, dropped=0.3)
    plain = World(task, seeds).reset(0)
    seen = make_world(task, seeds, disturbance=both).reset(0)
    entity, noise, checked = task.layout.entities, (seen - plain) / 0.02, 0
    free = (np.abs(plain) < 0.9) & (plain != 0) & (seen != 0)
    for k in range(int(entity.max()) + 1):
        if entity[k] != k and (entity == k).any():
            dropped = (seen[..., entity == k] == 0).all(axis=-1)
            values = noise[..., k][dropped & free[..., k]]
            assert len(values) == 0 or abs(values.mean()) < 5 / np.sqrt(len(values))
            checked += len(values)
    assert checked > 500
