"""Registers the environments of the table with Gymnasium and PettingZoo, without importing the simulator."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import pettingzoo

from flockenv.envs.table import ENVIRONMENTS, EnvInfo

__all__ = ["register", "register_all"]


def register_all() -> None:
    """Register every environment of the table; existing registrations stay."""
    for info in ENVIRONMENTS.values():
        register(info)


def register(info: EnvInfo) -> None:
    """Add a row to the table, and register its environments with Gymnasium and PettingZoo.

    info: the row of `table.ENVIRONMENTS`: the task, its environments, its horizon and its version.

    An existing registration of the same id stays. Raises ValueError if the table has another row of that name.
    """
    if ENVIRONMENTS.setdefault(info.name, info) != info:
        raise ValueError(f"register: there is another environment {info.name!r}, {ENVIRONMENTS[info.name].id}")
    if info.id not in gymnasium.registry:
        gymnasium.register(
            info.id,
            entry_point=f"flockenv.envs.single:{info.name}Env",
            vector_entry_point=f"flockenv.envs.vector:{info.name}VectorEnv",
            max_episode_steps=info.horizon,
        )
    if info.team:
        _register_team("parallel", info, f"flockenv.envs.parallel:{info.name}ParallelEnv")
        _register_team("aec", info, f"flockenv.envs.aec:{info.name}AECEnv")


def _register_team(kind: Literal["parallel", "aec"], info: EnvInfo, entry_point: str) -> None:
    registry: dict[str, Any] = pettingzoo.parallel_registry if kind == "parallel" else pettingzoo.aec_registry
    if info.id not in registry:
        pettingzoo.register(kind, info.id, entry_point, max_cycles=info.horizon)
