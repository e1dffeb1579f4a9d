"""All faces are views of one World: one sequence of actions through each of them gives the same numbers."""

import enum

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.vector import AutoresetMode

from flockenv.envs.common import ByAgent, iterate_by_name
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.envs.table import id_of
from flockenv.tasks import Bottleneck, Corridor, Crossing, CrowdNav, Evade, Flock, Herd, Obstacles, Pursuit, School

SEED, LIMIT, STEPS = 21, 15, 40
ALONE = {
    "Pursuit": (Pursuit(), {}),
    "Obstacles": (Obstacles(), {}),
    "Flock": (Flock(agents=8, learners=1), {"agents": 8}),
    "Evade": (Evade(), {}),
    "Corridor": (Corridor(people=8, learners=1), {"people": 8}),
    "Bottleneck": (Bottleneck(people=8, learners=1), {"people": 8}),
    "CrowdNav": (CrowdNav(goal_radius=11.8), {"goal_radius": 11.8}),
    "Herd": (Herd(), {}),
    "Crossing": (Crossing(agents=8, learners=1), {"agents": 8}),
    "School": (School(learners=1, metabolism=0.4), {"metabolism": 0.4}),
}
"""Per id: a task with one learner, and the parameters with which make() gives just that task."""


def sequence(task, seed=0):
    shape = (STEPS, task.learners, task.action_layout.size)
    return np.random.default_rng(seed).uniform(-1.2, 1.2, shape).astype(np.float32)


def record(observation, reward, terminated, truncated):
    return observation.tobytes(), np.float64(reward).tobytes(), bool(terminated), bool(truncated)


# Each of these functions plays the sequence in one face, with a reset at every end. It returns one list per learner:
# the first observation, then records, and after each end the first observation of the next episode.


def through_world(task, actions, disturbance=Disturbance()):  # noqa: B008  # immutable
    world = make_world(task, time_limit=LIMIT, disturbance=disturbance)
    logs = [[row.tobytes()] for row in world.reset(seeds=SEED)[0]]
    for action in actions:
        step = world.step(action[None])
        for i, log in enumerate(logs):
            log.append(record(step.observation[0, i], step.reward[0, i], step.terminated[0, i], step.truncated[0]))
        if step.ended[0]:
            for log, row in zip(logs, world.reset()[0], strict=True):
                log.append(row.tobytes())
    return logs


def through_gymnasium(env_id, parameters, actions):
    env = gymnasium.make(env_id, max_episode_steps=LIMIT, **parameters)
    log = [env.reset(seed=SEED)[0].tobytes()]
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action[0])
        log.append(record(observation, reward, terminated, truncated))
        if terminated or truncated:
            log.append(env.reset()[0].tobytes())
    return [log]


def through_vector(env_id, parameters, actions):
    learners = actions.shape[1]
    envs = gymnasium.make_vec(
        env_id, 3 * learners, max_episode_steps=LIMIT, autoreset_mode=AutoresetMode.SAME_STEP, **parameters
    )
    mine = range(learners, 2 * learners)
    first = envs.reset(seed=SEED - 1)[0]
    logs = [[first[k].tobytes()] for k in mine]
    for action in actions:
        observation, reward, terminated, truncated, info = envs.step(np.concatenate([-action, action, action / 2]))
        for k, log in zip(mine, logs, strict=True):
            ended = terminated[k] or truncated[k]
            last = info["final_obs"][k] if ended else observation[k]
            log.append(record(last, reward[k], terminated[k], truncated[k]))
            if ended:
                log.append(observation[k].tobytes())
    return logs


def through_sb3(task, actions, disturbance=None):
    env = WorldVecEnv(task, 3, time_limit=LIMIT, disturbance=disturbance)
    env.seed(SEED - 1)
    mine = slice(task.learners, 2 * task.learners)
    logs = [[row.tobytes()] for row in env.reset()[mine]]
    for action in actions:
        observation, reward, done, infos = env.step(np.concatenate([-action, action, action / 2]))
        for row, log, info, r, over in zip(observation[mine], logs, infos[mine], reward[mine], done[mine], strict=True):
            truncated = info.get("TimeLimit.truncated", False)
            log.append(record(info.get("terminal_observation", row), r, over and not truncated, truncated))
            if over:
                log.append(row.tobytes())
    return logs


def through_parallel(env_id, parameters, actions):
    env = pettingzoo.make("parallel", env_id, max_cycles=LIMIT, **parameters)
    logs = {name: [row.tobytes()] for name, row in env.reset(seed=SEED)[0].items()}
    index = {name: i for i, name in enumerate(env.possible_agents)}
    for action in actions:
        outcome = env.step({name: action[index[name]] for name in env.agents})
        for name in outcome[0]:
            logs[name].append(record(*(part[name] for part in outcome[:4])))
        if not env.agents:
            for name, row in env.reset()[0].items():
                logs[name].append(row.tobytes())
    return list(logs.values())


