"""Ctrl-C at random moments of ten commands: `python -m benchmarks.interrupts --times 300`.

Each run is a process group of its own in an empty folder, with a kernel cache that is warm or empty. It gets SIGINT (a
tenth SIGTERM) at a random moment: the whole group, as from a terminal, or the command alone; a tenth get it twice. What
is counted must be 0: tracebacks, other words than the one line and the announcements before it, wrong exit codes,
processes that are still there 5 s later, temporary files and files that cannot be read. Runs in which SIGTERM was
neither blocked nor handled when the signal was sent, by /proc/PID/status, are counted apart, with how they ended:
Python was starting, and had not run the first statements of flockenv. POSIX with /proc (Linux).
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from flockenv.cli.terminal import progress_bar, run_program

__all__ = ["COMMANDS", "Outcome", "interrupt"]

ROOT = Path(__file__).resolve().parent.parent
SCENES = ROOT / "configs" / "scenes"
PATIENCE, ORPHANED, LATE = 60.0, 5.0, 2.0
"""s until a command that was interrupted counts as hanging, and until a process that is left counts as an orphan; one
that succeeds so soon after its signal without a word had done its work, and was on its way out. A simulation that
`measure` interrupts is still measured, which takes up to 20 s."""

FLOCKENV = (str(Path(sysconfig.get_path("scripts")) / "flockenv"),)
COMMANDS: dict[str, tuple[str, ...]] = {
    "list": (*FLOCKENV, "list"),
    "run": (*FLOCKENV, "run", f"{SCENES}/boids.yaml", "--duration", "4000", "--out", "a/b/run.npz"),
    "measure": (*FLOCKENV, "measure", f"{SCENES}/boids.yaml", "--json", "m.json", "--out", "pictures"),
    "render": (*FLOCKENV, "render", f"{SCENES}/boids.yaml", "--duration", "20", "--out", "a/x.gif"),
    "accuracy": (*FLOCKENV, "accuracy", "--suite", "--out", "accuracy.png"),
    "stress": (*FLOCKENV, "stress", "--out", "stress.json"),
    "compare": ("-m", "agents.compare", "--tasks", "pursuit,obstacles", "--players", "random,rules"),
    "transfer": ("-m", "agents.transfer", "pursuit", "--players", "random,rules", "--worlds", "16"),
    "tune": ("-m", "agents.tune", "pursuit.yaml"),
    "ppo": ("-m", "agents.ppo", "pursuit.yaml", "--out", "w.safetensors", "--runs", "runs"),
}

SIGNALLED = re.compile(r"\b(interrupted|terminated)\b")

ALLOWED = re.compile(
    r"\w+: (interrupted|terminated).*|interrupted; .*|flockenv: warning: .*|"
    r"[\w/: -]+: (done|failed)( \(\d+ of \d+\))?|.*\(.* so far.*\)|\s*[\d,]+ steps .*|\s*"
)
"""Lines of stderr that are not complained of: the one line, warnings, and news of how far a command is."""

REST = re.compile(r"\w+: (interrupted|terminated).*; .*, Ctrl-C again ends it")
"""An announcement of what a command still does after a signal; the one line follows at its end."""

LEFT = re.compile(r".*(\.part|\.tmp.*)$|\.partial-.*|tmp\w{8}|.*\.pyc\.\d+$")


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run; `faults` are one word each, and empty if nothing is wrong."""

    command: str
    at: float  # s
    early: bool  # before flockenv blocked or handled signals
    code: int
    faults: tuple[str, ...]
    stderr: str


def interrupt(
    command: str, at: float, number: signal.Signals, group: bool, twice: bool, cache: Path, folder: Path
) -> Outcome | None:
    """Run a command in a folder, send it a signal after a number of seconds, and look at what is left.

    None if it had ended before, or was just ending. The folder is empty; group: the signal goes to all its processes.
    """
    (folder / "pursuit.yaml").write_text((ROOT / "configs" / "training" / "pursuit.yaml").read_text())
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "FLOCKENV_CACHE": str(cache)}
    process = subprocess.Popen(
        [sys.executable, *COMMANDS[command]], cwd=folder, env=environment, text=True, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, start_new_session=True, preexec_fn=_reset_signals,
    )  # fmt: skip
    time.sleep(at)
    if process.poll() is not None:
        process.communicate()
        return None
    early = not _is_in_mask(process.pid, signal.SIGTERM, "Blk|Cgt|Ign")
    done = _is_in_mask(process.pid, number, "Ign")  # the command ignores signals once it has done its work
    sent = time.monotonic()
    for _ in range(1 + twice):
        (os.killpg if group else os.kill)(process.pid, number)
        if twice:
            time.sleep(0.5)
            if process.poll() is not None:
                break
    faults = []
    try:
        stderr = process.communicate(timeout=PATIENCE)[1]
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        stderr = process.communicate()[1]
        faults.append("hangs")
    if _is_alive(process.pid):
        faults.append("orphan")
        os.killpg(process.pid, signal.SIGKILL)
    if process.returncode == 0 and not SIGNALLED.search(stderr) and (done or time.monotonic() - sent < LATE):
        return None
    if process.returncode != 128 + number:
        faults.append(f"exit code {process.returncode}")
    faults += [*_faults_of(stderr), *_leftovers(folder, cache)]
    return Outcome(command, at, early, process.returncode, tuple(faults), stderr)


