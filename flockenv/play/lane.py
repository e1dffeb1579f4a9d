"""Lane: one world of a playground. A room plays one to four lanes side by side."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from flockenv.core.magnitudes import check_array
from flockenv.core.record import Record
from flockenv.model.snapshot import Mark, Snapshot
from flockenv.model.state import State
from flockenv.play.edits import Edit, MoveAgent
from flockenv.scene import Scene

__all__ = ["Change", "Drawn", "Keyframe", "Lane", "Scenery", "circles_of", "collected_warnings", "move_agent"]

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Change:
    """What an edit did."""

    restarts: bool = False
    """True if the lane began again at its seed, because the edit changes what a world begins with."""
    in_record: bool = True
    """True if the edit is part of the lane's record, so that a saved file has it."""
    notices: tuple[str, ...] = ()
    """Warnings and remarks, a line each."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a frame shows of a world at one instant, as views that the next step overwrites. N agents."""

    time: float  # s
    pos: Floats  # (D, N) m
    vel: Floats  # (D, N) m/s
    aim: Floats  # (D, N) directions in which agents point, of any length
    alive: NDArray[np.bool_]  # (N,)
    low: tuple[float, ...]  # (D,) m, corners of the region to show
    high: tuple[float, ...]
    shade: Floats | None  # (N,) from 0 to 1, set by appearances; None without one
    identity: NDArray[np.int64] | None  # (N,) the agent in each slot; None: the same agents at all times
    broken: NDArray[np.bool_] | None = None  # (E,) edges of networks that are broken; None if none breaks


class Scenery(NamedTuple):
    """What stands around the agents at an instant."""

    circles: Floats  # (M, D + 1) m, centres and radii of round obstacles
    outlines: tuple[Floats, ...]  # polygons (n, 2) m of other obstacles, seen from above
    marks: tuple[Mark, ...]  # goals, paths, headings


class Keyframe(Protocol):
    """The exact state of a lane, which shares no array with it, and all that edits have changed."""

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""


class Lane(Protocol):
    """One world of a playground, and what can be done with it.

    Equal records, seeds and edits at equal ticks give equal states, bit for bit.
    """

    record: Any  # the Scene or Task as edits have left it
    seed: int
    tick: int
    """Steps since the start, each of `interval` s: physics steps of a scene, decisions of a task."""
    stopped: str
    """Why the lane makes no more steps, in one line; "" while it does."""

    @property
    def time(self) -> float:
        """Time of the world, s."""

    @property
    def interval(self) -> float:
        """Time of one tick, s."""

    @property
    def returns(self) -> float | None:
        """Return so far, mean over learners; None for a scene."""

    @property
    def made_of(self) -> Callable[[], Lane]:
        """What makes such a lane, at its start; it can be pickled."""

    def start(self, record: Record | None = None) -> None:
        """Begin again at tick 0, with another record if given."""

    def step(self, ticks: int = 1) -> None:
        """Advance by some ticks, fewer if it stops; a stopped lane keeps its last state."""

    def compile(self) -> None:
        """Compile what steps need, in any thread, before the first one; the state stays as it is."""

    def prepare(self, edit: Edit) -> None:
        """Compile what an edit needs, in any thread, so that `apply` is fast; raise ValueError as `apply` does."""

    def would_restart(self, path: str, value: object) -> bool | None:
        """Return True if another value at a path begins the world again; None if the value is not possible."""

    def apply(self, edit: Edit) -> Change:
        """Apply an edit between two steps; raise ValueError, in one line, before anything changes."""

    def keep(self) -> Keyframe:
        """Return the exact state."""

    def restore(self, keyframe: Any) -> None:
        """Go back, or on, to a keyframe of this lane."""

    @property
    def digest(self) -> str:
        """A digest of the exact state."""

    @property
    def drawn(self) -> Drawn:
        """What a frame shows now."""

    @property
    def scenery(self) -> Scenery:
        """What stands around the agents now."""

    def snapshot(self) -> Snapshot:
        """Return the world at this instant, with all that is drawn."""


def move_agent(scene: Scene, state: State, edit: MoveAgent) -> None:
    """Put an agent of a state elsewhere; raise ValueError, in one line, before anything changes if there is none."""
    if edit.agent >= scene.agents or not state.alive[0, edit.agent]:
        raise ValueError(f"agent = {edit.agent}: there is no such living agent among {scene.agents}")
    for name, value in (("pos", edit.pos), ("vel", edit.vel)):
        if value is not None and len(value) != scene.dimension:
            raise ValueError(f"{name} = {value}: must have {scene.dimension} numbers")
        if value is not None:
            check_array(name, np.array(value, float).reshape(1, 1, -1), scene.dtype)
    state.pos[0, edit.agent] = scene.space.wrap(edit.pos)
    if edit.vel is not None:
        state.vel[0, edit.agent] = edit.vel
        state.face()


def circles_of(state: State) -> Floats:
    """Return the round obstacles of a state's first world, (M, D + 1) m: centres and radii, without empty slots."""
    rows = np.column_stack([state.obstacles.centre[0], state.obstacles.radius[0]])
    return np.asarray(rows[rows[:, -1] > 0])


_one_at_a_time = threading.RLock()


@contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """Collect the warnings of a block as lines of text, each once, instead of showing them.

    One thread at a time is in such a block, because it changes what the whole process does with warnings.
    """
    lines: list[str] = []
    with _one_at_a_time, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield lines
    lines += dict.fromkeys(" ".join(str(each.message).split()) for each in caught)
