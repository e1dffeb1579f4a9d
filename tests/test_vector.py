"""The native vector environment: numbers and infos equal those of gymnasium's vector of single environments."""

import copy
import itertools
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import (
    ClipAction,
    ClipReward,
    DictInfoToList,
    DtypeObservation,
    FlattenObservation,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
    RescaleAction,
    RescaleObservation,
)

from flockenv.envs.table import ENVIRONMENTS
from flockenv.envs.world import World
from flockenv.tasks import Flock, Pursuit
from tests.catalogue import SINGLE

MODES = list(AutoresetMode)
EASY = {
    "flockenv/Pursuit-v0": {"capture_distance": 6.0},
    "flockenv/Obstacles-v0": {"goal_radius": 20.5},
    "flockenv/Evade-v1": {"capture_distance": 6.0},
    "flockenv/Herd-v0": {"pen_radius": 20.5},
    "flockenv/Crossing-v0": {"goal_radius": 11.8},
    "flockenv/PathFollow-v0": {"lost_distance": 1.5, "max_force": 2.5},
    "flockenv/School-v0": {"start_hunger": 0.6, "metabolism": 0.15},
    "flockenv/Bottleneck-v0": {"people": 4, "room": 2.0, "clear": 0.0, "width": 1.8},
    "flockenv/Corridor-v1": {},  # never terminates
    "flockenv/CrowdNav-v0": {"goal_radius": 11.8},
    "flockenv/Flock-v1": {},  # never terminates
}
"""Parameters with which random actions sometimes end an episode; the time limit ends the others."""


def rows(envs, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *envs.action_space.shape)).astype(np.float32)


def masked(ended, mode):
    return {"reset_mask": ended.copy()} if mode is AutoresetMode.DISABLED and ended.any() else None


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env_id", SINGLE)
def test_results_equal_those_of_gymnasiums_vector_of_single_environments(env_id, mode):
    """Observations, rewards, ends, every info and its mask, over episodes that terminate or are truncated."""
    options = {"max_episode_steps": 40, **EASY[env_id]}
    native = gymnasium.make_vec(env_id, 4, autoreset_mode=mode, **options)
    loop = gymnasium.make_vec(env_id, 4, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options)
    ends = np.zeros(2, int)
    assert data_equivalence(native.reset(seed=11), loop.reset(seed=11), exact=True)
    for row in rows(native, 130):
        ours, theirs = native.step(row), loop.step(row)
        for a, b in zip(ours, theirs, strict=True):
            assert data_equivalence(a, b, exact=True), (a, b)
        ended = ours[2] | ours[3]
        ends += ours[2].sum(), ours[3].sum()
        if masked(ended, mode):
            ours, theirs = native.reset(options=masked(ended, mode)), loop.reset(options=masked(ended, mode))
            assert data_equivalence(ours, theirs, exact=True)
    loop.close()
    native.close()
    assert ends[1] > 0
    assert (ends[0] > 0) == bool(EASY[env_id])


@pytest.mark.parametrize("env_id", SINGLE)
def test_the_default_autoreset_mode_is_that_of_gymnasium(env_id):
    """In the step after an end: it ignores the actions, has no reward and ends no episode."""
    native = gymnasium.make_vec(env_id, 2, max_episode_steps=3)
    loop = gymnasium.make_vec(env_id, 2, max_episode_steps=3, vectorization_mode="sync")
    assert native.metadata["autoreset_mode"] is loop.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    native.reset(seed=4), loop.reset(seed=4)
    for t, row in enumerate(rows(native, 9)):
        ours, theirs = native.step(row), loop.step(row)
        assert data_equivalence(ours, theirs, exact=True)
        if t == 3:
            assert not ours[1].any() and not ours[2].any() and not ours[3].any()
            assert list(ours[4]) == ["seed", "_seed"]


