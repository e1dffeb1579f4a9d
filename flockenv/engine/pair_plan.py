"""What the sweep over neighbours depends on: which pair laws there are, how they look around, where their sums lie."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.neighbour_lists import Listing, listing_of
from flockenv.engine.parameters import Images, images_in
from flockenv.engine.shape_rows import Surroundings
from flockenv.jit.decorators import Law

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import Parts

__all__ = ["PairLaw", "Pairs", "View", "pairs_of"]


class View(NamedTuple):
    """How some pair laws look around."""

    fov: int  # the first sight with the same field of view; -1: all around
    grouped: bool  # is one group alone seen?
    occluded: bool  # are agents that an obstacle hides not seen?
    near: tuple[int, int]  # where the squares of the nearest lie, and how many of them there are; (0, 0): all count
    counted: int  # where the agents in sight are counted; -1: nowhere


class PairLaw(NamedTuple):
    """An effect with a pair law."""

    k: int  # its number among all effects
    start: Any  # its laws, or None where it has none
    pair: Any
    apart: Any
    finish: Any
    joined: Any  # its law of obstacles, of a fold that meets these before neighbours
    first: int  # where its running numbers lie
    sums: int
    sight: int
    contact: bool
    vanishes: bool
    averages: bool
    images: Images | None
    target: int  # what it adds to


class Pairs(NamedTuple):
    """All that the sweep over neighbours depends on."""

    listing: Listing
    views: tuple[View, ...]
    laws: tuple[PairLaw, ...]
    targets: tuple[int, ...]  # where what each target comes to lies
    inner: tuple[str, ...]
    oriented: bool
    parting: bool  # are those in one place met by themselves?
    seldom: bool  # are ties not listed, because they are seldom looked at?
    ahead: bool  # is it worked out how far the next candidate is while one is met?
    masks: bool  # is what was compared kept in masks, so that it costs nothing to compare once more?
    offset_to: Law
    hidden: Surroundings | None  # by which obstacles agents may be hidden, see visibility.py

    @property
    def lanes(self) -> int:
        """How many agents a block has."""
        return self.listing.width

    def slots(self, first: int, count: int) -> tuple[int, ...]:
        """Return where running numbers lie that follow each other."""
        return tuple(first + k * self.lanes for k in range(count))


def pairs_of(parts: Parts) -> Pairs:
    """Return what the sweep of a scene depends on."""
    listing = listing_of(parts, parts.sorted_fields, parts.confines, parts.arranges)
    fovs = [sight.fov for sight in parts.sights]
    views = tuple(
        View(
            fovs.index(sight.fov) if sight.fov < 360 else -1,
            sight.group is not None,
            sight.occluded,
            (int(listing.slot(f"near{q}_0")), sight.nearest) if sight.nearest else (0, 0),
            int(listing.slot(f"many{q}_0")) if q in parts.averaged else -1,
        )
        for q, sight in enumerate(parts.sights)
    )
    laws = tuple(
        PairLaw(
            k, e.pair_start, e.pair_law, e.apart_law, e.finish_law, e.obstacle_law if e.joined else None,
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
