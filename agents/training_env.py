"""The environment in which PPO trains: all drawn settings side by side, with the rules of a hybrid in between."""

from __future__ import annotations

from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from agents.drawn import drawn_settings, hybrid_of, reward_weight
from agents.drawn_env import DrawnVecEnv
from agents.experiment import PpoSettings
from agents.hybrid_env import HybridVecEnv
from agents.learning_env import ForLearning
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.tasks import Task

__all__ = ["learning_env"]


def learning_env(task: Task, p: PpoSettings, env_class: type[WorldVecEnv] = WorldVecEnv) -> VecEnv:
    """Return the worlds of a training; each drawn setting has an equal share of `p.worlds`."""
    settings = drawn_settings(task, p.disturbance, p.draw)
    parts: dict[str, VecEnvWrapper] = {}
    for name, drawn, disturbance in settings:
        learned = drawn.model_copy(update={"dtype": p.dtype})
        share = p.worlds // len(settings)
        envs = env_class(learned, share, leaving=not task.ends_together, disturbance=disturbance)
        parts[name] = ForLearning(envs, p.reward_scale * reward_weight(drawn), p.stagger, p.hold)
        if (hybrid := hybrid_of(drawn, p)) is not None:
            parts[name] = HybridVecEnv(parts[name], hybrid)
    return DrawnVecEnv(parts) if len(parts) > 1 else next(iter(parts.values()))
