"""Benchmark of every method in every setting on one problem: first errors, then wall times, in rounds over all."""

from __future__ import annotations

import gc
import os
import platform
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path as File
from statistics import median
from time import perf_counter
from typing import Literal

import numpy as np

from flockenv.model.state import State
from flockenv.physics.integrators import INTEGRATORS, Integrator
from flockenv.scene import Scene
from flockenv.studies.accuracy.chaos import find_sensitivity
from flockenv.studies.accuracy.methods import method_name
from flockenv.studies.accuracy.paths import Path, count_unmatched, largest_distance, largest_value
from flockenv.studies.accuracy.problem import Problem
from flockenv.studies.accuracy.reference import COARSE, LEAST_FINER, Reference, find_reference
from flockenv.studies.accuracy.results import Curve, Machine, Point, Report, measured_order

__all__ = ["REPETITIONS", "TOLERANCES", "add_times", "machine", "measure", "usual_methods"]

REPETITIONS = 20
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
"""Tolerances of adaptive methods, which determine their own steps."""

DEAREST = 4
"""Evaluations per step of the most expensive method with fixed steps."""

MOST_SOLVED = 100_000
"""Evaluations of a method that solves equations beyond which finer steps are not measured: they take minutes."""

TRUSTED = 4.0
"""Errors below this multiple of the reference's own error are not trusted."""

TOLERANCE_WITHIN = 1e-8
"""Tolerance of an adaptive method if something acts after each step; its steps are then fixed, as for other methods."""


@dataclass(eq=False)
class _Trial:
    """A method in one setting: a scene to run, and its results."""

    problem: Problem
    method: Integrator
    steps: int
    tolerance: float | None
    times: list[float] = field(default_factory=list)
    point: Point | None = None

    @property
    def name(self) -> str:
        """The name of the method, see `method_name`."""
        return method_name(self.method)

    def compare(self, reference: Reference) -> None:
        """Run from instant to instant, and measure the distance from the reference."""
        try:
            path = self.problem.path(self.method, self.steps)
        except ArithmeticError:  # divergence, or equations that were not solved
            self.point = self._point(self.steps * self.method.evaluations, {})
            return
        off = self.problem.distances(path, reference.path)
        last = off[-1][~np.isnan(off[-1])]
        errors = {
            "error": largest_value(last),
            "rms": float(np.sqrt((last**2).mean())) if len(last) else float("nan"),
            "along": largest_distance(off),
            "energy": _energy_error(self.problem, path, reference.path),
            "momentum": _momentum_error(self.problem, path, reference.path),
        }
        self.point = self._point(
            path.count_of("evaluations"), {k: v for k, v in errors.items() if np.isfinite(v)},
            count_unmatched(path, reference.path), path.count_of("unsolved"), path.count_of("linear_iterations"),
        )  # fmt: skip

    def _point(
        self, evaluations: int, errors: dict[str, float], unmatched: int = 0, unsolved: int = 0, iterations: int = 0
    ) -> Point:
        names = ("error", "rms", "along", "energy", "momentum")
        return Point(
            steps=self.steps, dt=self.problem.seconds / self.steps, tolerance=self.tolerance, evaluations=evaluations,
            seconds=None, unmatched=unmatched, unsolved=unsolved, iterations=iterations,
            **{name: errors.get(name) for name in names},
        )  # fmt: skip

    def clock(self) -> None:
        """Time one call for the whole run; a step before it brings the code back into the caches."""
        scene, start, out = self._run_arguments
        scene.step(start, out=out)
        began = perf_counter()
        scene.step(start, out=out, steps=self.steps)
        self.times.append(perf_counter() - began)

    @cached_property
    def _run_arguments(self) -> tuple[Scene, State, State]:
        scene, start = self.problem.prepare(self.method, self.steps)
        return scene, start, start.copy()

    @property
    def has_error(self) -> bool:
        """True if the run reached the end and has an error."""
        return self.point is not None and self.point.error is not None

    @property
    def timed_point(self) -> Point:
        """The point with the median of its times."""
        assert self.point is not None
        return self.point.model_copy(update={"seconds": median(self.times)}) if self.times else self.point


