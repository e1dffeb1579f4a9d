"""Settings of the learners of agents.learn, besides those that they share with PPO (agents.learn.SHARED)."""

from __future__ import annotations

from pydantic import Field

from flockenv.core.record import Record

__all__ = ["CloningSettings", "OffPolicySettings", "RecurrentSettings"]


class OffPolicySettings(Record):
    """Settings of SAC and TQC: fewer worlds than PPO has, and gradient steps on minibatches from a replay buffer."""

    steps: int = Field(default=1_000_000, ge=1, description="agent-steps in all")
    worlds: int = Field(default=64, ge=1, description="worlds stepped together; rows = worlds x learners")
    buffer: int = Field(default=400_000, ge=1, description="actions of single rows that the replay buffer holds")
    minibatch: int = Field(default=256, ge=1, description="actions per gradient step")
    actions_per_update: float = Field(default=16, gt=0, description="actions of single rows per gradient step")
    random_actions: int = Field(default=10_000, ge=0, description="uniform actions of single rows before learning")
    learning_rate: float = Field(default=1e-3, gt=0, description="of all networks, constant")
    reward_scale: float = Field(default=1.0, gt=0, description="rewards are multiplied by this while learning")
    entropy_weight: float = Field(default=0.1, gt=0, description="of the objective, at the start; then it is learnt")
    tau: float = Field(default=0.005, gt=0, le=1, description="share of the critics in an update of their targets")
    threads: int = Field(
        default=1, ge=1, le=64, description="of torch and of the worlds; more cost time at these sizes on shared cores"
    )
    evaluate_every: int = Field(default=50_000, ge=1, description="agent-steps between points of the curve")


class RecurrentSettings(Record):
    """Settings of RecurrentPPO; all others are those of `ppo`."""

    lstm: int = Field(default=64, ge=1, le=4096, description="units of the LSTM before the layers of `ppo.hidden`")


class CloningSettings(Record):
    """Settings of behaviour cloning of the tuned rules."""

    updates: int = Field(default=6000, ge=1, description="gradient steps, each of 2,048 rows")
    worlds: int = Field(default=96, ge=1, description="training worlds of each round, an episode each")
    rounds: int = Field(
        default=1, ge=1, le=64, description="1: in states of the rules; more: then also in its own states (DAgger)"
    )
    evaluate_updates: int = Field(default=1000, ge=1, description="gradient steps between points of the curve")
