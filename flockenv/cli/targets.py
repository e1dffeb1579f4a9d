"""Arguments that name a task or a scene: which of the two it is, and the completion of such a word."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from flockenv.core.bundled import bundled_scenes
from flockenv.core.errors import nearest, printable
from flockenv.core.yaml_paths import STANDARD_INPUT, has_yaml_suffix

__all__ = ["SceneFile", "complete_scene", "complete_target", "is_scene"]


def is_scene(target: str) -> bool:
    """Return True if a word names a scene that ships or a scene file (or standard input), False if a task.

    The file may be missing: then reading it says so. Raises ValueError if the word can be neither.
    """
    from flockenv.tasks import TASKS

    if target in TASKS:
        return False
    if target == STANDARD_INPUT or target in bundled_scenes() or has_yaml_suffix(target) or Path(target).exists():
        return True
    tasks = f"{nearest(target, [*TASKS, *bundled_scenes()])} ({', '.join(TASKS)})"
    raise ValueError(f"{printable(target)}: no such task{tasks}, nor a scene of `flockenv list` or a .yaml file")


def complete_target(incomplete: str) -> list[str]:
    """Return the tasks, scenes, scene files and folders that complete a word (shell completion)."""
    from flockenv.envs.table import ENVIRONMENTS

    tasks = (re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() for name in ENVIRONMENTS)
    return [*(word for word in tasks if word.startswith(incomplete)), *complete_scene(incomplete)]


def complete_scene(incomplete: str) -> list[str]:
    """Return the scenes that ship, scene files and folders that complete a word (shell completion)."""
    here = Path(incomplete).parent if "/" in incomplete else Path()
    found = sorted(here.iterdir()) if here.is_dir() else []
    files = [f"{p}/" if p.is_dir() else str(p) for p in found if p.is_dir() or has_yaml_suffix(p.name)]
    return [word for word in (*bundled_scenes(), *files) if word.startswith(incomplete)]


SceneFile = Annotated[
    str,
    typer.Argument(
        metavar="SCENE", help="A scene of `flockenv list`, or a YAML file; - for standard input.",
        autocompletion=complete_scene,
    ),
]  # fmt: skip
