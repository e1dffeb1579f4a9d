"""The plan of the loop over neighbours: the pair laws, their sights, and where their sums lie."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.neighbour_lists import Listing, listing_of
from flockenv.engine.parameters import Images, images_in
from flockenv.engine.shape_rows import Surroundings
from flockenv.jit.decorators import Law

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import KernelPlan

__all__ = ["PairLaw", "Pairs", "View", "pairs_of"]


class View(NamedTuple):
    """The sight that some pair laws share."""

    fov: int  # the first sight with the same field of view; -1: in all directions
    grouped: bool  # True if only one group is seen
    occluded: bool  # True if agents that an obstacle hides are not seen
    near: tuple[int, int]  # where the squares of the nearest lie, and their number; (0, 0): not topological
    counted: int  # where agents in sight are counted; -1: nowhere


class PairLaw(NamedTuple):
    """An effect with a pair law."""

    k: int  # its index among all effects
    start: Any  # its laws; None if it has none
    pair: Any
    apart: Any
    finish: Any
    joined: Any  # its law of obstacles, if its fold takes these before neighbours
    first: int  # where its running numbers lie
    sums: int
    sight: int
    contact: bool
    vanishes: bool
    averages: bool
    images: Images | None
    target: int  # index of the target that it adds to


class Pairs(NamedTuple):
    """All constants of the loop over neighbours."""

    listing: Listing
    views: tuple[View, ...]
    laws: tuple[PairLaw, ...]
    targets: tuple[int, ...]  # where the sum of each target lies
    inner: tuple[str, ...]
    oriented: bool
    parting: bool  # True if agents in the same position are handled in a pass of their own
    seldom: bool  # True if ties are not listed, because they are rarely read
    ahead: bool  # True if the next candidate's distance is computed early
    masks: bool  # True if comparisons yield mask registers, so that repeating one costs nothing
    offset_to: Law
    hidden: Surroundings | None  # the obstacles that may hide agents, see visibility.py

    @property
    def lanes(self) -> int:
        """How many agents a block has."""
        return self.listing.width

    def slots(self, first: int, count: int) -> tuple[int, ...]:
        """Return where consecutive running numbers lie."""
        return tuple(first + k * self.lanes for k in range(count))


def pairs_of(parts: KernelPlan) -> Pairs:
    """Return the plan of the loop over the neighbours of a scene."""
    listing = listing_of(parts, parts.sorted_fields, parts.confines, parts.arranges)
    fovs = [sight.fov for sight in parts.sights]
    views = tuple(
        View(
            fovs.index(sight.fov) if sight.fov < 360 else -1,
            sight.group is not None,
            sight.occluded,
            (int(listing.slot(f"near{q}_0")), sight.nearest) if sight.nearest else (0, 0),
            int(listing.slot(f"many{q}_0")) if q in parts.counted_sights else -1,
        )
        for q, sight in enumerate(parts.sights)
    )
    laws = tuple(
        PairLaw(
            k, e.pair_start, e.pair_law, e.apart_law, e.finish_law, e.obstacle_law if e.is_joint_fold else None,
            int(listing.slot(f"c{k}_0")), e.sums(parts.dimension), parts.sights.index(parts.sight_of(e)), e.contact,
            e.vanishes and parts.trusts, e.averages,
            images_in(parts, e), parts.targets.index(parts.pair_target(k)),
        )
        for k, e in parts.pairs
    )  # fmt: skip
    targets = tuple(int(listing.slot(f"g{name}0")) for name in parts.targets)
    return Pairs(
        listing, views, laws, targets, parts.inner, parts.oriented, parts.parting,
        parts.fields != parts.sorted_fields, parts.looks_ahead, parts.masks, parts.space.offset_law,
        parts.surroundings if any(view.occluded for view in views) else None,
    )  # fmt: skip