WRAPPERS = {
    "ClipAction": ClipAction,
    "ClipReward": lambda envs: ClipReward(envs, -0.1, 0.1),
    "DtypeObservation": lambda envs: DtypeObservation(envs, np.float64),
    "FlattenObservation": FlattenObservation,
    "NormalizeObservation": NormalizeObservation,
    "NormalizeReward": NormalizeReward,
    "RecordEpisodeStatistics": RecordEpisodeStatistics,
    "RescaleAction": lambda envs: RescaleAction(envs, -2.0, 2.0),
    "RescaleObservation": lambda envs: RescaleObservation(envs, np.float32(0), np.float32(1)),
    "CleanRL's": lambda envs: NormalizeReward(NormalizeObservation(ClipAction(RecordEpisodeStatistics(envs)))),
}
"""Wrappers of gymnasium for vector environments."""


@pytest.mark.filterwarnings("ignore:.*overflow encountered in cast", "ignore:.*precision lowered")  # gymnasium's own
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrappers_give_the_same_results_as_on_the_vector_of_gymnasium(name):
    options = {"max_episode_steps": 7, "capture_distance": 6.0}
    native = WRAPPERS[name](gymnasium.make_vec("flockenv/Pursuit-v0", num_envs=4, **options))
    loop = WRAPPERS[name](gymnasium.make_vec("flockenv/Pursuit-v0", 4, vectorization_mode="sync", **options))
    np.testing.assert_array_equal(native.reset(seed=3)[0], loop.reset(seed=3)[0])
    ends = 0
    for row in rows(native, 30):
        ours, theirs = native.step(row), loop.step(row)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        assert ours[4].keys() == theirs[4].keys()
        for key in ("r", "l"):
            np.testing.assert_array_equal(*(each[4].get("episode", {}).get(key) for each in (ours, theirs)))
        ends += (ours[2] | ours[3]).sum()
    assert ends > 8


@pytest.mark.filterwarnings("ignore:.*overflow encountered in cast", "ignore:.*precision lowered")  # gymnasium's own
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrappers_work_with_several_learners_in_each_world(name):
    envs = WRAPPERS[name](crowd(max_episode_steps=5))
    assert envs.reset(seed=3)[0].shape == (12, *envs.single_observation_space.shape)
    for t, row in enumerate(rows(envs, 13)):
        observation, _, terminated, truncated, _ = envs.step(row)
        assert np.isfinite(observation).all()
        np.testing.assert_array_equal(terminated | truncated, np.full(12, t % 6 == 4))  # 5 steps, then a reset


@pytest.mark.parametrize("mode", MODES)
def test_a_metric_without_a_value_is_left_out(monkeypatch, mode):
    """NaN would make equal infos unequal; in a batch the mask marks the worlds that have a value."""
    write_metrics, k = World._write_metrics, Pursuit.metric_names.index("least_distance")

    def sometimes(self, first, metrics):
        write_metrics(self, first, metrics)
        metrics[k, metrics[k] >= 8.0] = np.nan

    monkeypatch.setattr(World, "_write_metrics", sometimes)
    native = gymnasium.make_vec("flockenv/Pursuit-v0", 4, autoreset_mode=mode, max_episode_steps=30)
    loop = gymnasium.make_vec(
        "flockenv/Pursuit-v0",
        4,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        max_episode_steps=30,
    )
    native.reset(seed=3), loop.reset(seed=3)
    shares = []
    for row in rows(native, 29):
        ours, theirs = native.step(row)[4], loop.step(row)[4]
        assert data_equivalence(ours, theirs, exact=True)
        shares.append(ours.get("_least_distance", np.zeros(4)).mean())
    assert 0 < np.mean(shares) < 1


@pytest.mark.parametrize("env_id", SINGLE)
def test_a_row_of_sixteen_worlds_equals_that_world_alone(env_id):
    many = gymnasium.make_vec(env_id, 16, max_episode_steps=150)
    actions = rows(many, 400)
    picked = (0, 5, 15)
    alone = [gymnasium.make_vec(env_id, 1, max_episode_steps=150) for _ in picked]
    first, _ = many.reset(seed=100)
    for k, env in zip(picked, alone, strict=True):
        np.testing.assert_array_equal(env.reset(seed=100 + k)[0][0], first[k])
    together = [many.step(action)[:4] for action in actions]
    assert not np.shares_memory(together[0][0], together[1][0])
    for k, env in zip(picked, alone, strict=True):
        by_itself = [env.step(action[k : k + 1])[:4] for action in actions]
        for a, b in zip(zip(*by_itself, strict=True), zip(*together, strict=True), strict=True):
            np.testing.assert_array_equal([each[0] for each in a], [each[k] for each in b])


