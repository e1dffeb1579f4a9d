"""The plan of `look`, and the records that its functions pass each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.neighbour_lists import Listing, listing_of
from flockenv.jit.decorators import Law

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import KernelPlan

__all__ = ["LookPlan", "Looking", "Nearest", "Span", "plan_look"]


class LookPlan(NamedTuple):
    """All constants of `look`."""

    listing: Listing
    agents: int  # number of nearest agents in a list
    obstacles: int  # number of nearest obstacles in a list
    keyed: bool  # True if lists of agents are kept as keys
    exact: bool  # True if each operation of a square is rounded, the same in every loop
    offset_to: Law
    at: int  # where its numbers begin: radius, m, and the square of that

    @property
    def place(self) -> tuple[int, ...]:
        """Where the coordinates of an agent of a block lie."""
        return self.listing.lanes_of(self.listing.axes("x"))

    def slots(self, name: str, count: int) -> tuple[int, ...]:
        """Return where running numbers of one name lie."""
        return tuple(int(self.listing.slot(f"{name}{k}")) for k in range(count))


def plan_look(parts: KernelPlan) -> LookPlan:
    """Return the plan of `look` for a task whose parts have one."""
    look, exact = parts.look, parts.keyed or any(sight.nearest for sight in parts.sights)
    assert look is not None
    return LookPlan(
        listing_of(parts, parts.seen_fields), look.agents, look.obstacles, parts.keyed, exact,
        parts.space.offset_law, parts.number_plan.look[0],
    )  # fmt: skip


class Span(NamedTuple):
    """The size of the space, and the radius within which neighbours are queried."""

    size: Any  # m, size of the space
    reach: Any  # m
    within: Any  # m^2, its square


class Nearest(NamedTuple):
    """Where the nearest agents are written."""

    square: Any  # (K, N) m^2
    who: Any  # (K, N)
    count: Any  # (N,)
    pos: Any  # (D, K, N) m


class Looking(NamedTuple):
    """One world in which neighbours are queried: the fields of a context that listing and walking blocks read."""

    numbers: Span
    near: Nearest
    n: Any  # number of agents
    present: Any  # number of agents alive
    arranged: Any  # always False: agents lie by number
    first: Any  # blocks: [first, end)
    end: Any
    rank: Any  # a single thread
    team: Any
    scratch: Any
