"""Films of tasks for their pages: an episode of rules, policy and hybrid, side by side in the same world."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from flockenv.tasks import TASKS

__all__ = ["draw_missing", "hybrid_of"]

ROOT = Path(__file__).resolve().parent.parent.parent
HYBRIDS = ("residual", "mixture", "residual_home")
"""Folders of agents/policies with hybrids of rules and policy; the first that has one of a task is shown."""

COMMAND = "import sys; from flockenv.cli.main import main; sys.exit(main(sys.argv[1:]))"


def hybrid_of(task: str) -> Path | None:
    """Return the weights of a task's hybrid of rules and policy, below the repository; None if it has none."""
    paths = [Path("agents", "policies", kind, f"{task}-seed-0.safetensors") for kind in HYBRIDS]
    return next((path for path in paths if (ROOT / path).is_file()), None)


def draw_missing(folder: Path) -> None:
    """Draw the film of each task that has none in the folder, each in a process of its own, one per core at a time."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_DISABLE_JIT"}
    environment["PYTHONPATH"] = str(ROOT)

    def draw(task: str) -> None:
        hybrid = hybrid_of(task)
        players = ["rules", "ppo", *([str(hybrid)] if hybrid else [])]
        picture = ["--size", str(240 * len(players)), "--out", str(folder.resolve() / f"{task}.gif")]
        command = [sys.executable, "-c", COMMAND, "render", task, "--player", ",".join(players), *picture]
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(draw, [task for task in TASKS if not (folder / f"{task}.gif").exists()]))