@pytest.mark.parametrize("env_id", SINGLE)
def test_observations_stay_inside_their_space(env_id):
    envs = gymnasium.make_vec(env_id, 8, max_episode_steps=60)
    assert envs.reset(seed=0)[0] in envs.observation_space
    for action in np.sign(rows(envs, 150)):
        observation, reward, terminated, truncated, _ = envs.step(action)
        assert observation in envs.observation_space
        assert reward.dtype == np.float64
        assert terminated.dtype == truncated.dtype == np.bool_


def test_the_default_time_limit_is_that_of_the_id():
    assert gymnasium.make_vec("flockenv/Pursuit-v0", 2).spec.max_episode_steps == ENVIRONMENTS["Pursuit"].horizon
    envs = gymnasium.make_vec("flockenv/Pursuit-v0", 2, max_episode_steps=3)
    envs.reset(seed=0)
    ends = [envs.step(row)[3].tolist() for row in np.zeros((4, *envs.action_space.shape))]
    assert ends == [[False] * 2, [False] * 2, [True] * 2, [False] * 2]


def test_the_end_of_an_episode_is_in_the_infos():
    envs = gymnasium.make_vec("flockenv/Flock-v1", 3, max_episode_steps=5, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=0)
    for row in rows(envs, 5):
        observation, _, _, truncated, info = envs.step(row)
    assert truncated.all()
    assert info["_final_obs"].all()
    assert not any(np.array_equal(info["final_obs"][k], observation[k]) for k in range(3))
    assert info["final_info"]["_is_success"].all()
    assert not any(name.startswith("reward/") for name in info)
    np.testing.assert_array_equal(info["seed"], [0, 1, 2])


def of(info, rows):
    """Return the infos of these rows: other rows are zero, and columns without any of these rows are left out."""
    kept = {}
    for name, mask in info.items():
        if name.startswith("_") and (mask & rows).any():
            column, here = info[name[1:]], mask & rows
            zeros = None if isinstance(column, dict) else np.zeros_like(column)
            kept[name[1:]] = of(column, rows) if zeros is None else np.where(here, column, zeros)
            kept[name] = here
    return kept


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("learners", [1, 3])
def test_infos_can_be_limited_to_rows_that_end(mode, learners):
    """Worlds end in different steps; a row that ends has the same infos as with infos="steps"."""
    options = {"autoreset_mode": mode, "max_episode_steps": 9, "agents": 7, "learners": learners}
    envs, twin = (gymnasium.make_vec("flockenv/Flock-v1", 4 * learners, infos=i, **options) for i in ("ends", "steps"))
    for each in (envs, twin):
        each.reset(seed=2)
        each.world.steps[1:3] = 4  # these worlds end earlier
    silent, reported = 0, 0
    for row in rows(envs, 40):
        ours, theirs = envs.step(row), twin.step(row)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        info, ended = theirs[4], ours[2] | ours[3]
        silent, reported = silent + (not ours[4]), reported + ended.any()
        begun = {name: info[name] for name in ("seed", "_seed") if name in info}
        last = {name: info[name] for name in info if "final" in name}
        rest = {name: info[name] for name in info if name not in begun | last}
        assert ours[4].keys() == (begun | last | of(rest, ended)).keys()
        assert data_equivalence(ours[4], begun | last | of(rest, ended), exact=True)
        if masked(ended, mode):
            for each in (envs, twin):
                each.reset(options=masked(ended, mode))
    assert reported >= 6
    assert silent >= 20