def _reset_signals() -> None:
    """Let a new process handle SIGINT and SIGTERM as by default."""
    for number in (
        signal.SIGINT,
        signal.SIGTERM,
    ):  # processes of a shell in the background inherit that it ignores them
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


def _is_in_mask(pid: int, number: int, names: str) -> bool:
    """True if a signal is in one of a process's masks, named as in /proc/PID/status: Blk|Cgt|Ign."""
    masks = re.findall(rf"^Sig(?:{names}):\s*(\w+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    return any(int(mask, 16) >> (number - 1) & 1 for mask in masks)


def _ending_text(outcome: Outcome) -> str:
    """Return how a run ended whose signal arrived while Python was starting."""
    if not outcome.faults:
        return "one line of flockenv's"  # the first statement ran between the look into /proc and the signal
    if re.search(r"Traceback|Fatal Python error|^KeyboardInterrupt$", outcome.stderr, re.MULTILINE):
        return "traceback of Python's"
    return "killed without a word" if outcome.code < 0 and not outcome.stderr else f"exit code {outcome.code}"


def _is_alive(group: int) -> bool:
    """True if a process of a group is still there after ORPHANED seconds."""
    until = time.monotonic() + ORPHANED
    while time.monotonic() < until:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.05)
    return True


def _faults_of(stderr: str) -> Iterator[str]:
    if "Traceback" in stderr or "Exception ignored" in stderr:
        yield "traceback"
    elif any(not ALLOWED.fullmatch(line) for line in stderr.splitlines()):
        yield "words"
    lines = [line for line in stderr.splitlines() if not REST.fullmatch(line)]
    ends = [line for line in lines if re.match(r"(\w+: )?(interrupted|terminated)", line)]
    if len(ends) != 1:
        yield f"{len(ends)} lines"


def _leftovers(folder: Path, cache: Path) -> Iterator[str]:
    places = [*folder.rglob("*"), *cache.rglob("*"), *ROOT.rglob("__pycache__/*")]
    yield from (f"left: {path.name}" for path in places if LEFT.fullmatch(path.name))
    empty = (path for path in folder.rglob("*") if path.is_dir() and not any(path.iterdir()))
    yield from (f"empty: {path.name}" for path in empty)
    for path in folder.rglob("*.json"):
        try:
            json.loads(path.read_text())
        except ValueError:
            yield f"half: {path.name}"


def main(
    times: Annotated[int, typer.Option(min=1, help="Total number of interrupts.")] = 300,
    seed: Annotated[int, typer.Option(help="Seed of moments and signals.")] = 0,
    longest: Annotated[
        float, typer.Option(help="Latest moment in seconds; half of the moments are in the first 1.5 s.")
    ] = 10.0,
    cold: Annotated[float, typer.Option(min=0, max=1, help="Share of runs with an empty cache.")] = 0.25,
    only: Annotated[str, typer.Option(help="Commands, by comma [all].")] = "",
) -> None:
    """Interrupt commands at random moments, and count what went wrong."""
    rng = random.Random(seed)  # noqa: S311  # moments, not secrets
    outcomes, names = [], only.split(",") if only else list(COMMANDS)
    with tempfile.TemporaryDirectory() as warm, progress_bar("interrupting", times, "runs") as progress:
        while len(outcomes) < times:
            command = names[len(outcomes) % len(names)]
            at = rng.uniform(0, 1.5 if rng.random() < 0.5 else longest)
            number = signal.SIGTERM if rng.random() < 0.1 else signal.SIGINT
            group, twice, empty = rng.random() < 0.6, rng.random() < 0.1, rng.random() < cold
            with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as fresh:
                place = Path(fresh if empty else warm)
                outcome = interrupt(command, at, number, group, twice, place, Path(folder))
            if outcome is None:
                continue
            outcomes.append(outcome)
            progress(len(outcomes))
            if outcome.faults and (not outcome.early or _ending_text(outcome).startswith("exit")):
                how = f"{number.name} at {at:.2f} s, group {group}, twice {twice}, cold {empty}"
                print(f"{command}, {how}: {', '.join(outcome.faults)}\n{outcome.stderr}", flush=True)
    counted = [outcome for outcome in outcomes if not outcome.early]
    faults = Counter(fault.split(":")[0] for outcome in counted for fault in outcome.faults)
    print(f"{len(counted)} interrupts of {len(names)} commands: {dict(faults) or 'nothing went wrong'}")
    early = Counter(_ending_text(outcome) for outcome in outcomes if outcome.early)
    print(f"{early.total()} while Python was starting, before flockenv blocks or handles signals: {dict(early)}")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command()(main)
    run_program("interrupts", app)
