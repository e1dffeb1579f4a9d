"""The Gymnasium face: Gymnasium's own checks, and properties that they do not test."""

import copy
import hashlib
import importlib
import itertools
import json
import os
import pickle
import re
import subprocess
import sys
import threading

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import NameNotFound, ResetNeeded
from gymnasium.utils.env_checker import check_env

import flockenv
from flockenv.envs import single
from flockenv.envs.single import PursuitEnv
from flockenv.envs.table import ENVIRONMENTS, id_of
from flockenv.tasks import TASKS
from tests.catalogue import RAISED, SINGLE, TEAMS

MODES = (None, "rgb_array", "human")


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    """Let SDL draw without a display, and replace the clock of windows by one that does not wait."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("pygame.time.Clock", Clock)


class Clock:
    def tick(self, fps):
        assert fps > 0


def actions(env, steps, seed=7):
    shape = (steps, *env.action_space.shape)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def play(env, rows, seed=None):
    """Step through the rows, resetting at every end; return everything that step and reset return, as bytes."""
    log = [] if seed is None else [env.reset(seed=seed)[0].tobytes()]
    for row in rows:
        observation, reward, terminated, truncated, info = env.step(row)
        log.append(observation.tobytes() + repr((reward, terminated, truncated, info)).encode())
        if terminated or truncated:
            log.append(env.reset()[0].tobytes())
    return log


def rewards_of(info):
    """Return the reward terms of an info by their names in the task."""
    return {key.removeprefix("reward/"): value for key, value in info.items() if key.startswith("reward/")}


def digest(env_id, steps=1000):
    env = gymnasium.make(env_id, max_episode_steps=150)
    return hashlib.sha256(b"".join(play(env, actions(env, steps), seed=5))).hexdigest()


# --- the libraries' own checks -------------------------------------------------------------------------------------


def test_check_env_of_gymnasium_passes_under_a_disturbance():
    check_env(gymnasium.make("flockenv/Pursuit-v0", noise=0.3, delay=2, dropped=0.2).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env_id", SINGLE)
def test_check_env_of_gymnasium_passes(env_id, mode):
    env = gymnasium.make(env_id, render_mode=mode)
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("env_id", SINGLE)
def test_an_episode_passes_the_passive_checker_of_make(env_id):
    env = gymnasium.make(env_id)
    env.reset(seed=1)
    for row in actions(env, 50):
        _, _, terminated, truncated, _ = env.step(row)
        if terminated or truncated:
            env.reset()


# --- registration --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", SINGLE)
def test_the_registered_time_limit_is_the_horizon_of_the_task(env_id):
    spec = gymnasium.spec(env_id)
    assert spec.max_episode_steps == gymnasium.make(env_id).unwrapped.task.horizon


@pytest.mark.parametrize("kind", ["parallel", "aec"])
@pytest.mark.parametrize("env_id", TEAMS)
def test_the_registered_max_cycles_is_the_horizon_of_the_task(env_id, kind):
    assert pettingzoo.spec(kind, env_id).max_cycles == pettingzoo.make(kind, env_id).unwrapped.task.horizon


def test_every_task_has_an_id():
    assert sorted(re.sub(r"(?<!^)([A-Z])", r"_\1", name).lower() for name in ENVIRONMENTS) == sorted(TASKS)


def test_every_task_maps_to_a_registered_id():
    assert sorted(id_of(task.__name__) for task in TASKS.values()) == sorted(SINGLE)


def test_importing_twice_registers_once():
    before = dict(gymnasium.registry)
    importlib.reload(flockenv)  # a second registration would warn, and warnings are errors here
    assert dict(gymnasium.registry) == before


@pytest.mark.parametrize("env_id", SINGLE)
def test_a_spec_survives_a_round_trip_through_json(env_id):
    env = gymnasium.make(env_id, render_mode="rgb_array")
    spec = EnvSpec.from_json(env.spec.to_json())
    json.loads(env.spec.to_json())
    again = gymnasium.make(spec)
    assert again.unwrapped.render_mode == "rgb_array"
    assert again.unwrapped.task == env.unwrapped.task


def test_the_package_can_be_named_in_the_id():
    code = "import gymnasium; print(gymnasium.make('flockenv:flockenv/Pursuit-v0').reset(seed=3)[0].tolist())"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == gymnasium.make("flockenv/Pursuit-v0").reset(seed=3)[0].tolist()


def test_importing_flockenv_loads_no_heavy_package():
    heavy = ["torch", "stable_baselines3", "matplotlib", "numba", "pygame", "PIL", "pydantic", "scipy"]
    code = f"import sys, flockenv; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_load_on_demand():
    for name in flockenv.__all__:
        assert getattr(flockenv, name) is not None
    assert set(flockenv.__all__) <= set(dir(flockenv))
    with pytest.raises(AttributeError, match="no attribute 'Wrold'"):
        _ = flockenv.Wrold


# --- docstrings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", SINGLE)
def test_the_docstring_of_an_environment_is_complete(env_id):
    env = gymnasium.make(env_id).unwrapped
    page = type(env).__doc__
    for section in ("Description", "Action space", "Observation space", "Rewards", "Infos", "Episode end", "Arguments"):
        assert f"## {section}" in page
    for layout in (env.task.layout, env.task.action_layout):
        for index, name, unit, meaning in layout.table():
            line = next(row for row in page.splitlines() if row.startswith(f"| {index} | `{name}` |"))
            assert meaning.replace("|", "\\|") in line
            assert f"| {unit} |" in line
    for name in (*env.task.terms, *env.task.metric_names, *(set(type(env.task).model_fields) - {"horizon"})):
        assert f"`{name}`" in page
    env.reset()
    assert all(f"`{key}`" in page for key in env.step(env.action_space.sample())[4])
    assert f'`gymnasium.make("flockenv:{env_id}")`' in page
    assert "`AutoresetMode.NEXT_STEP`" in page
    assert f"({env.observation_space.shape[0]},)" in page
    assert f"{env.task.horizon} decisions" in page


# --- returned values -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", SINGLE)
def test_types_and_spaces_hold_at_every_step(env_id):
    env = gymnasium.make(env_id, max_episode_steps=100, disable_env_checker=True)
    rng = np.random.default_rng(0)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    assert info == {"seed": 0}
    for t in range(1000):
        # Actions at corners of the box bring observations to their limits.
        action = (
            rng.choice([-1.0, 1.0], env.action_space.shape).astype(np.float32)
            if t % 50 < 40
            else np.ones(env.action_space.shape, np.float32)
        )
        observation, reward, terminated, truncated, info = env.step(action)
        assert observation.dtype == np.float32
        assert observation in env.observation_space
        assert type(reward) is float
        assert type(terminated) is bool
        assert type(truncated) is bool
        assert type(info["is_success"]) is bool
        assert sum(rewards_of(info).values()) == pytest.approx(reward, abs=1e-12)
        assert tuple(rewards_of(info)) == env.unwrapped.task.terms
        assert all(type(value) in (float, bool) for value in info.values())
        if terminated or truncated:
            env.reset()


@pytest.mark.parametrize("env_id", SINGLE)
def test_returned_observations_are_never_overwritten(env_id):
    env = gymnasium.make(env_id).unwrapped
    kept = [env.reset(seed=1)[0]]
    copies = [kept[0].copy()]
    for row in actions(env, 20):
        kept.append(env.step(row)[0])
        copies.append(kept[-1].copy())
        kept[-2][:] = 9.0  # writing into an old observation must not change later ones
    assert not any(np.shares_memory(a, b) for a, b in itertools.pairwise(kept))
    np.testing.assert_array_equal(kept[-1], copies[-1])
    replay = [env.reset(seed=1)[0], *(env.step(row)[0] for row in actions(env, 20))]
    np.testing.assert_array_equal(replay, copies)


@pytest.mark.parametrize("env_id", SINGLE)
def test_an_episode_is_truncated_at_the_time_limit_with_metrics(env_id):
    env = gymnasium.make(env_id, max_episode_steps=5)
    env.reset(seed=0)
    for t in range(5):
        _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert not terminated
        assert truncated is (t == 4)
    rewards = {f"reward/{name}" for name in rewards_of(info)}
    assert set(info) - rewards - {"is_success"} <= set(env.unwrapped.task.metric_names)
    assert set(info) & set(env.unwrapped.task.metric_names)
    assert all(type(info[name]) is float for name in set(info) & set(env.unwrapped.task.metric_names))


# --- replay --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", SINGLE)
def test_a_thousand_steps_replay_bit_for_bit(env_id):
    assert digest(env_id) == digest(env_id)


@pytest.mark.slow
def test_a_thousand_steps_replay_in_another_process():
    # Results must not depend on the hash seed or on the interpreter's history.
    code = (
        "import importlib.util, sys\n"
        f"spec = importlib.util.spec_from_file_location('replayed', {__file__!r})\n"
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module)\n"
        f"print([module.digest(env_id) for env_id in {SINGLE!r}])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONHASHSEED": "77"},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str([digest(env_id) for env_id in SINGLE])


def test_another_seed_or_other_actions_give_another_episode():
    env = gymnasium.make("flockenv/Flock-v1")
    rows = actions(env, 10)
    assert play(env, rows, seed=1) != play(env, rows, seed=2)
    assert play(env, rows, seed=1) != play(env, -rows, seed=1)


@pytest.mark.parametrize("env_id", SINGLE)
def test_a_reset_with_the_seed_of_an_episode_repeats_it(env_id):
    env = gymnasium.make(env_id).unwrapped
    first, info = env.reset()
    drawn = info["seed"]
    second, _ = env.reset()
    third, _ = env.reset(seed=drawn)
    fourth, info = env.reset()
    np.testing.assert_array_equal(first, third)
    np.testing.assert_array_equal(second, fourth)
    assert not np.array_equal(first, second)
    assert info == {"seed": drawn}
    assert gymnasium.make(env_id).reset()[1]["seed"] != drawn
    np.testing.assert_array_equal(env.reset(seed=np.int64(drawn))[0], first)


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("mode", MODES)
def test_a_copy_continues_as_the_original_does(clone, mode):
    env = gymnasium.make("flockenv/Pursuit-v0", render_mode=mode, max_episode_steps=60)
    rows = actions(env, 100)
    play(env, rows[:40], seed=3)
    twin = clone(env)
    assert play(env, rows[40:]) == play(twin, rows[40:])
    env.close()
    twin.close()


# --- several at once -----------------------------------------------------------------------------------------------


def test_random_numbers_of_wrappers_follow_the_seed():
    """This holds for all kinds of environments; a reset without a seed continues the sequence."""
    forms = {
        "single": gymnasium.make("flockenv/Pursuit-v0").unwrapped,
        "vector": gymnasium.make_vec("flockenv/Pursuit-v0", num_envs=2),
        "parallel": pettingzoo.make("parallel", "flockenv/Pursuit-v0"),
        "aec": pettingzoo.make("aec", "flockenv/Pursuit-v0"),
    }
    drawn = {}
    for name, env in forms.items():
        env.reset(seed=5)
        first = env.np_random.integers(2**40, size=3).tolist()
        assert env.unwrapped.np_random is env.np_random
        env.reset()
        assert env.np_random.integers(2**40, size=3).tolist() != first
        env.reset(seed=5)
        drawn[name] = env.np_random.integers(2**40, size=3).tolist()
        assert drawn[name] == first
        env.reset(seed=6)
        assert env.np_random.integers(2**40, size=3).tolist() != first
    assert len(set(map(tuple, drawn.values()))) == 1


def test_two_interleaved_envs_do_not_disturb_each_other():
    envs = [gymnasium.make(env_id, max_episode_steps=30) for env_id in ("flockenv/Flock-v1", "flockenv/Flock-v1")]
    rows = [actions(env, 80, seed) for seed, env in enumerate(envs)]
    alone = [play(gymnasium.make("flockenv/Flock-v1", max_episode_steps=30), rows[k], seed=k) for k in range(2)]
    together = [play(env, [], seed=k) for k, env in enumerate(envs)]
    for t in range(80):
        for k, env in enumerate(envs):
            together[k] += play(env, rows[k][t : t + 1])
    assert together == alone


def test_envs_in_threads_do_not_disturb_each_other():
    def run(k):
        env = gymnasium.make(SINGLE[k % len(SINGLE)], max_episode_steps=60)
        logs[k] = play(env, actions(env, 200, seed=k), seed=k)

    logs = {}
    for k in range(8):
        run(k)
    alone, logs = logs, {}
    threads = [threading.Thread(target=run, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert logs == alone


@pytest.mark.slow
def test_spawned_workers_play_the_same_worlds():
    env_id, options = "flockenv:flockenv/Pursuit-v0", {"num_envs": 2, "max_episode_steps": 15}
    far = gymnasium.make_vec(env_id, vectorization_mode="async", vector_kwargs={"context": "spawn"}, **options)
    near = gymnasium.make_vec(env_id, vectorization_mode="sync", **options)
    rows = np.random.default_rng(0).uniform(-1, 1, (20, *near.action_space.shape)).astype(np.float32)
    try:
        np.testing.assert_array_equal(far.reset(seed=4)[0], near.reset(seed=4)[0])
        for row in rows:
            for a, b in zip(far.step(row)[:4], near.step(row)[:4], strict=True):
                np.testing.assert_array_equal(a, b)
    finally:
        far.close()


# --- bad input -----------------------------------------------------------------------------------------------------


def one_line(error):
    text = str(error.value)
    assert text
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("seed", "kind"),
    [(-1, ValueError), (2**64, ValueError), (1.5, TypeError), ("abc", TypeError), (True, TypeError), ([1], TypeError)],
)
def test_bad_seeds_are_refused_and_change_nothing(seed, kind):
    env = gymnasium.make("flockenv/Pursuit-v0").unwrapped
    env.reset(seed=1)
    twin = copy.deepcopy(env)
    with pytest.raises(kind) as error:
        env.reset(seed=seed)
    assert repr(seed) in one_line(error)
    row = actions(env, 1)[0]
    np.testing.assert_array_equal(env.step(row)[0], twin.step(row)[0])


def test_unknown_options_are_refused_by_name():
    env = gymnasium.make("flockenv/Pursuit-v0")
    with pytest.raises(ValueError, match="'bogus'") as error:
        env.reset(options={"bogus": 1})
    one_line(error)
    with pytest.raises(TypeError, match="dictionary"):
        env.reset(options=3)
    env.reset(options={})


@pytest.mark.parametrize(
    "action",
    [
        [np.nan, 0.0], [np.inf, 0.0], [-np.inf, 0.0], [0.0], [0.0, 0.0, 0.0], 0.0, [[0.0, 0.0]], None, "ab", ["a", "b"],
        {"x": 1.0},
    ],
)  # fmt: skip
def test_bad_actions_are_refused_and_change_nothing(action):
    env = gymnasium.make("flockenv/Pursuit-v0").unwrapped
    env.reset(seed=1)
    twin = copy.deepcopy(env)
    with pytest.raises((ValueError, TypeError)) as error:
        env.step(action)
    one_line(error)
    row = actions(env, 1)[0]
    np.testing.assert_array_equal(env.step(row)[0], twin.step(row)[0])


def test_actions_of_many_types_are_accepted():
    env = gymnasium.make("flockenv/Pursuit-v0").unwrapped
    backwards = np.array([0.0, 9.0, 1.0], np.float32)[::-2]
    forms = [[1.0, 0.0], (1, 0), np.array([1, 0]), np.array([1, 0], np.float16), np.array([1.0, 0.0]), backwards]
    answers = []
    for form in forms:
        env.reset(seed=2)
        answers.append(env.step(form)[0])
    np.testing.assert_array_equal(answers, [answers[0]] * len(forms))


def test_actions_beyond_the_box_are_clipped():
    env = gymnasium.make("flockenv/Pursuit-v0").unwrapped
    answers = []
    for big in (1.0, 1.0 + 1e-6, 2.0, 1e300):
        env.reset(seed=2)
        answers.append(env.step([big, -big])[0])
    np.testing.assert_array_equal(answers, [answers[0]] * 4)


def test_an_unknown_id_and_an_unknown_parameter_are_named():
    with pytest.raises(NameNotFound, match="Pursuit"):
        gymnasium.make("flockenv/Pursiut-v0")
    with pytest.raises(
        TypeError, match="got an unexpected keyword argument 'pursuer', did you mean `pursuers`"
    ) as error:
        gymnasium.make("flockenv/Pursuit-v0", pursuer=2)
    one_line(error)


@pytest.mark.parametrize(
    ("name", "meant"),
    [("frameskip", ""), ("rendermode", ", did you mean `render_mode`"), ("max_forc", ", did you mean")],
)
@pytest.mark.parametrize("form", ["single", "native", "sync", "parallel", "aec"])
def test_an_unknown_argument_raises_a_type_error_with_the_words_of_python(form, name, meant):
    """TorchRL's GymEnv passes `frameskip`, and retries without it if the error has these words."""
    make_env = {
        "single": lambda **given: gymnasium.make("flockenv/Pursuit-v0", **given),
        "native": lambda **given: gymnasium.make_vec("flockenv/Pursuit-v0", num_envs=2, **given),
        "sync": lambda **given: gymnasium.make_vec("flockenv/Pursuit-v0", 2, vectorization_mode="sync", **given),
        "parallel": lambda **given: pettingzoo.make("parallel", "flockenv/Pursuit-v0", **given),
        "aec": lambda **given: pettingzoo.make("aec", "flockenv/Pursuit-v0", **given),
    }[form]
    with pytest.raises(TypeError, match=f"got an unexpected keyword argument '{name}'{meant}") as error:
        make_env(**{name: 1})
    assert "evaders" in one_line(error)  # one of the allowed arguments