OLD = tuple(map(int, gymnasium.__version__.split(".")[:2])) < (1, 4)
SAME_STEP = pytest.param(
    AutoresetMode.SAME_STEP,
    marks=pytest.mark.skipif(
        OLD, reason="gymnasium 1.2's RecordEpisodeStatistics loses first rewards in SAME_STEP (#1624)"
    ),
)


@pytest.mark.parametrize("mode", [SAME_STEP, AutoresetMode.NEXT_STEP])
def test_statistics_of_gymnasium_are_those_of_the_episodes(mode):
    envs = gymnasium.make_vec("flockenv/Flock-v1", 3, max_episode_steps=10, autoreset_mode=mode)
    envs = DictInfoToList(RecordEpisodeStatistics(envs))
    envs.reset(seed=0)
    total, seen = np.zeros(3), []
    for row in rows(envs, 34):
        _, reward, terminated, truncated, infos = envs.step(row)
        assert not terminated.any()
        total += reward
        if truncated.any():
            seen += [info["episode"]["l"] for info in infos]
            np.testing.assert_allclose([info["episode"]["r"] for info in infos], total)
            total[:] = 0
    assert seen == [10] * 9


@pytest.mark.parametrize("recycle", [0, 2**62], ids=["recycled", "fresh"])
def test_no_buffer_is_shared(monkeypatch, recycle):
    monkeypatch.setattr("flockenv.envs.world.RECYCLE", recycle)
    envs = gymnasium.make_vec("flockenv/Obstacles-v0", 4, max_episode_steps=7)
    kept = [envs.reset(seed=0)[0]]
    copies = [kept[0].copy()]
    outcomes = []
    for row in rows(envs, 20):
        outcomes.append(envs.step(row))
        kept.append(outcomes[-1][0])
        copies.append(kept[-1].copy())
        kept[-2][:] = 5.0
    for before, after in itertools.pairwise(outcomes):
        assert not any(np.shares_memory(a, b) for a, b in zip(before[:4], after[:4], strict=True))
    envs.reset(seed=0)
    for row, copy_ in zip(rows(envs, 20), copies[1:], strict=True):
        np.testing.assert_array_equal(envs.step(row)[0], copy_)


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_like_the_original(clone):
    envs = gymnasium.make_vec("flockenv/Pursuit-v0", 3, max_episode_steps=9)
    envs.reset(seed=1)
    actions = rows(envs, 40)
    for row in actions[:13]:
        envs.step(row)
    twin = clone(envs)
    for row in actions[13:]:
        assert data_equivalence(envs.step(row), twin.step(row), exact=True)


# --- several learners in each world -----------------------------------------------------------------------------------


def crowd(worlds=3, learners=4, **options):
    return gymnasium.make_vec("flockenv/Flock-v1", worlds * learners, agents=7, learners=learners, **options)


