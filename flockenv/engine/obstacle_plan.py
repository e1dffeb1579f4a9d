"""The plan of folds over the obstacles: the laws, where their numbers lie, which shapes they may skip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.agent_records import AgentPlan
from flockenv.engine.shape_rows import Surroundings
from flockenv.jit.decorators import Law

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import KernelPlan

__all__ = ["Fold", "Obstacles", "Place", "Shape", "obstacle_plan"]


class Fold(NamedTuple):
    """An effect with a fold over the obstacles."""

    k: int  # its index among all effects
    start: Law  # its laws; None if it has none
    law: Law
    ray: Any
    origin: Any  # returns the point from which it sees obstacles, if not the agent's position
    reach: Any
    rays: int
    pieces: bool  # True if walls, polygons and rooms are handled one side at a time
    hidden: Surroundings | None  # the obstacles that may hide others; None: occlusion does not matter
    slots: tuple[int, ...]  # where its running numbers lie
    ahead: tuple[int, ...]  # where form and place of the obstacle ahead are noted; empty if no law reads them
    pair_force_at: int  # where the sum of its pair law lies in a block of `pair_force`; -1: it has none


class Obstacles(NamedTuple):
    """All constants of the folds over the obstacles of a scene."""

    agent: AgentPlan
    around: Surroundings
    folds: tuple[Fold, ...]
    arranges: bool  # True if numbers that all agents share may be read from the first block
    pair_force_size: int  # count of numbers of `pair_force` in a block
    reach: int  # where the largest reach of all folds is noted, m; -1: nowhere
    found: int  # where the rows that a grid lists are written; -1: nowhere
    bounded_forms: tuple[str, ...]  # forms whose shapes are skipped if their box is out of reach
    gridded_forms: tuple[str, ...]  # forms whose shapes within reach are found by a grid
    only_rays: bool  # True if all folds cast rays


class Place(NamedTuple):
    """Where the agents of a block lie: in arrays of vectors, in arrays of numbers, and their bodies."""

    base: Any
    row: Any
    one: Any


class Shape(NamedTuple):
    """A shape as an agent sees it."""

    at: Any  # where its row begins
    place: Any  # index of it among its form; of a form with a grid, how far its row lies behind the first
    y: Any  # m, the agent's offset from its anchor
    vel: Any  # m/s
    gap: Any  # m, the distance of its surface
    out: Any  # the outward unit normal there


def obstacle_plan(parts: KernelPlan, agent: AgentPlan) -> Obstacles:
    """Return the `Obstacles` of a scene."""
    d, width, slots, around = parts.dimension, parts.width, parts.slots, parts.surroundings

    def places(prefix: str) -> tuple[int, ...]:
        return tuple(at * width for name, at in slots.items() if name.startswith(prefix))

    folds = tuple(
        Fold(
            k, e.obstacle_start, e.obstacle_law, e.obstacle_ray, e.obstacle_from, e.obstacle_reach,
            e.rays(d) if e.obstacle_ray is not None else 1, e.obstacle_pieces,
            around if e.occluded_obstacles else None, places(f"o{k}_"),
            places(f"ahead{k}_") if e.obstacle_edges else (),
            parts.pair_force_at(parts.pair_target(k)) if e.pair_law is not None else -1,
        )
        for k, e in enumerate(parts.effects)
        if e.obstacle_start is not None and e.obstacle_law is not None
    )  # fmt: skip
    return Obstacles(
        agent, around, folds, parts.arranges, parts.pair_force_size,
        slots["reach0"] * width if "reach0" in slots else -1, slots["found0"] * width if "found0" in slots else -1,
        parts.bounded_forms, parts.gridded_forms, parts.only_rays,
    )  # fmt: skip
