"""The side on which an agent passes the obstacle ahead, that of the nearest silhouette edge: `passing_side_of`.

Source: Reynolds 1988.

An obstacle is passed as grown by the body's radius. If another obstacle leaves no room beside an edge, the two count as
one, and the edge of the other is searched for on the same side: so joined walls, and gaps that are too narrow, have no
edge in between.

All functions take the `world`: the circles of the state (obstacle_x, obstacle_radius), params, the size of the space,
the index of the world, and the time (s). A touched obstacle is given by its form, and the row in `params` where it
begins: for a circle of the state the form is -1 and the row its index; if nothing is touched the form is -2.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.blocks import vector_of
from flockenv.engine.shape_rows import (
    FormPlan,
    Surroundings,
    box_of_path,
    by_form,
    each_circle,
    each_row,
    number_of,
    offset_from_shape,
)
from flockenv.geometry.shapes.edges import near_path, sphere_edge
from flockenv.geometry.shapes.ray_contact import touched_spot
from flockenv.geometry.shapes.round import touched_normal
from flockenv.geometry.shapes.table import law_of
from flockenv.jit.decorators import Law, Vec, kernel, law, like, routine
from flockenv.jit.section import section
from flockenv.maths.vectors import add, cross, dot, lateral, norm, perpendicular, scale, select, sub, unit, zero
from flockenv.steering.around import threat

__all__ = ["passing_side_of"]

FOLLOWED = 8
"""Obstacles in a row, edge to edge, that count as one; with more there is no edge on that side."""

ALL_AROUND = 6.0
"""rad: an obstacle that needs a larger turn to pass has no edge on that side."""

JUST = 1 - 1e-3
"""Share of its clearance that a body keeps in the test whether it passes an edge: so it does not touch that edge."""

NEARER = 1 - 1e-5
"""Share of the best distance within which another edge must lie to be preferred: so rounding selects no side."""

SPINES = ("chain", "block")
"""Forms that have an axis of their own: `spine_FORM` of shapes/edges.py."""


def _laws(verb: str, forms: tuple[FormPlan, ...]) -> tuple[tuple[str, Law], ...]:
    """Return the laws `edge_FORM` or `spine_FORM` of some forms, see shapes/edges.py."""
    module = importlib.import_module(near_path.__module__)
    return tuple((form.name, getattr(module, f"{verb}_{form.name}")) for form in forms)


@law
def _no_edge(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return an infinite angle and distance: there is no edge, because there is no shape."""
    return like(room, np.inf), like(room, np.inf)


@law
def _no_surface(table: Any, at: int, x: Vec) -> tuple[float, Vec]:
    """Return an infinite distance and no normal: there is no shape."""
    return like(x[0], np.inf), zero(x)


@law
def _no_spine(table: Any, at: int, x: Vec, ray: Vec) -> Vec:
    """Return 0: the shape has no axis of its own."""
    return zero(x)


# --- what a body touches ----------------------------------------------------------------------------------------------


@functools.cache
def first_hit(around: Surroundings) -> Callable[..., tuple[float, int, int]]:
    """Make `first_hit(world, x, ray, room, most)`: how far a body of radius `room` moves along a ray, m; form and row.

    At most `most`. If several are touched at once, it returns the first as they are listed.
    """
    each, has_shapes = each_circle(around, _first_circle(around), _box_of_path, _never), bool(around.forms)
    first_row: Any = _first_row(around) if has_shapes else None

    def first_hit(world: Any, x: Any, ray: Any, room: Any, most: Any) -> Any:
        obstacle_x, obstacle_radius, params, size, b, time = world
        found = each(params, size, ((obstacle_x, obstacle_radius, b), x, ray, room), (most, -2, -1))
        if has_shapes:
            return first_row(params, size, (time, x, ray, room), found)
        return found

    return routine(first_hit)


@section
def _first_circle(around: Surroundings) -> Callable[..., tuple[float, int, int]]:
    """Make the function for each circle: keep (distance, form, index) of what is touched first."""
    offset_to, circle = around.offset_to, vector_of(around.dimension)

    def touches(params: Any, size: Any, m: Any, given: Any, state: Any) -> Any:
        (obstacle_x, obstacle_radius, b), x, ray, room = given
        best, form, row = state
        to = offset_to(size, x, circle(obstacle_x, b, m))
        here = threat(ray, to, room + obstacle_radius[b, m], like(room, np.inf))
        if here < best or (here == best and form == -1 and m < row):
            best, form, row = here, -1, m
        return best, form, row

    return touches


