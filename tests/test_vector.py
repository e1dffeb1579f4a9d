"""The native vector face: number for number and info for info what gymnasium makes of many single environments."""

import copy
import itertools
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from flockenv.envs.registration import HORIZONS, SINGLE
from flockenv.tasks import Pursuit

MODES = list(AutoresetMode)
EASY = {
    "flockenv/Pursuit-v0": {"capture_distance": 6.0},
    "flockenv/Obstacles-v0": {"goal_radius": 20.5},
    "flockenv/Flock-v0": {},  # nobody ever terminates there
}
"""Parameters under which random actions sometimes end an episode, and the clock ends the others."""


def rows(envs, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *envs.action_space.shape)).astype(np.float32)


def masked(ended, mode):
    return {"reset_mask": ended.copy()} if mode is AutoresetMode.DISABLED and ended.any() else None


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env_id", SINGLE)
def test_it_is_gymnasium_s_own_vector_of_singles(env_id, mode):
    """Observations, rewards, ends, every info and its mask, over episodes that end by the clock and by themselves."""
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


@pytest.mark.parametrize("mode", MODES)
def test_a_metric_without_a_value_is_left_out(monkeypatch, mode):
    """NaN would make equal infos unequal; in a batch its mask says which worlds have none."""
    metrics = Pursuit.metrics

    def sometimes(self, sums, last, steps):
        numbers = metrics(self, sums, last, steps)
        return numbers | {"least_distance": np.where(last["distance"] < 8.0, last["distance"], np.nan)}

    monkeypatch.setattr(Pursuit, "metrics", sometimes)
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
def test_a_row_of_sixteen_is_that_world_alone(env_id):
    many = gymnasium.make_vec(env_id, 16, max_episode_steps=150)
    actions = rows(many, 1000)
    picked = (0, 5, 15)
    alone = [gymnasium.make_vec(env_id, 1, max_episode_steps=150) for _ in picked]
    first, _ = many.reset(seed=100)
    for k, env in zip(picked, alone, strict=True):
        np.testing.assert_array_equal(env.reset(seed=100 + k)[0][0], first[k])
    for action in actions:
        outcome = many.step(action)
        for k, env in zip(picked, alone, strict=True):
            for a, b in zip(env.step(action[k : k + 1])[:4], outcome[:4], strict=True):
                np.testing.assert_array_equal(a[0], b[k])


@pytest.mark.parametrize("env_id", SINGLE)
def test_observations_stay_inside_their_space(env_id):
    envs = gymnasium.make_vec(env_id, 8, max_episode_steps=60)
    assert envs.reset(seed=0)[0] in envs.observation_space
    for action in np.sign(rows(envs, 150)):
        observation, reward, terminated, truncated, _ = envs.step(action)
        assert observation in envs.observation_space
        assert reward.dtype == np.float64
        assert terminated.dtype == truncated.dtype == np.bool_


def test_time_limit_is_the_id_s_unless_said_otherwise():
    assert gymnasium.make_vec("flockenv/Pursuit-v0", 2).spec.max_episode_steps == HORIZONS["Pursuit"]
    envs = gymnasium.make_vec("flockenv/Pursuit-v0", 2, max_episode_steps=3)
    envs.reset(seed=0)
    ends = [envs.step(row)[3].tolist() for row in np.zeros((4, *envs.action_space.shape))]
    assert ends == [[False] * 2, [False] * 2, [True] * 2, [False] * 2]


def test_the_end_of_an_episode_is_in_the_infos():
    envs = gymnasium.make_vec("flockenv/Flock-v0", 3, max_episode_steps=5)
    envs.reset(seed=0)
    for row in rows(envs, 5):
        observation, _, _, truncated, info = envs.step(row)
    assert truncated.all()
    assert info["_final_obs"].all()
    assert not any(np.array_equal(info["final_obs"][k], observation[k]) for k in range(3))
    assert info["final_info"]["_is_success"].all()
    assert "terms" not in info
    np.testing.assert_array_equal(info["seed"], [0, 1, 2])


OLD = tuple(map(int, gymnasium.__version__.split(".")[:2])) < (1, 4)
SAME_STEP = pytest.param(
    AutoresetMode.SAME_STEP,
    marks=pytest.mark.skipif(
        OLD, reason="gymnasium 1.2's RecordEpisodeStatistics loses first rewards in SAME_STEP (#1624)"
    ),
)


@pytest.mark.parametrize("mode", [SAME_STEP, AutoresetMode.NEXT_STEP])
def test_gymnasium_s_wrappers_work_on_it(mode):
    envs = gymnasium.make_vec("flockenv/Flock-v0", 3, max_episode_steps=10, autoreset_mode=mode)
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


