"""APIs of one World: gymnasium (single.py, vector.py), pettingzoo (parallel.py, aec.py), Stable-Baselines3 (sb3.py).

They hold no physics and no rules: they only translate shapes, names and conventions, so that an action sequence gives
the same numbers through each of them.
"""

from __future__ import annotations

from typing import Any

from flockenv.envs.registration import PARALLEL

__all__: list[str] = []


def __getattr__(name: str) -> Any:
    """Return PettingZoo's stand-in for a former version of an environment, whose functions raise an error."""
    former, _, version = name.rpartition("_v")
    current = {module.rpartition("_v")[0]: module.rpartition("_v")[2] for module in PARALLEL.values()}
    if former in current and version.isdigit() and int(version) < int(current[former]):
        from pettingzoo.utils.deprecated_module import DeprecatedModule

        return DeprecatedModule(former, version, current[former])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
