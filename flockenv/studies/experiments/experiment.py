"""An experiment: cases, each under several variants, and its numbers as table, JSON and picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field

from flockenv.core.record import ResultRecord
from flockenv.model.state import Floats, State
from flockenv.scene import Scene
from flockenv.studies.sources import SIMULATOR, fingerprint

__all__ = ["Cell", "Experiment", "Results", "Trial", "depth", "run"]


class Trial(NamedTuple):
    """Result of one case under one variant."""

    numbers: Mapping[str, float]  # by the names of the experiment's columns; NaN = no value
    scene: Scene  # that was run
    path: Floats  # (T, N, D) m, of the first world, for pictures


@dataclass(frozen=True)
class Experiment:
    """Cases, variants and the numbers measured on them."""

    name: str  # of the experiment
    title: str  # for pictures and pages
    cases: Mapping[str, str]  # description of each
    variants: tuple[str, ...]
    columns: Mapping[str, str]  # meaning of each number, with its unit
    shown: tuple[str, ...]  # the columns that are shown below a picture
    trial: Callable[[str, str], Trial]  # runs a case under a variant
    curve: tuple[str, str] | None = None  # labels of axes, if cases are numbers: the first column is drawn over them


class Cell(ResultRecord):
    """The numbers of one case under one variant."""

    case: str
    variant: str
    numbers: dict[str, float | None] = Field(description="by column; null = no value")


class Results(ResultRecord):
    """All numbers of an experiment, and a fingerprint of the sources that they depend on."""

    experiment: str
    title: str
    cases: dict[str, str]
    columns: dict[str, str]
    cells: tuple[Cell, ...]
    sources: str = Field(default="", description="fingerprint of the laws")

    def at(self, case: str, variant: str) -> dict[str, float | None]:
        """Return the numbers of one case under one variant."""
        return next(c.numbers for c in self.cells if (c.case, c.variant) == (case, variant))

    def rows(self) -> list[list[str]]:
        """Return the table: a row for each case and variant."""
        return [
            [cell.case, cell.variant, *("-" if x is None else f"{x:.3g}" for x in cell.numbers.values())]
            for cell in self.cells
        ]


def depth(scene: Scene, state: State) -> Floats:
    """Return the depth of each agent in an obstacle, (B, N) m; negative outside all obstacles."""
    gap = np.min([shape.gap(state.pos) for shape in scene.obstacles], axis=0)
    return np.asarray(scene.body.radius - gap)


def run(
    experiment: Experiment, progress: Callable[[int], None] = lambda done: None
) -> tuple[Results, dict[tuple[str, str], Trial]]:
    """Run every case under every variant; return the numbers, and the trials for pictures.

    experiment: its cases, variants and trial; `progress` is called with the number of trials done.
    """
    trials: dict[tuple[str, str], Trial] = {}
    for case in experiment.cases:
        for variant in experiment.variants:
            progress(len(trials))
            trials[case, variant] = experiment.trial(case, variant)
    cells = tuple(
        Cell(case=case, variant=variant, numbers=_finite_by_column(trial.numbers, tuple(experiment.columns)))
        for (case, variant), trial in trials.items()
    )
    sources = fingerprint((*SIMULATOR, "studies/experiments"), but=("plots.py", "curves.py"))
    results = Results(
        experiment=experiment.name, title=experiment.title, cases=dict(experiment.cases),
        columns=dict(experiment.columns), cells=cells, sources=sources,
    )  # fmt: skip
    return results, trials


def _finite_by_column(numbers: Mapping[str, float], columns: Sequence[str]) -> dict[str, float | None]:
    """Return the numbers in the order of the columns; None for those that are not finite."""
    found = {name: numbers.get(name, math.nan) for name in columns}
    return {name: float(x) if math.isfinite(x) else None for name, x in found.items()}
