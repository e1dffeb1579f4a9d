"""Stable-Baselines3: its tools on our environments, and our VecEnv against the contract of `VecEnv`."""

import base64
import copy
import itertools
import json
import operator
import pickle
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import pytest
import torch
from gymnasium.error import ResetNeeded
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor

from flockenv.envs.sb3 import NOTHING, WorldMonitor, WorldVecEnv, load_sb3_zip
from flockenv.envs.world import World
from flockenv.players.rules import player
from flockenv.tasks import TASKS, Bottleneck, Flock, Pursuit, School
from tests.catalogue import SINGLE

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    """Let SDL draw without a display, and let the clock of a window not wait."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("pygame.time.Clock", Clock)


class Clock:
    def tick(self, fps):
        assert fps > 0


def flock(worlds=3, **options):
    return WorldVecEnv(Flock(agents=7, learners=4), worlds, **{"time_limit": 10, **options})


def rows(env, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, env.num_envs, *env.action_space.shape)).astype(np.float32)


# --- tools of SB3 --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [None, "rgb_array", "human"])
@pytest.mark.parametrize("env_id", SINGLE)
def test_check_env_accepts_every_environment_and_render_mode(env_id, mode):
    check_env(gymnasium.make(env_id, render_mode=mode), skip_render_check=False)


def test_ppo_trains_on_a_registered_id():
    model = PPO("MlpPolicy", "flockenv/Pursuit-v0", n_steps=128, batch_size=64, n_epochs=2, seed=0)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(384)
    assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
    mean, deviation = evaluate_policy(model, Monitor(gymnasium.make("flockenv/Pursuit-v0")), n_eval_episodes=2)
    assert np.isfinite([mean, deviation]).all()


@pytest.mark.parametrize("env_id", SINGLE)
def test_evaluate_policy_gives_the_same_returns_on_our_vec_env(env_id):
    env = make_vec_env(env_id, 2, seed=1, env_kwargs={})
    task = env.get_attr("task")[0]
    returns, lengths = evaluate_policy(player(task), env, n_eval_episodes=4, return_episode_rewards=True)
    assert len(returns) == len(lengths) == 4
    again, _ = evaluate_policy(
        player(task), make_vec_env(env_id, 2, seed=1), n_eval_episodes=4, return_episode_rewards=True
    )
    assert returns == again
    native = VecMonitor(WorldVecEnv(task, 2))
    native.seed(1)
    ours, our_lengths = evaluate_policy(player(task), native, n_eval_episodes=4, return_episode_rewards=True)
    assert sorted(our_lengths) == sorted(lengths)
    np.testing.assert_allclose(sorted(ours), sorted(returns), rtol=1e-4)


# --- our VecEnv ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(TASKS))
def test_our_vec_env_equals_dummy_vec_env_of_single_environments(name):
    """Observations, rewards, dones and common keys of infos are compared, also across ends of episodes."""
    env_id = next(i for i in SINGLE if name.replace("_", "") in i.lower())
    dummy = DummyVecEnv([lambda: gymnasium.make(env_id, max_episode_steps=25)] * 3)
    native = WorldVecEnv(dummy.get_attr("task")[0], 3, time_limit=25)
    native.seed(6), dummy.seed(6)
    np.testing.assert_array_equal(native.reset(), dummy.reset())
    for row in rows(native, 80):
        ours, theirs = native.step(row), dummy.step(row)
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1].astype(np.float32), theirs[1])
        np.testing.assert_array_equal(ours[2], theirs[2])
        for k in np.flatnonzero(ours[2]):
            mine, other = ours[3][k], theirs[3][k]
            np.testing.assert_array_equal(mine["terminal_observation"], other["terminal_observation"])
            sums = {key for key in mine if key.startswith("reward/")}  # ours: of the episode; theirs: of the step
            assert sums <= set(other)
            for key in set(mine) & set(other) - sums - {"terminal_observation"}:
                assert mine[key] == other[key], key
            assert {"TimeLimit.truncated", "is_success"} <= set(mine) & set(other)


def test_rows_are_the_learners_of_each_world_in_order():
    env = flock()
    world = World(env.task, 3, time_limit=10)
    env.seed(40)
    np.testing.assert_array_equal(env.reset(), world.reset(seeds=40).reshape(12, -1))
    for row in rows(env, 9):
        observation, reward, done, infos = env.step(row)
        step = world.step(row.reshape(3, 4, -1))
        np.testing.assert_array_equal(observation, step.observation.reshape(12, -1))
        np.testing.assert_array_equal(reward, step.reward.reshape(12))
        assert not done.any()
        assert infos == [{}] * 12


def test_infos_at_the_end_of_an_episode_have_observation_success_and_sums():
    env = flock()
    world = World(env.task, 3, time_limit=10)
    env.seed(40)
    env.reset(), world.reset(seeds=40)
    for _ in range(2):
        sums = np.zeros((3, 4))
        for row in rows(env, 10):
            observation, _, done, infos = env.step(row)
            step = world.step(row.reshape(3, 4, -1))
            sums += step.reward
        assert done.all()
        check_end(infos, step, world.measure(), sums)
        np.testing.assert_array_equal(observation, world.reset().reshape(12, -1))


def check_end(infos, step, metrics, sums):
    for k, info in enumerate(infos):
        np.testing.assert_array_equal(info["terminal_observation"], step.observation[k // 4, k % 4])
        assert info["TimeLimit.truncated"] is True
        assert info["is_success"] is bool(step.success[k // 4])
        assert sum(value for key, value in info.items() if key.startswith("reward/")) == pytest.approx(sums.flat[k])
        assert all(info[name] == column[k // 4] for name, column in metrics.items() if not np.isnan(column[k // 4]))


def test_termination_at_the_time_limit_is_not_truncation():
    env = WorldVecEnv(Pursuit(capture_distance=100.0), 2, time_limit=1)
    env.reset()
    _, _, done, infos = env.step(np.zeros((2, 2)))
    assert done.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False]
    assert [info["is_success"] for info in infos] == [True, True]


def test_infos_with_content_are_never_shared():
    env = flock()
    env.seed(0)
    env.reset()
    seen = [env.step(row)[3] for row in rows(env, 25)]
    dicts = [info for infos in seen for info in infos if info]
    assert len({id(info) for info in dicts}) == len(dicts)
    assert len({id(infos) for infos in seen}) == len(seen)
    last = [info["terminal_observation"] for info in dicts]
    assert not any(np.shares_memory(a, b) for a, b in itertools.pairwise(last))
    assert len(dicts) == 2 * env.num_envs


WRITES = {
    "[]": lambda info: info.__setitem__("episode", 1),
    "update": lambda info: info.update(episode=1),
    "setdefault": lambda info: info.setdefault("episode", 1),
    "|=": lambda info: operator.ior(info, {"episode": 1}),
}


@pytest.mark.parametrize("write", WRITES.values(), ids=WRITES)
def test_all_rows_share_one_empty_info_that_cannot_be_written(write):
    env = flock()
    env.reset()
    infos = env.step(rows(env, 1)[0])[3]
    assert len(infos) == 12
    assert len({id(info) for info in infos}) == 1
    with pytest.raises(TypeError, match=r"^[^\n]*info\.copy\(\)[^\n]*$"):
        write(infos[3])
    assert isinstance(infos[3], dict)
    assert infos[3] == {}
    assert infos[3].get("episode") is None
    assert json.dumps(infos[3]) == "{}"


def test_explicit_copies_of_the_empty_info_are_writable():
    own = NOTHING.copy()
    assert type(own) is dict
    own["episode"] = 1
    assert type({**NOTHING}) is type(NOTHING | {}) is type(dict(NOTHING)) is dict
    # Otherwise a deep copy of a list of infos would hold one writable dictionary many times.
    assert copy.deepcopy([NOTHING] * 2)[1] is copy.copy(NOTHING) is pickle.loads(pickle.dumps(NOTHING)) is NOTHING
    assert NOTHING == {}


@pytest.mark.parametrize("recycle", [0, 2**62], ids=["recycled", "fresh"])
def test_no_buffer_is_shared(monkeypatch, recycle):
    monkeypatch.setattr("flockenv.envs.world.RECYCLE", recycle)
    env = flock()
    env.seed(0)
    kept = [env.reset()]
    copies = [kept[0].copy()]
    for row in rows(env, 25):
        kept.append(env.step(row)[0])
        copies.append(kept[-1].copy())
        kept[-2][:] = 3.0
    env.seed(0)
    np.testing.assert_array_equal([env.reset(), *(env.step(row)[0] for row in rows(env, 25))], copies)


def test_seeds_belong_to_worlds():
    env = flock()
    assert env.seed(7) == [7] * 4 + [8] * 4 + [9] * 4
    first = env.reset()
    second = env.reset()
    assert not np.array_equal(first, second)
    env.seed(7)
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(), second)
    assert not np.array_equal(flock().reset(), flock().reset())
    with pytest.raises(ValueError, match="seed"):
        env.seed(-1)


def test_ppo_training_is_reproducible_under_vec_monitor_and_vec_check_nan():
    def train():
        env = VecMonitor(VecCheckNan(flock(worlds=4), raise_exception=True), info_keywords=("is_success",))
        return PPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=2, seed=3).learn(512)

    one, other = train(), train()
    assert [int(info["l"]) for info in one.ep_info_buffer][:4] == [10] * 4
    for a, b in zip(one.policy.parameters(), other.policy.parameters(), strict=True):
        assert torch.equal(a, b)


def test_ppo_bootstraps_time_limits():
    """PPO adds gamma V(terminal_observation) to the reward of a truncated row; that needs both keys of the info."""
    env = flock(worlds=1)
    model = PPO("MlpPolicy", env, n_steps=10, batch_size=40, n_epochs=1, gamma=0.5, seed=0)
    raised = []
    predict_values = model.policy.predict_values
    model.policy.predict_values = lambda obs: raised.append(obs) or predict_values(obs)
    model.learn(40)
    assert sum(obs.shape[0] == 1 for obs in raised) == 4


def test_tasks_whose_learners_leave_one_by_one_are_refused_by_default():
    with pytest.raises(ValueError, match=r"^[^\n]*pettingzoo[^\n]*$"):
        WorldVecEnv(Pursuit(pursuers=3, evaders=2, sides="both"))


def test_rows_of_absent_learners_have_no_reward_until_their_world_is_reset():
    task = School(metabolism=0.1, start_hunger=0.6)
    env, world = WorldVecEnv(task, 3, time_limit=60, leaving=True), World(task, 3, time_limit=60)
    env.seed(2)
    env.reset()
    world.reset(seeds=2)
    begun, gone = 0, np.zeros((3, 8), bool)
    for action in rows(env, 70):
        _, reward, done, infos = env.step(action)
        step = world.step(action.reshape(3, 8, -1))
        assert not reward.reshape(3, 8)[gone].any()
        np.testing.assert_array_equal(done.reshape(3, 8), (step.terminated | step.ended[:, None]) & ~gone)
        gone = step.terminated & ~step.ended[:, None]
        for k in np.flatnonzero(done):
            assert infos[k]["TimeLimit.truncated"] == (step.truncated[k // 8] and not step.terminated.flat[k])
        begun += step.ended.sum()
        world.reset(mask=step.ended)
    assert begun >= 3


ROOM = Bottleneck(people=8)


def played(env, steps):
    """Play the tuned rules; yield which rows had a learner before each step, and rewards, dones and infos."""
    rules, state, first = player(env.task), None, np.ones(env.num_envs, bool)
    seen = env.reset()
    for _ in range(steps):
        actions, state = rules.predict(seen, state, first)
        before = env.present
        seen, reward, first, infos = env.step(actions)
        yield before, reward, first, infos


def test_each_learner_is_done_once_per_episode_with_its_last_observation_and_sums():
    env = WorldVecEnv(ROOM, 2, leaving=True)
    env.seed(3)
    ends, sums, early = np.zeros(16, int), np.zeros(16), 0
    for present, reward, done, infos in played(env, 330):
        sums += reward
        assert not reward[~present].any()
        assert not done[~present].any()
        for row in np.flatnonzero(done):
            assert infos[row]["terminal_observation"] in env.observation_space
            paid = sum(value for key, value in infos[row].items() if key.startswith("reward/"))
            assert paid == pytest.approx(sums[row])
            sums[row], ends[row] = 0, ends[row] + 1
            early += not env.present[row]
        assert all(bool(info) == over for info, over in zip(infos, done.tolist(), strict=True))
        begun = np.repeat(env.world.steps == 0, 8)
        np.testing.assert_array_equal(env.present, present & ~done | begun)
        assert (
            np.ptp(ends.reshape(2, 8)[env.world.steps == 0], axis=-1).sum() == 0
        )  # all learners of a world, equally often
    assert early > 10
    assert ends.min() >= 2


def one_by_one(task, seed, episodes):
    """Return the returns and episode lengths of the tuned rules, per agent, in the PettingZoo environment."""
    env = pettingzoo.make("parallel", "flockenv/Bottleneck-v0", people=task.people)
    rules, returns, lengths = player(task), [], []
    for episode in range(episodes):
        seen, state, first = env.reset(seed=None if episode else seed)[0], None, np.ones(task.learners, bool)
        latest, index = np.stack([*seen.values()]), {agent: i for i, agent in enumerate(env.possible_agents)}
        paid, duration = np.zeros(task.learners), np.zeros(task.learners, int)
        while env.agents:
            for agent, row in seen.items():
                latest[index[agent]] = row
            actions, state = rules.predict(latest, state, first)
            first = np.zeros(task.learners, bool)
            seen, reward, *_ = env.step({agent: actions[index[agent]] for agent in env.agents})
            for agent in reward:
                paid[index[agent]] += reward[agent]
                duration[index[agent]] += 1
        returns += paid.tolist()
        lengths += duration.tolist()
    return returns, lengths


@pytest.mark.parametrize("monitor", [WorldMonitor, VecMonitor])
def test_monitors_count_one_episode_for_each_learner(monitor):
    """Returns, and with our monitor also lengths, are those of the PettingZoo environment."""
    worlds = WorldVecEnv(ROOM, 2, leaving=True)
    worlds.seed(3)
    counted = evaluate_policy(player(ROOM), monitor(worlds), 32, return_episode_rewards=True)
    expected = [a + b for a, b in zip(one_by_one(ROOM, 3, 2), one_by_one(ROOM, 4, 2), strict=True)]
    np.testing.assert_allclose(sorted(counted[0]), sorted(expected[0]), rtol=1e-5)
    if monitor is WorldMonitor:
        assert sorted(counted[1]) == sorted(expected[1])


@pytest.mark.parametrize("monitor", [WorldMonitor, lambda env: WorldMonitor(VecCheckNan(env))])
def test_our_monitor_equals_vec_monitor_if_all_learners_end_together(monitor):
    ours, theirs = monitor(flock(worlds=2)), VecMonitor(flock(worlds=2))
    for env in (ours, theirs):
        env.seed(5)
        env.reset()
    for row in rows(ours, 25):
        a, b = ours.step(row)[3], theirs.step(row)[3]
        for one, other in zip(a, b, strict=True):
            assert [one.get("episode", {}).get(key) for key in "rl"] == [
                other.get("episode", {}).get(key) for key in "rl"
            ]


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_like_the_original(clone):
    env = flock()
    env.seed(1)
    env.reset()
    actions = rows(env, 30)
    for row in actions[:7]:
        env.step(row)
    twin = clone(env)
    for row in actions[7:]:
        for a, b in zip(env.step(row)[:3], twin.step(row)[:3], strict=True):
            np.testing.assert_array_equal(a, b)


def test_attributes_and_methods_follow_the_contract_of_vec_env():
    env = flock()
    assert env.get_attr("task") == [env.task] * 12
    assert env.get_attr("task", indices=[1, 2]) == [env.task] * 2
    assert env.has_attr("world")
    assert not env.has_attr("wrold")
    env.set_attr("note", 5)
    assert env.get_attr("note", indices=3) == [5]
    with pytest.raises(ValueError, match="share one simulator"):
        env.set_attr("note", 6, indices=0)
    assert env.env_method("seed", 3, indices=[0])[0][:5] == [3] * 4 + [4]
    assert env.env_is_wrapped(Monitor) == [False] * 12
    env.reset()
    assert env.reset_infos == [{"seed": 3 + k // 4} for k in range(12)]


@pytest.mark.parametrize("task", [Pursuit(control_dt=0.25), Flock(agents=7, learners=4)], ids=["pursuit", "flock"])
def test_render_fps_is_the_rate_of_control_steps(task):
    assert WorldVecEnv(task, 2, render_mode="rgb_array").metadata["render_fps"] == round(1 / task.control_dt)
    assert WorldVecEnv(task, 2).metadata["render_fps"] == round(1 / task.control_dt)


@pytest.mark.parametrize("task", [Pursuit(), Flock(agents=7, learners=4), Pursuit(pursuers=2, capture_distance=1.5)])
def test_make_vec_of_the_spec_makes_the_same_worlds(task):
    env = WorldVecEnv(task, 2, time_limit=9)
    spec = env.get_attr("spec")[0]
    again = gymnasium.make_vec(spec, num_envs=env.num_envs)
    assert again.task == task
    assert again.world.time_limit == 9
    assert VecMonitor(env).venv.spec.id == spec.id


def test_np_random_follows_the_seed():
    env = flock()
    env.seed(5)
    env.reset()
    first = env.get_attr("np_random")[0].integers(2**40, size=3).tolist()
    env.reset()
    assert env.np_random.integers(2**40, size=3).tolist() != first
    env.seed(5)
    env.reset()
    assert env.np_random.integers(2**40, size=3).tolist() == first


def test_bad_input_raises_errors():
    env = flock()
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.zeros((12, 2)))
    env.reset()
    with pytest.raises(ValueError, match="shape"):
        env.step(np.zeros((3, 2)))
    with pytest.raises(ResetNeeded):
        env.step_wait()
    bad = np.zeros((12, 2))
    bad[6, 1] = np.nan
    with pytest.raises(ValueError, match=r"world 1"):
        env.step(bad)
    env.set_options({"bogus": 1})
    with pytest.raises(ValueError, match="'bogus'"):
        env.reset()
    for wrong in ({"worlds": 0}, {"time_limit": 0}, {"render_mode": "ansi"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            flock(**wrong)
    env.close()
    env.close()
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.zeros((12, 2)))


def test_render_and_get_images_return_the_same_picture():
    env = flock(render_mode="rgb_array")
    env.reset()
    picture = env.render()
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(env.get_images()[0], picture)
    assert env.render("human") is None
    env.close()


# --- zips ----------------------------------------------------------------------------------------------------------


class Canary:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_code_in_a_zip_runs_only_with_trust_pickle(tmp_path):
    good, bad, marker = tmp_path / "good.zip", tmp_path / "bad.zip", tmp_path / "ran"
    model = PPO("MlpPolicy", "flockenv/Pursuit-v0", n_steps=64, batch_size=64, seed=0)
    model.save(good)
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "data":
                data = json.loads(content)
                data["policy_class"][":serialized:"] = base64.b64encode(pickle.dumps(Canary(marker))).decode()
                content = json.dumps(data).encode()
            target.writestr(name, content)
    for file in (good, bad):
        with pytest.raises(ValueError, match=r"^[^\n]*trust_pickle[^\n]*$"):
            load_sb3_zip(file)
    assert not marker.exists()
    again = load_sb3_zip(good, trust_pickle=True)
    row = np.zeros(model.observation_space.shape, np.float32)
    np.testing.assert_array_equal(again.predict(row, deterministic=True)[0], model.predict(row, deterministic=True)[0])
    with pytest.raises(ValueError, match="no such file"):
        load_sb3_zip(tmp_path / "none.zip", trust_pickle=True)