@pytest.mark.parametrize("mode", MODES)
def test_rows_are_learners_of_worlds(mode):
    """Row i is learner i % L of world i // L, with the numbers and infos of a World, over several episodes."""
    envs, world = crowd(max_episode_steps=12, autoreset_mode=mode), World(Flock(agents=7, learners=4), 3, time_limit=12)
    assert envs.num_envs == 12
    np.testing.assert_array_equal(envs.reset(seed=9)[0], world.reset(9).reshape(12, -1))
    world.steps[:] = envs.world.steps[:] = [0, 5, 9]  # worlds end one after another
    resting, ends = np.zeros(3, bool), 0
    for row in rows(envs, 40):
        observation, reward, terminated, truncated, info = envs.step(row)
        step = world.step(np.where(np.repeat(resting, 4)[:, None], 0, row).reshape(3, 4, -1))
        ended = step.truncated & ~resting
        rewards = [f"reward/{name}" for name in Flock.terms]
        metrics = world.measure()
        valued = [name for name in world.task.metric_names if not np.isnan(metrics[name]).any()]
        keys = (*rewards, "is_success", *valued)
        last = step.observation.copy()
        ends += ended.sum()
        anew = ended if mode is AutoresetMode.SAME_STEP else resting
        if anew.any():
            world.reset(mask=anew, into=step.observation)
        np.testing.assert_array_equal(observation, step.observation.reshape(12, -1))
        np.testing.assert_array_equal(reward, np.where(resting[:, None], 0, step.reward).reshape(12))
        np.testing.assert_array_equal(truncated, np.repeat(ended, 4))
        assert not terminated.any()
        if mode is AutoresetMode.SAME_STEP and ended.any():
            check_rows(info["final_info"], keys, step, metrics, ended)
            np.testing.assert_array_equal(info["_final_obs"], np.repeat(ended, 4))
            for k in range(12):
                if ended[k // 4]:
                    np.testing.assert_array_equal(info["final_obs"][k], last[k // 4, k % 4])
                else:
                    assert info["final_obs"][k] is None
        check_rows(info, keys, step, metrics, ~anew)
        np.testing.assert_array_equal(info.get("_seed", np.zeros(12)), np.repeat(anew, 4))
        if anew.any():
            np.testing.assert_array_equal(info["seed"], np.repeat(np.where(anew, [9, 10, 11], 0), 4))
        resting = ended if mode is AutoresetMode.NEXT_STEP else np.zeros(3, bool)
        if mode is AutoresetMode.DISABLED and ended.any():
            seen, info = envs.reset(options={"reset_mask": np.repeat(ended, 4)})
            np.testing.assert_array_equal(seen, world.reset(mask=ended).reshape(12, -1))
            np.testing.assert_array_equal(info["seed"], np.repeat(np.where(ended, [9, 10, 11], 0), 4))
    assert ends >= 8


def check_rows(info, keys, step, metrics, worlds):
    """Check that infos of these worlds equal those of the step and the metrics, and that others are zero."""
    here = np.repeat(worlds, 4)
    assert [key for key in keys if key in info] == (list(keys) if worlds.any() else [])
    for key in keys if worlds.any() else ():
        np.testing.assert_array_equal(info[f"_{key}"], here)
        if key.startswith("reward/"):
            column = step.terms[..., Flock.terms.index(key.removeprefix("reward/"))].reshape(12)
        else:
            column = np.repeat(step.success if key == "is_success" else metrics[key], 4)
        np.testing.assert_array_equal(info[key], np.where(here, column, 0))


def test_a_capture_ends_all_rows_of_its_world():
    options = {"pursuers": 2, "capture_distance": 3.0, "autoreset_mode": AutoresetMode.SAME_STEP}
    envs = gymnasium.make_vec("flockenv/Pursuit-v0", 16, **options)
    envs.reset(seed=0)
    ends = 0
    for row in rows(envs, 60):
        _, _, terminated, _, info = envs.step(row)
        pairs = terminated.reshape(8, 2)
        np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])
        if terminated.any():
            np.testing.assert_array_equal(info["final_info"]["is_success"], terminated)
            ends += 1
    assert ends


def test_a_number_of_rows_that_does_not_fill_worlds_is_refused():
    for count, message in ((100, "96 or 128"), (5, "the nearest: 32$"), (33, "32 or 64"), (-5, "the nearest: 32$")):
        with pytest.raises(ValueError, match=rf"^num_envs: {count} rows [^\n]*{message}"):
            gymnasium.make_vec("flockenv/Flock-v1", count, agents=32, learners=32)
    for count in (0, -32, 2.5, "many"):
        with pytest.raises(ValueError, match=r"^worlds is [^\n]*$"):
            gymnasium.make_vec("flockenv/Flock-v1", count, agents=32, learners=32)
    assert gymnasium.make_vec("flockenv/Flock-v1", 64, agents=32, learners=32).world.worlds == 2


def test_tasks_whose_learners_end_one_by_one_are_refused_with_a_hint():
    with pytest.raises(ValueError, match=r"^[^\n]*pettingzoo[^\n]*$"):
        gymnasium.make_vec("flockenv/Pursuit-v0", 5, pursuers=3, evaders=2, sides="both")


def test_rows_of_one_world_share_its_seed():
    envs = crowd()
    first, info = envs.reset(seed=5)
    np.testing.assert_array_equal(info["seed"], np.repeat([5, 6, 7], 4))
    again, _ = envs.reset(seed=[5] * 4 + [6] * 4 + [7] * 4)
    np.testing.assert_array_equal(again, first)
    second, _ = envs.reset()
    envs.reset(seed=5)
    mixed, _ = envs.reset(seed=[None] * 4 + [6] * 4 + [None] * 4)
    np.testing.assert_array_equal(mixed[[*range(4), *range(8, 12)]], second[[*range(4), *range(8, 12)]])
    np.testing.assert_array_equal(mixed[4:8], first[4:8])
    for seeds in ([5] * 4 + [6, 6, 7, 6] + [7] * 4, [5] * 4 + [6, 6, None, 6] + [7] * 4):
        with pytest.raises(ValueError, match=r"^seed: rows 4 and 6 are one world, number 1, and must agree$"):
            envs.reset(seed=seeds)
    with pytest.raises(ValueError, match="3 seeds for 12 rows"):
        envs.reset(seed=[5, 6, 7])


def test_rows_of_one_world_are_reset_together():
    envs = crowd(autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=5)
    kept = envs.step(rows(envs, 1)[0])[0]
    mask = np.repeat([False, True, False], 4)
    seen, info = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(seen[~mask], kept[~mask])
    assert not np.array_equal(seen[mask], kept[mask])
    np.testing.assert_array_equal(info["_seed"], mask)
    mask[11] = True
    with pytest.raises(ValueError, match=r"^options\['reset_mask'\]: rows 8 and 11 are one world, number 2[^\n]*$"):
        envs.reset(options={"reset_mask": mask})


def test_a_bad_action_of_one_of_several_is_named():
    envs = crowd()
    envs.reset(seed=5)
    bad = rows(envs, 1)[0]
    bad[6, 1] = np.nan
    with pytest.raises(ValueError, match="boid_2 in world 1"):
        envs.step(bad)
    assert not envs.world.steps.any()
    with pytest.raises(ValueError, match="one row per learner"):
        envs.step(bad.reshape(3, 4, 2))


def test_statistics_of_gymnasium_work_with_several_learners():
    envs = DictInfoToList(RecordEpisodeStatistics(crowd(max_episode_steps=10, autoreset_mode=AutoresetMode.NEXT_STEP)))
    envs.reset(seed=0)
    total = np.zeros(12)
    for row in rows(envs, 10):
        _, reward, _, truncated, infos = envs.step(row)
        total += reward
    assert truncated.all()
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], total)