def test_no_buffer_is_shared():
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
def test_a_copy_goes_on_as_the_original_would(clone):
    envs = gymnasium.make_vec("flockenv/Pursuit-v0", 3, max_episode_steps=9)
    envs.reset(seed=1)
    actions = rows(envs, 40)
    for row in actions[:13]:
        envs.step(row)
    twin = clone(envs)
    for row in actions[13:]:
        assert data_equivalence(envs.step(row), twin.step(row), exact=True)


# --- resets --------------------------------------------------------------------------------------------------------


def test_seeds_may_be_a_number_or_one_per_world_or_nothing():
    envs = gymnasium.make_vec("flockenv/Flock-v0", 3)
    by_number = envs.reset(seed=5)
    by_list = envs.reset(seed=[5, 6, 7])
    assert data_equivalence(by_number, by_list, exact=True)
    second = envs.reset()[0]
    envs.reset(seed=[5, 6, 7])
    mixed = envs.reset(seed=[None, 6, None])[0]
    np.testing.assert_array_equal(mixed[[0, 2]], second[[0, 2]])
    np.testing.assert_array_equal(mixed[1], by_number[0][1])
    drawn = gymnasium.make_vec("flockenv/Flock-v0", 3)
    observation, info = drawn.reset()
    assert data_equivalence(envs.reset(seed=info["seed"].tolist())[0], observation, exact=True)
    assert len(set(info["seed"].tolist())) == 3


def test_a_masked_reset_leaves_the_others_alone():
    options = {"autoreset_mode": AutoresetMode.DISABLED}
    envs, twin = (gymnasium.make_vec("flockenv/Flock-v0", 3, **options) for _ in range(2))
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


def test_worlds_that_ended_want_a_reset_when_nobody_resets_them():
    envs = gymnasium.make_vec("flockenv/Flock-v0", 2, max_episode_steps=2, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    row = np.zeros(envs.action_space.shape)
    envs.step(row)
    ended = envs.step(row)[3]
    with pytest.raises(ResetNeeded, match="world 0"):
        envs.step(row)
    envs.reset(options={"reset_mask": ended})
    envs.step(row)


def test_actions_of_worlds_that_rest_are_not_read():
    envs = gymnasium.make_vec("flockenv/Flock-v0", 2, max_episode_steps=2, autoreset_mode=AutoresetMode.NEXT_STEP)
    envs.reset(seed=0)
    row = np.zeros(envs.action_space.shape)
    envs.step(row), envs.step(row)
    _, reward, _, truncated, info = envs.step(row * np.nan)
    assert not truncated.any()
    assert not reward.any()
    assert info["_seed"].all()
    with pytest.raises(ValueError, match="world 0"):
        envs.step(row * np.nan)


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mask",
    [[True, False], np.array([1, 0]), np.array([True]), np.zeros(2, bool)],
    ids=["list", "int", "short", "empty"],
)
def test_bad_masks_are_refused(mask):
    envs = gymnasium.make_vec("flockenv/Flock-v0", 2)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask"):
        envs.reset(options={"reset_mask": mask})


def test_the_first_reset_begins_every_world():
    envs = gymnasium.make_vec("flockenv/Flock-v0", 2)
    with pytest.raises(ValueError, match="first reset"):
        envs.reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize(
    ("seed", "kind"), [(-1, ValueError), ("a", TypeError), ([1], ValueError), ([1, -1], ValueError)]
)
def test_bad_seeds_are_refused(seed, kind):
    with pytest.raises(kind, match="seed"):
        gymnasium.make_vec("flockenv/Flock-v0", 2).reset(seed=seed)


def test_bad_options_actions_and_modes_are_refused():
    envs = gymnasium.make_vec("flockenv/Flock-v0", 2)
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
        gymnasium.make_vec("flockenv/Flock-v0", 2, render_mode="human")
    with pytest.raises(ValueError, match="`SameStep`"):
        gymnasium.make_vec("flockenv/Flock-v0", 2, autoreset_mode="samestep")
    with pytest.raises(ValueError, match="worlds"):
        gymnasium.make_vec("flockenv/Flock-v0", 0)
    envs.close()
    envs.close()


def test_one_picture_per_world():
    envs = gymnasium.make_vec("flockenv/Flock-v0", 2, render_mode="rgb_array")
    envs.reset(seed=0)
    first, second = envs.render()
    assert first.shape == second.shape
    assert first.dtype == np.uint8
    assert not np.array_equal(first, second)
