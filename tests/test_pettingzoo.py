"""The parallel and turn-based (AEC) environments: PettingZoo's own tests, and what these do not test."""

import copy
import functools
import itertools
import pickle
import warnings

import numpy as np
import pettingzoo
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence

from flockenv.envs import aec, common, crossing_v0, flock_v1, pursuit_v0, school_v0
from flockenv.envs.table import id_of
from tests.catalogue import RAISED, TEAMS

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # the import loads its own example, by a deprecated call
    from pettingzoo.test import (
        api_test,
        max_cycles_test,
        parallel_api_test,
        parallel_seed_test,
        render_test,
        seed_test,
        state_test,
    )

MODULES = (crossing_v0, flock_v1, pursuit_v0, school_v0)
CROSSING, FLOCK = "flockenv/Crossing-v0", "flockenv/Flock-v1"
PURSUIT, SCHOOL = "flockenv/Pursuit-v0", "flockenv/School-v0"
IDS = (CROSSING, FLOCK, PURSUIT, SCHOOL)
SMALL = {CROSSING: {"agents": 5}, FLOCK: {"agents": 6}, PURSUIT: {}, SCHOOL: {"metabolism": 0.2}}


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    """Let SDL draw to no display, and let a window's clock not wait."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("pygame.time.Clock", Clock)


class Clock:
    def tick(self, fps):
        assert fps > 0


def make(env_id, kind="parallel", **options):
    return pettingzoo.make(kind, env_id, **{**SMALL[env_id], **options})


def some(env, rng):
    return {name: rng.uniform(-1, 1, env.action_space(name).shape).astype(np.float32) for name in env.agents}


def play(env, steps, seed):
    """Return the results of `steps` steps of random actions, with a reset at each end of an episode."""
    rng = np.random.default_rng(seed)
    log = [env.reset(seed=seed)]
    for _ in range(steps):
        log.append(env.step(some(env, rng)))
        if not env.agents:
            log.append(env.reset())
    return log


# --- the library's own tests ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_parallel_environments_pass_the_api_test_of_pettingzoo(env_id):
    parallel_api_test(make(env_id), num_cycles=300)


def test_a_disturbed_environment_passes_the_api_test_of_pettingzoo():
    parallel_api_test(make("flockenv/Crossing-v0", agents=5, noise=0.3, delay=2, dropped=0.2), num_cycles=60)


@pytest.mark.parametrize("env_id", IDS)
def test_turn_based_environments_pass_the_api_test_of_pettingzoo(env_id):
    api_test(make(env_id, "aec"), num_cycles=200)


@pytest.mark.parametrize("env_id", IDS)
def test_environments_pass_the_seed_tests_of_pettingzoo(env_id):
    seed_test(functools.partial(make, env_id, "aec", max_cycles=40), num_cycles=60)
    parallel_seed_test(functools.partial(make, env_id))


@pytest.mark.parametrize("module", MODULES)
def test_environments_pass_the_max_cycles_test_of_pettingzoo(module):
    max_cycles_test(module)


@pytest.mark.parametrize("env_id", IDS)
def test_environments_pass_the_render_test_of_pettingzoo(env_id):
    render_test(functools.partial(make, env_id, "aec"))


@pytest.mark.parametrize("env_id", IDS)
def test_environments_pass_the_state_test_of_pettingzoo(env_id):
    state_test(make(env_id, "aec"), make(env_id))


# --- what they do not test --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_whole_episodes_replay_bit_for_bit(env_id):
    """The library's parallel_seed_test compares one step, since it tests whether any *name* is true."""
    one, other = (play(make(env_id, max_cycles=60), 150, seed=8) for _ in range(2))
    assert data_equivalence(one, other, exact=True)
    assert not data_equivalence(one, play(make(env_id, max_cycles=60), 150, seed=9))


