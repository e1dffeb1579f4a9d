"""Jobs: keys, records, engines, failures and resumption, on small jobs."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flockenv.cli.main import app
from flockenv.core.available_memory import available_memory
from flockenv.jit.thread_pool import cores
from flockenv.jobs import (
    FailedJobsError,
    Failure,
    Job,
    Shard,
    ShardDone,
    Store,
    Work,
    engine_of,
    records,
    run_jobs,
)
from flockenv.jobs import job as job_module
from flockenv.jobs.job import code_digest, execute
from flockenv.jobs.local_engine import LocalEngine, count_fitting
from flockenv.jobs.store import State
from flockenv.model.appearance import Appearance
from flockenv.physics.integrators import RK4
from flockenv.studies import accuracy, stress, trial_log
from flockenv.studies.accuracy.suite import SUITE
from tests.small_jobs import blas_threads, end_always, end_twice

ROOT = Path(__file__).resolve().parent.parent


def number(value: int) -> bytes:
    return str(value).encode()


def note_and_return(folder: str, value: int) -> bytes:
    """Append a line to a file, so that a test sees how often the job has run."""
    with open(Path(folder, f"{value}.txt"), "a") as file:
        file.write("ran\n")
    return str(value).encode()


def fail(value: int) -> bytes:
    raise ValueError(f"{value} is too much")


def process_id(value: int) -> bytes:
    return str(os.getpid()).encode()


def sleep(seconds: float) -> bytes:
    time.sleep(seconds)
    return b""


def numbers(count: int) -> list[Job]:
    return [Job(f"test/{k}", number, (k,), k) for k in range(count)]


def work(tmp_path: Path, processes: int = 1, **more: Any) -> Work:
    return Work(Store(tmp_path / "jobs"), LocalEngine(processes), **more)


# --- keys


def test_a_key_depends_on_the_name_on_all_that_the_record_depends_on_and_on_the_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    job = Job("a/b", number, (1,), {"x": 1, "y": [2.5, None]})
    assert job.key == Job("a/b", fail, (), {"y": [2.5, None], "x": 1}).key
    others = [Job("a/c", number, (1,), job.about), Job("a/b", number, (1,), {"x": 2, "y": [2.5, None]})]
    monkeypatch.setattr(job_module, "code_digest", lambda: "other")
    others.append(dataclasses.replace(job))
    assert len({job.key, *(other.key for other in others)}) == 4


def test_a_process_with_other_code_refuses_a_job() -> None:
    assert execute(number, (1,), code_digest()) == b"1"
    assert isinstance(refusal := execute(number, (1,), "0123456789abcdef"), Failure)
    assert "other code, other versions or another processor" in str(refusal)


# --- records


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    name: str
    values: tuple[Any, ...]
    by_name: dict[str, Any]


def test_records_come_back_with_the_same_bits() -> None:
    arrays = [
        np.linspace(0, 1, 7), np.zeros((0, 2), np.int32), np.array([True, False]), np.float32([[np.nan, np.inf]]),
        np.arange(12).reshape(3, 4).T, np.array(2.5),
    ]  # fmt: skip
    sample = Sample(
        "ü", (None, True, 3, -0.0, float("nan"), float("-inf"), *arrays), {"look": Appearance(), "l": [1, 2]}
    )
    data = records.to_bytes(sample)
    back = records.from_bytes(data, (Sample, Appearance))
    assert back.name == "ü" and back.by_name == {"look": Appearance(), "l": [1, 2]}
    assert repr(back.values[:6]) == "(None, True, 3, -0.0, nan, -inf)"
    for array, other in zip(arrays, back.values[6:], strict=True):
        assert array.dtype == other.dtype and array.shape == other.shape
        assert array.tobytes() == other.tobytes()
    assert records.to_bytes(back) == data


def test_equal_arrays_are_written_once() -> None:
    once, twice = (len(records.to_bytes([np.arange(1000.0)] * count)) for count in (1, 2))
    assert twice < once + 200


def test_one_object_in_several_places_is_written_once_and_read_as_one() -> None:
    inner, other = Sample("in", (1.0,), {}), Sample("other", (2.0,), {})
    outer = Sample("out", (inner, other, inner), {"again": inner})
    once, often = (len(records.to_bytes([outer] * count)) for count in (1, 9))
    assert often < once + 200
    first, second = records.from_bytes(records.to_bytes([outer, outer]), (Sample,))
    assert first is second
    assert first.values[0] is first.values[2] is first.by_name["again"] is not first.values[1]
    assert [first.values[0].name, first.values[1].name] == ["in", "other"]


def test_a_record_of_an_unexpected_class_and_damaged_bytes_are_refused() -> None:
    data = records.to_bytes(Sample("a", (np.arange(9.0),), {}))
    with pytest.raises(ValueError, match=r"^damaged: "):
        records.from_bytes(data, ())
    for wrong in (b"", data[:-1], data[9:], b"\xff" * 64):
        with pytest.raises(ValueError, match=r"^damaged: "):
            records.from_bytes(wrong, (Sample,))
    with pytest.raises(TypeError, match="a record contains a set"):
        records.to_bytes({"x": {1}})


# --- runs


@pytest.mark.parametrize("processes", [1, 2])
def test_every_job_is_stored_under_its_key_and_none_runs_twice(processes: int, tmp_path: Path) -> None:
    jobs = [Job(f"test/{k}", note_and_return, (str(tmp_path), k), k) for k in range(5)]
    reports: list[tuple[int, int, str]] = []
    run_jobs(jobs[:2], work(tmp_path, processes))
    run_jobs(jobs, work(tmp_path, processes, progress=lambda *report: reports.append(report)))
    store = Store(tmp_path / "jobs")
    assert [store.read(job, bytes.decode) for job in jobs] == ["0", "1", "2", "3", "4"]
    assert [(tmp_path / f"{k}.txt").read_text() for k in range(5)] == 5 * ["ran\n"]
    assert [report[:2] for report in reports] == [(2, 5), (3, 5), (4, 5), (5, 5)]
    run_jobs(jobs[:1], work(tmp_path, processes, fresh=True))
    assert (tmp_path / "0.txt").read_text() == "ran\nran\n"
    assert not multiprocessing.active_children()


def test_the_rest_is_done_if_jobs_fail(tmp_path: Path) -> None:
    jobs = [*numbers(3), *(Job(f"bad/{k}", fail, (k,), k) for k in range(4))]
    with pytest.raises(FailedJobsError) as raised:
        run_jobs(jobs, work(tmp_path))
    assert list(raised.value.failures) == [job.key for job in jobs[3:]]
    assert str(raised.value).startswith(
        f"0 is too much (job {jobs[3].key}); 1 is too much (job {jobs[4].key}); 2 more, see"
    )
    assert all(Store(tmp_path / "jobs").has(job) for job in jobs[:3])


@pytest.mark.slow
def test_a_job_whose_process_is_killed_runs_again_and_nothing_else_is_lost(tmp_path: Path) -> None:
    jobs = [Job("killed", end_twice, (str(tmp_path),), None), *numbers(6)]
    run_jobs(jobs, work(tmp_path, 2))
    assert Store(tmp_path / "jobs").read(jobs[0], bytes) == b"survived"
    assert all(Store(tmp_path / "jobs").read(job, bytes.decode) == str(k) for k, job in enumerate(jobs[1:]))
    assert len(list(tmp_path.glob("attempt-*"))) == 3


@pytest.mark.slow
def test_a_job_that_kills_its_process_three_times_fails_with_the_end_of_its_output(tmp_path: Path) -> None:
    jobs = [Job("killer", end_always, (), None), *numbers(3)]
    with pytest.raises(FailedJobsError, match=r"its process ended 3 times.*it wrote: the last words \(job killer"):
        run_jobs(jobs, work(tmp_path, 2))
    assert all(Store(tmp_path / "jobs").has(job) for job in jobs[1:])


@pytest.mark.slow
def test_kept_processes_serve_several_runs_and_end_with_the_block() -> None:
    engine, jobs = LocalEngine(2), [Job(f"test/{k}", process_id, (k,), k) for k in range(2)]
    with engine.keep():
        first, second = ({record for _, record in engine.run(jobs, lambda job: None)} for _ in range(2))
        assert first == second and len(first) == 2
        run = engine.run([Job("test/long", sleep, (600.0,), 0), *numbers(1)], lambda job: None)
        assert next(run)[1] == b"0"
        run.close()
        assert {record for _, record in engine.run(numbers(2), lambda job: None)} == {b"0", b"1"}
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_every_job_gets_a_process_of_its_own_if_wanted() -> None:
    jobs = [Job(f"pid/{k}", own_process, (), k) for k in range(3)]
    found = {record for _, record in LocalEngine(1, renew=True).run(jobs, lambda job: None)}
    assert len(found) == 3 and str(os.getpid()).encode() not in found


@pytest.mark.slow
def test_a_process_that_ends_between_two_jobs_is_replaced() -> None:
    jobs = [Job(f"pid/{k}", own_process, (), k) for k in range(3)]
    found = []
    for _, record in LocalEngine(2).run([*jobs, *numbers(2)], lambda job: None):
        assert isinstance(record, bytes)
        if len(record) > 1:
            os.kill(int(record), signal.SIGKILL)
            time.sleep(0.3)
        found.append(record)
    assert len(found) == 5 and {b"0", b"1"} < set(found)


def test_a_failure_has_the_traceback_for_debugging(tmp_path: Path) -> None:
    with pytest.raises(FailedJobsError) as raised:
        run_jobs([Job("bad", fail, (1,), 1)], work(tmp_path))
    assert 'raise ValueError(f"{value} is too much")' in raised.value.__notes__[0]


def lack_memory() -> bytes:
    raise MemoryError("at least 9 TB are needed")


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_lack_of_memory_ends_the_run(processes: int, tmp_path: Path) -> None:
    with pytest.raises(MemoryError, match="at least 9 TB"):
        run_jobs([Job("large", lack_memory, (), 1), *numbers(2)], work(tmp_path, processes))


def test_jobs_that_run_for_long_are_shown_as_running(tmp_path: Path) -> None:
    seen = []

    def slow() -> bytes:
        time.sleep(1.3)
        seen.append(list(State.read(tmp_path / "jobs")["slow"]["running"]))
        return b""

    jobs = [Job(f"slow/{k}", slow, (), k) for k in range(2)]
    run_jobs(jobs, work(tmp_path))
    assert seen == [[jobs[0].key], [jobs[1].key]]


def test_commands_that_play_as_jobs_need_no_torch() -> None:
    """The environment with Ray has none, by configs/constraints-ray.txt."""
    code = "import sys, agents.compare, agents.tune, agents.transfer, agents.curves; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, timeout=60)


# --- threads and memory


@pytest.mark.skipif(sys.platform != "linux" or cores() < 2, reason="finds the library in /proc; needs two cores")
@pytest.mark.parametrize(("processes", "given", "bound"), [(1, None, cores()), (2, None, cores() // 2), (2, "2", 2)])
def test_a_worker_uses_its_share_of_the_cores_for_blas(
    processes: int, given: str | None, bound: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    jobs = [Job(f"threads/{k}", blas_threads, (), k) for k in range(processes)]
    found = [record for _, record in LocalEngine(processes, renew=True).run(jobs, lambda job: None)]
    assert found == processes * [str(bound).encode()]
    assert os.environ.get("OMP_NUM_THREADS") == given


def test_fewer_processes_run_if_jobs_would_not_fit_into_memory(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("flockenv.jobs.local_engine.available_memory", lambda: 5 * 10**9)
    large = [dataclasses.replace(job, memory=2 * 10**9) for job in numbers(4)]
    sizes = "processes: a job needs about 2 GB, 5 GB are available"
    for jobs, processes, count, text in (
        (large, 4, 2, f"2 of 4 {sizes}"), (large, 2, 2, ""), (large, 1, 1, ""), (numbers(4), 4, 4, ""),
        ([dataclasses.replace(job, memory=10**10) for job in numbers(2)], 2, 1, "1 of 2 processes: "),
    ):  # fmt: skip
        assert count_fitting(processes, jobs) == count
        assert [each.startswith(text) for each in caplog.messages] == ([True] if text else [])
        caplog.clear()
    jobs = [Job(f"pid/{k}", own_process, (), k, memory=3 * 10**9) for k in range(3)]
    found = {record for _, record in LocalEngine(2).run(jobs, lambda job: None)}
    assert len(found) == 1 and caplog.messages[0].startswith("1 of 2 processes: ")
    assert {each.name for each in caplog.records} == {"flockenv.jobs"} and not capsys.readouterr().err


@pytest.mark.parametrize("version", [1, 2])
def test_available_memory_is_the_least_of_the_machine_and_of_the_control_groups(version: int, tmp_path: Path) -> None:
    assert available_memory(tmp_path) is None
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text("MemTotal:  9000 kB\nMemAvailable:    8000 kB\n")
    assert available_memory(tmp_path) == 8000 * 1024
    line, top, names = {
        1: ("4:memory:/job/step", "sys/fs/cgroup/memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")),
        2: ("0::/job/step", "sys/fs/cgroup", ("memory.max", "memory.current")),
    }[version]
    (tmp_path / "proc/self/cgroup").write_text(f"7:pids:/\n{line}\n")
    groups = ("", "job", "job/step")
    for group, limit in zip(groups, ("max", "5000000", "6000000"), strict=True):
        folder = tmp_path / top / group
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in zip(names, (limit, "3000000"), strict=True):
            (folder / name).write_text(f"{text}\n")
        (folder / "memory.stat").write_text("inactive_file 1000\ntotal_inactive_file 1000\n")
    assert available_memory(tmp_path) == 5_000_000 - 3_000_000 + 1000


def own_process() -> bytes:
    return str(os.getpid()).encode()


RUN = """
import sys, time
from pathlib import Path
from flockenv.jobs import Job, Shard, ShardDone, Store, Work, run_jobs
from flockenv.jobs.local_engine import LocalEngine

