"""The hyperparameters for RL Baselines3 Zoo that docs/clients.md shows."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "clients.md"


def rl_zoo_settings() -> str:
    """Return the page's file of hyperparameters, with one entry, for Pursuit."""
    (text,) = re.findall(r"^```yaml\n(flockenv/Pursuit-v0:\n.*?)```", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    return str(text)