@pytest.mark.parametrize("env_id", IDS)
def test_every_observation_and_every_state_is_in_its_space(env_id):
    env, rng = make(env_id, max_cycles=80), np.random.default_rng(0)
    env.reset(seed=0)
    states = []
    for _ in range(200):
        actions = {name: np.sign(action) for name, action in some(env, rng).items()}
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert set(observations) == set(rewards) == set(terminated) == set(truncated) == set(infos) == set(actions)
        assert all(observations[name] in env.observation_space(name) for name in observations)
        assert all(type(value) is float for value in rewards.values())
        assert all(type(value) is bool for value in (*terminated.values(), *truncated.values()))
        for name, info in infos.items():
            terms = {key: value for key, value in info.items() if key.startswith("reward/")}
            assert tuple(terms) == tuple(f"reward/{term}" for term in env.task.terms)
            assert sum(terms.values()) == pytest.approx(rewards[name], abs=1e-12)
            assert all(type(value) in (float, bool) for value in info.values())
        assert env.state() in env.state_space
        states.append(env.state())
        if not env.agents:
            env.reset()
    assert np.ptp(states, axis=0).max() > 0.1


@pytest.mark.parametrize("env_id", IDS)
def test_returned_arrays_and_dictionaries_are_not_changed_later(env_id):
    env, rng = make(env_id), np.random.default_rng(0)
    outcomes = [env.reset(seed=0)]
    copies = [copy.deepcopy(outcomes[0])]
    for _ in range(10):
        outcomes.append(env.step(some(env, rng)))
        copies.append(copy.deepcopy(outcomes[-1]))
    assert data_equivalence(outcomes, copies, exact=True)
    for before, after in itertools.pairwise(outcomes):
        assert not {id(d) for d in before} & {id(d) for d in after}
    for name in outcomes[-1][0]:
        outcomes[-1][0][name][:] = 9.0  # changes by a user have no effect
    outcomes[-1][3]["__all__"] = True  # as RLlib does
    actions = some(env, rng)
    twin, twin_rng = make(env_id), np.random.default_rng(0)
    twin.reset(seed=0)
    for _ in range(10):
        twin.step(some(twin, twin_rng))
    assert data_equivalence(env.step(actions), twin.step(actions), exact=True)


@pytest.mark.parametrize("env_id", IDS)
def test_names_and_spaces_stay_the_same_objects(env_id):
    env = make(env_id)
    env.reset(seed=0)
    assert env.agents == env.possible_agents
    assert env.metadata["name"] == str(env) == env_id.split("/")[1].lower().replace("-", "_")
    for name in env.possible_agents:
        assert env.observation_space(name) is env.observation_space(name)
        assert env.action_space(name) is env.action_space(name)
    with pytest.raises(ValueError, match=f"`{env.possible_agents[1]}`"):
        env.action_space(env.possible_agents[1] + "x")


@pytest.mark.parametrize("kind", ["parallel", "aec"])
@pytest.mark.parametrize("env_id", TEAMS)
def test_spaces_of_all_agents_exist_before_the_first_reset(env_id, kind):
    env = pettingzoo.make(kind, env_id)
    for several, one in (
        (env.observation_spaces, env.observation_space), (env.action_spaces, env.action_space)
    ):  # fmt: skip
        assert list(several) == env.possible_agents
        assert all(several[agent] is one(agent) for agent in env.possible_agents)


@pytest.mark.parametrize("env_id", TEAMS)
def test_a_step_without_agents_takes_an_empty_dictionary(env_id):
    """PettingZoo's own loops and SuperSuit's black_death pass {} after all agents have left."""
    env = pettingzoo.make("parallel", env_id, max_cycles=3)
    with pytest.raises(ResetNeeded, match="reset"):
        env.step({})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"'{env.agents[0]}' has no action"):
        env.step({})
    for _ in range(3):
        last = {agent: env.action_space(agent).sample() for agent in env.agents}
        env.step(last)
    assert not env.agents
    state = env.state()
    for _ in range(2):
        assert env.step({}) == ({}, {}, {}, {}, {})
    np.testing.assert_array_equal(env.state(), state)
    for actions in (last, None, [], np.zeros(0)):
        with pytest.raises(ResetNeeded, match="reset"):
            env.step(actions)
    env.reset()
    env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    env.close()
    with pytest.raises(ResetNeeded, match="reset"):
        env.step({})


