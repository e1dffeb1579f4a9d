"""Scenes that ship with flockenv, by name: `flockenv run boids`, `load_scene("boids")`.

They are the files of configs/scenes. In a wheel, setup.py has copied them to flockenv/scenes.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

__all__ = ["bundled_scenes"]

PACKAGE = Path(__file__).resolve().parent.parent


@functools.cache
def bundled_scenes() -> Mapping[str, Path]:
    """Return the YAML files of all scenes that ship, by name, in alphabetical order."""
    installed = PACKAGE / "scenes"
    folder = installed if installed.is_dir() else PACKAGE.parent / "configs" / "scenes"
    return MappingProxyType({path.stem: path for path in sorted(folder.glob("*.yaml"))})
