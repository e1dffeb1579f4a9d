"""Crossing for PettingZoo, as a module: env() (AEC), parallel_env(), and raw_env, the class of both."""

from __future__ import annotations

from typing import Any

from pettingzoo import AECEnv

from flockenv.envs.aec import by_turns
from flockenv.envs.parallel import CrossingParallelEnv

__all__ = ["env", "parallel_env", "raw_env"]

raw_env = CrossingParallelEnv


def parallel_env(
    max_cycles: int | None = None, render_mode: str | None = None, **parameters: Any
) -> CrossingParallelEnv:
    """Make the parallel environment; the parameters are those of flockenv.tasks.Crossing."""
    return CrossingParallelEnv(max_cycles, render_mode, **parameters)


def env(max_cycles: int | None = None, render_mode: str | None = None, **parameters: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based environment (AEC); the parameters are those of flockenv.tasks.Crossing."""
    return by_turns(parallel_env(max_cycles, render_mode, **parameters))
