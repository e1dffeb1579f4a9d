"""Folds over the obstacles, all in one pass: circles of the state, then all other shapes.

The circles may differ from world to world; the other shapes are those that are not round, that move, or that are
hollow. They are placed where they are at the time of the stage.

If there are many shapes of a form, each agent looks up those that may lie within reach in a grid (shapes/cells.py), in
the order in which they are listed. Circles have a grid too, if those of the state are where the scene has them. Both
keep the order of a loop over all shapes, and a law ignores shapes out of reach: so results are the same bits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.agent_records import AgentPlan, agent_of
from flockenv.engine.blocks import vector_of, vector_of_lane
from flockenv.engine.lane_access import scatter
from flockenv.engine.obstacle_folds import update_by_circle, update_by_shape
from flockenv.engine.obstacle_plan import Fold, Obstacles, Place, Shape
from flockenv.engine.shape_rows import near_rows
from flockenv.engine.silhouette import passing_side_of
from flockenv.geometry.shapes.cells import CIRCLES
from flockenv.geometry.shapes.edges import near_path
from flockenv.geometry.shapes.row_header import outside_box, shift_of, velocity_of
from flockenv.geometry.shapes.table import law_of
from flockenv.jit.decorators import Vec, kernel, law, like
from flockenv.jit.section import call_in_turn, section, vector
from flockenv.maths.vectors import add, dot, equal_coordinates, scale, sub, zero

__all__ = ["obstacles_of"]

LOOSE = 1 + 1e-6
"""Factor of a reach, so that single precision loses nothing that a law would have used."""


@section
def obstacles_of(plan: Obstacles) -> Callable[..., None]:
    """Make `fold_obstacles(context, pos, vel, time, block)`: compute the folds of a block over the obstacles.

    Results are written into `scratch.lanes`, at the places that the plan names. time: s.
    """
    d, width, arranges = plan.agent.dimension, plan.agent.width, plan.arranges
    size, wide = np.uint64(d * width), np.uint64(width)
    forms = (
        _every_shape(plan, j) if form.name not in plan.gridded_forms else _gridded_shapes(plan, j)
        for j, form in enumerate(plan.around.forms)
    )
    edges = (_passing_sides(plan, fold) for fold in plan.folds if fold.ahead)
    circles = _circles_of(plan) if CIRCLES in plan.gridded_forms else _every_circle(plan)
    passes = call_in_turn(_starts(plan), circles, *forms, *edges)

    def fold_obstacles(context: Any, pos: Any, vel: Any, time: Any, block: Any) -> None:
        base, row = block * size, block * wide
        one = row & context.scratch.spread[0] if arranges else row
        passes(context, pos, vel, time, Place(base, row, one))

    return fold_obstacles


@section
def _agent_of(plan: AgentPlan) -> Callable[..., Any]:
    """Make `agent(scratch, random_key, pos, vel, time, place, lane)`: an agent of a block, as laws see it."""
    vector_at, agent_at = vector_of_lane(plan.dimension, plan.width), agent_of(plan)

    def agent(scratch: Any, random_key: Any, pos: Any, vel: Any, time: Any, place: Any, lane: Any) -> Any:
        at = place.base + lane
        x, v = vector_at(pos, at), vector_at(vel, at)
        return agent_at(scratch, random_key, time, at, place.row + lane, place.one + lane, x, v, zero(x))

    return agent


@functools.cache
def _world_of(plan: Obstacles) -> Callable[..., Any]:
    """Make `world(context)`: return the data that occlusion by obstacles needs; an empty tuple if no fold does."""
    if all(fold.hidden is None for fold in plan.folds):
        return kernel(lambda context: ())

    def world(context: Any) -> Any:
        return (
            context.obstacle_x, context.obstacle_radius, context.params, context.numbers.size, context.b
        )  # fmt: skip

    return kernel(world)


# --- how folds begin --------------------------------------------------------------------------------------------------


@section
def _starts(plan: Obstacles) -> Callable[..., None]:
    """Make `starts(context, pos, vel, time, place)`: begin all folds of a block, and note how far they reach."""
    width, agent, begin = plan.agent.width, _agent_of(plan.agent), call_in_turn(*(_start(plan, f) for f in plan.folds))
    reach, limited = np.uint64(max(plan.reach, 0)), plan.reach >= 0
    furthest: Any = _furthest(plan.folds) if limited else None

    def starts(context: Any, pos: Any, vel: Any, time: Any, place: Any) -> None:
        scratch, numbers, random_key = context.scratch, context.numbers, context.key[context.b]
        lanes = scratch.lanes
        for lane in range(np.uint64(width)):
            me = agent(scratch, random_key, pos, vel, time, place, lane)
            begin(scratch, numbers, me, place.row, lanes, lane)
            if limited:
                lanes[reach + lane] = furthest(numbers, me)

    return starts


@section
def _start(plan: Obstacles, fold: Fold) -> Callable[..., None]:
    """Make `start(scratch, numbers, me, row, lanes, lane)`: write the initial numbers of one fold."""
    k, start, slots, adds_pair_force = fold.k, fold.start, fold.slots, fold.pair_force_at >= 0
    each, place = np.uint64(plan.pair_force_size // plan.agent.width), np.uint64(max(fold.pair_force_at, 0))
    vector_at = vector_of_lane(plan.agent.dimension, plan.agent.width)

    def begin(scratch: Any, numbers: Any, me: Any, row: Any, lanes: Any, lane: Any) -> None:
        if adds_pair_force:
            others = vector_at(scratch.pair_force, row * each + place + lane)
            scatter(lanes, lane, slots, start(numbers.effects[k], me, others))
        else:
            scatter(lanes, lane, slots, start(numbers.effects[k], me))

    return begin


@functools.cache
def _furthest(folds: tuple[Fold, ...]) -> Callable[..., float]:
    """Make `furthest(numbers, me)`: return the largest reach of all folds, m."""
    before, k, reach = _furthest(folds[:-1]) if folds[1:] else None, folds[-1].k, folds[-1].reach

    def furthest(numbers: Any, me: Any) -> Any:
        mine = reach(numbers.effects[k], me)
        return mine if before is None else max(before(numbers, me), mine)

    return kernel(furthest)


# --- loops over obstacles ---------------------------------------------------------------------------------------------


@section
def _circles_of(plan: Obstacles) -> Callable[..., None]:
    """Make `circles(context, pos, vel, time, place)`: as `_every_circle`, by the grid if it holds for this state."""
    every, listed = _every_circle(plan), _gridded_circles(plan)

    def circles(context: Any, pos: Any, vel: Any, time: Any, place: Any) -> None:
        if context.numbers.circles.cells > 0:
            listed(context, pos, vel, time, place)
        else:
            every(context, pos, vel, time, place)

    return circles


@section
def _every_circle(plan: Obstacles) -> Callable[..., None]:
    """Make `circles(context, pos, vel, time, place)`: update all folds of a block by every circle of the state."""
    width, agent, circle = plan.agent.width, _agent_of(plan.agent), vector_of(plan.agent.dimension)
    offset_to, update, world_of = plan.around.offset_to, update_by_circle(plan.folds), _world_of(plan)

    def circles(context: Any, pos: Any, vel: Any, time: Any, place: Any) -> None:
        scratch, numbers, b, world = context.scratch, context.numbers, context.b, world_of(context)
        radius, lanes, random_key = context.obstacle_radius, scratch.lanes, context.key[b]
        if place.row == 0:
            context.work[b, 3] += context.n * radius.shape[1]
        for m in range(radius.shape[1]):
            rho = radius[b, m]
            if rho > 0:
                centre = circle(context.obstacle_x, b, m)
                for lane in range(np.uint64(width)):
                    me = agent(scratch, random_key, pos, vel, time, place, lane)
                    update(numbers, world, me, offset_to(numbers.size, me.pos, centre), rho, m, lanes, lane)

    return circles


@section
def _gridded_circles(plan: Obstacles) -> Callable[..., None]:
    """Make `circles(context, pos, vel, time, place)`: update each agent's folds by circles of the state, by a grid.

    Only those that may lie within reach, in order.
    """
    width, agent, circle = plan.agent.width, _agent_of(plan.agent), vector_of(plan.agent.dimension)
    offset_to, update, world_of = plan.around.offset_to, update_by_circle(plan.folds), _world_of(plan)
    near, box = near_rows(offset_to, plan.agent.dimension), _box(plan.folds, plan.only_rays)
    first, reach = plan.found, np.uint64(plan.reach)

    def circles(context: Any, pos: Any, vel: Any, time: Any, place: Any) -> None:
        scratch, numbers, b, world = context.scratch, context.numbers, context.b, world_of(context)
        lanes, random_key, mine = scratch.lanes, context.key[b], numbers.circles
        if place.row == 0:
            context.work[b, 3] += context.n * mine.many
        for lane in range(np.uint64(width)):
            me = agent(scratch, random_key, pos, vel, time, place, lane)
            middle, around = box(numbers, me, lanes[reach + lane] * like(me.pos[0], LOOSE))
            listed = near(context.params, numbers.size, mine.cells, middle, around, lanes, np.int64(first))
            for k in range(listed if listed >= 0 else mine.many):
                m = np.int64(lanes[np.uint64(first) + np.uint64(k)]) if listed >= 0 else k
                to = offset_to(numbers.size, me.pos, circle(context.obstacle_x, b, m))
                update(numbers, world, me, to, context.obstacle_radius[b, m], m, lanes, lane)

    return circles


@section
def _motion_of(dimension: int, moving: bool) -> Callable[..., tuple[Vec, Vec]]:
    """Make `motion_of(params, at, time)`: position (m) and velocity (m/s) of the shape at `at` at a time (s)."""
    vector_at = vector(dimension)

    def motion_of(params: Any, at: Any, time: Any) -> Any:
        place = vector_at(params, at + 2)
        if moving:
            return add(place, shift_of(params, at, time, place)), velocity_of(params, at, time, place)
        return place, zero(place)

    return motion_of


@section
def _row(plan: Obstacles, form: str) -> Callable[..., None]:
    """Make `update(numbers, world, params, me, at, place, where, vel, lanes, lane)`: update an agent's folds.

    The shape is skipped if it is out of reach. where: its anchor, m; vel: m/s.
    """
    offset_to, nearest, update = plan.around.offset_to, law_of("nearest", form), update_by_shape(plan.folds, form)
    bounded, picks, reach = (
        form in plan.bounded_forms,
        form in plan.gridded_forms and plan.only_rays,
        np.uint64(max(plan.reach, 0)),
    )
    near_a_ray: Any = _near_a_ray(plan.folds) if picks else None

    def update_by_row(
        numbers: Any, world: Any, params: Any, me: Any, at: Any, place: Any, where: Any, vel: Any, lanes: Any, lane: Any
    ) -> None:
        y = offset_to(numbers.size, where, me.pos)
        if picks:  # noqa: SIM102  # numba drops the branch by this alone
            if not near_a_ray(numbers, params, at, y, me, lanes[reach + lane] * like(y[0], LOOSE)):
                return
        if bounded:
            beside, seen = outside_box(params, at, y), lanes[reach + lane]
            if not (dot(beside, beside) < seen * seen):
                return
        gap, out = nearest(params, at, y)
        update(numbers, world, params, me, Shape(at, place, y, vel, gap, out), lanes, lane)

    return update_by_row


@section
def _every_shape(plan: Obstacles, j: int) -> Callable[..., None]:
    """Make `shapes(context, pos, vel, time, place)`: update all folds of a block by every shape of form j."""
    width, agent, world_of = plan.agent.width, _agent_of(plan.agent), _world_of(plan)
    motion_of, update = _motion_of(plan.agent.dimension, plan.around.moving), _row(plan, plan.around.forms[j].name)

    def shapes(context: Any, pos: Any, vel: Any, time: Any, place: Any) -> None:
        scratch, numbers, b, world = context.scratch, context.numbers, context.b, world_of(context)
        params, lanes, random_key = context.params, scratch.lanes, context.key[b]
        at, many = numbers.forms[j].at, numbers.forms[j].many
        if place.row == 0:
            context.work[b, 3] += context.n * many
        for m in range(many):
            where, glide = motion_of(params, at, time)
            for lane in range(np.uint64(width)):
                me = agent(scratch, random_key, pos, vel, time, place, lane)
                update(numbers, world, params, me, at, m, where, glide, lanes, lane)
            at += np.int64(params[at])

    return shapes


@section
def _gridded_shapes(plan: Obstacles, j: int) -> Callable[..., None]:
    """Make `shapes(context, pos, vel, time, place)`: update each agent's folds by shapes of form j, found by a grid.

    Only those that may lie within reach, in order.
    """
    width, agent, world_of = plan.agent.width, _agent_of(plan.agent), _world_of(plan)
    motion_of, update = _motion_of(plan.agent.dimension, plan.around.moving), _row(plan, plan.around.forms[j].name)
    near, box = near_rows(plan.around.offset_to, plan.agent.dimension), _box(plan.folds, plan.only_rays)
    first, reach = plan.found, np.uint64(plan.reach)

    def shapes(context: Any, pos: Any, vel: Any, time: Any, place: Any) -> None:
        scratch, numbers, b, world = context.scratch, context.numbers, context.b, world_of(context)
        params, lanes, random_key, mine = context.params, scratch.lanes, context.key[b], numbers.forms[j]
        if place.row == 0:
            context.work[b, 3] += context.n * mine.many
        for lane in range(np.uint64(width)):
            me = agent(scratch, random_key, pos, vel, time, place, lane)
            middle, around = box(numbers, me, lanes[reach + lane] * like(me.pos[0], LOOSE))
            listed = near(params, numbers.size, mine.cells, middle, around, lanes, np.int64(first))
            at = mine.at
            for m in range(listed if listed >= 0 else mine.many):
                at = mine.at + np.int64(lanes[np.uint64(first) + np.uint64(m)]) if listed >= 0 else at
                where, glide = motion_of(params, at, time)
                update(numbers, world, params, me, at, at - mine.at, where, glide, lanes, lane)
                at += np.int64(params[at])

    return shapes


# --- what may lie within reach ----------------------------------------------------------------------------------------


@functools.cache
def _near_a_ray(folds: tuple[Fold, ...]) -> Callable[..., bool]:
    """Make `near(numbers, params, at, y, me, seen)`: return True if a ray comes near a shape.

    That is, if a ray, up to `seen` m long, enters the bounding circle or sphere of the shape.
    """
    before, k, ray_of, rays = _near_a_ray(folds[:-1]) if folds[1:] else None, folds[-1].k, folds[-1].ray, folds[-1].rays

    def near(numbers: Any, params: Any, at: Any, y: Any, me: Any, seen: Any) -> Any:
        found = False if before is None else before(numbers, params, at, y, me, seen)
        for j in range(rays):
            ray, margin = ray_of(numbers.effects[k], me, j)
            found |= near_path(params, at, y, ray, me.radius + margin, seen)
        return found

    return kernel(near)


@law
def _grow(low: Vec, high: Vec, spot: Vec) -> tuple[Vec, Vec]:
    """Return the corners of a box, grown to hold a point."""
    a, b = (min(low[0], spot[0]), min(low[1], spot[1])), (max(high[0], spot[0]), max(high[1], spot[1]))
    if len(low) == 2:
        return a, b
    else:
        return (a[0], a[1], min(low[2], spot[2])), (b[0], b[1], max(high[2], spot[2]))


@section
def _box(folds: tuple[Fold, ...], only_rays: bool) -> Callable[..., tuple[Vec, Vec]]:
    """Make `box(numbers, me, seen)`: return the box that an agent's folds reach, its middle and half its edges, m.

    It holds all rays if all folds cast rays, else all within `seen` m.
    """
    span: Any = _span(folds) if only_rays else None

    def box(numbers: Any, me: Any, seen: Any) -> Any:
        x, half = me.pos, like(seen, 0.5)
        if only_rays:
            low, high, wide = span(numbers, me, seen)
            wide = wide * like(wide, LOOSE)
            room = scale(sub(high, low), half)
            return add(x, scale(add(low, high), half)), add(room, equal_coordinates(x, wide))
        return x, equal_coordinates(x, seen)

    return box


@functools.cache
def _span(folds: tuple[Fold, ...]) -> Callable[..., tuple[Vec, Vec, float]]:
    """Make `span(numbers, me, seen)`: return the corners of the box around all rays, and the widest body.

    The corners are relative to the agent, m; the width is the radius of the body that moves along a ray plus its
    margin, m.
    """
    before, k, ray_of, rays = _span(folds[:-1]) if folds[1:] else None, folds[-1].k, folds[-1].ray, folds[-1].rays

    def span(numbers: Any, me: Any, seen: Any) -> Any:
        o = zero(me.pos)
        low, high, wide = (o, o, like(seen, 0.0)) if before is None else before(numbers, me, seen)
        for j in range(rays):
            ray, margin = ray_of(numbers.effects[k], me, j)
            end, room = scale(ray, seen), me.radius + margin
            (low, high), wide = _grow(low, high, end), max(wide, room)
        return low, high, wide

    return kernel(span)


# --- the side to pass on ----------------------------------------------------------------------------------------------


@section
def _passing_sides(plan: Obstacles, fold: Fold) -> Callable[..., None]:
    """Make `passing_sides(context, pos, vel, time, place)`: write on which side each agent passes the obstacle ahead.

    For a law that reads it, see steering/around.py.
    """
    k, ray_of, slots, ahead, width = fold.k, fold.ray, fold.slots, fold.ahead, plan.agent.width
    agent, passing_side, sides = (
        _agent_of(plan.agent),
        passing_side_of(plan.around),
        fold.slots[-plan.agent.dimension :],
    )
    first, which, place_at = np.uint64(slots[0]), np.uint64(ahead[0]), np.uint64(ahead[1])

    def passing_sides(context: Any, pos: Any, vel: Any, time: Any, place: Any) -> None:
        scratch, numbers, b = context.scratch, context.numbers, context.b
        lanes, random_key = scratch.lanes, context.key[b]
        world = context.obstacle_x, context.obstacle_radius, context.params, numbers.size, b, time
        for lane in range(np.uint64(width)):
            impact = lanes[first + lane]
            if impact > 0 and impact < like(impact, np.inf):
                me = agent(scratch, random_key, pos, vel, time, place, lane)
                ray, margin = ray_of(numbers.effects[k], me, 0)
                known = impact, np.int64(lanes[which + lane]), np.int64(lanes[place_at + lane])
                scatter(lanes, lane, sides, passing_side(world, me.pos, ray, me.radius + margin, known))

    return passing_sides
