"""Trajectories as tables, a row for each agent at each instant, in the form that PedPy reads.

Columns: id; frame, from 0; x, y and in 3-D z, m. Instants of a table are equally far apart: the last one is left out if
it is nearer. `pedpy.TrajectoryData(pandas.read_csv("walk.csv"), frame_rate)` reads a CSV; the frame rate is in the
summary beside it, and in the metadata of a Parquet file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from flockenv.scene import Scene

__all__ = ["SUFFIXES", "frame_rate", "require_writer", "table_of", "write_csv", "write_parquet"]

SUFFIXES = (".csv", ".parquet")

Columns = Mapping[str, NDArray[Any]]


class Instants(Protocol):
    """T instants of N agents; see `trajectory.Trajectory`, which is the only one."""

    @property
    def scene(self) -> Scene:
        """The scene that was run."""

    @property
    def step(self) -> NDArray[np.int64]:
        """Physics steps since the start, (T,)."""

    @property
    def pos(self) -> NDArray[Any]:
        """Positions, (T, N, D) m."""

    @property
    def alive(self) -> NDArray[np.bool_]:
        """True for agents that are alive, (T, N)."""

    @property
    def identity(self) -> NDArray[np.int64] | None:
        """Number of the agent in each slot, (T, N), of scenes with a population."""


def require_writer(suffix: str) -> None:
    """Raise ValueError, in one line, if files of a suffix need a package that is missing."""
    if suffix.lower() == ".parquet":
        try:
            import pyarrow  # noqa: F401
        except ImportError:
            raise ValueError("a Parquet file needs the package pyarrow: pip install 'flockenv[parquet]'") from None


def frame_rate(trajectory: Instants) -> float | None:
    """Return the number of frames per second; None of a trajectory of a single instant."""
    step = trajectory.step
    return 1.0 / (float(step[1] - step[0]) * trajectory.scene.dt) if len(step) > 1 else None


def table_of(trajectory: Instants) -> Columns:
    """Return the columns of the table: living agents, in the order of frames and then of slots.

    With a population, an id is the number of the agent, not of its slot.
    """
    step = trajectory.step
    frames = len(step) - 1 if len(step) > 2 and step[-1] - step[-2] != step[1] - step[0] else len(step)
    frame, slot = np.nonzero(trajectory.alive[:frames])
    who = slot if trajectory.identity is None else trajectory.identity[frame, slot]
    places = {axis: trajectory.pos[frame, slot, k] for k, axis in enumerate("xyz"[: trajectory.pos.shape[2]])}
    return {"id": who, "frame": frame, **places}


def write_csv(trajectory: Instants, path: Path) -> None:
    """Write the table as CSV, with numbers that read back exactly."""
    columns = table_of(trajectory)
    digits = 9 if trajectory.pos.dtype == np.float32 else 17
    formats = ["%d", "%d"] + [f"%.{digits}g"] * (len(columns) - 2)
    rows = np.column_stack([each.astype(np.float64) for each in columns.values()])
    with path.open("w", encoding="utf-8", newline="\n") as file:
        np.savetxt(file, rows, fmt=formats, delimiter=",", header=",".join(columns), comments="")


def write_parquet(trajectory: Instants, path: Path) -> None:
    """Write the table as Parquet; its metadata have the frame rate.

    Raises:
        ValueError: pyarrow is missing; one line.
    """
    require_writer(".parquet")
    import pyarrow
    from pyarrow import parquet

    table = pyarrow.table({name: pyarrow.array(column) for name, column in table_of(trajectory).items()})
    rate = frame_rate(trajectory)
    parquet.write_table(table.replace_schema_metadata({} if rate is None else {"frame_rate": repr(rate)}), path)