@section
def _first_row(around: Surroundings) -> Callable[..., tuple[float, int, int]]:
    """Make `first(params, size, given, state)`: return `state` after all shapes; given: (time, x, ray, room)."""
    first, form = len(around.forms) == 1, around.forms[-1]
    before: Any = None if first else _first_row(around._replace(forms=around.forms[:-1]))
    each = each_row(around, form, _first_touched(around, form), _box_of_path, _never)

    def first_row(params: Any, size: Any, given: Any, state: Any) -> Any:
        if first:
            return each(params, size, given, state)
        return each(params, size, given, before(params, size, given, state))

    return first_row


@section
def _first_touched(around: Surroundings, form: FormPlan) -> Callable[..., tuple[float, int, int]]:
    """Make the function for each row: keep (distance, form, row) of what is touched first."""
    offset_of, hit, number = (
        offset_from_shape(around.offset_to, around.moving),
        law_of("hit", form.name),
        number_of(form.name),
    )

    def touches(params: Any, size: Any, at: Any, given: Any, state: Any) -> Any:
        time, x, ray, room = given
        best, touched, row = state
        y = offset_of(params, size, at, time, x)
        if near_path(params, at, y, ray, room, best):
            here = hit(params, at, y, ray, room)
            if here < best or (here == best and touched == number and at < row):
                best, touched, row = here, number, at
        return best, touched, row

    return touches


@kernel
def _box_of_path(given: Any, state: Any) -> Any:
    """Return the box around the free path of a body: the middle, and half the edges."""
    _, x, ray, room = given
    return box_of_path(x, scale(ray, state[0] * like(state[0], 0.5)), room)


@kernel
def _never(state: Any) -> Any:
    """Return False: another row may be nearer."""
    return False


@section
def _row_ahead(forms: tuple[FormPlan, ...]) -> Callable[..., int]:
    """Make `row(params, form, place)`: where the row of an obstacle begins, or the index of a circle of the state.

    place: index of it among its form; of a form with a grid, how far its row lies behind the first.
    """
    some = bool(forms)
    number, first, gridded = (number_of(forms[0].name), *forms[0][1:]) if forms else (0, 0, False)
    rest: Any = _row_ahead(forms[1:]) if forms else None

    def row_ahead(params: Any, form: Any, place: Any) -> Any:
        if some:
            if form != number:
                return rest(params, form, place)
            row = np.int64(params[first])
            if gridded:
                return row + place
            for _ in range(place):
                row += np.int64(params[row])
            return row
        return place

    return row_ahead


# --- its edges --------------------------------------------------------------------------------------------------------


@functools.cache
def edge(around: Surroundings) -> Callable[..., tuple[float, float]]:
    """Make `edge(world, form, row, x, ray, side, room)`: the angle by which a ray must turn to pass, and the distance.

    Towards `side`; rad, and m along the turned ray until the body is beside the obstacle.
    """
    offset_to, circle, has_shapes = around.offset_to, vector_of(around.dimension), bool(around.forms)
    offset_of, edge_of = (
        offset_from_shape(around.offset_to, around.moving),
        by_form(_laws("edge", around.forms), _no_edge),
    )

    def edge(world: Any, form: Any, row: Any, x: Any, ray: Any, side: Any, room: Any) -> Any:
        obstacle_x, obstacle_radius, params, size, b, time = world
        if form == -1:
            to = offset_to(size, x, circle(obstacle_x, b, row))
            return sphere_edge(to, ray, side, room + obstacle_radius[b, row])
        if has_shapes:
            return edge_of(params, form, row, (offset_of(params, size, row, time, x), ray, side, room))
        return like(room, np.inf), like(room, np.inf)

    return routine(edge)


@functools.cache
def normal_hit(around: Surroundings) -> Callable[..., Vec]:
    """Make `normal_hit(world, form, row, x, ray, hit, room)`: the outward unit normal where a body touches an obstacle.

    hit: distance along the ray, m.
    """
    offset_to, circle, has_shapes = around.offset_to, vector_of(around.dimension), bool(around.forms)
    laws = tuple((form.name, law_of("nearest", form.name)) for form in around.forms)
    offset_of, nearest = offset_from_shape(around.offset_to, around.moving), by_form(laws, _no_surface)

    def normal_hit(world: Any, form: Any, row: Any, x: Any, ray: Any, hit: Any, room: Any) -> Any:
        obstacle_x, _, params, size, b, time = world
        if form == -1:
            return touched_normal(offset_to(size, x, circle(obstacle_x, b, row)), ray, hit)
        if has_shapes:
            return nearest(params, form, row, (touched_spot(offset_of(params, size, row, time, x), ray, hit, room),))[1]
        return zero(x)

    return routine(normal_hit)


