"""Experiments and helpers that tests of training share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agents.experiment import Experiment

__all__ = ["PURSUIT", "SCHOOL", "TINY", "interrupt"]

TINY: dict[str, Any] = {
    "worlds": 16, "rollout": 16, "minibatch": 64, "epochs": 1, "threads": 1, "evaluate_every": 512,
    "evaluate_worlds": 4,
}  # fmt: skip
PURSUIT = Experiment(task="pursuit", ppo={**TINY, "steps": 1024})
SCHOOL = Experiment(
    task="school",
    arguments={"fish": 3, "patches": 2, "horizon": 20},
    ppo={
        **TINY, "steps": 2304, "worlds": 4, "hidden": (8, 8), "evaluate_every": 576, "hold": 3,
        "central_critic": True, "care": 1.0, "taught": 3, "critic_first": 600, "stagger": True,
        "disturbance": {"noise": 0.05, "delay": 2, "dropped": 0.1},
    },
)  # fmt: skip
"""Experiment with every part of training that has state of its own, which an interrupted run must restore."""


def interrupt(experiment: Experiment, folder: Path, points: int = 1) -> None:
    """Train until `points` points of the curve are measured, then raise KeyboardInterrupt as Ctrl-C would."""
    from agents import ppo  # with torch

    measure, measured = ppo.score, 0

    def interrupted(*given: Any) -> tuple[float, float]:
        nonlocal measured
        if measured == points:
            raise KeyboardInterrupt
        measured += 1
        return measure(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "score", interrupted)
        with pytest.raises(KeyboardInterrupt):
            ppo.train(experiment, folder)
