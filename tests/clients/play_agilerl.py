# /// script
# dependencies = ["torch==2.13.0", "agilerl==2.7.1"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""AgileRL: PPO over its own vectors of an id, and its asynchronous vectors of PettingZoo's parallel form."""

import numpy as np
import pettingzoo
from agilerl.algorithms.ppo import PPO
from agilerl.training.train_on_policy import train_on_policy
from agilerl.utils.utils import make_vect_envs
from agilerl.vector.pz_async_vec_env import AsyncPettingZooVecEnv
from row import IDS, STEPS, row

import flockenv  # noqa: F401  # registers the ids


def drawn(envs, seen, over):
    """Return random actions by agent; NaN for one that has left.

    AgileRL shows NaN of such an agent, but not yet in the step in which it leaves; an action for it after that step is
    refused, as PettingZoo's contract has it.
    """
    gone = np.stack([np.isnan(rows).all(axis=1) for rows in seen.values()]) | (over == 1)
    gone &= (over == 0).any(axis=0)  # where none goes on, a new episode has begun
    spaces = [envs.action_space(agent) for agent in seen]
    return {
        agent: np.where(left[:, None], np.nan, space.sample())
        for agent, left, space in zip(seen, gone, spaces, strict=True)
    }


def play(envs, steps):
    """Take random steps in all of them."""
    seen, _ = envs.reset()
    over = np.zeros((len(seen), envs.num_envs))
    for _ in range(steps):
        seen, _, terminated, truncated, _ = envs.step(drawn(envs, seen, over))
        over = np.stack([np.maximum(terminated[agent], truncated[agent]) for agent in seen])


def main():
    """Play; in a function, since its worker processes may import this file."""
    for env_id in IDS:
        with row("agilerl", "PPO, make_vect_envs", env_id):
            envs = make_vect_envs(env_id, num_envs=4)
            agent = PPO(envs.single_observation_space, envs.single_action_space, learn_step=500, num_envs=4)
            options = {"max_steps": STEPS, "evo_steps": STEPS, "eval_steps": 50, "verbose": False}
            train_on_policy(envs, env_id, "PPO", [agent], **options)
            envs.close()
        with row("agilerl", "AsyncPettingZooVecEnv", env_id, lines=0 if "Crossing" in env_id else 2):
            envs = AsyncPettingZooVecEnv([lambda env_id=env_id: pettingzoo.make("parallel", env_id)] * 2)
            play(envs, STEPS // 2)
            envs.close()


if __name__ == "__main__":
    main()
