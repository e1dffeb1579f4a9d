"""A report as lines and rows of text."""

from __future__ import annotations

from collections.abc import Sequence

from flockenv.studies.accuracy.results import HALVINGS, Choice, Cost, Curve, Point, Report

__all__ = ["COLUMNS", "cheapest_lines", "columns", "errors", "headlines", "rows"]

COLUMNS = ("method", "order", "declared")
DRIFTS = ("energy off", "momentum off")


def headlines(report: Report) -> list[str]:
    """Return the lines above the table: agents, reference, sensitivity, energy, machine."""
    times = f"median of {report.repetitions} runs" if report.repetitions else "not taken"
    load = "" if report.machine.load is None else f", load {report.machine.load:.1f}"
    lines = [
        f"{report.agents:,} agents, {report.seconds:g} s, {report.dtype}; the farthest goes {report.reach:.3g} m",
        f"errors against: {report.reference}" + (f" ({report.note})" if report.note else ""),
        f"off by itself: {_reference_error_text(report)}; errors below {report.floor:.1e} m are not trusted",
        f"a tiny difference at the start grows {report.growth:.2g}-fold{_rate(report)}",
        f"energy: {report.energy}",
        f"times: {times} on {report.machine.cpu}, {report.machine.cores} cores{load}",
    ]
    points = [point for curve in report.curves for point in curve.points]
    if most := max((point.unmatched for point in points), default=0):
        lines.append(f"agents are compared by identity; up to {most:,} live in a run or in the reference alone")
    if most := max((point.unsolved for point in points), default=0):
        lines.append(f"collisions: up to {most:,} contacts unsolved in a run")
    if solves := _solves(report):
        lines.append(f"linear iterations in a step, which are no evaluations: {solves}")
    return lines + ([f"{report.stopped}: what was done until then is shown"] if report.stopped else [])


def _solves(report: Report) -> str:
    """Return the range of linear iterations in a step of each method that solves equations."""
    found = []
    for curve in report.curves:
        each = [point.iterations / point.steps for point in curve.points if point.iterations]
        found += [f"{curve.method} {min(each):.1f} to {max(each):.1f}"] if each else []
    return ", ".join(found)


def _reference_error_text(report: Report) -> str:
    """Return the error of the reference, in words."""
    return f"about {report.reference_error:.1e} m" if report.reference_error > 0 else "nothing"


def _rate(report: Report) -> str:
    """Return the growth rate of a difference as text, if it is fast enough to matter."""
    return f" (e-fold in {1 / report.rate:.2g} s)" if report.sensitive and report.rate > 0 else ""


def errors(report: Report) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return header and rows of the errors at the end, m, of every method in every number of steps.

    ? = not clearly above the error of the reference itself. Adaptive methods are left out.
    """
    steps = sorted({p.steps for c in report.curves for p in c.points if p.tolerance is None})
    found = []
    for curve in report.curves:
        points = {p.steps: p for p in curve.points if p.tolerance is None}
        if points:
            found.append([curve.method, *(_error(points.get(n), report) for n in steps)])
    return ("method", *(f"{n:,} steps" for n in steps)), found


def _error(point: Point | None, report: Report) -> str:
    """Return one error as text, with ? if it cannot be trusted."""
    if point is None:
        return ""
    if point.error is None:
        return "diverges"
    return f"{point.error:.1e}" + ("" if report.trusts(point) else " ?")


def columns(tolerances: Sequence[float]) -> tuple[str, ...]:
    """Return the header of the table."""
    return (*COLUMNS, *(f"{what} to {t:g} m" for t in tolerances for what in ("evals", "ms")), *DRIFTS)


def rows(report: Report, tolerances: Sequence[float]) -> list[list[str]]:
    """Return a row per method: its order, its cost for each tolerance, and its errors of energy and momentum.

    ~ before a number: it lies between two measured points. Energy and momentum are those of the finest steps.
    """
    return [_row(curve, report, tolerances) for curve in report.curves]


def _row(curve: Curve, report: Report, tolerances: Sequence[float]) -> list[str]:
    costs = [_cost(curve, t, by, report.floor) for t in tolerances for by in ("evaluations", "seconds")]
    last = next((p for p in reversed(curve.points) if p.error is not None), None)
    drifts = [None, None] if last is None else [last.energy, last.momentum]
    return [
        curve.method,
        _order(curve, report.floor),
        str(curve.declared),
        *costs,
        *("-" if d is None else f"{d:.1e}" for d in drifts),
    ]


def _order(curve: Curve, floor: float) -> str:
    """Return the measured order, with the number of points if there are fewer than usual."""
    if curve.order is not None:
        return f"{curve.order:.2f}" + (f" ({curve.used} points)" if curve.used <= HALVINGS else "")
    errors = [p.along for p in curve.points]
    if errors and all(e is not None and e <= floor for e in errors):
        return "exact"
    return "own steps" if any(p.tolerance is not None for p in curve.points) else "-"


def _cost(curve: Curve, tolerance: float, by: Cost, floor: float) -> str:
    choice = curve.cheapest_choice(tolerance, by) if tolerance >= floor else None
    return "-" if choice is None else _amount(choice, by)


def _amount(choice: Choice, by: Cost) -> str:
    number = f"{choice.cost:,.0f}" if by == "evaluations" else f"{1e3 * choice.cost:.3g}"
    return ("~" if choice.interpolated else "") + number


def cheapest_lines(report: Report, tolerances: Sequence[float]) -> list[str]:
    """Return, a line per tolerance, the cheapest method by time and by evaluations."""
    lines = []
    for tolerance in tolerances:
        if tolerance < report.floor:
            lines.append(f"to {tolerance:g} m: errors below {report.floor:.1e} m are not trusted")
            continue
        parts = []
        for by, unit in (("seconds", "ms"), ("evaluations", "evaluations")):
            choice = report.cheapest(tolerance, by)  # type: ignore[arg-type]  # mypy widens the tuple's words
            if choice is not None:
                setting = (
                    f"dt = {choice.dt:.3g} s" if choice.tolerance is None else f"tolerance = {choice.tolerance:.1e}"
                )
                parts.append(f"{choice.method} at {setting}, {_amount(choice, by)} {unit}")  # type: ignore[arg-type]
        lines.append(f"to {tolerance:g} m: " + ("; ".join(parts) if parts else "no measured setting reaches it"))
    return lines
