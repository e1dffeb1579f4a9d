# /// script
# dependencies = ["wandb==0.31.0", "torch==2.13.0", "stable-baselines3==2.9.2", "tensorboard==2.21.0"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""Weights & Biases: its callback for Stable-Baselines3, offline, so that nothing is sent."""

import os
import tempfile
from pathlib import Path

os.environ["WANDB_MODE"] = "offline"

import wandb
from row import IDS, STEPS, row
from stable_baselines3 import PPO
from wandb.integration.sb3 import WandbCallback

import flockenv  # noqa: F401  # registers the ids

with tempfile.TemporaryDirectory() as folder:
    for env_id in IDS:
        with row("wandb", "WandbCallback, offline, id", env_id):
            run = wandb.init(project="flockenv", sync_tensorboard=True, dir=folder)
            model = PPO(
                "MlpPolicy", env_id, n_steps=500, batch_size=100, n_epochs=2, tensorboard_log=f"{folder}/{run.id}"
            )
            model.learn(STEPS, callback=WandbCallback())
            run.finish()
    assert list(Path(folder).rglob("*.wandb")), "runs are written as files"