def still(env):
    return dict.fromkeys(env.agents, np.zeros(2))


def test_a_captured_agent_leaves_and_the_others_continue():
    env = make(PURSUIT, capture_distance=6.0)
    for seed in range(50):  # until exactly one evader is within reach
        env.reset(seed=seed)
        outcome = env.step(still(env))
        gone = [name for name, over in outcome[2].items() if over]
        if len(gone) == 1:
            break
    assert gone[0].startswith("evader")
    assert all(set(part) == set(env.possible_agents) for part in outcome)
    assert not any(outcome[3].values())
    assert not any(info["is_success"] for info in outcome[4].values())
    assert env.agents == [name for name in env.possible_agents if name not in gone]
    outcome = env.step(still(env))
    assert all(set(part) == set(env.possible_agents) - set(gone) for part in outcome)


def without_one(**options):
    """Return Pursuit after a first step in which exactly one of the two evaders was captured, and its name."""
    env = make(PURSUIT, capture_distance=6.0, **options)
    for seed in range(50):
        env.reset(seed=seed)
        env.step(still(env))
        gone = [name for name in env.possible_agents if name not in env.agents]
        if len(gone) == 1:
            break
    return env, gone[0]


@pytest.mark.parametrize("place", ["first", "last"])
@pytest.mark.parametrize("ignored", [np.ones(2), np.full(2, np.nan), np.zeros(3), None, "left"])
def test_actions_of_agents_that_have_left_are_ignored(place, ignored):
    """PettingZoo's conversion does so; TorchRL passes them until the episode ends, AgileRL for one more step."""
    env, gone = without_one()
    twin = copy.deepcopy(env)
    rng = np.random.default_rng(0)
    while env.agents:
        actions = some(env, rng)
        more = {gone: ignored, **actions} if place == "first" else {**actions, gone: ignored}
        assert data_equivalence(twin.step(more), env.step(actions), exact=True)
        assert twin.agents == env.agents


def test_actions_of_agents_that_have_left_do_not_replace_missing_ones():
    env, gone = without_one()
    for lacking in env.agents:
        refused(env, {**still(env), gone: np.zeros(2)} | {lacking: np.zeros(3)}, repr(lacking))
        given = {name: np.zeros(2) for name in env.possible_agents if name != lacking}
        refused(env, given, repr(lacking), "has no action")
    refused(env, {**still(env), gone: np.zeros(2), gone + "x": np.zeros(2)}, repr(gone + "x"), "is unknown")
    assert gone not in env.step({**still(env), gone: np.zeros(2)})[0]


def test_every_agent_ends_once_and_none_returns_before_the_reset():
    """An agent that has left is dead in the world also, and needs no action; a reset brings all agents back."""
    env, rng = make(PURSUIT, capture_distance=2.5, max_cycles=40), np.random.default_rng(0)
    early = 0
    for seed in range(6):
        env.reset(seed=seed)
        assert env.agents == env.possible_agents
        assert env.world.state.alive.all()
        ended = []
        while env.agents:
            present = env.agents
            outcome = env.step(some(env, rng))
            assert all(list(part) == present for part in outcome)
            over = [name for name in present if outcome[2][name] or outcome[3][name]]
            assert not set(over) & set(ended)
            ended += over
            early += bool(over) and bool(env.agents)
            assert env.agents == [name for name in present if name not in over]
            if env.agents:
                living = dict(zip(env.possible_agents, env.world.state.alive[0].tolist(), strict=True))
                assert [name for name, alive in living.items() if alive] == env.agents
        assert sorted(ended) == sorted(env.possible_agents)
    assert early > 0  # an agent left before the others


