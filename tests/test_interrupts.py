"""Signals: a command ends with one line, its processes end with it, and no partly written file is left."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from benchmarks import interrupts
from flockenv.core import signals
from flockenv.core.signals import ONE_PRESS
from flockenv.jobs import Failure, Job
from flockenv.jobs.local_engine import LocalEngine, guard_process_starts

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

SCENE = """\
space: {kind: torus, size: [9, 9]}
groups: [{count: 4, spawn: {speed: [1, 2]}}]
effects: [{kind: drag, rate: 0.5}]
dt: 0.01
"""

COMMAND = """\
import os, sys, time
from flockenv.core import signals
from flockenv.core.atomic_files import new_folder, replace_file
from pathlib import Path
signals.begin("toy")
def say(word):
    print(word, flush=True)
{body}
"""


def start(*command: str, folder: Path) -> subprocess.Popen[str]:
    """Start a process with a group of its own and default signal handlers, however the tests were started."""

    def reset_handlers() -> None:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)

    return subprocess.Popen(
        [sys.executable, *command], cwd=folder, env=ENVIRONMENT, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, start_new_session=True, preexec_fn=reset_handlers,
    )  # fmt: skip


def toy(body: str, folder: Path, word: str = "ready") -> subprocess.Popen[str]:
    """Start a command of a few lines, and wait until it prints a word."""
    process = start("-c", COMMAND.format(body=body), folder=folder)
    wait_for(process, word)
    return process


def wait_for(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None and process.stdout.readline() == f"{word}\n"


def guards_signals(process: subprocess.Popen[str]) -> bool:
    """Return True if a process blocks or handles SIGTERM; Python itself does neither."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    masks = re.findall(r"^Sig(?:Blk|Cgt):\s*(\w+)", status, re.MULTILINE)
    return any(int(mask, 16) >> (signal.SIGTERM - 1) & 1 for mask in masks)


def lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


# --- one line, at any time


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
@pytest.mark.parametrize(
    "command",
    [
        (str(Path(sys.executable).with_name("flockenv")), "list"),
        ("-m", "agents.compare", "--smoke"),
        ("-m", "agents.tune", "pursuit.yaml"),
    ],
    ids=["flockenv", "compare", "tune"],
)
def test_a_signal_during_imports_ends_a_command_with_one_line(
    command: tuple[str, ...], number: signal.Signals, tmp_path: Path
) -> None:
    process = start(*command, folder=tmp_path)
    while not guards_signals(process):
        assert process.poll() is None
        time.sleep(0.0005)
    os.killpg(process.pid, number)
    out, message = process.communicate(timeout=60)
    assert process.returncode == 128 + number, message
    assert re.fullmatch(r"\w+: (interrupted|terminated).*\n", message)
    assert (out, list(tmp_path.iterdir())) == ("", [])


PLACES = {
    "a line of the command": "with signals.handle_signals('toy'):\n    say('ready')\n    time.sleep(60)",
    "inside pickle": """\
import pickle
class Slow:
    def __reduce__(self):
        say('ready')
        time.sleep(60)
with signals.handle_signals('toy'):
    pickle._dumps(Slow())""",
    "machine code": """\
import numba
count = numba.njit(nogil=True)(lambda n: sum([k % 7 for k in range(n)]))
count(1)
with signals.handle_signals('toy'):
    say('ready')
    count(10**13)""",
}
"""The code that the main thread executes when a signal arrives, or soon after."""


@pytest.mark.slow
@pytest.mark.parametrize("body", PLACES.values(), ids=PLACES)
def test_an_interrupt_ends_a_command_in_any_code(body: str, tmp_path: Path) -> None:
    process = toy(body, tmp_path)
    time.sleep(0.2)  # until the line after the output; a slow machine may still be before it
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=60)
    if process.returncode == 130:
        assert message == "toy: interrupted\n"
    else:  # raised in the command's own code, which does not handle it
        assert message.splitlines()[-1] == "KeyboardInterrupt" and "pickle" not in body


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (signal.SIGINT, "interrupted, nothing kept"),
        (signal.SIGTERM, "terminated, nothing kept"),
        (signal.SIGHUP, "terminated: the terminal was closed, nothing kept"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_the_last_line_of_a_command_begins_with_the_signal_that_ended_it(
    number: signal.Signals, message: str, tmp_path: Path
) -> None:
    body = """\
import typer
from flockenv.cli.terminal import report_errors, run_program
app = typer.Typer()
@app.command()
def main():
    with report_errors('toy', 'interrupted, nothing kept'):
        say('ready')
        while True:
            time.sleep(0.01)
sys.argv = ['toy']
run_program('toy', app)"""
    process = toy(body, tmp_path)
    process.send_signal(number)
    assert process.communicate(timeout=60)[1] == f"toy: {message}\n"
    assert process.returncode == 128 + number


def test_a_second_interrupt_ends_the_cleanup_that_the_first_one_began(tmp_path: Path) -> None:
    slow = """\
with signals.handle_signals('toy'):
    try:
        say('ready')
        time.sleep(60)
    finally:
        say('first')
        time.sleep(60)"""
    process = toy(slow, tmp_path)
    process.send_signal(signal.SIGINT)
    wait_for(process, "first")
    time.sleep(2 * ONE_PRESS)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=60)
    assert (process.returncode, message) == (130, "toy: interrupted\n")


