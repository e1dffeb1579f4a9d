# /// script
# dependencies = ["torch==2.13.0", "torchrl==0.14.1", "tensordict==0.14.3"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""TorchRL: GymEnv by id, and PettingZooWrapper around both of PettingZoo's forms."""

import pettingzoo
from row import IDS, STEPS, row
from torchrl.collectors import Collector
from torchrl.envs.libs.gym import GymEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

import flockenv  # noqa: F401  # registers the ids

TOGETHER = ("flockenv/Crossing-v0",)
"""Where all agents end together. Elsewhere the turn-based form cannot be played: TorchRL passes an action for an agent
that has ended, which PettingZoo does not allow."""


def collect(env):
    """Collect STEPS frames of random actions, over the ends of episodes; return how many there were."""
    collector = Collector(env, None, frames_per_batch=500, total_frames=STEPS)
    return sum(batch.numel() for batch in collector)


for env_id in IDS:
    with row("torchrl", "GymEnv, id", env_id) as played:
        check_env_specs(GymEnv(env_id))
        played["steps"] = collect(GymEnv(env_id))
    with row("torchrl", "PettingZooWrapper, parallel, use_mask=True, done_on_any=False", env_id) as played:
        env = PettingZooWrapper(pettingzoo.make("parallel", env_id), use_mask=True, done_on_any=False)
        played["steps"] = collect(env)

for env_id in TOGETHER:
    with row("torchrl", "PettingZooWrapper, aec, use_mask=True", env_id) as played:
        env = PettingZooWrapper(pettingzoo.make("aec", env_id), use_mask=True)
        played["steps"] = collect(env)
