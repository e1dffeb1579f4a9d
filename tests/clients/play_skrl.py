# /// script
# dependencies = ["torch==2.13.0", "skrl==2.1.1"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""skrl: one environment, our vector form, and PettingZoo's parallel form, by its wrappers."""

import gymnasium
import pettingzoo
import torch
from row import IDS, STEPS, row
from skrl.envs.wrappers.torch import wrap_env

import flockenv  # noqa: F401  # registers the ids


def play(env, rows, steps):
    """Take random steps."""
    env.reset()
    for _ in range(steps):
        env.step(2 * torch.rand(rows, *env.action_space.shape) - 1)


for env_id in IDS:
    with row("skrl", "wrap_env, id", env_id):
        env = wrap_env(gymnasium.make(env_id))
        observation, _ = env.reset()
        for _ in range(STEPS):
            _, _, terminated, truncated, _ = env.step(2 * torch.rand(1, *env.action_space.shape) - 1)
            if terminated.any() or truncated.any():
                env.reset()
    with row("skrl", 'wrap_env(make_vec, wrapper="gymnasium")', env_id, lines=1):
        play(wrap_env(gymnasium.make_vec(env_id, num_envs=4), wrapper="gymnasium"), 4, STEPS // 4)
    with row("skrl", 'wrap_env(parallel, wrapper="pettingzoo")', env_id, lines=1):
        env = wrap_env(pettingzoo.make("parallel", env_id), wrapper="pettingzoo")
        env.reset()
        for _ in range(STEPS):
            spaces = {agent: env.action_space(agent) for agent in env.agents}
            env.step({agent: 2 * torch.rand(1, *space.shape) - 1 for agent, space in spaces.items()})
            if not env.agents:
                env.reset()
