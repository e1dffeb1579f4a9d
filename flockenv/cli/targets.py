"""Arguments that name a task or a scene file: which of the two it is, and the completion of such a word."""

from __future__ import annotations

import re
from pathlib import Path

from flockenv.core.errors import nearest, printable
from flockenv.core.yaml_paths import STANDARD_INPUT, has_yaml_suffix

__all__ = ["complete_target", "is_scene_file"]


def is_scene_file(target: str) -> bool:
    """Return True if a word names a scene file (or standard input), False if a task.

    The file may be missing: then reading it says so. Raises ValueError if the word can be neither.
    """
    from flockenv.tasks import TASKS

    if target in TASKS:
        return False
    if target == STANDARD_INPUT or has_yaml_suffix(target) or Path(target).exists():
        return True
    tasks = f"{nearest(target, TASKS)} ({', '.join(TASKS)})"
    raise ValueError(f"{printable(target)}: no such task{tasks}, nor a .yaml file")


def complete_target(incomplete: str) -> list[str]:
    """Return the tasks, scene files and folders that complete a word (shell completion)."""
    from flockenv.envs.table import ENVIRONMENTS

    tasks = (re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() for name in ENVIRONMENTS)
    here = Path(incomplete).parent if "/" in incomplete else Path()
    found = sorted(here.iterdir()) if here.is_dir() else []
    files = [f"{p}/" if p.is_dir() else str(p) for p in found if p.is_dir() or has_yaml_suffix(p.name)]
    return [word for word in (*tasks, *files) if word.startswith(incomplete)]
