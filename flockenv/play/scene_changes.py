"""States of a scene that was changed while it runs: whether the present state goes on, and in which form."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.model.state import State
from flockenv.scene import Scene

__all__ = ["adapted", "begins_otherwise", "have_same_code", "rows_after"]


def have_same_code(old: Scene, new: Scene) -> bool:
    """Return True if steps of both run the same compiled code, as they do if only numbers differ."""
    members, others = ((*scene.constraints, *scene.population) for scene in (old, new))
    alike = [type(each) for each in members] == [type(each) for each in others]
    return alike and bool(old.obstacles) == bool(new.obstacles) and old.stepper.move is new.stepper.move


def begins_otherwise(old: Scene, new: Scene, seed: int) -> bool:
    """Return True if a scene must begin again: its state has other rows, or the change acts at the start alone.

    The latter is a change of the initial state that changes no body, no obstacle and not the space.
    """
    if _shape(old) != _shape(new):
        return True
    plain = not (new.parts.inner or new.population or old.parts.inner)
    if plain and old.groups == new.groups:
        return False  # nothing but groups, inner numbers and births decides on initial states
    same_world = (
        (old.obstacles, old.space, old.parts.frame_rows) == (new.obstacles, new.space, new.parts.frame_rows)
        and all(map(np.array_equal, old.body.arrays(), new.body.arrays()))
    )  # fmt: skip
    return same_world and old.parts.inner == new.parts.inner and _initial(old, seed) != _initial(new, seed)


def _initial(scene: Scene, seed: int) -> str:
    """Return a digest of an initial state, independent of dt."""
    return dataclasses.replace(scene.start(seed), dt=1.0).digest


def _shape(scene: Scene) -> tuple[Any, ...]:
    """Return all on which the rows of a state depend."""
    sizes = tuple((group.size, group.network) for group in scene.groups)
    return scene.dimension, scene.dtype, sizes, scene.living, bool(scene.population)


def adapted(old: Scene, new: Scene, state: State, seed: int) -> State:
    """Return a state of one world as one of a changed scene of the same agents: itself if all of it goes on."""
    kept = state.bonds.shape[1]
    same = (old.groups, old.obstacles, old.space, old.parts.inner, old.parts.frame_rows, old.dt, kept)
    if same == (new.groups, new.obstacles, new.space, new.parts.inner, new.parts.frame_rows, new.dt, new.kept_bonds):
        return state
    return rows_after(old, new, state, np.arange(new.agents), seed)


def rows_after(old: Scene, new: Scene, state: State, source: NDArray[np.int64], seed: int) -> State:
    """Return a state of a changed scene, whose agent k is agent source[k] of `state`; -1: a new one, as at the start.

    Headings, inner numbers and rest lengths that the old scene does not keep are those at the start. If dt is another
    one, the time is rounded to a multiple of it.
    """
    out = new.start(seed)
    rows, at = source[source >= 0], source >= 0
    for name in ("x", "v", "alive", "identity", "born", "dies"):
        mine, theirs = getattr(out, name), getattr(state, name)
        if theirs.shape[-1]:
            mine[..., at] = theirs[..., rows]
    if len(out.frame) == len(state.frame):
        out.frame[..., at] = state.frame[..., rows]
    else:
        out.face()
    for k, number in enumerate(new.parts.inner):
        if number in old.parts.inner:
            out.inner[k][:, at] = state.inner[old.parts.inner.index(number)][:, rows]
    networks = [[g.network for g in scene.groups if g.network is not None] for scene in (old, new)]
    if out.bonds.shape == state.bonds.shape and networks[0] == networks[1]:
        out.bonds[...] = state.bonds
    _let_live(new, out, ~at, float(state.time[0]))
    out.tick[:], out.work[:], out.key[:] = np.rint(state.time / new.dt), state.work, state.key
    return out


def _let_live(scene: Scene, state: State, fresh: NDArray[np.bool_], time: float) -> None:
    """Let added agents live from now on."""
    state.alive[0, fresh] = True
    if scene.population and fresh.any():
        state.identity[0, fresh] = state.identity.max() + 1 + np.arange(fresh.sum())
        state.born[0, fresh], state.dies[0, fresh] = time, np.inf
