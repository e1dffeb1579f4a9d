# /// script
# dependencies = ["torch==2.13.0", "tianshou==2.0.1"]
# ///
"""Tianshou: PPO over its DummyVectorEnv, and its PettingZooEnv around the turn-based form."""

import gymnasium
import pettingzoo
import torch
from row import IDS, STEPS, row
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

import flockenv  # noqa: F401  # registers the ids


def learner(env):
    """Return PPO for an environment, as Tianshou's examples build it."""
    shape, acts = env.observation_space.shape, env.action_space.shape
    nets = [Net(state_shape=shape, hidden_sizes=[64, 64]) for _ in range(2)]
    actor = ContinuousActorProbabilistic(preprocess_net=nets[0], action_shape=acts)
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda both: torch.distributions.Independent(torch.distributions.Normal(*both), 1),
        action_space=env.action_space,
    )
    return PPO(policy=policy, critic=ContinuousCritic(preprocess_net=nets[1]), optim=AdamOptimizerFactory(lr=3e-4))


for env_id in IDS:
    with row("tianshou", "PPO, DummyVectorEnv", env_id):
        envs = DummyVectorEnv([lambda env_id=env_id: gymnasium.make(env_id) for _ in range(4)])
        algorithm = learner(gymnasium.make(env_id))
        algorithm.run_training(
            OnPolicyTrainerParams(
                training_collector=Collector(algorithm, envs, VectorReplayBuffer(2000, 4)),
                max_epochs=1,
                epoch_num_steps=STEPS,
                collection_step_num_env_steps=1000,
                batch_size=100,
            )
        )
    with row("tianshou", "PettingZooEnv(aec)", env_id):
        env = PettingZooEnv(pettingzoo.make("aec", env_id))
        env.reset()
        for _ in range(STEPS):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
