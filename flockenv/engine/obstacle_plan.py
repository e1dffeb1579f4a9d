"""What folds over the obstacles depend on: which laws ask, where their numbers lie, which shapes they may skip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.agent_records import AgentPlan
from flockenv.engine.shape_rows import Surroundings
from flockenv.jit.decorators import Law

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import Parts

__all__ = ["Fold", "Obstacles", "Place", "Shape", "obstacle_plan"]


class Fold(NamedTuple):
    """An effect with a fold over the obstacles."""

    k: int  # its number among all effects
    start: Law  # its laws, or None where it has none
    law: Law
    ray: Any
    origin: Any  # from where it sees obstacles, if not from where the agent is
    reach: Any
    rays: int
    pieces: bool  # are walls, polygons and rooms met side after side?
    hidden: Surroundings | None  # by which obstacles others may be hidden from it; None: that does not matter
    slots: tuple[int, ...]  # where its running numbers lie
    ahead: tuple[int, ...]  # where it is noted which obstacle is ahead, by form and place; nowhere if none asks
    told: int  # where in a block of `felt` lies what its pair law has found out; -1: it has none


class Obstacles(NamedTuple):
    """All that the folds over the obstacles of a scene depend on."""

    agent: AgentPlan
    around: Surroundings
    folds: tuple[Fold, ...]
    arranges: bool  # may what all agents have in common lie where the first block has it?
    felt: int  # how many numbers of `felt` a block has
    reach: int  # where it lies how far all folds look, m; -1: nowhere
    found: int  # where rows lie that a grid lists; -1: nowhere
    bounded: tuple[str, ...]  # forms of which a shape is met only if its box lies within reach
    looked_up: tuple[str, ...]  # forms of which a grid lists the shapes that may lie within reach
    only_rays: bool  # do all folds cast rays?


class Place(NamedTuple):
    """Where the agents of a block lie: in arrays of vectors, in arrays of numbers, and their bodies."""

    base: Any
    row: Any
    one: Any


class Shape(NamedTuple):
    """A shape as an agent meets it."""

    at: Any  # where its row begins
    place: Any  # which of its form it is; of a form with a grid, how far its row lies behind the first
    y: Any  # m, the agent from its anchor
    vel: Any  # m/s
    gap: Any  # m, how far its surface is
    out: Any  # the outward unit normal there


def obstacle_plan(parts: Parts, agent: AgentPlan) -> Obstacles:
    """Return the plan of a scene."""
    d, width, slots, around = parts.dimension, parts.width, parts.slots, parts.surroundings

    def places(prefix: str) -> tuple[int, ...]:
        return tuple(at * width for name, at in slots.items() if name.startswith(prefix))

    folds = tuple(
        Fold(
            k, e.obstacle_start, e.obstacle_law, e.obstacle_ray, e.obstacle_from, e.obstacle_reach,
            e.rays(d) if e.obstacle_ray is not None else 1, e.obstacle_pieces,
            around if e.occluded_obstacles else None, places(f"o{k}_"),
            places(f"ahead{k}_") if e.obstacle_edges else (),
            parts.felt_at(parts.pair_target(k)) if e.pair_law is not None else -1,
        )
        for k, e in enumerate(parts.effects)
        if e.obstacle_start is not None and e.obstacle_law is not None
    )  # fmt: skip
    return Obstacles(
        agent, around, folds, parts.arranges, parts.felt_size,
        slots["reach0"] * width if "reach0" in slots else -1, slots["found0"] * width if "found0" in slots else -1,
        parts.bounded, parts.looked_up, parts.only_rays,
    )  # fmt: skip
