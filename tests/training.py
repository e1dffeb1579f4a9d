"""What tests of training share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agents.experiment import Experiment

__all__ = ["interrupt"]


def interrupt(experiment: Experiment, folder: Path) -> None:
    """Train, and press Ctrl-C at the first point of the curve."""
    from agents import ppo  # with torch

    write = ppo.checkpoint

    def interrupted(*given: Any) -> None:
        write(*given)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "checkpoint", interrupted)
        with pytest.raises(KeyboardInterrupt):
            ppo.train(experiment, folder)
