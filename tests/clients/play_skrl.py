# /// script
# dependencies = ["torch==2.13.0", "skrl==2.1.1"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""skrl: PPO in our vector form, by its wrapper; random actions in one environment and in the parallel form."""

import gymnasium
import pettingzoo
import torch
from row import IDS, STEPS, row
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

import flockenv  # noqa: F401  # registers the ids

ROWS = 8


def trainer(env, steps):
    """Return PPO for a vector environment, which takes this many steps in each of its rows and writes no files."""
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    network = [{"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}]
    models = {
        "policy": gaussian_model(**spaces, network=network, output="ACTIONS", clip_mean_actions=True),
        "value": deterministic_model(**spaces, network=network, output="ONE"),
    }
    files = {"write_interval": 0, "checkpoint_interval": 0}
    settings = PPO_CFG(rollouts=32, mini_batches=4, time_limit_bootstrap=True, experiment=files)
    agent = PPO(models=models, memory=RandomMemory(memory_size=32, num_envs=ROWS), cfg=settings, **spaces)
    options = {"timesteps": steps, "headless": True, "disable_progressbar": True}
    return SequentialTrainer(env=env, agents=agent, cfg=options)


for env_id in IDS:
    with row("skrl", "wrap_env, id", env_id):
        env = wrap_env(gymnasium.make(env_id))
        observation, _ = env.reset()
        for _ in range(STEPS):
            _, _, terminated, truncated, _ = env.step(2 * torch.rand(1, *env.action_space.shape) - 1)
            if terminated.any() or truncated.any():
                env.reset()
    with row("skrl", 'PPO, headless, wrap_env(make_vec, wrapper="gymnasium")', env_id, lines=2):
        envs = gymnasium.make_vec(env_id, num_envs=ROWS, autoreset_mode="SameStep")
        training = trainer(wrap_env(envs, wrapper="gymnasium"), STEPS // ROWS)
        before = training.agents.policy.log_std_parameter.clone()
        training.train()
        assert not torch.equal(before, training.agents.policy.log_std_parameter), "it learns"
    with row("skrl", 'wrap_env(parallel, wrapper="pettingzoo")', env_id, lines=1):
        env = wrap_env(pettingzoo.make("parallel", env_id), wrapper="pettingzoo")
        env.reset()
        for _ in range(STEPS):
            spaces = {agent: env.action_space(agent) for agent in env.agents}
            env.step({agent: 2 * torch.rand(1, *space.shape) - 1 for agent, space in spaces.items()})
            if not env.agents:
                env.reset()
