# /// script
# dependencies = ["torch==2.13.0", "rl_zoo3==2.9.2"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""RL Baselines3 Zoo: its training script, with our package named and the settings of docs/clients.md."""

import subprocess
import sys
import tempfile
from pathlib import Path

from row import IDS, STEPS, row
from zoo_settings import rl_zoo_settings

for env_id in IDS:
    with row("rl_zoo3", "rl_zoo3.train --algo ppo, id", env_id), tempfile.TemporaryDirectory() as folder:
        settings = Path(folder, "ppo.yml")
        settings.write_text(rl_zoo_settings().replace("flockenv/Pursuit-v0", env_id), encoding="utf-8")
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
        options = ["-conf", settings, "-f", folder, "--eval-freq", "5000", "--eval-episodes", "4", "--verbose", "0"]
        subprocess.run([*command, *options], check=True, cwd=folder, stdout=sys.stderr)