def through_turns(env_id, parameters, actions):
    env = pettingzoo.make("aec", env_id, max_cycles=LIMIT, **parameters)
    env.reset(seed=SEED)
    index = {name: i for i, name in enumerate(env.possible_agents)}
    logs = {name: [env.observe(name).tobytes()] for name in env.agents}
    for action in actions:
        for name in list(env.agents):
            assert env.agent_selection == name
            env.step(action[index[name]])
        for name in list(env.agents):
            over = env.terminations[name], env.truncations[name]
            logs[name].append(record(env.observe(name), env.rewards[name], *over))
        while env.agents and (env.terminations[env.agent_selection] or env.truncations[env.agent_selection]):
            env.step(None)
        if not env.agents:
            env.reset()
            for name in env.agents:
                logs[name].append(env.observe(name).tobytes())
    return list(logs.values())


@pytest.mark.parametrize("name", ALONE)
def test_one_learner_gets_the_same_numbers_in_every_face(name):
    task, parameters = ALONE[name]
    env_id, actions = id_of(name), sequence(task)
    expected = through_world(task, actions)
    assert sum(isinstance(entry, bytes) for entry in expected[0]) >= 3  # several episodes
    assert through_gymnasium(env_id, parameters, actions) == expected
    assert through_vector(env_id, parameters, actions) == expected
    assert through_sb3(task, actions) == expected
    if name in (alone := {
        "Pursuit": {"pursuers": 1, "evaders": 1, "sides": "pursuers"}, "Flock": {"agents": 8, "learners": 1},
        "Herd": {"dogs": 1}, "Crossing": {"agents": 8, "learners": 1},
        "Corridor": {"people": 8, "learners": 1}, "Bottleneck": {"people": 8, "learners": 1},
    }):  # fmt: skip
        assert through_parallel(env_id, alone[name], actions) == expected
        assert through_turns(env_id, alone[name], actions) == expected


def test_many_learners_get_the_same_numbers_in_every_face_for_several():
    task = Flock(agents=7, learners=5)
    parameters, actions = {"agents": 7, "learners": 5}, sequence(task)
    expected = through_world(task, actions)
    assert through_sb3(task, actions) == expected
    assert through_vector("flockenv/Flock-v1", parameters, actions) == expected
    assert through_parallel("flockenv/Flock-v1", parameters, actions) == expected
    assert through_turns("flockenv/Flock-v1", parameters, actions) == expected


DISTURBED = {"noise": 0.2, "delay": 2, "dropped": 0.3, "range": 5.0}


def test_a_disturbance_has_the_same_numbers_in_every_face():
    parameters, disturbed = {"agents": 7, "learners": 5}, {**DISTURBED, "seen": 3}
    task, disturbance = Flock(**parameters), Disturbance(**disturbed)
    actions = sequence(task)
    expected = through_world(task, actions, disturbance)
    assert expected != through_world(task, actions)
    assert through_sb3(task, actions, disturbance) == expected
    for through in (through_vector, through_parallel, through_turns):
        assert through("flockenv/Flock-v1", {**parameters, **disturbed}, actions) == expected


def test_a_disturbance_has_the_same_numbers_in_every_face_for_one_learner():
    task, disturbance = Pursuit(), Disturbance(**DISTURBED)
    actions = sequence(task)
    expected = through_world(task, actions, disturbance)
    assert through_gymnasium("flockenv/Pursuit-v0", DISTURBED, actions) == expected
    assert through_vector("flockenv/Pursuit-v0", DISTURBED, actions) == expected
    assert through_sb3(task, actions, disturbance) == expected


@pytest.mark.parametrize(
    ("task", "parameters"),
    [(Pursuit(pursuers=3, evaders=2, sides="both"), {}), (School(metabolism=0.4), {"metabolism": 0.4})],
    ids=["pursuit", "school"],
)
def test_faces_agree_in_a_game_in_which_agents_leave(task, parameters):
    actions, env_id = sequence(task), id_of(type(task).__name__)
    parallel = through_parallel(env_id, parameters, actions)
    assert parallel == through_turns(env_id, parameters, actions)
    for log, whole in zip(parallel, through_world(task, actions), strict=True):
        # The World continues to return rows for an agent that left; the other faces do not.
        assert [e for e in whole if e in log] == log


class Odd(enum.StrEnum):
    QUOTED = "it's {a}\n\\"
    PLAIN = "plain"


@pytest.mark.parametrize("names", [["a", "b"], (Odd.QUOTED, Odd.PLAIN), (np.str_("a"), "class"), ("n1", "agents")])
def test_numbers_keep_their_names_of_any_string_type(names):
    rows = np.arange(6.0).reshape(3, 2)
    expected = [dict(zip(map(str, names), row, strict=True)) for row in rows.tolist()]
    assert list(iterate_by_name(names, rows)) == expected
    infos = ByAgent(names, ["x", "y", "z"]).of(rows, [0.0] * 3, [False] * 3, False, rows.T.tolist(), True)[-1]
    assert infos == {agent: {**its, "is_success": True} for agent, its in zip("xyz", expected, strict=True)}
