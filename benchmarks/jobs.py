"""The overhead of engines: `python -m benchmarks.jobs`, in an environment with Ray (configs/constraints-ray.txt).

The same 64 small jobs run on the local engine and on a local Ray, in turns, with one process for each core. Measured is
the time from the end of the first jobs, when all processes run, to the end of the last.
"""

from __future__ import annotations

import json
import statistics
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated

import ray
import typer

from benchmarks.measure import command_line
from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.jobs import Engine, Failure, Job
from flockenv.jobs.local_engine import LocalEngine
from flockenv.jobs.ray_engine import RayEngine

JOBS, FIRST = 64, 8


def work(milliseconds: float, number: int) -> bytes:
    """Occupy a core for a time; return a record of 100 kB."""
    until = time.perf_counter() + milliseconds / 1e3
    while time.perf_counter() < until:
        pass
    return bytes(100_000)


def seconds(engine: Engine, milliseconds: float, kind: str) -> float:
    """Return the time of the jobs after the first few."""
    jobs = [Job(f"{kind}/{k}", work, (milliseconds, k), k) for k in range(FIRST + JOBS)]
    with closing(engine.run(jobs, lambda job: None)) as results:
        for done, (_, record) in enumerate(results, 1):
            if isinstance(record, Failure):
                raise RuntimeError(str(record))
            if done == FIRST:
                began = time.perf_counter()
    return time.perf_counter() - began


def main(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds in which both engines take turns.")] = 5,
    milliseconds: Annotated[float, typer.Option(help="Duration of a job.")] = 50.0,
    cores: Annotated[int, typer.Option(min=1, help="Processes of each engine.")] = 2,
    out: Annotated[Path, typer.Option(help="File for all samples.")] = Path("results/benchmarks/jobs.json"),
) -> None:
    """Compare the time of small jobs on Ray with that on the local engine."""
    ray.init(num_cpus=cores, include_dashboard=False, log_to_driver=False)
    engines: dict[str, Engine] = {"local": LocalEngine(cores), "ray": RayEngine()}
    samples: dict[str, list[float]] = {name: [] for name in engines}
    for _ in range(rounds):
        for name, engine in engines.items():
            samples[name].append(seconds(engine, milliseconds, name))
    ratios = [other / own for own, other in zip(samples["local"], samples["ray"], strict=True)]
    for name, values in samples.items():
        print(f"{name:6} {JOBS} jobs of {milliseconds:g} ms: {statistics.median(values):.2f} s")
    print(f"ray / local: {statistics.median(ratios):.3f} ({min(ratios):.3f}-{max(ratios):.3f})")
    with new_folder(out.parent), replace_file(out) as file:
        content = {"seconds": samples, "ratios": ratios, "milliseconds": milliseconds, "cores": cores}
        file.write(json.dumps(content, indent=1).encode())


if __name__ == "__main__":
    command_line(main)()
