"""Common parts of the commands: exit codes, options, console tables, progress, one-line errors and signals."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, cast

import typer

from flockenv.core import signals
from flockenv.core.address_space import shortage

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, Task

__all__ = [
    "BAD_INPUT", "DIVERGED", "INTERRUPTED", "OK", "EarlyEnd", "Force", "Seed", "announce_rest", "describe_error",
    "duration_text", "flush_output", "handle_interrupt", "job_bar", "name_stdout_errors", "new_console", "print_error",
    "printable", "progress_bar", "relative_path", "report_errors", "run_program", "show_progress", "show_table",
]  # fmt: skip

OK, DIVERGED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
MOST_SEED = 2**63 - 1

FIRST, OFTEN = 3.0, 10.0
"""s until the first progress line if stderr is not a terminal, and s between two lines."""

Seed = Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Seed of the world: the same seed gives the same run.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite existing files.")]


class EarlyEnd(Exception):  # noqa: N818  # not an error: the results so far are kept and shown
    """A run that ended early, with its exit code."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


def print_error(name: str, text: str) -> None:
    """Write lines to stderr, each prefixed by the name of the command."""
    for line in text.splitlines():
        print(f"{name}: {printable(line)}", file=sys.stderr)


def announce_rest(doing: str) -> None:
    """Write to stderr, at once, that a signal arrived and what the command still does before it ends."""
    print(printable(signals.signal_line(f"interrupted; {doing}, Ctrl-C again ends it")), file=sys.stderr, flush=True)


def describe_error(error: Exception) -> tuple[str, int]:
    """Return the text for an error in a command, and the exit code."""
    usage = getattr(error, "format_message", None)  # typer's own errors about the command line
    if usage is not None:
        return usage() or "no command given; see flockenv --help", BAD_INPUT
    if (short := shortage(error)) is not None:
        return f"not enough memory: {short}", BAD_INPUT
    if isinstance(error, OSError) and error.strerror:
        return _os_text(error), BAD_INPUT
    if isinstance(error, (ValueError, OSError, ImportError)):
        return str(error), BAD_INPUT
    return f"{type(error).__name__}: {error} (a bug in flockenv; --debug shows where)", DIVERGED


def _os_text(error: OSError) -> str:
    """Return the system's reason for an error, with the file if it is known."""
    return str(error.strerror) if error.filename is None else f"{error.filename}: {error.strerror}"


@contextmanager
def handle_interrupt(interrupted: str = "interrupted") -> Iterator[None]:
    """End a command that a signal interrupts with one line on stderr, and the exit code of the signal.

    interrupted: the line; a leading "interrupted" is replaced by the signal's own word.
    """
    signals.set_message(interrupted)
    try:
        yield
    except KeyboardInterrupt:
        if line := signals.take_message():
            print(printable(line), file=sys.stderr)
        raise typer.Exit(signals.exit_code()) from None


@contextmanager
def report_errors(name: str, interrupted: str = "interrupted", debug: bool = False) -> Iterator[None]:
    """End a command with one line on stderr and an exit code if its input is invalid or a signal interrupts it.

    Lack of memory is left to `run_program`. interrupted: as for `handle_interrupt`. debug: errors are raised unchanged.
    """
    with handle_interrupt(interrupted), name_stdout_errors():
        try:
            yield
        except (ValueError, TypeError, OSError) as error:
            if debug or shortage(error) is not None:
                raise
            text, code = describe_error(error) if isinstance(error, OSError) else (str(error), BAD_INPUT)
            print_error(name, " ".join(text.split()))
            raise typer.Exit(code) from None


def run_program(name: str, app: typer.Typer, interrupted: str = "interrupted") -> None:
    """Run an app as the main program of this process, and end the process with its exit code.

    Lack of memory anywhere ends it with one line and code 2, with --debug with a traceback.
    interrupted: the line about an interrupt, unless the command itself sets another.
    """
    signals.set_message(interrupted)
    with signals.handle_signals(name):
        try:
            app()
        except SystemExit as end:
            if end.code not in (INTERRUPTED, signals.exit_code()):
                raise
            if line := signals.take_message():  # typer turns a KeyboardInterrupt into this code without a message
                print(line, file=sys.stderr)
            signals.exit_now(signals.exit_code())
        except Exception as error:
            if shortage(error) is None or "--debug" in sys.argv:
                raise
            print_error(name, describe_error(error)[0])
            sys.exit(BAD_INPUT)


