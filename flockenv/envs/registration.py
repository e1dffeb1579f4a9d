"""The ids, and where each is built: strings and numbers only, so that importing flockenv imports no simulator."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import pettingzoo

__all__ = ["HORIZONS", "PARALLEL", "SINGLE", "register_all"]

HORIZONS = {
    "Pursuit": 300,
    "Obstacles": 250,
    "Flock": 300,
    "Herd": 600,
    "Crossing": 200,
    "Evade": 300,
    "PathFollow": 300,
    "School": 400,
    "CrowdNav": 250,
    "Corridor": 300,
    "Bottleneck": 300,
}
"""Time limit of an episode in control steps, by name: `Task.horizon`, repeated here so that no task is imported."""

SINGLE = tuple(f"flockenv/{name}-v0" for name in HORIZONS)
"""Ids for gymnasium.make and gymnasium.make_vec: one learner, everybody else is scripted."""

PARALLEL = {
    "flockenv/Bottleneck-v0": "bottleneck_v0",
    "flockenv/Corridor-v0": "corridor_v0",
    "flockenv/Crossing-v0": "crossing_v0",
    "flockenv/Flock-v0": "flock_v0",
    "flockenv/Herd-v0": "herd_v0",
    "flockenv/Pursuit-v0": "pursuit_v0",
    "flockenv/School-v0": "school_v0",
}
"""Ids for pettingzoo.make("parallel" or "aec", ...), and the module in flockenv.envs that builds each."""


def register_all() -> None:
    """Tell Gymnasium and PettingZoo about every environment; what is there already stays."""
    for name, horizon in HORIZONS.items():
        _register_single(f"flockenv/{name}-v0", name, horizon)
    for env_id, module in PARALLEL.items():
        horizon = HORIZONS[env_id.removeprefix("flockenv/").removesuffix("-v0")]
        _register_many("parallel", env_id, f"flockenv.envs.{module}:parallel_env", horizon)
        _register_many("aec", env_id, f"flockenv.envs.{module}:env", horizon)


def _register_single(env_id: str, name: str, horizon: int) -> None:
    if env_id not in gymnasium.registry:
        gymnasium.register(
            env_id,
            entry_point=f"flockenv.envs.single:{name}Env",
            vector_entry_point=f"flockenv.envs.vector:{name}VectorEnv",
            max_episode_steps=horizon,
        )


def _register_many(kind: Literal["parallel", "aec"], env_id: str, entry_point: str, horizon: int) -> None:
    registry: dict[str, Any] = pettingzoo.parallel_registry if kind == "parallel" else pettingzoo.aec_registry
    if env_id not in registry:
        pettingzoo.register(kind, env_id, entry_point, max_cycles=horizon)
