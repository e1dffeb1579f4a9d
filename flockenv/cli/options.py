"""Options that several commands have, of flockenv and of agents/; those of jobs are in jobs.py."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["Debug", "Delay", "Dropped", "Noise", "Reach", "Seen", "TrustPickle"]

Debug = Annotated[bool, typer.Option("--debug", help="Show a traceback if something goes wrong.")]
TrustPickle = Annotated[
    bool, typer.Option("--trust-pickle", help="Also load Stable-Baselines3 zips, which executes the code in them.")
]
Noise = Annotated[float, typer.Option(help="Standard deviation of noise on what players observe, 0 to 1.")]
Delay = Annotated[int, typer.Option(help="Decisions by which actions are late, 0 to 20.")]
Dropped = Annotated[float, typer.Option(help="Probability that a neighbour is not detected, 0 to 1.")]
Reach = Annotated[
    float | None, typer.Option("--range", help="Metres beyond which other agents are not detected. [no limit]")
]
Seen = Annotated[int | None, typer.Option(help="Agents of a kind that are detected, the nearest. [all in slots]")]
