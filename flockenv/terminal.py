"""What every command shares: exit codes, options, where tables go, bars while it works, an end before its time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

__all__ = [
    "BAD_INPUT", "DIVERGED", "INTERRUPTED", "OK", "EarlyEnd", "Force", "Seed", "new_console", "printable",
    "progress_bar", "relative", "show_table",
]  # fmt: skip

OK, DIVERGED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
MOST_SEED = 2**63 - 1

Seed = Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Which world: the same seed is the same run.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")]


class EarlyEnd(Exception):  # noqa: N818  # not an error: what was done is kept and shown
    """A run that ended before its time, and the exit code that says so."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


def printable(text: str) -> str:
    """Return text without the control characters that would drive a terminal."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def new_console() -> Console:
    """Return where tables go; what is piped is not folded to the 80 columns of a terminal that is not there."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    return console if console.is_terminal else Console(highlight=False, markup=False, width=160)


def show_table(console: Console, title: str, rows: Iterable[Sequence[str]], columns: Sequence[str] = ("", "")) -> None:
    """Print a table under a title; no header if columns have no names."""
    from rich.table import Table

    console.print(title, style="bold")
    table = Table(box=None, show_header=any(columns), pad_edge=False)
    for k, column in enumerate(columns):
        table.add_column(column, no_wrap=k == 0 and len(columns) > 1, style="cyan" if k == 0 else None, overflow="fold")
    for row in rows:
        table.add_row(*map(printable, row))
    console.print(table)
    console.print()


def relative(path: Path) -> str:
    """Return a path as seen from here, if it is below."""
    here = Path.cwd().resolve()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


@contextmanager
def progress_bar(title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show a bar on stderr while a command works; only where somebody watches."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total} " + unit))
    with Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("compiling", total=total)
        yield lambda done: bar.update(task, completed=done, description=title)
