"""The `jobs` command: how far a run of jobs is, from its results folder."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flockenv.cli.terminal import new_console, show_table

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["EngineName", "Fresh", "Processes", "jobs"]

EngineName = Annotated[
    str, typer.Option(help="local: processes of this machine; ray: a Ray cluster (RAY_ADDRESS), or a local Ray.")
]
Processes = Annotated[
    int | None, typer.Option(min=1, max=256, help="Processes of the local engine. [one for each core]")
]
Fresh = Annotated[bool, typer.Option("--fresh", help="Run all jobs anew, also those whose record is stored.")]

STATES = ("running", "failed", "waiting", "done")


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
    content = State.read(folder)
    keys = _keys_by_state(content)
    console = new_console()
    if state is not None:
        for key in keys[state]:
            console.print(key, markup=False, soft_wrap=True)
        return
    kinds = list(dict.fromkeys(key.split("/")[0] for key in content["keys"]))
    rows = [[kind, *(str(sum(key.startswith(f"{kind}/") for key in keys[name])) for name in STATES)] for kind in kinds]
    age = time.time() - float(content["written"])
    show_table(console, f"Jobs in {folder}, as of {age:.0f} s ago", rows, ("", *STATES))
    if content["failed"]:
        show_table(console, "Failed", list(content["failed"].items()))


def _keys_by_state(content: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the keys of all jobs in their order, by state."""
    ended = {*content["done"], *content["running"], *content["failed"]}
    found = {name: [key for key in content["keys"] if key in content[name]] for name in ("running", "failed", "done")}
    return {**found, "waiting": [key for key in content["keys"] if key not in ended]}