def slow(k):
    time.sleep(0.3)
    return str(k).encode()

if __name__ == "__main__":
    jobs = [Job(f"slow/{k}", slow, (k,), k) for k in range(8)]
    shard = Shard.of_text(sys.argv[1]) if len(sys.argv) > 1 else None
    try:
        run_jobs(jobs, Work(Store(Path("jobs")), LocalEngine(1 if shard else 2), shard=shard))
    except ShardDone as done:
        print(done, file=sys.stderr)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=lambda number: number.name)
def test_a_run_that_is_ended_goes_on_where_it_was(number: signal.Signals, tmp_path: Path) -> None:
    (tmp_path / "run.py").write_text(RUN)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "run.py"], cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    until = time.monotonic() + 60
    while len(list(tmp_path.glob("jobs/slow/*.safetensors"))) < 3:
        assert time.monotonic() < until
        time.sleep(0.02)
    process.send_signal(number)
    process.wait(timeout=60)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("jobs/slow/*.safetensors")}
    assert 3 <= len(before) < 8
    subprocess.run([sys.executable, "run.py"], cwd=tmp_path, env=environment, check=True)
    after = {path: path.stat().st_mtime_ns for path in tmp_path.glob("jobs/slow/*.safetensors")}
    assert len(after) == 8 and before.items() <= after.items()


