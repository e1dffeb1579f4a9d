# /// script
# dependencies = ["torch==2.13.0", "sb3-contrib==2.9.2"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""sb3-contrib: TQC and a recurrent PPO by id."""

from row import IDS, STEPS, row
from sb3_contrib import TQC, RecurrentPPO

import flockenv  # noqa: F401  # registers the ids

for env_id in IDS:
    with row("sb3-contrib", "TQC, id", env_id):
        TQC("MlpPolicy", env_id, train_freq=100, gradient_steps=10).learn(STEPS)
    with row("sb3-contrib", "RecurrentPPO, id", env_id):
        RecurrentPPO("MlpLstmPolicy", env_id, n_steps=500, batch_size=100, n_epochs=1).learn(STEPS)