@functools.cache
def edge_beyond(around: Surroundings) -> Callable[..., tuple[float, Vec]]:
    """Make `edge_beyond(world, form, row, hit, x, ray, side, room, most)`: the distance at which a body passes a side.

    From the impact to the nearest such place, m; inf if beyond `most`. In 3-D also the normal of the first other
    obstacle that blocks that side; else 0.
    """
    touched, edge_at, space = first_hit(around), edge(around), around.dimension == 3
    normal_at: Any = normal_hit(around) if space else None

    def edge_beyond(
        world: Any, form: Any, row: Any, hit: Any, x: Any, ray: Any, side: Any, room: Any, most: Any
    ) -> Any:
        far, off, first = like(room, np.inf), zero(x), True
        spot, direction, across, turned_by = scale(ray, hit), ray, side, like(room, 0.0)
        for _ in range(FOLLOWED):
            turn, reach = edge_at(world, form, row, x, direction, across, room)
            turned_by += turn
            if not (turned_by < like(room, ALL_AROUND)) or reach == far:
                return far, off
            c, s = np.cos(turn), np.sin(turn)
            direction, across = add(scale(direction, c), scale(across, s)), sub(scale(across, c), scale(direction, s))
            beyond = norm(sub(scale(direction, reach), spot))
            if not (beyond < most):
                return far, off
            hit, form, row = touched(world, x, direction, room * like(room, JUST), reach + room)
            if form == -2:
                return beyond, off
            if space and first:
                off, first = normal_at(world, form, row, x, direction, hit, room), False
        return far, off

    return routine(edge_beyond)


# --- the nearest edge -------------------------------------------------------------------------------------------------


@functools.cache
def passing_side_of(around: Surroundings) -> Callable[..., Vec]:
    """Make `passing_side_of(world, x, ray, room, known)`: the unit vector across a ray to the side of the nearest edge.

    Nearest to the impact; 0 if the obstacle ahead has no edge that the body can pass. known: its distance, m, form, and
    place in that. In the plane both sides are compared; in 3-D the side of the normal and those along and across an
    axis.
    """
    row_of, normal_at, beyond = _row_ahead(around.forms), normal_hit(around), edge_beyond(around)
    sides_of = _sides_in_space(around) if around.dimension == 3 else _both_sides

    def passing_side(world: Any, x: Any, ray: Any, room: Any, known: Any) -> Any:
        hit, form, place = known
        row, right = row_of(world[2], form, place), perpendicular(ray)
        out = lateral(normal_at(world, form, row, x, ray, hit, room), ray)
        own = select(dot(out, out) > like(room, 1e-10), unit(out), right)
        best, off = beyond(world, form, row, hit, x, ray, own, room, like(room, np.inf))
        found = own if best < like(room, np.inf) else zero(x)
        for side in sides_of(world, form, row, x, ray, own, off):
            far = beyond(world, form, row, hit, x, ray, side, room, best * like(room, NEARER))[0]
            best, found = (far, side) if far < best else (best, found)
        return found

    return routine(passing_side)


@kernel
def _both_sides(world: Any, form: Any, row: Any, x: Any, ray: Any, own: Any, off: Any) -> Any:
    """Return the side opposite to that of the normal, `own`: in the plane it is the only other."""
    return (scale(own, like(x[0], -1.0)),)


@section
def _sides_in_space(around: Surroundings) -> Callable[..., tuple[Vec, ...]]:
    """Make `sides(world, form, row, x, ray, own, off)`: both sides along and across an axis.

    The axis is the obstacle's own; otherwise it points away from what blocked the side of the normal. So no axis of the
    coordinates is preferred, and agents of the mirrored scene take the mirrored path.
    """
    laws = _laws("spine", tuple(form for form in around.forms if form.name in SPINES))
    some, offset_of, spine_of = bool(laws), offset_from_shape(around.offset_to, around.moving), by_form(laws, _no_spine)

    def sides(world: Any, form: Any, row: Any, x: Any, ray: Any, own: Any, off: Any) -> Any:
        _, _, params, size, _, time = world
        ax, e = zero(x), like(x[0], 1.0)
        if some and form >= 0:
            ax = lateral(spine_of(params, form, row, (offset_of(params, size, row, time, x), ray)), ray)
        if dot(ax, ax) <= like(e, 1e-10):
            ax = lateral(lateral(off, ray), own)
        if dot(ax, ax) <= like(e, 1e-10):
            ax = cross(ray, own)
        ax = unit(ax)
        across = cross(ray, ax)
        return ax, scale(ax, -e), across, scale(across, -e)

    return sides