def test_all_agents_may_end_in_the_same_step():
    env = make(PURSUIT, capture_distance=100.0)
    env.reset(seed=0)
    _, _, terminated, truncated, infos = env.step(still(env))
    assert set(terminated) == set(env.possible_agents)
    assert all(terminated.values())
    assert not any(truncated.values())
    assert all(info["is_success"] for info in infos.values())
    assert all(set(info) & set(env.task.metric_names) for info in infos.values())
    assert env.agents == []


def test_an_agent_that_ends_at_the_time_limit_is_truncated_also():
    """For RLlib an episode is over if all agents are terminated or all are truncated, never for a mixture."""
    env = make(PURSUIT, capture_distance=100.0, max_cycles=1)
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step(still(env))
    assert all(terminated.values())
    assert all(truncated.values())


def test_at_the_time_limit_all_agents_are_truncated():
    env = make(FLOCK, max_cycles=1)
    env.reset(seed=0)
    _, _, terminated, truncated, infos = env.step(still(env))
    assert all(truncated.values())
    assert not any(terminated.values())
    assert env.agents == []
    assert all(set(info) & set(env.task.metric_names) for info in infos.values())
    env.reset()
    assert env.agents == env.possible_agents


@pytest.mark.parametrize("agents", [("a",), ("a", "'", '"]}', "\\"), tuple(f"walker_{k}" for k in range(300))])
def test_dictionaries_by_agent_are_equal_with_generated_code_and_with_loops(monkeypatch, agents):
    terms, rng = ("effort", "it's"), np.random.default_rng(len(agents))
    seen, over = rng.random((len(agents), 3)), (rng.random(len(agents)) < 0.5).tolist()
    paid, earned = rng.random(len(agents)).tolist(), rng.random((2, len(agents))).tolist()
    for displayed in (0, 1000):
        monkeypatch.setattr(common, "DISPLAYED", displayed)
        common._compile_by_agent.cache_clear()
        found = common.ByAgent(terms, agents).of(seen, paid, over, True, earned, False)
        assert [list(each) for each in found] == [list(agents)] * 5
        for i, agent in enumerate(agents):
            info = {**{term: earned[k][i] for k, term in enumerate(terms)}, "is_success": False}
            np.testing.assert_array_equal(found[0][agent], seen[i])
            assert [each[agent] for each in found[1:]] == [paid[i], over[i], True, info]
    common._compile_by_agent.cache_clear()


def test_changes_of_the_list_of_agents_have_no_effect():
    env = make(FLOCK)
    env.reset(seed=0)
    env.agents.clear()
    assert env.agents == env.possible_agents
    env.step(still(env))


@pytest.mark.parametrize("kind", ["parallel", "aec"])
@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_exactly_like_the_original(kind, clone):
    env = make(PURSUIT, kind, max_cycles=30, render_mode="human")
    env.reset(seed=2)
    for _ in range(7):
        env.step(some(env, np.random.default_rng(0)) if kind == "parallel" else np.full(2, 0.5))
    twin = clone(env)
    for _ in range(20):
        if kind == "parallel":
            actions = some(env, np.random.default_rng(1))
            assert data_equivalence(env.step(actions), twin.step(actions), exact=True)
        else:
            env.step(np.full(2, -0.5)), twin.step(np.full(2, -0.5))
            assert data_equivalence(env.last(), twin.last(), exact=True)
    env.close()
    twin.close()


def test_boids_that_are_not_learners_are_scripted():
    env = make(FLOCK, learners=2)
    assert len(env.possible_agents) == 2
    assert env.task.agents == 6
    assert len(make(FLOCK).possible_agents) == 6
    assert len(pettingzoo.make("parallel", PURSUIT).possible_agents) == 5


# --- bad input --------------------------------------------------------------------------------------------------------


def refused(env, actions, *words):
    """Assert that a step raises an error of one line with these words, and that no agent has moved."""
    before = env.state()
    with pytest.raises(ValueError, match=r"^[^\n]*$") as error:
        env.step(actions)
    assert all(word in str(error.value) for word in words), str(error.value)
    np.testing.assert_array_equal(env.state(), before)


