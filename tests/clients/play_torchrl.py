# /// script
# dependencies = ["torch==2.13.0", "torchrl==0.14.1", "tensordict==0.14.3"]
# [tool.flockenv]
# constraints = "configs/constraints.txt"
# ///
"""TorchRL: PPO in GymEnv by id; random actions in PettingZooWrapper around both of PettingZoo's forms."""

import pettingzoo
import torch
from row import IDS, STEPS, row
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs.libs.gym import GymEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import flockenv  # noqa: F401  # registers the ids

TOGETHER = ("flockenv/Crossing-v0",)
"""Where all agents end together. Elsewhere the turn-based form cannot be played: TorchRL passes an action for an agent
that has ended, which PettingZoo does not allow."""


def collect(env):
    """Collect STEPS frames of random actions, over the ends of episodes; return how many there were."""
    collector = Collector(env, None, frames_per_batch=500, total_frames=STEPS)
    return sum(batch.numel() for batch in collector)


def learn(env):
    """Learn by PPO from STEPS frames; return how many there were."""
    size, actions = env.observation_spec["observation"].shape[0], env.action_spec.shape[0]
    layers = torch.nn.Sequential(MLP(size, 2 * actions, num_cells=[64, 64]), NormalParamExtractor())
    policy = ProbabilisticActor(
        TensorDictModule(layers, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(size, 1, num_cells=[64, 64]), in_keys=["observation"])
    advantage, loss, frames = GAE(gamma=0.99, lmbda=0.95, value_network=critic), ClipPPOLoss(policy, critic), 0
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    options = {"frames_per_batch": 500, "total_frames": STEPS, "auto_register_policy_transforms": True}
    for batch in Collector(env, policy, **options):
        frames += batch.numel()
        for _ in range(4):
            losses = loss(advantage(batch))
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
            optimizer.step()
    return frames


for env_id in IDS:
    with row("torchrl", "PPO, GymEnv, id", env_id) as played:
        check_env_specs(GymEnv(env_id))
        played["steps"] = learn(GymEnv(env_id))
    with row("torchrl", "PettingZooWrapper, parallel, use_mask=True, done_on_any=False", env_id) as played:
        env = PettingZooWrapper(pettingzoo.make("parallel", env_id), use_mask=True, done_on_any=False)
        played["steps"] = collect(env)

for env_id in TOGETHER:
    with row("torchrl", "PettingZooWrapper, aec, use_mask=True", env_id) as played:
        env = PettingZooWrapper(pettingzoo.make("aec", env_id), use_mask=True)
        played["steps"] = collect(env)
