"""Pursuit for PettingZoo, as a module: env() (AEC), parallel_env(), and raw_env, the class of both."""

from __future__ import annotations

from typing import Any

from pettingzoo import AECEnv

from flockenv.envs.aec import by_turns
from flockenv.envs.parallel import PursuitParallelEnv

__all__ = ["env", "parallel_env", "raw_env"]

raw_env = PursuitParallelEnv


def parallel_env(
    max_cycles: int | None = None, render_mode: str | None = None, **parameters: Any
) -> PursuitParallelEnv:
    """Make the parallel environment; the parameters are those of flockenv.tasks.Pursuit."""
    return PursuitParallelEnv(max_cycles, render_mode, **parameters)


def env(max_cycles: int | None = None, render_mode: str | None = None, **parameters: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based environment (AEC); the parameters are those of flockenv.tasks.Pursuit."""
    return by_turns(parallel_env(max_cycles, render_mode, **parameters))
