"""What `look` depends on, and what its parts hand each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.neighbour_lists import Listing, listing_of
from flockenv.jit.decorators import Law

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import Parts

__all__ = ["LookPlan", "Looking", "Nearest", "Span", "plan_look"]


class LookPlan(NamedTuple):
    """All that `look` depends on."""

    listing: Listing
    agents: int  # how many of the nearest agents are listed
    obstacles: int  # and how many obstacles
    keyed: bool  # are lists of agents kept as keys?
    exact: bool  # is each operation of a square rounded, in every loop the same?
    offset_to: Law
    at: int  # where its numbers begin: how far it looks, m, and the square of that

    @property
    def place(self) -> tuple[int, ...]:
        """Where the coordinates of an agent of a block lie."""
        return self.listing.lanes_of(self.listing.axes("x"))

    def slots(self, name: str, count: int) -> tuple[int, ...]:
        """Return where running numbers of one name lie."""
        return tuple(int(self.listing.slot(f"{name}{k}")) for k in range(count))


def plan_look(parts: Parts) -> LookPlan:
    """Return what `look` depends on for a task whose parts have a look."""
    look, exact = parts.look, parts.keyed or any(sight.nearest for sight in parts.sights)
    assert look is not None
    return LookPlan(
        listing_of(parts, parts.seen_fields), look.agents, look.obstacles, parts.keyed, exact,
        parts.space.offset_law, parts.number_plan.look[0],
    )  # fmt: skip


class Span(NamedTuple):
    """How far agents look."""

    size: Any  # m, of the space
    reach: Any  # m
    within: Any  # m^2, its square


class Nearest(NamedTuple):
    """Where the nearest agents are told."""

    square: Any  # (K, N) m^2
    who: Any  # (K, N)
    count: Any  # (N,)
    pos: Any  # (D, K, N) m


class Looking(NamedTuple):
    """One world in which agents look around: the fields of a context that listing agents and walking blocks read."""

    numbers: Span
    near: Nearest
    n: Any  # how many agents
    present: Any  # how many of them are alive
    arranged: Any  # never: agents lie by number
    first: Any  # blocks: [first, end)
    end: Any
    rank: Any  # one thread alone
    team: Any
    scratch: Any
