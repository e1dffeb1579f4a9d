"""The same worlds for every player, and what may be said about the scores."""

from __future__ import annotations

from flockenv.evaluation.episodes import (
    EVALUATION,
    TRAINING,
    TUNING,
    WORLDS_PER_SEED,
    Comparison,
    Episodes,
    Interval,
    Recording,
    Summary,
    bootstrap,
    compare,
    iqm,
    proportion,
    rollout,
    summarise,
    task_digest,
    worlds_for,
)

__all__ = [
    "EVALUATION",
    "TRAINING",
    "TUNING",
    "WORLDS_PER_SEED",
    "Comparison",
    "Episodes",
    "Interval",
    "Recording",
    "Summary",
    "bootstrap",
    "compare",
    "iqm",
    "proportion",
    "rollout",
    "summarise",
    "task_digest",
    "worlds_for",
]
