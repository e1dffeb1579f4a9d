"""APIs of one World: gymnasium (single.py, vector.py), pettingzoo (parallel.py, aec.py), Stable-Baselines3 (sb3.py).

They hold no physics and no rules: they only translate shapes, names and conventions, so that an action sequence gives
the same numbers through each of them. table.py has a row for each task. As in PettingZoo, `pursuit_v0` and the like
are modules with `env`, `parallel_env` and `raw_env`::

    from flockenv.envs import pursuit_v0
    env = pursuit_v0.parallel_env(evaders=3)
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

from flockenv.envs.registration import register
from flockenv.envs.table import ENVIRONMENTS, EnvInfo

__all__ = ["EnvInfo", "register"]


def __getattr__(name: str) -> Any:
    """Return the module of a PettingZoo environment; of a former version, one whose functions raise an error."""
    lower, _, version = name.rpartition("_v")
    info = next((info for info in ENVIRONMENTS.values() if info.team and info.name.lower() == lower), None)
    if info is not None and version == str(info.version):
        return globals().setdefault(name, _module(name, info))
    if info is not None and version in map(str, info.former):
        from pettingzoo.utils.deprecated_module import DeprecatedModule

        return DeprecatedModule(lower, version, str(info.version))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _module(name: str, info: EnvInfo) -> ModuleType:
    from flockenv.envs import aec, parallel

    module = ModuleType(f"{__name__}.{name}", f"{info.name} for PettingZoo: env() (AEC) and parallel_env().")
    module.__dict__["env"] = getattr(aec, f"{info.name}AECEnv")
    module.__dict__["parallel_env"] = module.__dict__["raw_env"] = getattr(parallel, f"{info.name}ParallelEnv")
    return module