def test_two_signals_of_one_key_press_count_as_one(tmp_path: Path) -> None:
    """A terminal and a wrapper such as `uv run` both pass Ctrl-C on."""
    keeps = """\
with signals.handle_signals('toy'):
    try:
        os.kill(os.getpid(), 2)
        time.sleep(60)
    except KeyboardInterrupt:
        os.kill(os.getpid(), 2)
        time.sleep(0.6)
        say('kept')"""
    process = toy(keeps, tmp_path, "kept")
    out, message = process.communicate(timeout=60)
    assert (process.returncode, out, message) == (0, "", "")


def test_a_command_under_nohup_ignores_a_closed_terminal(tmp_path: Path) -> None:
    ignoring = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    process = start("-c", ignoring + COMMAND.format(body="say('ready')\ntime.sleep(1)"), folder=tmp_path)
    wait_for(process, "ready")
    process.send_signal(signal.SIGHUP)
    assert process.communicate(timeout=60)[1] == "" and process.returncode == 0


@pytest.mark.slow
def test_a_signal_during_a_simulation_is_announced_before_it_is_measured(tmp_path: Path) -> None:
    """SIGTERM is announced by its own word, and the benchmark of interrupts does not count the line as a fault."""
    (tmp_path / "x.yaml").write_text(SCENE)
    command = [
        str(Path(sys.executable).with_name("flockenv")),
        "measure",
        "x.yaml",
        "--time",
        "1e6",
        "--every",
        "1e4",
    ]
    process = start(*command, folder=tmp_path)
    assert process.stderr is not None
    assert any(line.startswith("simulating") for line in process.stderr)
    process.send_signal(signal.SIGTERM)
    out, message = process.communicate(timeout=60)
    first, last = message.splitlines()
    assert re.fullmatch(r"flockenv: terminated; measuring the first \S+ s, Ctrl-C again ends it", first)
    assert last == "flockenv: terminated; results until then are shown"
    assert process.returncode == 143 and "nearest neighbour" in out
    assert not list(interrupts._faults_of(message))


def test_importing_flockenv_does_not_change_signal_handlers() -> None:
    code = "import signal, flockenv, agents; assert signal.getsignal(signal.SIGINT) is signal.default_int_handler"
    process = start("-c", code, folder=ROOT)
    assert process.communicate(timeout=60)[1] == ""


END = """\
import atexit
with signals.handle_signals('toy'):
    pass
atexit.register(time.sleep, 1.0)
atexit.register(print, 'done', flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_a_signal_after_the_work_changes_neither_exit_code_nor_output(number: signal.Signals, tmp_path: Path) -> None:
    process = toy(END, tmp_path, "done")
    process.send_signal(number)
    assert (process.communicate(timeout=60)[1], process.returncode) == ("", 0)


def test_a_signal_is_dropped_if_the_work_ends_before_it_takes_effect(tmp_path: Path) -> None:
    """The signal arrives inside pickle, where no exception may be raised; the work is done within PATIENCE."""
    outruns = """\
import atexit, pickle
signals.PATIENCE = 1.5
atexit.register(time.sleep, 3.3)
class Slow:
    def __reduce__(self):
        os.kill(os.getpid(), 2)
        time.sleep(0.1)
        return (list, ())
with signals.handle_signals('toy'):
    pickle._dumps(Slow())
