"""How a script of this folder is run: alone, or turn by turn beside another one. Needs the standard library alone.

    PYTHON run_vmas.py flocking_4 --rounds 5       prints one JSON line: what it does, versions, five samples
    PYTHON run_vmas.py flocking_4 --turns          prints one when it is ready, then one per line "SECONDS" on stdin

Packages are imported by the function that builds a case, after the number of threads has been settled.
"""

import argparse
import importlib
import json
import os
import sys
from collections.abc import Callable, Mapping
from importlib import metadata
from time import perf_counter, process_time
from typing import Any, NamedTuple

DRAWS = 16
"""Random actions are drawn before, a number of sets, and used in turn: drawing them is no part of a simulation."""


class Case(NamedTuple):
    """Something that can be stepped."""

    step: Callable[[], object]
    agent_steps: float  # per call of `step`
    does: str  # in words: how many, which forces, observations, rewards
    work: Any = None  # benchmarks.floors.Work of an agent-step, where it was counted


def run(cases: Mapping[str, Callable[[int], Case]], *packages: str) -> None:
    """Read the command line and measure one case; `cases` build theirs from a number of threads."""
    parser = argparse.ArgumentParser()
    parser.add_argument("case", choices=cases)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=0.2, help="of one sample")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--turns", action="store_true", help="take a sample per line on stdin, until it ends")
    given = parser.parse_args()
    limit(given.threads)
    began = perf_counter()
    case = cases[given.case](given.threads)
    case.step()  # whatever compiles, compiles now
    about = {
        "does": case.does,
        "work": case.work and vars(case.work),
        "versions": {name: version(name) for name in packages},
        "ready_seconds": perf_counter() - began,
    }
    if given.turns:
        say(about)
        for line in sys.stdin:
            say(sample(case, float(line)))
    else:
        rounds = [sample(case, given.seconds) for _ in range(given.rounds)]
        total = {key: sum(one[key] for one in rounds) for key in rounds[0]}
        say({**about, **total, "rounds": rounds})


def limit(threads: int) -> None:
    """Limit the cores of this process and the threads of every thread pool; before anything is imported."""
    if hasattr(os, "sched_setaffinity"):  # the only limit that JAX keeps to
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-threads:])
    for name in ("OMP", "MKL", "OPENBLAS", "NUMBA"):
        os.environ[f"{name}_NUM_THREADS"] = str(threads)


def version(package: str) -> str:
    """Return which one was measured; a checkout that is not installed says so itself."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return str(importlib.import_module(package).__version__)


def sample(case: Case, seconds: float) -> dict[str, float]:
    """Step for about so long."""
    calls, cpu, began = 0, process_time(), perf_counter()
    while (took := perf_counter() - began) < seconds:
        case.step()
        calls += 1
    return {"agent_steps": calls * case.agent_steps, "seconds": took, "cpu_seconds": process_time() - cpu}


def say(what: Mapping[str, Any]) -> None:
    """Print one line of JSON."""
    print(json.dumps(what), flush=True)
