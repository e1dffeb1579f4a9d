"""Evaluation of players in the same held-out worlds, and statistics of their scores."""

from __future__ import annotations

from flockenv.evaluation.comparison import Comparison, Summary, compare, summarise
from flockenv.evaluation.episodes import (
    EVALUATION,
    TRAINING,
    TUNING,
    WORLDS_PER_SEED,
    Episodes,
    Interval,
    Playable,
    Purpose,
    Recording,
    bootstrap,
    iqm,
    proportion,
    rollout,
    task_digest,
    worlds_for,
)
from flockenv.evaluation.seeds import lead_interval, mean_interval, success_interval

__all__ = [
    "EVALUATION",
    "TRAINING",
    "TUNING",
    "WORLDS_PER_SEED",
    "Comparison",
    "Episodes",
    "Interval",
    "Playable",
    "Purpose",
    "Recording",
    "Summary",
    "bootstrap",
    "compare",
    "iqm",
    "lead_interval",
    "mean_interval",
    "proportion",
    "rollout",
    "success_interval",
    "summarise",
    "task_digest",
    "worlds_for",
]
