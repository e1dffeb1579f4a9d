# /// script
# dependencies = ["torch==2.13.0", "sbx-rl==0.28.0"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""sbx, Stable-Baselines3's algorithms in JAX: SAC by id, and PPO over every learner of many worlds at once."""

import sbx
from row import IDS, STEPS, row

import flockenv  # noqa: F401  # registers the ids
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.tasks import Bottleneck, Crossing, Pursuit

for env_id, task in zip(IDS, (Pursuit(), Crossing(), Bottleneck()), strict=True):
    with row("sbx-rl", "SAC, id", env_id):
        sbx.SAC("MlpPolicy", env_id, train_freq=100, gradient_steps=10).learn(STEPS)
    with row("sbx-rl", "PPO, WorldVecEnv, all learners", env_id):
        worlds = WorldVecEnv(task, worlds=4, leaving=not task.ends_together)
        sbx.PPO("MlpPolicy", worlds, n_steps=100, batch_size=200, n_epochs=2).learn(STEPS)