def test_a_bad_value_and_a_bad_mode_are_named():
    with pytest.raises(ValueError, match="evaders") as error:
        gymnasium.make("flockenv/Pursuit-v0", evaders=-1)
    one_line(error)
    with pytest.raises(ValueError, match="`rgb_array`"):
        PursuitEnv(render_mode="rgb_aray")


def test_there_is_one_name_for_the_time_limit():
    with pytest.raises(TypeError, match="unexpected keyword argument 'horizon': the time limit is `max_episode_steps`"):
        gymnasium.make("flockenv/Pursuit-v0", horizon=9)


def test_the_error_for_several_learners_names_the_faces_that_support_them():
    with pytest.raises(ValueError, match=r"make_vec.*pettingzoo\.make.*WorldVecEnv"):
        gymnasium.make("flockenv/Flock-v1", learners=3)


def test_step_and_render_need_a_reset_first():
    env = gymnasium.make("flockenv/Obstacles-v0", render_mode="rgb_array").unwrapped
    row = np.zeros(env.action_space.shape, np.float32)
    for call in (lambda: env.step(row), env.render):
        with pytest.raises(ResetNeeded, match="reset"):
            call()
    env.reset(seed=0)
    env.step(row)
    env.close()
    env.close()
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(row)
    env.reset(seed=0)
    env.step(row)


