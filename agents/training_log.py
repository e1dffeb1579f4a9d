"""The log of a training: Stable-Baselines3's own logger, as CSV and, if that package is there, for TensorBoard.

Each start of a training, also one that continues, has a folder of its own: log_1, log_2, ... in the folder of its run.
The rows are those of Stable-Baselines3, with the learning curve (`tuning/...`) and the agent-steps in addition.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.utils import get_latest_run_id

__all__ = ["log_point", "open_log", "turn_off_log", "write_log"]

NAME = "log"


def turn_off_log(model: BaseAlgorithm) -> None:
    """Let a model log nothing: with the logger that it makes itself, an empty folder would stay."""
    model.set_logger(Logger(folder=None, output_formats=[]))


@contextmanager
def open_log(folder: Path, console: Console) -> Iterator[Logger]:
    """Open a logger into the next folder log_N of a folder, for a block; nothing stays of a log without rows."""
    place = folder / f"{NAME}_{get_latest_run_id(str(folder), NAME) + 1}"
    is_there = find_spec("tensorboard") is not None
    note = "" if is_there else " (CSV only: TensorBoard's needs the package tensorboard)"
    console.print(f"log: {place}{note}", markup=False, highlight=False, soft_wrap=True)
    logger = configure(str(place), ["csv", "tensorboard"] if is_there else ["csv"])
    try:
        yield logger
    finally:
        logger.close()
        rows = place / "progress.csv"
        if rows.exists() and rows.stat().st_size == 0:  # gone if the folder was removed meanwhile
            shutil.rmtree(place)


@contextmanager
def write_log(model: BaseAlgorithm, folder: Path, console: Console) -> Iterator[None]:
    """Let a model log into the next folder log_N of a folder, for a block."""
    with open_log(folder, console) as logger:
        model.set_logger(logger)
        try:
            yield
        finally:
            turn_off_log(model)


def log_point(logger: Logger, point: dict[str, Any]) -> None:
    """Add a point of the learning curve to the next row of the log."""
    logger.record("time/agent_steps", point["steps"])
    logger.record("tuning/mean_return", point["mean"])
    logger.record("tuning/success_rate", point["success"])
