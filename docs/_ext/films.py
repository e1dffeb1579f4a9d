"""Films of tasks for their pages: an episode of the rules and of the policy, side by side in the same world."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from flockenv.tasks import TASKS

__all__ = ["PLAYERS", "draw_missing"]

PLAYERS = "rules,ppo"
COMMAND = "import sys; from flockenv.cli.main import main; sys.exit(main(sys.argv[1:]))"


def draw_missing(folder: Path) -> None:
    """Draw the film of each task that has none in the folder, each in a process of its own, which compiles kernels."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_DISABLE_JIT"}
    environment["PYTHONPATH"] = str(Path(__file__).resolve().parent.parent.parent)
    for task in TASKS:
        path = folder / f"{task}.gif"
        if not path.exists():
            call = ["render", task, "--player", PLAYERS, "--size", "480", "--out", str(path)]
            subprocess.run(
                [sys.executable, "-c", COMMAND, *call], env=environment, check=True, stdout=subprocess.DEVNULL
            )