def test_a_step_after_the_end_is_refused():
    env = gymnasium.make("flockenv/Obstacles-v0", goal_radius=100.0).unwrapped
    env.reset(seed=0)
    _, _, terminated, _, info = env.step(np.zeros(env.action_space.shape))
    assert terminated
    assert info["is_success"]
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.zeros(env.action_space.shape))


# --- pictures ------------------------------------------------------------------------------------------------------


def test_every_rendered_picture_is_a_new_array():
    env = gymnasium.make("flockenv/Flock-v1", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert first.shape[2] == 3
    env.step(env.action_space.sample())
    second = env.render()
    assert not np.shares_memory(first, second)
    assert not np.array_equal(first, second)


def test_rendering_without_a_mode_warns_as_gymnasium_does():
    env = gymnasium.make("flockenv/Flock-v1", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render mode"):
        assert env.render() is None


@pytest.mark.parametrize("env_id", SINGLE)
def test_render_fps_is_the_number_of_decisions_per_second(env_id):
    env = gymnasium.make(env_id)
    assert env.metadata["render_fps"] == round(1 / env.unwrapped.task.control_dt)
    assert set(env.metadata["render_modes"]) == {"rgb_array", "human"}


@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
@pytest.mark.parametrize("name", sorted(RAISED))
def test_the_error_for_a_former_version_names_the_new_one(name: str) -> None:
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(gymnasium.error.DeprecatedEnv, match=rf"Please use `flockenv/{name}-v{RAISED[name]}`"):
            make(f"flockenv/{name}-v{RAISED[name] - 1}")


@pytest.mark.parametrize("env_id", SINGLE)
def test_docstrings_list_the_changes_of_every_version(env_id: str) -> None:
    name, _, version = env_id.removeprefix("flockenv/").partition("-v")
    page = getattr(single, f"{name}Env").__doc__
    listed = re.findall(r"^v(\d+): ", page.partition("## Version history")[2], re.MULTILINE)
    assert listed == [str(v) for v in range(int(version), -1, -1)]
    assert f'`gymnasium.make("{env_id}")`' in page
