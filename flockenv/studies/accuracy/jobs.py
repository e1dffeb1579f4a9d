"""Errors of several problems as jobs. Times are no part of a job: other jobs of the machine would change them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace

from flockenv.jobs import Engine, Failure, Job
from flockenv.physics.integrators import Integrator
from flockenv.studies.accuracy.benchmark import measure
from flockenv.studies.accuracy.problem import Problem
from flockenv.studies.accuracy.results import Report
from flockenv.studies.accuracy.suite import SUITE

__all__ = ["measure_errors"]

MEMORY = 500 * 2**20
"""Bytes that a process needs: 340 MiB for libraries and to compile a flock's kernel, then some MiB for each method."""


def measure_errors(
    problems: Mapping[str, Problem], methods: Sequence[Integrator], finer: int | None, engine: Engine
) -> Iterator[tuple[str, Report | ValueError]]:
    """Yield the report of each problem without times, see `add_times`, by name; ValueError if it has no reference.

    problems: by name; methods: instances; engine: runs the measurements as jobs.

    finer: as of `measure`. A closed form must be that of the problem's name in the suite: processes find it there.

    Raises:
        RuntimeError: an error that is not about a reference, or a process that ends in every attempt.
    """
    jobs = [
        Job(
            f"accuracy/{name}",
            _measure,
            (replace(problem, exact=None), bool(problem.exact), tuple(methods), finer),
            name,
            MEMORY,
        )
        for name, problem in problems.items()
    ]
    with closing(engine.run(jobs, lambda job: None)) as results:
        for job, record in results:
            if isinstance(record, Failure):
                raise RuntimeError(f"{job.name}: {record}")
            content = json.loads(record)
            refused = isinstance(content, str)
            yield job.about, ValueError(content) if refused else Report.model_validate_json(record)


def _measure(problem: Problem, has_exact: bool, methods: Sequence[Integrator], finer: int | None) -> bytes:
    """Return the report of a problem, or the text of its refusal, as JSON."""
    try:
        if has_exact:
            problem = replace(problem, exact=SUITE[problem.name]().exact)
        return measure(problem, methods, 0, finer).model_dump_json().encode()
    except ValueError as error:
        return json.dumps(str(error)).encode()
