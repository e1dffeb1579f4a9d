"""Cost of accuracy: the error of each method in steps of each length, with time and evaluations.

from flockenv.studies.accuracy import Problem, measure
report = measure(Problem.of(scene, seconds=1.0, steps=[16, 32, 64, 128, 256, 512]))
report.cheapest(1e-3, by="seconds")
"""

from __future__ import annotations

from flockenv.studies.accuracy.benchmark import add_times, measure, usual_methods
from flockenv.studies.accuracy.jobs import measure_errors
from flockenv.studies.accuracy.methods import methods_named
from flockenv.studies.accuracy.problem import Problem
from flockenv.studies.accuracy.results import Choice, Curve, Machine, Point, Report, Results
from flockenv.studies.accuracy.suite import SUITE, select_problems

__all__ = [
    "SUITE", "Choice", "Curve", "Machine", "Point", "Problem", "Report", "Results", "add_times", "measure",
    "measure_errors", "methods_named", "select_problems", "usual_methods",
]  # fmt: skip
