"""Results of a benchmark: points, a curve of points per method, a report per problem; and the cheapest of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import takewhile
from typing import Literal

import numpy as np

from flockenv.core.errors import nearest, printable
from flockenv.core.record import ResultRecord

__all__ = ["COSTS", "FORMAT", "Choice", "Cost", "Curve", "Machine", "Point", "Report", "Results"]

FORMAT = 1

Cost = Literal["seconds", "evaluations"]
COSTS: dict[Cost, str] = {"seconds": "wall time, s", "evaluations": "force evaluations"}

HALVINGS = 5
"""Halvings over which an order is measured: the finest whose errors are neither too large nor rounding."""

SENSITIVE = 100.0
"""Growth of a tiny difference at the start beyond which a report counts as sensitive."""

FEWEST = 4
"""Fewest points over which an order is measured."""


class Machine(ResultRecord):
    """The machine of a measurement."""

    cpu: str
    cores: int
    load: float | None
    """Runnable processes, on average over the last minute; None if the system does not count them."""


class Point(ResultRecord):
    """One run of a method in one setting, from start to end; values that do not exist are None."""

    steps: int
    """Calls of the method."""
    dt: float
    """s; an adaptive method takes shorter ones."""
    tolerance: float | None
    """Tolerance of an adaptive method."""
    evaluations: int
    """Evaluations of the force."""
    error: float | None
    """m, of the agent with the largest error at the end; None if the run diverged."""
    rms: float | None
    """m, root of the mean square over the agents at the end."""
    along: float | None
    """m, the largest error of any agent at any instant."""
    energy: float | None
    """Largest error of the energy, as a share of the largest kinetic energy."""
    momentum: float | None
    """Largest change of the momentum, as a share of the summed magnitudes; None if momentum is not conserved."""
    seconds: float | None
    """s, wall time of the whole run, the median of several; None if not measured."""
    unmatched: int = 0
    """Agents that live in only one of this run and the reference, at the instant with most of them."""
    unsolved: int = 0
    """Contacts that collisions left unsolved, see State.work."""
    iterations: int = 0
    """Of a method that solves equations: linear iterations and factorisations, see State.work."""

    def cost(self, by: Cost) -> float | None:
        """Return the cost of this point, in seconds or evaluations.

        by: `seconds` or `evaluations`.
        """
        return self.seconds if by == "seconds" else float(self.evaluations)


class Choice(ResultRecord):
    """A setting that reaches a tolerance, and its cost."""

    method: str
    dt: float
    tolerance: float | None
    """Tolerance of an adaptive method."""
    cost: float
    error: float
    """m"""
    interpolated: bool
    """True if it lies between two measured points."""


class Curve(ResultRecord):
    """The points of a method, from the cheapest to the most expensive."""

    method: str
    """Its kind, with fields that are not the default, see `method_name`."""
    declared: int
    """The order of the method if forces are smooth."""
    points: tuple[Point, ...]
    order: float | None
    """The measured order; None with too few points, and for adaptive methods, whose steps are not halved."""
    used: int
    """Number of points over which the order was measured."""

    def cheapest_choice(self, tolerance: float, by: Cost = "evaluations", interpolate: bool = True) -> Choice | None:
        """Return the cheapest setting of this method with an error of at most `tolerance`, m; None if there is none.

        All finer points must also be within the tolerance, so a coarse point that is accurate by chance is not taken.
        Between the last point that is too coarse and the first that is not, the logarithms of error and cost are
        interpolated linearly, unless `interpolate` is False. Times are noisy: a finer point may be cheaper.
        """
        known = [p for p in self.points if p.cost(by) is not None]
        good = list(takewhile(lambda p: p.error is not None and p.error <= tolerance, reversed(known)))
        found = [self._as_choice(point, by) for point in good]
        coarser = known[: len(known) - len(good)]
        if interpolate and good and coarser and coarser[-1].error and good[-1].error:
            found.append(self._choice_between(coarser[-1], good[-1], tolerance, by))
        return min(found, key=lambda choice: choice.cost, default=None)

    def _as_choice(self, point: Point, by: Cost) -> Choice:
        """Return the `Choice` of a measured point: its setting, and its cost in seconds or evaluations."""
        cost, error = point.cost(by), point.error
        assert cost is not None and error is not None
        return Choice(
            method=self.method, dt=point.dt, tolerance=point.tolerance, cost=cost, error=error, interpolated=False
        )

    def _choice_between(self, worse: Point, better: Point, error: float, by: Cost) -> Choice:
        """Return the interpolated choice with a given error, between a point of larger and one of smaller error."""
        a, b = self._as_choice(worse, by), self._as_choice(better, by)
        share = math.log(a.error / error) / math.log(a.error / b.error)
        tolerances = None
        if a.tolerance is not None and b.tolerance is not None:
            tolerances = _interpolate(a.tolerance, b.tolerance, share)
        return Choice(
            method=self.method, dt=_interpolate(a.dt, b.dt, share), tolerance=tolerances,
            cost=_interpolate(a.cost, b.cost, share), error=error, interpolated=True,
        )  # fmt: skip


class Report(ResultRecord):
    """Results of all methods on one problem."""

    name: str
    title: str
    agents: int
    seconds: float
    dtype: str
    reference: str
    """The reference that errors are measured against."""
    reference_error: float
    """m, estimated error of the reference."""
    note: str
    growth: float
    """Factor by which a tiny difference at the start has grown by the end."""
    rate: float = 0.0
    """1/s, its average growth rate: for a chaotic scene the largest Lyapunov exponent, over this horizon."""
    floor: float
    """m, errors below this are rounding or the reference's own."""
    reach: float
    """m, largest distance that an agent moves: with an error of a tenth of it or more, a path is no approximation."""
    energy: str
    """The kinds of energy that are compared."""
    repetitions: int
    machine: Machine
    curves: tuple[Curve, ...]
    stopped: str = ""
    """Reason if it ended early, else empty."""

    @property
    def sensitive(self) -> bool:
        """True if a tiny difference at the start grows at least a hundredfold."""
        return self.growth > SENSITIVE

    def trusts(self, point: Point) -> bool:
        """Return True if the error is clearly above that of the reference itself.

        point: one of this report.
        """
        return point.error is not None and point.error > self.floor

    def curve(self, method: str) -> Curve:
        """Return the curve of a method; raise ValueError, with the nearest name, if it was not measured."""
        for curve in self.curves:
            if curve.method == method:
                return curve
        names = [curve.method for curve in self.curves]
        raise ValueError(f"method = {printable(method)}: was not measured{nearest(method, names)} ({', '.join(names)})")

    def cheapest(self, tolerance: float, by: Cost = "evaluations", interpolate: bool = True) -> Choice | None:
        """Return the cheapest choice with an error of at most `tolerance`, m; None if no method reaches it.

        by: what is to be least, `seconds` or `evaluations`; interpolate: True if numbers of steps between the measured
        ones count.

        Raises ValueError for a tolerance below the floor of this report.
        """
        if not (math.isfinite(tolerance) and tolerance >= self.floor):
            raise ValueError(
                f"tolerance = {tolerance:g} m: must be finite and >= {self.floor:.1e} m, below which "
                f"errors of {self.name} are not trusted"
            )
        found = [c for curve in self.curves if (c := curve.cheapest_choice(tolerance, by, interpolate)) is not None]
        return min(found, key=lambda choice: choice.cost, default=None)


class Results(ResultRecord):
    """Reports as stored in a file."""

    format: Literal[1] = FORMAT  # type: ignore[assignment]
    reports: tuple[Report, ...]


def measured_order(
    points: Iterable[Point], least: float, most: float, by: Literal["evaluations", "steps"] = "evaluations"
) -> tuple[float | None, int]:
    """Return the slope of the logarithm of the error over that of the evaluations, and the number of points used.

    by: "steps" for methods that solve equations, which take fewer evaluations per step in shorter ones. Uses the
    finest HALVINGS + 1 points whose errors lie between `least` (rounding) and `most` (no approximation), m; the order
    is None for fewer than FEWEST. The error is the largest over all instants, as at one it may pass zero.
    """
    usable = [p for p in points if p.along is not None and least < p.along < most]
    kept = usable[-HALVINGS - 1 :]
    if len(kept) < FEWEST:
        return None, len(kept)
    work, error = (np.log([getattr(p, name) for p in kept]) for name in (by, "along"))
    return float(-np.polyfit(work, error, 1)[0]), len(kept)


def _interpolate(a: float, b: float, share: float) -> float:
    """Return the logarithmic interpolation between two positive numbers."""
    return math.exp((1 - share) * math.log(a) + share * math.log(b))