def test_bad_action_dictionaries_are_refused_by_name():
    env = make(FLOCK)
    env.reset(seed=0)
    good = some(env, np.random.default_rng(0))
    lacking = {name: good[name] for name in env.agents if name != "boid_3"}
    refused(env, lacking, "'boid_3'")
    refused(env, {**good, "boid_33": np.zeros(2)}, "'boid_33'", "did you mean `boid_3`")
    for bad in (np.array([np.nan, 0]), np.array([0, np.inf]), np.zeros(3), 0.0, None, "left", {"x": 1}):
        refused(env, {**good, "boid_4": bad}, "'boid_4'")
    with pytest.raises(TypeError, match="dictionary"):
        env.step(list(good.values()))
    env.step(good)


def test_by_turns_a_bad_action_is_refused_at_the_turn_of_its_agent():
    env = make(FLOCK, "aec")
    env.reset(seed=0)
    env.step(np.zeros(2))
    assert env.agent_selection == "boid_1"
    with pytest.raises(ValueError, match="'boid_1'"):
        env.step(np.array([0.0, np.nan]))
    assert env.agent_selection == "boid_1"
    env.step(np.zeros(2))


@pytest.mark.parametrize("bad", [None, np.zeros(3), 0.0, "left", {"x": 1}])
def test_by_turns_an_agent_that_acts_needs_an_action(bad):
    env = make(FLOCK, "aec")
    env.reset(seed=0)
    env.step(np.zeros(2))
    refused(env, bad, "'boid_1'")
    assert env.agent_selection == "boid_1"
    env.step(np.zeros(2))


def after_an_end(env_id):
    """Return the turn-based environment at the turn of an agent that has ended; at the time limit all have."""
    env = make(env_id, "aec", max_cycles=3)
    env.reset(seed=0)
    while not (env.terminations[env.agent_selection] or env.truncations[env.agent_selection]):
        env.step(np.zeros(2))
    return env


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("bad", [np.zeros(2), np.array([np.nan, 0.0]), 0.0, "left"])
def test_by_turns_an_agent_that_has_ended_accepts_only_none(env_id, bad):
    env = after_an_end(env_id)
    agent, others = env.agent_selection, [*env.agents]
    refused(env, bad, repr(agent), "None")
    assert env.agent_selection == agent
    assert env.agents == others
    env.step(None)
    assert agent not in env.agents


def test_by_turns_an_unknown_agent_is_not_observed():
    env = after_an_end(FLOCK)
    for agent, reason in (("boid_00", "did you mean"), (None, "is unknown"), (0, "is unknown")):
        with pytest.raises(ValueError, match=f"{agent!r} .*{reason}"):
            env.observe(agent)
    assert env.observation_space("boid_1").contains(env.observe("boid_1"))


def round_of_turns(env):
    """Give each agent its turn until the world has moved: None for those that have ended, no force for the others."""
    steps = env.unwrapped.world.steps.copy()
    while env.agents and env.unwrapped.world.steps == steps:
        agent = env.agent_selection
        env.step(None if env.terminations[agent] or env.truncations[agent] else np.zeros(2))


def test_by_turns_an_agent_that_left_is_not_observed_after_the_next_world_step():
    env, gone = make(PURSUIT, "aec", capture_distance=6.0), []
    for seed in range(50):  # until exactly one evader is within reach
        env.reset(seed=seed)
        round_of_turns(env)
        gone = [agent for agent, over in env.terminations.items() if over]
        if len(gone) == 1:
            break
    assert env.observation_space(gone[0]).contains(env.observe(gone[0]))
    round_of_turns(env)
    assert gone[0] not in env.agents
    with pytest.raises(ValueError, match=f"^observe: agent '{gone[0]}' has left the game$"):
        env.observe(gone[0])


