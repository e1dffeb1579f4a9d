# /// script
# dependencies = ["torch==2.13.0", "rl_zoo3==2.9.2"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""RL Baselines3 Zoo: its training script, with our package named and the hyperparameters of configs/clients/ppo.yml."""

import subprocess
import sys
import tempfile
from pathlib import Path

from row import IDS, STEPS, row

SETTINGS = Path(__file__).resolve().parents[2] / "configs" / "clients" / "ppo.yml"

for env_id in IDS:
    with row("rl_zoo3", "rl_zoo3.train --algo ppo, id", env_id), tempfile.TemporaryDirectory() as folder:
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
            "-n",
            str(STEPS),
        ]
        options = ["-conf", SETTINGS, "-f", folder, "--eval-freq", "5000", "--eval-episodes", "4", "--verbose", "0"]
        subprocess.run([*command, *options], check=True, cwd=folder, stdout=sys.stderr)
