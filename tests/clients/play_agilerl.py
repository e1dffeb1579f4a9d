# /// script
# dependencies = ["torch==2.13.0", "agilerl==2.7.1"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""AgileRL: PPO over its own vectors of an id; random actions and IPPO in its vectors of PettingZoo's parallel form."""

import pettingzoo
from agilerl.algorithms import IPPO, PPO
from agilerl.training.train_multi_agent_on_policy import train_multi_agent_on_policy
from agilerl.training.train_on_policy import train_on_policy
from agilerl.utils.utils import make_vect_envs
from agilerl.vector.pz_async_vec_env import AsyncPettingZooVecEnv
from row import IDS, STEPS, row

import flockenv  # noqa: F401  # registers the ids

TOGETHER = "flockenv/Crossing-v0"
"""Where all agents end together: IPPO needs each agent to end at the same time in all worlds of a batch."""


def play(envs, steps):
    """Take random steps in all of them, with an action for each agent, as AgileRL's batches have it."""
    envs.reset()
    for _ in range(steps):
        envs.step({agent: envs.action_space(agent).sample() for agent in envs.agents})


def several(env_id):
    """Make two worlds, each in a process of its own."""
    return AsyncPettingZooVecEnv([lambda: pettingzoo.make("parallel", env_id)] * 2)


def main():
    """Play; in a function, since its worker processes may import this file."""
    options = {"max_steps": STEPS, "evo_steps": STEPS, "eval_steps": 50, "verbose": False}
    for env_id in IDS:
        with row("agilerl", "PPO, make_vect_envs", env_id):
            envs = make_vect_envs(env_id, num_envs=4)
            agent = PPO(envs.single_observation_space, envs.single_action_space, learn_step=500, num_envs=4)
            train_on_policy(envs, env_id, "PPO", [agent], **options)
            envs.close()
        with row("agilerl", "AsyncPettingZooVecEnv", env_id):
            envs = several(env_id)
            play(envs, STEPS // 2)
            envs.close()
    with row("agilerl", "IPPO, AsyncPettingZooVecEnv", TOGETHER):
        envs, one = several(TOGETHER), pettingzoo.make("parallel", TOGETHER)
        spaces = [list(each.values()) for each in (one.observation_spaces, one.action_spaces)]
        agent = IPPO(*spaces, one.possible_agents, learn_step=1000, batch_size=1000, update_epochs=1)
        train_multi_agent_on_policy(envs, TOGETHER, "IPPO", [agent], **options)
        envs.close()


if __name__ == "__main__":
    main()
