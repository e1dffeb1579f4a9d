"""The overhead of engines, and the sizes of jobs: `python -m benchmarks.jobs`.

The same 64 small jobs run on the local engine and on a local Ray, in turns, with one process for each core. Measured is
the time from the end of the first jobs, when all processes run, to the end of the last. This needs an environment with
Ray (configs/constraints-ray.txt).

`--sizes` runs one job of each kind in a process of its own instead: bytes of its pickled arguments and of its record,
seconds, and peak memory. It also measures storing a record, the memory and time of one world of each task, and a step
of a million worlds. This needs no Ray.
"""

from __future__ import annotations

import json
import pickle
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.measure import command_line, machine
from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.envs.world import World, bytes_per_world
from flockenv.jobs import Engine, Failure, Job, Store
from flockenv.jobs.local_engine import LocalEngine
from flockenv.physics.integrators import RK4
from flockenv.tasks import TASKS

JOBS, FIRST = 64, 8
PLAYED = 256
"""Worlds of a job that plays, as by default in agents.compare."""
STEPPED, DECISIONS, MANY = 4096, 20, 1_000_000
"""Worlds and decisions that are timed, and worlds of the largest batch."""


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


def samples_of_jobs() -> Iterator[Job]:
    """Yield a job of each kind: players of three tasks, a training of one rollout, trials."""
    from agents.experiment import CONFIGS, load_experiment
    from agents.training_job import training_job
    from flockenv.studies.play_jobs import Player, play_job

    for task, player in (("pursuit", "rules"), ("pursuit", "ppo"), ("flock", "rules"), ("school", "ppo")):
        experiment = load_experiment(CONFIGS / f"{task}.yaml")
        yield play_job("compare", experiment.build(), Player.of(player), PLAYED, 0, 0)
    experiment = load_experiment(CONFIGS / "pursuit.yaml")
    p = experiment.ppo
    few = p.model_copy(update={"steps": p.worlds * p.rollout, "evaluate_every": p.worlds * p.rollout})
    with tempfile.TemporaryDirectory() as runs:
        yield training_job(experiment.model_copy(update={"ppo": few}), Path(runs), False)
    yield from _trials()


def _trials() -> Iterator[Job]:
    """Yield a hard case, and the errors of a method on a problem, as the commands make them."""
    from flockenv.studies import accuracy, stress

    made: list[Job] = []

    class Noting(LocalEngine):
        """An engine that notes its jobs and runs none."""

        def run(self, jobs: Any, begun: Any) -> Any:
            made.extend(jobs)
            yield from ()

    stress.run(stress.CASES[:1], [RK4()], engine=Noting(1))
    problem = accuracy.select_problems(["boids"])[0]
    list(accuracy.measure_errors({"boids": problem}, [RK4()], None, Noting(1)))
    yield from (replace(job, name=f"{kind}/{job.name}") for kind, job in zip(("stress", "errors"), made, strict=True))


def measured(function: Callable[..., bytes], arguments: tuple[Any, ...]) -> bytes:
    """Run a job twice, the second time with its kernels loaded; return the sizes, the time, and the peak memory."""
    first = function(*arguments)
    began = time.perf_counter()
    function(*arguments)
    seconds = time.perf_counter() - began
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB on Linux
    moved = {"arguments": len(pickle.dumps((function, arguments))), "record": len(first)}
    return json.dumps({**moved, "seconds": seconds, "peak": peak}).encode()


def stepped(task: str, worlds: int, decisions: int) -> bytes:
    """Step some worlds of a task; return bytes per world, seconds per decision of all, and the memory they took."""
    World(TASKS[task]()).reset(0)
    before = resident()
    world = World(TASKS[task](), worlds)
    world.reset(0)
    actions = np.zeros((worlds, world.learners, world.action_size))
    times = []
    for _ in range(decisions):
        began = time.perf_counter()
        world.step(actions)
        times.append(time.perf_counter() - began)
    grown = resident() - before
    found = {"worlds": worlds, "learners": world.learners, "bytes_per_world": bytes_per_world(world.task)}
    return json.dumps({**found, "seconds_per_decision": statistics.median(times), "grown": grown}).encode()


def resident() -> int:
    """Return the memory that this process occupies, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def store_seconds(size: int = 100_000, times: int = 50) -> float:
    """Return the median time to store a record here, s."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        store, taken = Store(Path(folder)), []
        for k in range(times):
            began = time.perf_counter()
            store.write(Job(f"store/{k}", measured, (), k), bytes(size))
            taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def sizes() -> dict[str, Any]:
    """Print and return the sizes of jobs and worlds."""
    jobs = {}
    print(f"{'job':34} {'arguments, B':>13} {'record, B':>10} {'s':>7} {'peak, MB':>9} {'stated, MB':>11}")
    for job in samples_of_jobs():
        found = _alone(measured, job.function, job.arguments) | {"stated": job.memory}
        jobs[job.name] = found
        print(
            f"{job.name:34.34} {found['arguments']:13,} {found['record']:10,} {found['seconds']:7.3f} "
            f"{found['peak'] / 1e6:9.0f} {found['stated'] / 1e6:11.0f}"
        )
    stored = store_seconds()
    print(f"\nstoring a record of 100 kB: {1e3 * stored:.2f} ms\n")
    print(f"{'task':14} {'B per world':>12} {'GB per million':>15} {'world-decisions/s, one thread':>30}")
    worlds = {task: _alone(stepped, task, STEPPED, DECISIONS) for task in sorted(TASKS)}
    for task, found in worlds.items():
        rate, size = STEPPED / found["seconds_per_decision"], found["bytes_per_world"]
        print(f"{task:14} {size:12,} {size / 1e3:15.3g} {rate:30,.0f}")
    many = _alone(stepped, "pursuit", MANY, 5)
    print(
        f"\n{MANY:,} worlds of pursuit in one process: {many['grown'] / 1e9:.2f} GB in addition, "
        f"{many['seconds_per_decision']:.2f} s per decision"
    )
    return {"jobs": jobs, "store_seconds": stored, "worlds": worlds, "many": many, "machine": machine()}


def _alone(function: Callable[..., bytes], *arguments: Any) -> dict[str, Any]:
    """Call a function in a process of its own; return its answer."""
    [(_, record)] = LocalEngine(1, renew=True).run([Job("alone", function, arguments, None)], lambda job: None)
    if isinstance(record, Failure):
        raise RuntimeError(str(record))
    found: dict[str, Any] = json.loads(record)
    return found


def overhead(rounds: int, milliseconds: float, cores: int) -> dict[str, Any]:
    """Print and return the time of small jobs on Ray and on the local engine."""
    import ray  # type: ignore[import-not-found, unused-ignore]

    from flockenv.jobs.ray_engine import RayEngine

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
    return {"seconds": samples, "ratios": ratios, "milliseconds": milliseconds, "cores": cores}


def main(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds in which both engines take turns.")] = 5,
    milliseconds: Annotated[float, typer.Option(help="Duration of a job.")] = 50.0,
    cores: Annotated[int, typer.Option(min=1, help="Processes of each engine.")] = 2,
    with_sizes: Annotated[bool, typer.Option("--sizes", help="Measure the sizes of jobs and worlds instead.")] = False,
    out: Annotated[Path, typer.Option(help="File for all samples.")] = Path("results/benchmarks/jobs.json"),
) -> None:
    """Compare the time of small jobs on Ray with that on the local engine, or measure the sizes of jobs."""
    content = sizes() if with_sizes else overhead(rounds, milliseconds, cores)
    with new_folder(out.parent), replace_file(out) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


if __name__ == "__main__":
    command_line(main)()