# --- resets -----------------------------------------------------------------------------------------------------------


def test_seeds_can_be_a_number_a_list_or_none():
    envs = gymnasium.make_vec("flockenv/Flock-v1", 3)
    by_number = envs.reset(seed=5)
    by_list = envs.reset(seed=[5, 6, 7])
    assert data_equivalence(by_number, by_list, exact=True)
    second = envs.reset()[0]
    envs.reset(seed=[5, 6, 7])
    mixed = envs.reset(seed=[None, 6, None])[0]
    np.testing.assert_array_equal(mixed[[0, 2]], second[[0, 2]])
    np.testing.assert_array_equal(mixed[1], by_number[0][1])
    drawn = gymnasium.make_vec("flockenv/Flock-v1", 3)
    observation, info = drawn.reset()
    assert data_equivalence(envs.reset(seed=info["seed"].tolist())[0], observation, exact=True)
    assert len(set(info["seed"].tolist())) == 3


def test_a_masked_reset_does_not_change_other_worlds():
    options = {"autoreset_mode": AutoresetMode.DISABLED}
    envs, twin = (gymnasium.make_vec("flockenv/Flock-v1", 3, **options) for _ in range(2))
    actions = rows(envs, 10)
    envs.reset(seed=0), twin.reset(seed=0)
    for row in actions[:4]:
        before = envs.step(row)[0]
        twin.step(row)
    mask = np.array([False, True, False])
    given = {"reset_mask": mask}
    after, info = envs.reset(options=given)
    assert given == {"reset_mask": mask}
    np.testing.assert_array_equal(after[~mask], before[~mask])
    np.testing.assert_array_equal(info["_seed"], mask)
    for row in actions[4:]:
        np.testing.assert_array_equal(envs.step(row)[0][~mask], twin.step(row)[0][~mask])
    seeded, _ = envs.reset(seed=0, options={"reset_mask": mask})
    np.testing.assert_array_equal(seeded[mask], twin.reset(seed=0)[0][mask])


