"""Environment ids, and the module that builds each; only strings and numbers, so that no simulator is imported."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import pettingzoo

__all__ = ["HORIZONS", "PARALLEL", "SINGLE", "VERSIONS", "id_of", "register_all"]

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
"""Time limit of an episode in decisions, by name: `Task.horizon`, repeated here so that no task is imported."""

VERSIONS = {"Corridor": 1, "Evade": 1, "Flock": 1}
"""Versions of environments whose results have changed, by name; all others are 0. Reasons: each class's `history`."""


def id_of(name: str) -> str:
    """Return the id of an environment: flockenv/Pursuit-v0 for "Pursuit"."""
    return f"flockenv/{name}-v{VERSIONS.get(name, 0)}"


SINGLE = tuple(id_of(name) for name in HORIZONS)
"""Ids for gymnasium.make and gymnasium.make_vec: by default one learner, all other agents scripted."""

PARALLEL = {
    id_of(name): f"{name.lower()}_v{VERSIONS.get(name, 0)}"
    for name in ("Bottleneck", "Corridor", "Crossing", "Flock", "Herd", "Pursuit", "School")
}
"""Ids for pettingzoo.make("parallel" or "aec", ...), and the module in flockenv.envs that builds each."""


def register_all() -> None:
    """Register every environment with Gymnasium and PettingZoo; existing registrations stay."""
    for name, horizon in HORIZONS.items():
        _register_single(id_of(name), name, horizon)
    for env_id, module in PARALLEL.items():
        horizon = HORIZONS[env_id.removeprefix("flockenv/").partition("-v")[0]]
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
