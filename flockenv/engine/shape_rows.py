"""Loops over the rows of shapes of a scene, form by form: over all rows, or those that a grid lists.

A row is one of shapes/table.py; `at` is where it begins in `params`. A loop over rows is made from the function to be
called for each, which returns a state that is passed on to the next call.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flockenv.geometry.shapes.cells import (
    MOST_FOUND,
    count_of,
    entry_length,
    is_near_box,
    keep_in_order,
    list_of,
    row_of_entry,
    span_of,
)
from flockenv.geometry.shapes.row_header import shift_of, vector_at
from flockenv.geometry.shapes.table import FORMS
from flockenv.jit.decorators import Law, Vec, kernel, law
from flockenv.jit.section import section
from flockenv.maths.vectors import add

__all__ = [
    "FormPlan",
    "Surroundings",
    "box_of_path",
    "by_form",
    "each_circle",
    "each_row",
    "near_rows",
    "number_of",
    "offset_from_shape",
]


class FormPlan(NamedTuple):
    """A form of shapes that a scene has."""

    name: str
    place: int
    """Where `params` holds the start of its first row; behind that, the number of rows, and the start of its grid."""
    gridded: bool
    """True if a grid of cells lies over its rows, see shapes/cells.py."""


class Surroundings(NamedTuple):
    """Constants of the code about the obstacles of a scene."""

    dimension: int
    offset_to: Law
    """The law of the space that returns the shortest offset from one place to another."""
    moving: bool
    """True if any shape moves."""
    circles: FormPlan | None
    """The circles of the state, if they have a grid."""
    forms: tuple[FormPlan, ...]


def number_of(form: str) -> int:
    """Return the number of a form, as rows hold it."""
    return list(FORMS).index(form)


@section
def by_form(laws: tuple[tuple[str, Law], ...], otherwise: Law) -> Callable[..., Any]:
    """Make `of(params, form, row, given)`: return law(params, row, *given) with the law of the shape's form.

    laws: (form, its law); otherwise: that of a shape of any other form.
    """
    some = bool(laws)
    number, law_of_form = (number_of(laws[0][0]), laws[0][1]) if laws else (0, otherwise)
    rest: Any = by_form(laws[1:], otherwise) if laws else None

    def of(params: Any, form: Any, row: Any, given: Any) -> Any:
        if some:
            if form == number:
                return law_of_form(params, row, *given)
            return rest(params, form, row, given)
        return otherwise(params, row, *given)

    return of


@section
def offset_from_shape(offset_to: Law, moving: bool) -> Callable[..., Vec]:
    """Make `offset_of(params, size, at, time, x)`: the offset of x from the anchor of the shape at `at`, m.

    time: s.
    """

    def offset_of(params: Any, size: Any, at: Any, time: Any, x: Any) -> Any:
        place = vector_at(params, at + 2, x)
        if moving:
            return offset_to(size, add(place, shift_of(params, at, time, x)), x)
        return offset_to(size, place, x)

    return offset_of


@law
def box_of_path(x: Vec, half: Vec, room: float) -> tuple[Vec, Vec]:
    """Return the box around the path of a body of radius `room` from x: the middle, and half the edges, m.

    half: half of the displacement.
    """
    if len(half) == 2:
        return add(x, half), (abs(half[0]) + room, abs(half[1]) + room)
    else:
        return add(x, half), (abs(half[0]) + room, abs(half[1]) + room, abs(half[2]) + room)


@section
def each_row(around: Surroundings, form: FormPlan, visit: Law, box: Law, done: Law) -> Callable[..., Any]:
    """Make `each(params, size, given, state)`: `state = visit(params, size, at, given, state)` for the rows of a form.

    All rows, in order. For a form with a grid, only those that it lists in the box `box(given, state)` (the middle, and
    half the edges along each axis, m), which is updated after each row, until `done(state)`. Some of these may be
    visited twice, and their order is not defined.
    """
    place, gridded, of_first = form.place, form.gridded, _relative_to_first(visit)
    each_listed = _each_listed(around.offset_to, around.dimension, of_first, box, done)

    def each(params: Any, size: Any, given: Any, state: Any) -> Any:
        at = np.int64(params[place])
        if gridded:
            return each_listed(params, size, np.int64(params[place + 2]), at, given, state)
        for _ in range(np.int64(params[place + 1])):
            state = visit(params, size, at, given, state)
            at += np.int64(params[at])
        return state

    return each


@section
def each_circle(around: Surroundings, visit: Law, box: Law, done: Law) -> Callable[..., Any]:
    """Make `each(params, size, given, state)`: as `each_row`, for the circles of the state.

    `state = visit(params, size, m, given, state)`; given: (obstacle_x, obstacle_radius, b) first.
    """
    gridded, present = around.circles is not None, _if_present(visit)
    place = around.circles.place if around.circles is not None else 0
    each_listed: Any = _each_listed(around.offset_to, around.dimension, _relative_to_first(present), box, done)

    def each(params: Any, size: Any, given: Any, state: Any) -> Any:
        if gridded:  # noqa: SIM102  # numba drops the branch by this alone
            if params[place + 2] > 0:
                return each_listed(params, size, np.int64(params[place + 2]), 0, given, state)
        for m in range(given[0][1].shape[1]):
            state = present(params, size, m, given, state)
        return state

    return each


@section
def _if_present(visit: Law) -> Callable[..., Any]:
    """Make `visit` for a circle that may be missing: a radius of 0."""

    def visit_present(params: Any, size: Any, m: Any, given: Any, state: Any) -> Any:
        _, radius, b = given[0]
        return visit(params, size, m, given, state) if radius[b, m] > 0 else state

    return visit_present


@section
def _relative_to_first(visit: Law) -> Callable[..., Any]:
    """Make `visit` for a row that is given by its offset behind the first one."""

    def visit_listed(params: Any, size: Any, at: Any, row: Any, given: Any, state: Any) -> Any:
        return visit(params, size, at + row, given, state)

    return visit_listed


@section
def _each_listed(offset_to: Law, dimension: int, visit: Law, box: Law, done: Law) -> Callable[..., Any]:
    """Make `each(params, size, cells, at, given, state)`: the loop over the rows that the grid at `cells` lists.

    `state = visit(params, size, at, row, given, state)`; row: how far it lies behind the first row of the form.
    """
    length = entry_length(dimension)

    def each(params: Any, size: Any, cells: Any, at: Any, given: Any, state: Any) -> Any:
        middle, reach = box(given, state)
        span = span_of(params, cells, middle, reach)
        for k in range(count_of(span)):
            begin, end = list_of(params, cells, middle, span, k)
            for entry in range(begin, end, length):
                if is_near_box(params, entry, offset_to(size, middle, vector_at(params, entry + 1, middle)), reach):
                    state = visit(params, size, at, row_of_entry(params, entry), given, state)
                    if done(state):
                        return state
                    middle, reach = box(given, state)
        return state

    return each


@section
def near_rows(offset_to: Law, dimension: int) -> Callable[..., int]:
    """Make `near(params, size, cells, x, reach, found, first)`: list the rows that may lie within `reach` of x.

    x: a place, m; reach: along each axis, m; cells: where the grid over the rows begins. They are written to `found`
    from `first` on, ascending, by how far each lies behind the first row of its form. Returns how many; -1 if too many.
    """

    def box(given: Any, state: Any) -> Any:
        return given[0], given[1]

    def keep(params: Any, size: Any, at: Any, row: Any, given: Any, count: Any) -> Any:
        if count == MOST_FOUND:
            return -1
        return keep_in_order(given[2], given[3], count, row)

    def full(count: Any) -> Any:
        return count < 0

    each_listed = _each_listed(offset_to, dimension, kernel(keep), kernel(box), kernel(full))

    def near(params: Any, size: Any, cells: Any, x: Any, reach: Any, found: Any, first: Any) -> Any:
        return each_listed(params, size, cells, 0, (x, reach, found, first), 0)

    return near
