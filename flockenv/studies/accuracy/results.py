"""What was measured: points, a curve of them per method, a report per problem; and which of them is the cheapest."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import takewhile
from typing import Literal

import numpy as np

from flockenv.core.errors import nearest, shown
from flockenv.core.record import ResultRecord

__all__ = ["COSTS", "FORMAT", "Choice", "Cost", "Curve", "Machine", "Point", "Report", "Results"]

FORMAT = 1

Cost = Literal["seconds", "evaluations"]
COSTS: dict[Cost, str] = {"seconds": "wall time, s", "evaluations": "force evaluations"}

HALVINGS = 5
"""An order is measured over the finest so many halvings that are neither coarse nor drowned in rounding."""

SENSITIVE = 100.0
"""Growth of a tiny difference at the start beyond which a report counts as sensitive."""

FEWEST = 4
"""Points of which an order is told at all."""


class Machine(ResultRecord):
    """Where it was measured."""

    cpu: str
    cores: int
    load: float | None
    """Processes that wanted to run meanwhile, on average over a minute; none where the system does not count."""


class Point(ResultRecord):
    """One method in one setting, taken from the start to the end; what has no number is none."""

    steps: int
    """Calls of the method."""
    dt: float
    """s; an adaptive method chooses shorter ones."""
    tolerance: float | None
    """Of an adaptive method."""
    evaluations: int
    """Of the force."""
    error: float | None
    """m, of the agent that is farthest off at the end; none = it diverged."""
    rms: float | None
    """m, root of the mean square over the agents at the end."""
    along: float | None
    """m, of the agent that is farthest off at any instant."""
    energy: float | None
    """By how much the energy is off at worst, in parts of the largest kinetic energy."""
    momentum: float | None
    """By how much the momentum has changed at worst, in parts of the sum of its sizes; none where it is not kept."""
    seconds: float | None
    """Wall time of the whole run, the median of several; none = not measured."""
    unmatched: int = 0
    """Agents that live in this run or in the reference alone, at the instant at which they are most."""
    unsolved: int = 0
    """Contacts that collisions left unsolved, see State.work."""

    def cost(self, by: Cost) -> float | None:
        """Return what it costs."""
        return self.seconds if by == "seconds" else float(self.evaluations)


class Choice(ResultRecord):
    """A setting that keeps to a tolerance, and what it costs."""

    method: str
    dt: float
    tolerance: float | None
    """Of an adaptive method."""
    cost: float
    error: float
    """m"""
    interpolated: bool
    """Does it lie between two measured points?"""


class Curve(ResultRecord):
    """A method, from its cheapest point to its dearest."""

    method: str
    declared: int
    """The order it has where forces are smooth."""
    points: tuple[Point, ...]
    order: float | None
    """The measured one; none where too few points are left, and of adaptive methods: what they halve is no step."""
    used: int
    """Points that the order was measured over."""

    def needed(self, tolerance: float, by: Cost = "evaluations", interpolate: bool = True) -> Choice | None:
        """Return the cheapest way of this method to an error of at most `tolerance`, m; none if no point is so good.

        All points that are finer must be as good: a coarse one that is right by chance is not taken. Between the last
        one that is too coarse and the first that is not, errors and costs are taken for straight lines over their
        logarithms, unless `interpolate` is False. Times are noisy: a finer point may be the cheaper one.
        """
        known = [p for p in self.points if p.cost(by) is not None]
        good = list(takewhile(lambda p: p.error is not None and p.error <= tolerance, reversed(known)))
        found = [self._at(point, by) for point in good]
        coarser = known[: len(known) - len(good)]
        if interpolate and good and coarser and coarser[-1].error and good[-1].error:
            found.append(self._between(coarser[-1], good[-1], tolerance, by))
        return min(found, key=lambda choice: choice.cost, default=None)

    def _at(self, point: Point, by: Cost) -> Choice:
        """Return a point as a choice."""
        cost, error = point.cost(by), point.error
        assert cost is not None and error is not None
        return Choice(
            method=self.method, dt=point.dt, tolerance=point.tolerance, cost=cost, error=error, interpolated=False
        )

    def _between(self, worse: Point, better: Point, error: float, by: Cost) -> Choice:
        """Return the choice of a certain error between two points of larger and of smaller error."""
        a, b = self._at(worse, by), self._at(better, by)
        share = math.log(a.error / error) / math.log(a.error / b.error)
        tolerances = None
        if a.tolerance is not None and b.tolerance is not None:
            tolerances = _between(a.tolerance, b.tolerance, share)
        return Choice(
            method=self.method, dt=_between(a.dt, b.dt, share), tolerance=tolerances,
            cost=_between(a.cost, b.cost, share), error=error, interpolated=True,
        )  # fmt: skip


class Report(ResultRecord):
    """One problem, all methods."""

    name: str
    title: str
    agents: int
    seconds: float
    dtype: str
    reference: str
    """What errors are measured against."""
    reference_error: float
    """m, how wrong that may be."""
    note: str
    growth: float
    """How often larger a tiny difference at the start has become by the end."""
    rate: float = 0.0
    """1/s, at which it grew on average: of a chaotic scene its largest Lyapunov exponent, over this horizon."""
    floor: float
    """m, errors below are rounding or the reference's own."""
    reach: float
    """m, how far the farthest agent goes: an error of a tenth of it and more is no approximation."""
    energy: str
    """Which energy is compared."""
    repetitions: int
    machine: Machine
    curves: tuple[Curve, ...]
    stopped: str = ""
    """Why it ended before its time."""

    @property
    def sensitive(self) -> bool:
        """True if a tiny difference at the start grows at least a hundredfold."""
        return self.growth > SENSITIVE

    def trusts(self, point: Point) -> bool:
        """True if an error is clearly above what the reference itself may be wrong by."""
        return point.error is not None and point.error > self.floor

    def curve(self, method: str) -> Curve:
        """Return the curve of a method; raises ValueError, with the nearest name, if it was not measured."""
        for curve in self.curves:
            if curve.method == method:
                return curve
        names = [curve.method for curve in self.curves]
        raise ValueError(f"method = {shown(method)}: was not measured{nearest(method, names)} ({', '.join(names)})")

    def cheapest(self, tolerance: float, by: Cost = "evaluations", interpolate: bool = True) -> Choice | None:
        """Return the cheapest measured way to an error of at most `tolerance`, m; none if nothing measured is so good.

        Raises ValueError for a tolerance below what this report can tell, its floor.
        """
        if not (math.isfinite(tolerance) and tolerance >= self.floor):
            raise ValueError(
                f"tolerance = {tolerance:g} m: must be a finite number of at least {self.floor:.1e} m, below which "
                f"{self.name} is rounding"
            )
        found = [c for curve in self.curves if (c := curve.needed(tolerance, by, interpolate)) is not None]
        return min(found, key=lambda choice: choice.cost, default=None)


class Results(ResultRecord):
    """Reports as they lie in a file."""

    format: Literal[1] = FORMAT  # type: ignore[assignment]
    reports: tuple[Report, ...]


def measured_order(points: Iterable[Point], least: float, most: float) -> tuple[float | None, int]:
    """Return the slope of the logarithm of the error over that of the evaluations, and how many points it is of.

    Of the finest HALVINGS + 1 points whose errors lie between `least` (rounding) and `most` (no approximation) m; none
    of fewer than FEWEST. Of the error at any instant: at one of them alone it may pass through zero.
    """
    usable = [p for p in points if p.along is not None and least < p.along < most]
    kept = usable[-HALVINGS - 1 :]
    if len(kept) < FEWEST:
        return None, len(kept)
    work, error = (np.log([getattr(p, name) for p in kept]) for name in ("evaluations", "along"))
    return float(-np.polyfit(work, error, 1)[0]), len(kept)


def _between(a: float, b: float, share: float) -> float:
    """Return what lies between two positive numbers, on a straight line over logarithms."""
    return math.exp((1 - share) * math.log(a) + share * math.log(b))
