# /// script
# dependencies = ["torch==2.13.0", "stable-baselines3==2.9.2"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""Stable-Baselines3: PPO and SAC by id, and PPO over every learner of many worlds at once."""

from row import IDS, STEPS, row
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

import flockenv  # noqa: F401  # registers the ids
from flockenv.envs.sb3 import WorldMonitor, WorldVecEnv
from flockenv.tasks import Bottleneck, Crossing, Pursuit

for env_id in IDS:
    with row("stable-baselines3", "PPO, id", env_id):
        model = PPO("MlpPolicy", env_id, n_steps=500, batch_size=100, n_epochs=2)
        model.learn(STEPS)
        evaluate_policy(model, model.get_env(), n_eval_episodes=2)
    with row("stable-baselines3", "SAC, id", env_id):
        SAC("MlpPolicy", env_id, train_freq=100, gradient_steps=10).learn(STEPS)

for env_id, task in zip(IDS, (Pursuit(), Crossing(), Bottleneck()), strict=True):
    with row("stable-baselines3", "PPO, WorldMonitor(WorldVecEnv), all learners", env_id):
        worlds = WorldMonitor(WorldVecEnv(task, worlds=4, leaving=not task.ends_together))
        model = PPO("MlpPolicy", VecNormalize(worlds), n_steps=100, batch_size=200, n_epochs=2)
        model.learn(STEPS)