def test_without_autoreset_ended_worlds_need_a_reset():
    envs = gymnasium.make_vec("flockenv/Flock-v1", 2, max_episode_steps=2, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    row = np.zeros(envs.action_space.shape)
    envs.step(row)
    ended = envs.step(row)[3]
    with pytest.raises(ResetNeeded, match="world 0"):
        envs.step(row)
    envs.reset(options={"reset_mask": ended})
    envs.step(row)


def test_actions_in_the_step_of_an_autoreset_are_ignored():
    envs = gymnasium.make_vec("flockenv/Flock-v1", 2, max_episode_steps=2, autoreset_mode=AutoresetMode.NEXT_STEP)
    envs.reset(seed=0)
    row = np.zeros(envs.action_space.shape)
    envs.step(row), envs.step(row)
    _, reward, _, truncated, info = envs.step(row * np.nan)
    assert not truncated.any()
    assert not reward.any()
    assert info["_seed"].all()
    with pytest.raises(ValueError, match="world 0"):
        envs.step(row * np.nan)


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mask",
    [[True, False], np.array([1, 0]), np.array([True]), np.zeros(2, bool)],
    ids=["list", "int", "short", "empty"],
)
def test_bad_masks_are_refused(mask):
    envs = gymnasium.make_vec("flockenv/Flock-v1", 2)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask"):
        envs.reset(options={"reset_mask": mask})


def test_the_first_reset_must_reset_all_worlds():
    envs = gymnasium.make_vec("flockenv/Flock-v1", 2)
    with pytest.raises(ValueError, match="first reset"):
        envs.reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize(
    ("seed", "kind"), [(-1, ValueError), ("a", TypeError), ([1], ValueError), ([1, -1], ValueError)]
)
def test_bad_seeds_are_refused(seed, kind):
    with pytest.raises(kind, match="seed"):
        gymnasium.make_vec("flockenv/Flock-v1", 2).reset(seed=seed)


def test_bad_options_actions_and_modes_are_refused():
    envs = gymnasium.make_vec("flockenv/Flock-v1", 2)
    with pytest.raises(ValueError, match="`reset_mask`"):
        envs.reset(options={"reset_maks": np.array([True, False])})
    with pytest.raises(ResetNeeded, match="reset"):
        envs.step(np.zeros(envs.action_space.shape))
    envs.reset(seed=0)
    bad = np.zeros(envs.action_space.shape)
    bad[1, 0] = np.nan
    with pytest.raises(ValueError, match="world 1"):
        envs.step(bad)
    with pytest.raises(ValueError, match="shape"):
        envs.step(bad[0])
    with pytest.raises(ValueError, match="render_mode"):
        gymnasium.make_vec("flockenv/Flock-v1", 2, render_mode="human")
    with pytest.raises(ValueError, match="`SameStep`"):
        gymnasium.make_vec("flockenv/Flock-v1", 2, autoreset_mode="samestep")
    with pytest.raises(ValueError, match="infos: 'end' is unknown, did you mean `ends`"):
        gymnasium.make_vec("flockenv/Flock-v1", 2, infos="end")
    with pytest.raises(ValueError, match="worlds"):
        gymnasium.make_vec("flockenv/Flock-v1", 0)
    envs.close()
    envs.close()


def test_render_returns_one_picture_per_world():
    envs = gymnasium.make_vec("flockenv/Flock-v1", 2, render_mode="rgb_array")
    envs.reset(seed=0)
    first, second = envs.render()
    assert first.shape == second.shape
    assert first.dtype == np.uint8
    assert not np.array_equal(first, second)
    several = crowd(worlds=2, render_mode="rgb_array")
    several.reset(seed=0)
    assert len(several.render()) == 2
