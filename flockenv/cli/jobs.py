"""The `jobs` command: how far a run of jobs is, from its results folder."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flockenv.cli.terminal import duration_text, new_console, show_table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from flockenv.jobs import Shard

__all__ = ["STOPPED", "EngineName", "Fresh", "Processes", "ShardText", "end_of_shard", "jobs", "shard_of"]

STOPPED = "interrupted; what was played is stored, run the same command to continue"
"""The line about an interrupt of a command that stores the records of jobs."""

EngineName = Annotated[
    str, typer.Option(help="local: processes of this machine; ray: a Ray cluster (RAY_ADDRESS), or a local Ray.")
]
Processes = Annotated[
    int | None, typer.Option(min=1, max=256, help="Processes of the local engine. [one for each core]")
]
Fresh = Annotated[bool, typer.Option("--fresh", help="Run all jobs anew, also those whose record is stored.")]
ShardText = Annotated[
    str | None,
    typer.Option(
        "--shard", metavar="I/N", help="Run share I (from 0) of N of the jobs only; a later call without it collects."
    ),
]

STATES = ("running", "failed", "waiting", "done")


def shard_of(text: str | None) -> Shard | None:
    """Return the shard of the option; raise ValueError if its text is none."""
    from flockenv.jobs import Shard

    return None if text is None else Shard.of_text(text)


@contextmanager
def end_of_shard() -> Iterator[None]:
    """End a command whose share of the jobs is done with one line on stderr and exit code 0."""
    from flockenv.jobs import ShardDone

    try:
        yield
    except ShardDone as done:
        typer.echo(str(done), err=True)
        raise typer.Exit(0) from None


def jobs(
    folder: Annotated[Path, typer.Argument(help="Folder with the records of jobs.", show_default=True)] = Path(
        "results/jobs"
    ),
    state: Annotated[
        str | None, typer.Option(metavar="|".join(STATES), help="List the keys of the jobs in this state.")
    ] = None,
) -> None:
    """Show how many jobs are done, running, failed and waiting; the folder may belong to a run that goes on."""
    from flockenv.core.errors import nearest, printable
    from flockenv.jobs.store import State

    if state is not None and state not in STATES:
        raise ValueError(f"--state {printable(state)}: unknown{nearest(state, STATES)}; allowed: {', '.join(STATES)}")
    commands, console = State.read(folder), new_console()
    keys = {command: _keys_by_state(content) for command, content in commands.items()}
    if state is not None:
        for of in keys.values():
            for key in of[state]:
                console.print(key, markup=False, soft_wrap=True)
        return
    rows = [
        [command, *(str(len(of[name])) for name in STATES), _age(commands[command])] for command, of in keys.items()
    ]
    show_table(console, f"Jobs in {folder}", rows, ("", *STATES, "as of"))
    if failed := [item for content in commands.values() for item in content["failed"].items()]:
        show_table(console, "Failed", failed)


def _keys_by_state(content: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the keys of all jobs in their order, by state; none runs if the process has ended."""
    of = {name: set(content[name]) for name in ("running", "failed", "done")}
    if not _is_alive(content):
        of["running"].clear()
    found = {name: [key for key in content["keys"] if key in keys] for name, keys in of.items()}
    return {**found, "waiting": [key for key in content["keys"] if not any(key in keys for keys in of.values())]}


def _age(content: Mapping[str, Any]) -> str:
    """Return when the file was written."""
    text = f"{duration_text(max(0.0, time.time() - float(content['written'])))} ago"
    return text if _is_alive(content) else f"{text}, ended"


def _is_alive(content: Mapping[str, Any]) -> bool:
    """Return True if the process that wrote a file runs, or if that cannot be found out: it is on another machine."""
    if os.name != "posix" or content["host"] != platform.node():
        return True
    try:
        os.kill(content["process"], 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