say('worked')"""
    process = toy(outruns, tmp_path, "worked")
    assert (process.communicate(timeout=60)[1], process.returncode) == ("", 0)


# --- partly written files


@pytest.mark.parametrize("running", [True, False], ids=["running", "before it runs"])
def test_partly_written_files_are_removed(running: bool, tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text("old")
    write = (
        "with new_folder(Path('new/deep')), replace_file('new/deep/x.json') as one, replace_file('old.json') as two:\n"
        "    one.write(b'{'), two.write(b'{'), one.flush(), two.flush()\n"
        "    say(len(list(Path('.').rglob('*.part'))))\n    time.sleep(60)"
    )
    within = "with signals.handle_signals('toy'):\n    " + write.replace("\n", "\n    ")
    process = toy(within if running else write, tmp_path, "2")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert [path.name for path in tmp_path.rglob("*")] == ["old.json"]
    assert (tmp_path / "old.json").read_text() == "old"


def test_a_held_section_is_completed_in_spite_of_a_signal(tmp_path: Path) -> None:
    body = """\
with signals.handle_signals('toy'):
    with signals.defer_signals():
        say('ready')
        time.sleep(1.5)
        Path('all').write_text('there')
    time.sleep(60)"""
    process = toy(body, tmp_path)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode != 0 and (tmp_path / "all").read_text() == "there"


# --- processes end with their parent

WORK = """\
import os, time
from pathlib import Path
from flockenv.jobs import Job
from flockenv.jobs.local_engine import LocalEngine

def work(number):
    Path(str(number)).write_text(str(os.getpid()))
    {doing}

if __name__ == "__main__":
    jobs = [Job(str(number), work, (number,), None) for number in range(2)]
    list(LocalEngine(2).run(jobs, lambda job: None))
"""


@pytest.mark.parametrize("before", [None, "17"])
@pytest.mark.parametrize("error", [None, ValueError("a player fails")])
def test_the_mark_of_worker_processes_is_removed_after_they_are_started(
    before: str | None, error: Exception | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A later process with the mark that imports flockenv would ignore Ctrl-C, and end with this process."""
    monkeypatch.delenv(signals.PARENT, raising=False)
    if before is not None:
        monkeypatch.setenv(signals.PARENT, before)
    with suppress(ValueError), guard_process_starts():
        assert os.environ[signals.PARENT] == str(os.getpid())
        if error:
            raise error
    assert os.environ.get(signals.PARENT) == before


def _exit_after_signal() -> bytes:
    os._exit(143)


def test_workers_ended_by_a_signal_to_the_whole_group_are_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worker ends at once, while the command waits for a line at which it can raise KeyboardInterrupt."""
    jobs = [Job("exits", _exit_after_signal, (), None)]
    monkeypatch.setattr(signals._Received, "raised", False)
    with monkeypatch.context() as received:
        received.setattr(signals._Received, "signal", signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            list(LocalEngine(2).run(jobs, lambda job: None))
    [(_, failure)] = LocalEngine(2).run(jobs, lambda job: None)
    assert isinstance(failure, Failure) and "its process ended 3 times" in str(failure)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=lambda number: number.name)
@pytest.mark.parametrize(
    "doing", ["time.sleep(60)", "sum(k for k in range(10**12))"], ids=["waiting", "working"]
)  # fmt: skip
def test_worker_processes_end_with_their_parent(number: signal.Signals, doing: str, tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(WORK.format(doing=doing))
    process = start("parent.py", folder=tmp_path)
    files = [tmp_path / str(number) for number in range(2)]
    until = time.monotonic() + 60
    while not all(file.exists() and file.read_text() for file in files):
        assert time.monotonic() < until, "the workers do not start"
        time.sleep(0.05)
    workers = [int(file.read_text()) for file in files]
    assert all(lives(pid) for pid in workers)
    process.send_signal(number)
    process.wait(timeout=60)
    until = time.monotonic() + 5
    while any(lives(pid) for pid in workers):
        assert time.monotonic() < until, "a worker lives on"
        time.sleep(0.05)
    _, message = process.communicate(timeout=60)
    assert "Traceback" not in message and "leaked" not in message


def test_a_package_of_another_program_named_agents_keeps_its_signal_handlers(tmp_path: Path) -> None:
    package = tmp_path / "agents"
    package.mkdir()
    (package / "__init__.py").write_text("import flockenv\n")
    waiting = "    print('ready', flush=True)\n    time.sleep(60)\n"
    (package / "train.py").write_text(f"import time\ntry:\n{waiting}finally:\n    print('cleaned up', flush=True)\n")
    process = start("-m", "agents.train", folder=tmp_path)
    wait_for(process, "ready")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert "cleaned up" in out and "KeyboardInterrupt" in err