class _Output:
    """Standard output that adds its name to errors: those of the system name no file."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with _name_stdout():
            return self._stream.write(text)

    def flush(self) -> None:
        with _name_stdout():
            self._stream.flush()


@contextmanager
def _name_stdout() -> Iterator[None]:
    """Add the name of standard output to errors; a broken pipe keeps its own text."""
    try:
        yield
    except OSError as error:
        with suppress(OSError, ValueError):  # the buffer is flushed at the end of the process, which must not fail
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError) or error.strerror is None:  # such errors have a text already
            raise
        raise OSError(f"standard output: {error.strerror}") from None


@contextmanager
def name_stdout_errors() -> Iterator[None]:
    """Add the name of standard output to its errors, for everything printed in the block."""
    with redirect_stdout(cast("TextIO", _Output(sys.stdout))) if sys.stdout is not None else nullcontext():
        yield


def flush_output() -> None:
    """Flush stdout; if that fails, raise an OSError that names it. A closed pipe is no error."""
    with suppress(BrokenPipeError), _name_stdout():
        sys.stdout.flush()


def printable(text: str) -> str:
    """Return text with control characters, which a terminal would interpret, escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def new_console() -> Console:
    """Return the console for tables; piped output is not folded to the 80 columns of an assumed terminal."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    return console if console.is_terminal else Console(highlight=False, markup=False, width=160)


def show_table(console: Console, title: str, rows: Iterable[Sequence[str]], columns: Sequence[str] = ("", "")) -> None:
    """Print a table under a title; without a header if no column has a name."""
    from rich.table import Table

    console.print(title, style="bold")
    table = Table(box=None, show_header=any(columns), pad_edge=False)
    for k, column in enumerate(columns):
        table.add_column(column, no_wrap=k == 0 and len(columns) > 1, style="cyan" if k == 0 else None, overflow="fold")
    for row in rows:
        table.add_row(*map(printable, row))
    console.print(table)
    console.print()


def relative_path(path: Path) -> str:
    """Return a path, relative to the current folder if it is below it."""
    here = Path.cwd().resolve()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


@contextmanager
def progress_bar(title: str, total: int, unit: str, first: str = "compiling") -> Iterator[Callable[[int], None]]:
    """Show a command's progress and remaining time on stderr; `first` is the description until the first update."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total} " + unit),
        TimeElapsedColumn(), TextColumn("{task.fields[left]}"),
    )  # fmt: skip
    with show_progress(Progress(*columns, console=Console(stderr=True), transient=True)) as bar:
        task = bar.add_task(first, total=total, left="")
        clock = _Clock()

        def update(done: int) -> None:
            bar.update(task, completed=done, description=title, left=clock.remaining(done, total))

        yield update


@contextmanager
def job_bar(first: str = "compiling and playing", lines: bool = True) -> Iterator[Callable[[int, int, str], None]]:
    """Show one bar over all jobs on a terminal; otherwise write a line for each job that ends, if `lines`.

    first: description until the first job ends.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description:<28}"), BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )  # fmt: skip
    with show_progress(Progress(*columns, console=console, transient=True)) as progress:
        bar = progress.add_task(first, total=None, left="")
        clock = _Clock()

        def update(done: int, most: int, name: str) -> None:
            left = clock.remaining(done, most)
            progress.update(bar, completed=done, total=most, description=name or first, left=left)
            if lines and name and not console.is_terminal:
                console.print(f"{name} ({done} of {most})", highlight=False)

        yield update


class _Clock:
    """Estimate of the remaining time from the work since the first report, which excludes compilation."""

    def __init__(self) -> None:
        self._since: tuple[float, int] | None = None

    def remaining(self, done: int, total: float) -> str:
        """Return the remaining time in words, "" until some work is done."""
        now = time.monotonic()
        if self._since is None:
            self._since = now, done
        start, first = self._since
        if done <= first or done >= total:
            return ""
        return f"about {duration_text((now - start) * (total - done) / (done - first))} left"


def duration_text(seconds: float) -> str:
    """Return a duration in its largest fitting unit: 40 s, 3 min, 5 h, 12 days, 2,000 years."""
    for unit, size, most in (("s", 1.0, 90.0), ("min", 60.0, 5400.0), ("h", 3600.0, 172800.0)):
        if seconds < most:
            return f"{seconds / size:.0f} {unit}"
    days = seconds / 86400
    return f"{days:,.0f} days" if days < 730 else f"{days / 365.25:,.0f} years"


@contextmanager
def show_progress(progress: Progress) -> Iterator[Progress]:
    """Show bars on a terminal; otherwise write a line to stderr after FIRST seconds and then every OFTEN seconds."""
    if progress.console.is_terminal:
        with progress:
            yield progress
        return
    progress.disable = True
    done = threading.Event()
    writer = threading.Thread(target=_write_progress, args=(progress, done), daemon=True)
    writer.start()
    try:
        yield progress
    finally:
        done.set()


def _write_progress(progress: Progress, done: threading.Event) -> None:
    """Write a line about each active bar at intervals, until `done` is set."""
    wait = FIRST
    while not done.wait(wait):
        wait = OFTEN
        for task in progress.tasks:
            if task.started and not task.finished:
                print(_progress_line(task), file=sys.stderr, flush=True)


def _progress_line(task: Task) -> str:
    """Return one line about a bar: task, percentage done, elapsed time and remaining time."""
    share = f" {100 * task.completed / task.total:.3g} %" if task.total and task.completed else ""
    more = [f"{duration_text(task.elapsed or 0.0)} so far", *(str(text) for text in task.fields.values() if text)]
    if "left" not in task.fields and task.completed and task.time_remaining is not None:
        more.append(f"about {duration_text(task.time_remaining)} left")
    return f"{task.description}:{share} ({', '.join(more)})"
