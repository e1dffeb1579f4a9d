"""Update of a fold by one obstacle: how its law sees the obstacle, and what is kept.

A law is passed circles as they are, and of any other shape one point (`physics.effects.effect.Obstacle`): the nearest
of its surface, or, if the law casts a ray, the first point that the ray touches.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.lane_access import choose, gather, scatter
from flockenv.engine.obstacle_plan import Fold
from flockenv.engine.shape_rows import Surroundings, number_of
from flockenv.engine.visibility import is_blocked_of
from flockenv.geometry.shapes.ray_contact import touched_offset, touched_spot
from flockenv.geometry.shapes.round import normal, touched_normal
from flockenv.geometry.shapes.table import law_of
from flockenv.jit.decorators import kernel, like
from flockenv.jit.section import call_in_turn, section
from flockenv.maths.vectors import add, dot, norm, scale, sub, zero
from flockenv.physics.effects.effect import Obstacle
from flockenv.steering.around import threat

__all__ = ["update_by_circle", "update_by_shape"]

CIRCLE = -1
"""The form that is noted for a circle of the state."""

PIECED = ("chain", "hollow_chain", "hollow_block")
"""Forms whose sides a law may handle one by one."""

SIDE_BY_SIDE = ("block", "half_space")
"""Forms whose laws have no branches: lanes are vectorised there, and a selection costs less than a branch."""

SHORT = 1 - 1e-6
"""Share of the distance to a surface that must be free for it to be visible: the surface itself is left out."""


# --- what is kept -----------------------------------------------------------------------------------------------------


@functools.cache
def _in_sight(around: Surroundings | None) -> Callable[..., bool]:
    """Make `in_sight(world, me, gap, out)`: return True if the line to a nearest point is free."""
    if around is None:
        return kernel(lambda world, me, gap, out: True)
    hidden = is_blocked_of(around)

    def in_sight(world: Any, me: Any, gap: Any, out: Any) -> Any:
        obstacle_x, obstacle_radius, params, size, b = world
        line = scale(out, -gap * like(gap, SHORT))
        return (gap <= like(gap, 0.0)) or not hidden(
            obstacle_x, obstacle_radius, params, size, b, me.time, me.pos, line
        )

    return kernel(in_sight)


@section
def _update_fold(fold: Fold) -> Callable[..., None]:
    """Make `keep(p, world, me, it, form, place, lanes, lane)`: update a fold by an obstacle, as its law sees it.

    For a fold with `ahead`, if its first number changes, it also notes the form and place of the obstacle.
    """
    law, slots, ahead, notes = fold.law, fold.slots, fold.ahead, bool(fold.ahead)
    occluded, in_sight = fold.hidden is not None, _in_sight(fold.hidden)

    def keep(p: Any, world: Any, me: Any, it: Any, form: Any, place: Any, lanes: Any, lane: Any) -> None:
        was = gather(lanes, lane, slots)
        found = law(p, me, it, was)
        if notes:
            what = like(found[0], form), like(found[0], place)
            scatter(lanes, lane, ahead, choose(found[0] != was[0], what, gather(lanes, lane, ahead)))
        if occluded:
            scatter(lanes, lane, slots, choose(in_sight(world, me, it.gap, it.normal), found, was))
        else:
            scatter(lanes, lane, slots, found)

    return keep


# --- a circle of the state --------------------------------------------------------------------------------------------


def update_by_circle(folds: tuple[Fold, ...]) -> Callable[..., None]:
    """Return `update(numbers, world, me, to, rho, m, lanes, lane)`: update all folds by circle m of the state.

    to: the offset to its centre; rho: its radius, m.
    """
    return call_in_turn(*(_circle(fold, j) for fold in folds for j in range(fold.rays)))


@section
def _circle(fold: Fold, j: int) -> Callable[..., None]:
    """Make `update` by a circle for one fold, and for ray j if it casts rays."""
    k, ray_of, origin, keep = fold.k, fold.ray, fold.origin, _update_fold(fold)
    cast, elsewhere = fold.ray is not None, fold.origin is not None

    def update(numbers: Any, world: Any, me: Any, to: Any, rho: Any, m: Any, lanes: Any, lane: Any) -> None:
        p, o, far = numbers.effects[k], zero(me.pos), like(rho, np.inf)
        if cast:
            ray, margin = ray_of(p, me, j)
            hit = threat(ray, to, me.radius + rho + margin, far)
            out = touched_normal(to, ray, hit)
            it = Obstacle(like(rho, m), to, dot(to, to), o, rho, o, norm(to) - rho, out, hit, ray)
        else:
            offset = sub(to, origin(p, me)) if elsewhere else to
            it = Obstacle(
                like(rho, m), offset, dot(offset, offset), o, rho, o, norm(offset) - rho, normal(offset), far, o
            )
        keep(p, world, me, it, CIRCLE, m, lanes, lane)

    return update


# --- any other shape --------------------------------------------------------------------------------------------------


def update_by_shape(folds: tuple[Fold, ...], form: str) -> Callable[..., None]:
    """Return `update(numbers, world, params, me, shape, lanes, lane)`: update all folds by a shape of a form."""
    pieced = {fold for fold in folds if fold.pieces and form in PIECED}
    return call_in_turn(
        *(
            _pieces(fold, form)
            if fold in pieced
            else _ray_contact(fold, form, j)
            if fold.ray
            else _nearest_point(fold, form)
            for fold in folds
            for j in range(fold.rays)
        )
    )


@section
def _nearest_point(fold: Fold, form: str) -> Callable[..., None]:
    """Make `update` for one fold that casts no rays."""
    k, origin, keep, number = fold.k, fold.origin, _update_fold(fold), number_of(form)
    elsewhere, nearest = fold.origin is not None, law_of("nearest", form)

    def update(numbers: Any, world: Any, params: Any, me: Any, shape: Any, lanes: Any, lane: Any) -> None:
        p, o = numbers.effects[k], zero(me.pos)
        if elsewhere:
            gap, out = nearest(params, shape.at, add(shape.y, origin(p, me)))
        else:
            gap, out = shape.gap, shape.out
        to = touched_offset(o, like(gap, 0.0), out, gap, gap)
        who, none, far = params[shape.at + 1], like(gap, 0.0), like(gap, np.inf)
        it = Obstacle(who, to, dot(to, to), shape.vel, none, o, gap, out, far, o)
        keep(p, world, me, it, number, shape.place, lanes, lane)

    return update


@section
def _ray_contact(fold: Fold, form: str, j: int) -> Callable[..., None]:
    """Make `update` for ray j of one fold that casts rays.

    If the ray touches nothing, the normal is that of the nearest point, which is known.
    """
    k, ray_of, keep, number = fold.k, fold.ray, _update_fold(fold), number_of(form)
    nearest, hit_of, chooses = law_of("nearest", form), law_of("hit", form), form in SIDE_BY_SIDE

    def update(numbers: Any, world: Any, params: Any, me: Any, shape: Any, lanes: Any, lane: Any) -> None:
        p, at, y, gap = numbers.effects[k], shape.at, shape.y, shape.gap
        ray, margin = ray_of(p, me, j)
        room, none = me.radius + margin, like(gap, 0.0)
        hit = none if gap < room else hit_of(params, at, y, ray, room)
        if chooses:
            out = nearest(params, at, touched_spot(y, ray, hit, room))[1]
        else:
            touches = (hit > none) & (hit < like(gap, np.inf))
            out = nearest(params, at, touched_spot(y, ray, hit, room))[1] if touches else shape.out
        to = touched_offset(ray, hit, out, room, gap)
        it = Obstacle(params[at + 1], to, dot(to, to), shape.vel, none, zero(me.pos), gap, out, hit, ray)
        keep(p, world, me, it, number, shape.place, lanes, lane)

    return update


@section
def _pieces(fold: Fold, form: str) -> Callable[..., None]:
    """Make `update` for one fold that handles the sides of a shape one by one: the nearest point of each that acts.

    If the nearest point of the shape is out of reach, so are all its sides.
    """
    k, reach, keep, number = fold.k, fold.reach, _update_fold(fold._replace(hidden=None, ahead=())), number_of(form)
    pieces_of, piece_of, reaches = law_of("pieces", form), law_of("piece", form), fold.reach is not None
    in_sight = _in_sight(fold.hidden)

    def update(numbers: Any, world: Any, params: Any, me: Any, shape: Any, lanes: Any, lane: Any) -> None:
        p, at, y, gap, o = numbers.effects[k], shape.at, shape.y, shape.gap, zero(me.pos)
        near = gap < reach(p, me) if reaches else True
        if near:
            for piece in range(pieces_of(params, at, y, gap)):
                far, side, acts = piece_of(params, at, piece, y, gap, shape.out)
                if acts and in_sight(world, me, far, side):
                    none = like(far, 0.0)
                    to = touched_offset(o, none, side, far, far)
                    it = Obstacle(
                        params[at + 1], to, dot(to, to), shape.vel, none, o, far, side, like(far, np.inf), o
                    )  # fmt: skip
                    keep(p, world, me, it, number, shape.place, lanes, lane)

    return update
