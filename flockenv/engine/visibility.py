"""Occlusion by obstacles: `is_blocked_of`, for laws that ignore what an obstacle hides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flockenv.engine.blocks import vector_of
from flockenv.engine.shape_rows import FormPlan, Surroundings, box_of_path, each_circle, each_row, offset_from_shape
from flockenv.geometry.shapes.round import blocks
from flockenv.geometry.shapes.table import law_of
from flockenv.jit.decorators import kernel, like
from flockenv.jit.section import section
from flockenv.maths.vectors import norm, scale, unit

__all__ = ["is_blocked_of"]


@section
def is_blocked_of(around: Surroundings) -> Callable[..., bool]:
    """Make `is_blocked_of(obstacle_x, obstacle_radius, params, size, b, time, x, to)`.

    It returns True if an obstacle intersects the straight line from place x to the offset `to`, m.
    """
    each, has_shapes = each_circle(around, _circle_blocks_line(around), _box_of_line, _is_found), bool(around.forms)
    is_hidden: Any = _is_hidden_by_shape(around) if has_shapes else None

    def is_blocked(
        obstacle_x: Any, obstacle_radius: Any, params: Any, size: Any, b: Any, time: Any, x: Any, to: Any
    ) -> Any:
        found = each(params, size, ((obstacle_x, obstacle_radius, b), x, to), False)
        if has_shapes:
            return is_hidden(params, size, time, x, to, found)
        return found

    return is_blocked


@section
def _circle_blocks_line(around: Surroundings) -> Callable[..., bool]:
    """Make the function for each circle: return True if it or an earlier one intersects the line."""
    offset_to, circle = around.offset_to, vector_of(around.dimension)

    def hides(params: Any, size: Any, m: Any, given: Any, found: Any) -> Any:
        (obstacle_x, obstacle_radius, b), x, to = given
        return found | blocks(offset_to(size, x, circle(obstacle_x, b, m)), obstacle_radius[b, m], to)

    return hides


@section
def _is_hidden_by_shape(around: Surroundings) -> Callable[..., bool]:
    """Make `is_hidden(params, size, time, x, to, found)`: return True if `found`, or if a shape intersects the line."""
    first, form = len(around.forms) == 1, around.forms[-1]
    before: Any = None if first else _is_hidden_by_shape(around._replace(forms=around.forms[:-1]))
    each = each_row(around, form, _blocks_line(around, form), _box_of_line, _is_found)

    def is_hidden(params: Any, size: Any, time: Any, x: Any, to: Any, found: Any) -> Any:
        if first:
            return each(params, size, (time, x, to), found)
        return each(params, size, (time, x, to), before(params, size, time, x, to, found))

    return is_hidden


@section
def _blocks_line(around: Surroundings, form: FormPlan) -> Callable[..., bool]:
    """Make the function for each row: return True if it or an earlier one intersects the line."""
    offset_of, hit = offset_from_shape(around.offset_to, around.moving), law_of("hit", form.name)

    def hides(params: Any, size: Any, at: Any, given: Any, found: Any) -> Any:
        time, x, to = given
        y = offset_of(params, size, at, time, x)
        return found | (hit(params, at, y, unit(to), like(to[0], 0.0)) < norm(to))

    return hides


@kernel
def _box_of_line(given: Any, found: Any) -> Any:
    """Return the box around the line: the middle, and half the edges."""
    _, x, to = given
    return box_of_path(x, scale(to, like(to[0], 0.5)), like(to[0], 0.0))


@kernel
def _is_found(found: Any) -> Any:
    """Return True if the search is done: one shape is enough."""
    return found
