"""Options that several trainings have; those of jobs are in flockenv/cli/jobs.py."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["Config", "Seconds", "Steps", "TrainingSeed"]

Config = Annotated[Path, typer.Argument(help="an experiment, such as configs/training/pursuit.yaml")]
Steps = Annotated[int | None, typer.Option(help="total agent-steps, instead of those of the config")]
Seconds = Annotated[
    float | None, typer.Option(help="wall time in all, s; training ends at the first budget that is spent")
]
TrainingSeed = Annotated[int | None, typer.Option("--seed", help="training seed, instead of that of the config")]