def records_of(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Return the content of all records, and when they were written."""
    paths = sorted(folder.rglob("*.safetensors"))
    return {path.relative_to(folder).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}


@pytest.mark.slow
def test_shards_at_the_same_time_and_a_run_that_collects_store_the_bytes_of_one_run(tmp_path: Path) -> None:
    (tmp_path / "run.py").write_text(RUN)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "../run.py"]
    folders = [tmp_path / name for name in ("shards", "once")]
    for folder in folders:
        folder.mkdir()
    running = [
        subprocess.Popen([*command, f"{k}/2"], cwd=folders[0], env=environment, stderr=subprocess.PIPE, text=True)
        for k in range(2)
    ]
    for k, process in enumerate(running):
        line = process.communicate(timeout=60)[1].splitlines()[0]
        assert line.startswith(f"shard {k}/2: 4 of 8 jobs, stored in jobs; the same command without --shard collects")
    stored, states = records_of(folders[0] / "jobs"), State.read(folders[0] / "jobs")
    assert [len(states[f"slow-{k}-of-2"]["done"]) for k in range(2)] == [4, 4]
    for folder in folders:
        subprocess.run(command, cwd=folder, env=environment, check=True)
    assert records_of(folders[0] / "jobs") == stored, "collecting runs nothing again"
    assert len(State.read(folders[0] / "jobs")["slow"]["done"]) == 8
    once = records_of(folders[1] / "jobs")
    assert {name: data for name, (data, _) in once.items()} == {name: data for name, (data, _) in stored.items()}
    assert len(once) == 8


def test_shards_have_each_job_once_and_invalid_ones_are_refused(tmp_path: Path) -> None:
    jobs = numbers(7)
    shares = [Shard.of_text(f"{k}/3").of(jobs) for k in range(3)]
    assert sorted(job.name for share in shares for job in share) == [job.name for job in jobs]
    assert Shard(8, 9).of(jobs) == []
    with pytest.raises(ShardDone, match="shard 8/9: 0 of 7 jobs, stored"):
        run_jobs(jobs, work(tmp_path, shard=Shard(8, 9)))
    for text in ("", "3/3", "4/3", "1", "-1/3", "1/0", "a/b", "1/3 ", "1.0/3"):
        with pytest.raises(ValueError, match=r"^--shard '.*': must be I/N with I from 0 to N - 1, such as 0/4"):
            Shard.of_text(text)


def test_a_process_of_another_machine_counts_as_running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_jobs(numbers(1), work(tmp_path))
    file = tmp_path / "jobs" / "state-test.json"
    for host, ended in ((None, True), ("elsewhere", False)):
        content = {**json.loads(file.read_text()), "process": 2**22 + 1}  # beyond the largest process id
        file.write_text(json.dumps({**content, **({"host": host} if host else {})}))
        assert ("ended" in CliRunner().invoke(app, ["jobs", str(tmp_path / "jobs")]).stdout) == ended


def test_an_unknown_engine_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match=r"--engine 'locl': unknown, did you mean `local`.*allowed: local, ray"):
        engine_of("locl")


# --- how far a run is


def test_the_command_shows_how_many_jobs_are_in_which_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shown: list[str] = []

    def look(done: int, most: int, name: str) -> None:
        shown.append(CliRunner().invoke(app, ["jobs", "jobs"]).stdout)

    with pytest.raises(FailedJobsError):
        run_jobs([*numbers(2), Job("bad/1", fail, (1,), 1)], work(tmp_path, progress=look))
    last = CliRunner().invoke(app, ["jobs", "jobs"]).stdout
    assert [row.split()[:5] for row in last.splitlines() if row.startswith("test ")] == [
        ["test", "0", "1", "0", "2"],
    ]  # fmt: skip
    assert "1 is too much" in last and len(shown) == 4
    assert CliRunner().invoke(app, ["jobs", "jobs", "--state", "failed"]).stdout.startswith("bad/1-")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: None, "no jobs have run here"),
        (lambda folder: (folder / "state-test.json").write_text("{"), "is damaged"),
        (lambda folder: (folder / "state-test.json").write_text("[]"), "is damaged"),
    ],
)
def test_a_missing_or_damaged_state_is_one_line(spoil: Callable[[Path], object], message: str, tmp_path: Path) -> None:
    spoil(tmp_path)
    with pytest.raises(ValueError, match=message):
        State.read(tmp_path)


def test_parts_of_one_run_are_shown_together(tmp_path: Path) -> None:
    run_jobs(numbers(2), work(tmp_path))
    run_jobs([Job("test-more/1", number, (1,), 1)], work(tmp_path))
    content = json.loads((tmp_path / "jobs" / "state-test.json").read_text())
    assert len(content["keys"]) == 3 and sorted(content["done"]) == sorted(content["keys"])


class NotedJobs:
    """An engine that notes its jobs, and runs none."""

    parallel = False

    def __init__(self) -> None:
        self.jobs: list[Job] = []

    def run(self, jobs: Iterable[Job], told: Any) -> Iterator[tuple[Job, Any]]:
        self.jobs += jobs
        yield from ()


def test_jobs_of_trials_and_of_accuracy_state_the_memory_of_libraries_and_kernels() -> None:
    engine: Any = NotedJobs()
    trial_log.run(stress.CASES[:2], {"rk4": RK4()}, "sources", engine=engine)
    assert list(accuracy.measure_errors({"damped": SUITE["damped"]()}, [RK4()], None, engine)) == []
    assert len(engine.jobs) == 3 and all(2**28 <= job.memory <= 2**30 for job in engine.jobs)