def test_actions_beyond_the_box_are_clipped_without_a_warning():
    observations = []
    for big in (1.0, 5.0, 1e300):
        env = make(FLOCK, "aec")
        env.reset(seed=0)
        for _ in env.agents:
            env.step(np.array([big, -big]))
        observations.append(env.observe("boid_0"))
    np.testing.assert_array_equal(observations, [observations[0]] * 3)


@pytest.mark.parametrize(
    ("seed", "kind"), [(-1, ValueError), (2**64, ValueError), (1.5, TypeError), ("abc", TypeError)]
)
def test_bad_seeds_are_refused(seed, kind):
    env = make(FLOCK)
    with pytest.raises(kind, match="seed"):
        env.reset(seed=seed)


def test_the_world_has_the_seed_of_a_reset_without_seed():
    env, other = make(FLOCK), make(FLOCK)
    observations, infos = env.reset()
    assert infos == {agent: {} for agent in env.agents}  # TorchRL expects all agents as keys
    again, _ = make(FLOCK).reset(seed=env.world.seeds[0])
    assert data_equivalence(observations, again, exact=True)
    other.reset()
    assert other.world.seeds != env.world.seeds


def test_bad_options_parameters_and_limits_are_refused():
    env = make(FLOCK)
    with pytest.raises(ValueError, match="'bogus'"):
        env.reset(options={"bogus": 1})
    with pytest.raises(TypeError, match="max_cycles"):
        make(FLOCK, horizon=9)
    for limit in (0, -5):
        with pytest.raises(ValueError, match="time_limit"):
            make(FLOCK, max_cycles=limit)
        with pytest.raises(ValueError, match="max_cycles"):
            env.max_cycles = limit
    with pytest.raises(ValueError, match="`human`"):
        make(FLOCK, render_mode="humann")


def test_step_render_and_state_require_a_reset():
    env = make(FLOCK, render_mode="rgb_array")
    for call in (lambda: env.step({}), env.render, env.state):
        with pytest.raises(ResetNeeded, match="reset"):
            call()
    env.reset(seed=0)
    assert env.render().dtype == np.uint8
    env.close()
    env.close()
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(dict.fromkeys(env.possible_agents, np.zeros(2)))


def test_rendering_without_a_mode_warns():
    env = make(FLOCK)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render mode"):
        assert env.render() is None


def test_conversions_of_pettingzoo_raise_no_warnings():
    """From parallel to turn-based and back, as other libraries convert."""
    from pettingzoo.utils.conversions import aec_to_parallel

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        there_and_back = aec_to_parallel(make(PURSUIT, "aec"))
        here = make(PURSUIT)
        there_and_back.reset(seed=1), here.reset(seed=1)
        for _ in range(5):
            actions = some(here, np.random.default_rng(3))
            ours, theirs = here.step(actions), there_and_back.step(actions)
            assert data_equivalence(ours[0], theirs[0], exact=True)
            assert ours[1] == dict(theirs[1])


def test_a_former_version_is_refused_and_the_new_one_is_named() -> None:
    from flockenv import envs

    for name, version in RAISED.items():
        if id_of(name) not in TEAMS:  # tasks of one learner: see test_gymnasium.py
            continue
        for kind in ("parallel", "aec"):
            with pytest.raises(
                Exception, match=f"v{version - 1} for .*{name}.* not found. Available version: v{version}"
            ):
                pettingzoo.make(kind, f"flockenv/{name}-v{version - 1}")
        module = getattr(envs, f"{name.lower()}_v{version - 1}")
        for make in (module.env, module.parallel_env):
            with pytest.raises(ImportError, match=f"use {name.lower()}_v{version} instead"):
                make()
    for name in ("WorldAECEnv", "EvadeAECEnv", "NothingAECEnv", "nothing"):
        with pytest.raises(AttributeError, match=f"'flockenv.envs.aec' has no attribute '{name}'"):
            getattr(aec, name)
    for never in ("flock_v9", "nothing_v0", "flock_vx"):
        with pytest.raises(AttributeError, match=never):
            getattr(envs, never)