def measure(
    problem: Problem,
    methods: Sequence[Integrator] | None = None,
    repetitions: int = REPETITIONS,
    finer: int | None = None,
    progress: Callable[[int], None] = lambda percent: None,
) -> Report:
    """Return the error at the end and the cost of each method in each number of steps.

    problem: the scene, its start, its horizon and the numbers of steps.

    methods: instances (default: those of `usual_methods`). repetitions: number of wall times per point, taken in turns
    after compiling; 0 = none. finer: ratio of steps for a reference by own steps (see `reference_by_own_steps`).
    progress is called with percents. A KeyboardInterrupt ends it early: the report has what was done, with `stopped` =
    "interrupted"; it is raised again if no run has reached the end by then.
    Raises ValueError if there is no reference: the scene is chaotic over its horizon (see chaos.find_sensitivity), or
    does not converge to one path (see `reference_by_own_steps`).
    """
    chosen = usual_methods() if methods is None else tuple(methods)
    if repetitions < 0 or (finer is not None and (finer < LEAST_FINER or finer % LEAST_FINER)):
        raise ValueError(f"repetitions = {repetitions} must be >= 0, finer = {finer} a multiple of {LEAST_FINER}")
    sensitivity, reference = find_sensitivity(problem), find_reference(problem, finer)
    trials = [_Trial(problem, *setting) for method in chosen for setting in _settings(problem, method)]
    stopped, all_ = "", max(1, len(trials) * (1 + repetitions))
    try:
        for done, trial in enumerate(trials):
            progress(100 * done // all_)
            if done == 0 or not _is_too_costly(trials[done - 1], trial):
                trial.compare(reference)
        _clock([trial for trial in trials if trial.has_error], repetitions, progress)
    except KeyboardInterrupt:
        if not any(trial.has_error for trial in trials):
            raise
        stopped = "interrupted"
    floor = max(TRUSTED * reference.error, sensitivity.error)
    return Report(
        name=problem.name, title=problem.title or problem.name, agents=problem.scene.agents, seconds=problem.seconds,
        dtype=problem.scene.dtype, reference=reference.kind, reference_error=reference.error, note=reference.note,
        growth=sensitivity.growth, rate=sensitivity.rate, floor=floor, reach=reference.reach,
        energy=problem.energies, repetitions=repetitions,
        machine=machine(), curves=tuple(_curves(trials, floor, COARSE * reference.reach)), stopped=stopped,
    )  # fmt: skip


def add_times(
    report: Report,
    problem: Problem,
    methods: Sequence[Integrator],
    repetitions: int = REPETITIONS,
    progress: Callable[[int], None] = lambda percent: None,
) -> Report:
    """Return a report with wall times, measured now, of the runs whose errors another process may have measured.

    `progress` is called with percents.

    report: `measure` with the same problem and methods, and repetitions = 0. Other arguments, and a KeyboardInterrupt:
    as of `measure`.
    """
    trials = [_Trial(problem, *setting) for method in methods for setting in _settings(problem, method)]
    points = {_key(curve, point): point for curve in report.curves for point in curve.points}
    for trial in trials:
        trial.point = points.get((trial.name, trial.steps, trial.tolerance))
    stopped = ""
    try:
        _clock([trial for trial in trials if trial.has_error], repetitions, progress)
    except KeyboardInterrupt:
        stopped = "interrupted"
    timed = {
        (trial.name, trial.steps, trial.tolerance): trial.timed_point
        for trial in trials if trial.point is not None
    }  # fmt: skip
    curves = [
        curve.model_copy(update={"points": tuple(timed[_key(curve, point)] for point in curve.points)})
        for curve in report.curves
    ]
    news = {"curves": tuple(curves), "repetitions": repetitions, "machine": machine(), "stopped": stopped}
    return report.model_copy(update=news)


def _key(curve: Curve, point: Point) -> tuple[str, int, float | None]:
    """Return the method and the setting of a point."""
    return curve.method, point.steps, point.tolerance


def _settings(problem: Problem, method: Integrator) -> list[tuple[Integrator, int, float | None]]:
    """Return the settings of a method: numbers of steps, or tolerances if it is adaptive."""
    if method.adaptive and problem.after_steps:
        method = method.model_copy(update={"tolerance": TOLERANCE_WITHIN})
    if not method.adaptive or problem.after_steps:
        return [(method, steps, None) for steps in problem.steps]
    few = len(problem.times)
    return [(method.model_copy(update={"tolerance": t}), few, t) for t in TOLERANCES]


def _is_too_costly(before: _Trial, trial: _Trial) -> bool:
    """Return True if this method took too many evaluations in its previous, coarser setting.

    Adaptive methods: more than any method with fixed steps; if forces jump repeatedly, they may need as many steps as
    1 / tolerance. Methods that solve equations by differences of forces: more than MOST_SOLVED.
    """
    if before.name != trial.name or not (trial.method.solves or trial.tolerance is not None):
        return False
    most = MOST_SOLVED if trial.method.solves else DEAREST * trial.problem.steps[-1]
    return before.point is None or before.point.evaluations > most


def _clock(trials: Sequence[_Trial], repetitions: int, progress: Callable[[int], None]) -> None:
    """Time every trial, in rounds, so that a disturbance of the machine affects all of them."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        for done in range(repetitions):
            progress(100 * (1 + done) // (1 + repetitions))
            for trial in trials:
                trial.clock()
    finally:
        if collecting:
            gc.enable()


def _curves(trials: Sequence[_Trial], least: float, most: float) -> list[Curve]:
    curves = []
    for name in dict.fromkeys(trial.name for trial in trials):
        its = [trial for trial in trials if trial.name == name and trial.point is not None]
        if not its:
            continue
        points = tuple(trial.timed_point for trial in its)
        chosen = its[0].tolerance is not None
        by: Literal["evaluations", "steps"] = "steps" if its[0].method.solves else "evaluations"
        order, used = (None, 0) if chosen else measured_order(points, least, most, by)
        declared = min(its[0].method.order, its[0].method.order_with_drag)
        curves.append(Curve(method=name, declared=declared, points=points, order=order, used=used))
    return curves


def _energy_error(problem: Problem, path: Path, reference: Path) -> float:
    """Return the largest error of the energy, as a share of the largest kinetic energy of the reference."""
    if path.who is not None:
        return float("nan")
    off = largest_value(np.abs(problem.energy(path.pos, path.vel) - problem.energy(reference.pos, reference.vel)))
    scale = largest_value(problem.kinetic(reference.vel))
    return off / scale if scale > 0 else float("nan")


def _momentum_error(problem: Problem, path: Path, reference: Path) -> float:
    """Return the largest change of a conserved momentum, as a share of the summed magnitudes of all momenta."""
    if not problem.conserves_momentum:
        return float("nan")
    before = problem.momentum(problem.start.vel[0].astype(np.float64))
    carried = largest_value(problem.impulse(reference.vel))
    off = largest_value(np.linalg.norm(problem.momentum(path.vel) - before, axis=-1))
    return off / carried if carried > 0 else float("nan")


def usual_methods() -> tuple[Integrator, ...]:
    """Return every explicit method with its default fields, low orders first."""
    kinds = [kind for kind in INTEGRATORS.values() if not kind.solves]
    return tuple(kind() for kind in sorted(kinds, key=lambda kind: (kind.order, kind.evaluations)))


def machine() -> Machine:
    """Return the machine that times depend on: CPU, cores and load."""
    cpu = platform.processor()
    with suppress(OSError):
        lines = File("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), cpu)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return Machine(cpu=cpu or platform.machine(), cores=os.cpu_count() or 1, load=load)
