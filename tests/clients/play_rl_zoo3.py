# /// script
# dependencies = ["torch==2.13.0", "rl_zoo3==2.9.2"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""RL Baselines3 Zoo: its training script, with our package named and settings of our own."""

import subprocess
import sys
import tempfile
from pathlib import Path

from row import IDS, STEPS, row

SETTINGS = """
{env_id}:
  n_timesteps: !!float {steps}
  policy: MlpPolicy
  n_envs: 4
  n_steps: 250
  batch_size: 100
  n_epochs: 2
  normalize: true
"""

for env_id in IDS:
    with row("rl_zoo3", "rl_zoo3.train --algo ppo, id", env_id), tempfile.TemporaryDirectory() as folder:
        settings = Path(folder, "ppo.yml")
        settings.write_text(SETTINGS.format(env_id=env_id, steps=STEPS), encoding="utf-8")
        command = [
            sys.executable,
            "-m",
            "rl_zoo3.train",
            "--algo",
            "ppo",
            "--env",
            env_id,
            "--gym-packages",
            "flockenv",
        ]
        options = ["-conf", settings, "-f", folder, "--eval-freq", "5000", "--eval-episodes", "4", "--verbose", "0"]
        subprocess.run([*command, *options], check=True, cwd=folder, stdout=sys.stderr)
