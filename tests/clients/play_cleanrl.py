# /// script
# dependencies = ["torch==2.13.0"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""CleanRL's ppo_continuous_action: its wrappers, in gymnasium's vector form, over our native vector environments."""

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import vector as wrappers
from row import IDS, STEPS, row

import flockenv  # noqa: F401  # registers the ids

ROWS, GAMMA = 8, 0.99


def made(env_id):
    """Return the stack of make_env, over all rows at once."""
    envs = gymnasium.make_vec(env_id, num_envs=ROWS, max_episode_steps=100)  # some end within 1,000 steps
    envs = wrappers.FlattenObservation(envs)
    envs = wrappers.RecordEpisodeStatistics(envs)
    envs = wrappers.ClipAction(envs)
    envs = wrappers.NormalizeObservation(envs)
    envs = wrappers.TransformObservation(envs, lambda seen: np.clip(seen, -10, 10))
    envs = wrappers.NormalizeReward(envs, gamma=GAMMA)
    return wrappers.TransformReward(envs, lambda reward: np.clip(reward, -10, 10))


def layers(inputs, outputs):
    """Return a small network."""
    return torch.nn.Sequential(torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, outputs))


def learn(envs, steps):
    """Learn by an actor and a critic of one-step advantages; return how many episodes ended."""
    size, acts = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    actor, critic, ended = layers(size, acts), layers(size, 1), 0
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], 3e-4)
    seen, over = torch.tensor(envs.reset(seed=1)[0], dtype=torch.float32), np.zeros(ROWS, bool)
    for _ in range(steps // ROWS):
        chance = torch.distributions.Normal(actor(seen), 0.6)
        action = chance.sample()
        rows, reward, terminated, truncated, infos = envs.step(action.numpy())
        after, live = torch.tensor(rows, dtype=torch.float32), torch.tensor(~over)
        value, later = critic(seen)[:, 0], critic(after)[:, 0].detach() * torch.tensor(~terminated)
        gain = (torch.tensor(reward, dtype=torch.float32) + GAMMA * later - value) * live  # a reset is no step
        loss = gain.square().mean() - (chance.log_prob(action).sum(1) * gain.detach()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        seen, over = after, terminated | truncated
        ended += int(infos["_episode"].sum()) if "episode" in infos else 0
    return ended


for env_id in IDS:
    with row("gymnasium", "CleanRL's wrappers, make_vec", env_id):
        assert learn(made(env_id), STEPS) > 0
