"""Cases for the Ray engine: `python -m tests.ray_cases NAME` in an environment that has Ray, see tests/test_ray.py.

Each case is a function; it prints nothing and raises an error if it fails.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from ray.cluster_utils import Cluster
from typer.testing import CliRunner

from agents import compare, tune
from flockenv.jobs import FailedJobsError, Job, Store, Work, run_jobs
from flockenv.jobs.local_engine import LocalEngine
from flockenv.jobs.ray_engine import RayEngine
from flockenv.physics.integrators import methods_of
from flockenv.studies.accuracy import measure_errors, select_problems
from tests.small_jobs import blas_threads, end_always, end_twice

CLOCKS = (
    "microseconds_per_decision", "microseconds_single", "wall_time_s", "seconds", "verdict", "versions", "machine",
    "git",
)  # fmt: skip
"""Keys of results.json and of tuned parameters that depend on clocks, or on the packages of the environment."""


def wait_and_return(folder: str, value: int, seconds: float, size: int = 1) -> bytes:
    """Note in a file that the job has run to its end; return some bytes."""
    time.sleep(seconds)
    with open(Path(folder, f"{value}.txt"), "a") as file:
        file.write("ran\n")
    return bytes([value % 256]) * size


@contextmanager
def cluster(nodes: int, cores: int = 1, **more: Any) -> Iterator[Any]:
    """Connect to a cluster of nodes with one core each, all on this machine; more: arguments of the head."""
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": cores, "include_dashboard": False, **more})
    workers = [made.add_node(num_cpus=1) for _ in range(nodes - 1)]
    ray.init(address=made.address, log_to_driver=False)
    try:
        yield made, workers
    finally:
        ray.shutdown()
        made.shutdown()


def played(out: str, *arguments: str) -> Any:
    """Return the results of a small comparison without its clocks."""
    options = ["--tasks", "pursuit,obstacles", "--players", "random,rules,ppo", "--worlds", "8", "--out", out]
    result = CliRunner().invoke(compare.app, [*options, *arguments])
    assert result.exit_code == 0, result.output
    return without_clocks(json.loads(Path(out, "results.json").read_text()))


def without_clocks(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: without_clocks(value) for key, value in content.items() if key not in CLOCKS}
    return [without_clocks(value) for value in content] if isinstance(content, list) else content


def results_are_those_of_a_cluster_of_two_nodes() -> None:
    """Of the comparison: by the local engine, and by a cluster of two nodes."""
    local = played("local", "--processes", "2")
    with cluster(2):
        assert played("cluster", "--engine", "ray") == local


def a_killed_worker_loses_nothing() -> None:
    """A job whose process is killed runs again, at most three times; the rest finishes."""
    folder = os.getcwd()
    jobs = [Job("killed", end_twice, (folder,), None)]
    jobs += [Job(f"rest/{k}", wait_and_return, (folder, k, 0.0), k) for k in range(6)]
    store = Store(Path("jobs"))
    run_jobs(jobs, Work(store, RayEngine()))
    assert store.read(jobs[0], bytes) == b"survived"
    assert all(store.has(job) for job in jobs)
    try:
        run_jobs([Job("killer", end_always, (), None), *jobs], Work(store, RayEngine(), fresh=True))
    except FailedJobsError as error:
        assert "its process or node ended 3 times" in str(error) and len(error.failures) == 1
    else:
        raise AssertionError("a job that kills its process did not fail")


def a_killed_node_loses_nothing() -> None:
    """Jobs of a node that ends in the middle run on the other; every record is there, and none is written twice."""
    folder, written = os.getcwd(), []
    jobs = [Job(f"job/{k}", wait_and_return, (folder, k, 0.4), k) for k in range(12)]
    with cluster(2) as (made, workers):

        def end_node(done: int, most: int, name: str) -> None:
            written.append(name)
            if done == 3:
                made.remove_node(workers.pop(), allow_graceful=False)

        run_jobs(jobs, Work(Store(Path("jobs")), RayEngine(), progress=end_node))
    assert [Store(Path("jobs")).read(job, bytes) for job in jobs] == [bytes([k]) for k in range(12)]
    assert sorted(written[1:]) == sorted(f"{job.name}: done" for job in jobs) and not workers


def note_node(folder: str, kernel: int) -> None:
    """Note in a file that a kernel has been compiled on this node."""
    with open(Path(folder, f"kernel-{kernel}.txt"), "a") as file:
        file.write(f"{ray.get_runtime_context().get_node_id()}\n")


def see_kernel(folder: str, kernel: int) -> bytes:
    """Return the nodes on which a kernel has been compiled so far."""
    return Path(folder, f"kernel-{kernel}.txt").read_bytes()


def each_node_is_warmed_once_before_any_job() -> None:
    """A kernel that more jobs need than there are nodes is compiled on each; an error there fails no job."""
    here = os.getcwd()
    jobs = [
        Job(f"job/{k}", see_kernel, (here, k % 2), k, warm_up=(note_node, (here, k % 2)))
        for k in range(6)
    ]  # fmt: skip
    jobs += [Job(f"rest/{k}", wait_and_return, (here, k, 0.0), k, warm_up=(note_node, (here, 2))) for k in range(2)]
    jobs += [Job(f"bad/{k}", wait_and_return, (here, k, 0.0), k, warm_up=(end_always, ())) for k in range(3)]
    with cluster(2):
        nodes = sorted(node["NodeID"] for node in ray.nodes())
        run_jobs(jobs, Work(Store(Path("jobs")), RayEngine()))
    store = Store(Path("jobs"))
    assert all(sorted(store.read(job, bytes.decode).split()) == nodes for job in jobs[:6])
    assert all(store.has(job) for job in jobs) and not Path("kernel-2.txt").exists()


def a_worker_uses_one_thread_and_a_job_gets_its_memory() -> None:
    """Ray bounds the threads of a job with one core; a job that needs more memory than any node has runs alone."""
    jobs = [Job(f"threads/{k}", blas_threads, (), k, memory=(0, 10**6, 10**15)[k]) for k in range(3)]
    assert [record for _, record in RayEngine().run(jobs, lambda job: None)] == 3 * [b"1"]
    Path("memory").mkdir()
    with cluster(1, cores=3, memory=10**9):
        large = [Job(f"m/{k}", note_and_wait, (os.getcwd(), k), k, memory=6 * 10**8) for k in range(3)]
        assert [record for _, record in RayEngine().run(large, lambda job: None)] == 3 * [b"1"]


def note_and_wait(folder: str, value: int) -> bytes:
    """Return how many jobs ran while this one did, at most."""
    with open(Path(folder, "memory", str(value)), "w"):
        time.sleep(0.5)
    most = len(list(Path(folder, "memory").iterdir()))
    Path(folder, "memory", str(value)).unlink()
    return str(most).encode()


def errors_of_methods_and_a_search_are_the_same() -> None:
    """Of `flockenv accuracy`, and of a short search of `agents.tune`."""
    problems, methods = {each.name: each for each in select_problems(["damped", "tracer"])}, methods_of(["rk4"])
    reports = [
        {name: report.model_dump(exclude={"machine"}) for name, report in measure_errors(problems, methods, None, of)}
        for of in (LocalEngine(1), RayEngine())
    ]
    assert reports[0] == reports[1] and reports[0]["damped"]["curves"]
    settings = "{steps: 600, candidates: 4, worlds: 4, final_worlds: 4}"
    Path("tiny.yaml").write_text(f"task: pursuit\nppo: {{evaluate_worlds: 4}}\nsearch: {settings}\n")
    for name in ("local", "ray"):
        command = ["tiny.yaml", "--engine", name, "--jobs", f"jobs-{name}", "--out", f"{name}.json"]
        result = CliRunner().invoke(tune.app, command)
        assert result.exit_code == 0, result.output
    local, distributed = (json.loads(Path(f"{name}.json").read_text()) for name in ("local", "ray"))
    assert without_clocks(distributed) == without_clocks(local)


def memory_of_the_driver_does_not_grow_with_the_number_of_jobs() -> None:
    """1,000 records of 100 kB: the peak after all of them is that after the first 200, but for 30 MB."""
    peaks = {}

    def note(done: int, most: int, name: str) -> None:
        peaks[done] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    jobs = [Job(f"stub/{k}", wait_and_return, (os.getcwd(), k, 0.0, 100_000), k) for k in range(1000)]
    run_jobs(jobs, Work(Store(Path("jobs")), RayEngine(), progress=note))
    assert peaks[1000] < peaks[200] + 30, peaks


CASES = (
    results_are_those_of_a_cluster_of_two_nodes,
    a_killed_worker_loses_nothing,
    a_killed_node_loses_nothing,
    each_node_is_warmed_once_before_any_job,
    a_worker_uses_one_thread_and_a_job_gets_its_memory,
    errors_of_methods_and_a_search_are_the_same,
    memory_of_the_driver_does_not_grow_with_the_number_of_jobs,
)

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as empty:
        os.chdir(empty)
        next(case for case in CASES if case.__name__ == sys.argv[1])()
