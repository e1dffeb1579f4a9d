"""The numbers of a scene: how they are packed into the one array that a kernel is passed, and read there by name.

`pack_numbers` returns both at once, the values and where each lies (`NumberPlan`), so that packing and reading cannot
disagree. Code depends on the plan; the values are arguments, so a new value compiles nothing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from flockenv.engine.lane_access import gather
from flockenv.geometry.shapes.cells import CIRCLES
from flockenv.jit.decorators import Law, kernel
from flockenv.jit.section import concatenation_from, record, section, tuple_from
from flockenv.maths.vectors import add

if TYPE_CHECKING:
    from flockenv.geometry.space import Space
    from flockenv.physics.effects.effect import Effect
    from flockenv.physics.integrators.integrator import Integrator

__all__ = [
    "Form",
    "Images",
    "NumberPlan",
    "Numbers",
    "View",
    "images_in",
    "images_of",
    "numbers_of",
    "pack_numbers",
    "view_of",
]


class Form(NamedTuple):
    """Where the rows of a form of shapes begin, how many there are, and where the grid over them begins."""

    at: Any
    many: Any
    cells: Any  # 0 for a form without a grid


class View(NamedTuple):
    """A sight as kernels read it: see flockenv.physics.effects.effect.Sight."""

    within: float  # m^2, radius squared
    cone: float  # what `in_view` compares
    first: float  # the agents that can be seen: those of a group, [first, end); unused if all can
    end: float


class Numbers(NamedTuple):
    """Every number of a scene, as its kernels read them."""

    size: tuple[float, ...]  # m, size of the space
    reach: float  # m, the largest radius within which any law looks for neighbours
    forms: tuple[Form, ...]
    circles: Form  # the circles of the state if they have a grid: `cells` is 0 if they lie elsewhere than in the scene
    views: tuple[View, ...]
    effects: tuple[Any, ...]  # for each effect a record of what its laws are passed, by name
    space: tuple[float, ...]
    method: tuple[float, ...]
    look: tuple[float, ...]  # the radius of a task's query, m, and its square


class EffectPlan(NamedTuple):
    """Where the numbers of an effect lie, and of what kind each is: a number, vector, table or counters."""

    names: tuple[str, ...]
    kinds: tuple[tuple[str, int, int], ...]  # (kind, place, how many numbers)


class NumberPlan(NamedTuple):
    """Where every number of a scene lies."""

    dimension: int
    forms: tuple[tuple[int, bool], ...]  # (place, has a grid)
    circles: int  # place of what belongs to the circles of the state if they have a grid; -1: they have none
    views: tuple[tuple[int, bool], ...]  # (place, sees only one group)
    effects: tuple[EffectPlan, ...]
    space: tuple[int, int]  # (place, how many)
    method: tuple[int, int]
    look: tuple[int, int]


EDGE = 8
"""Rounding errors by which a field of view is wider: those of a heading, an offset and their product."""


def view_of(fov: float, dtype: str) -> float:
    """Return c |c|, what `in_view` compares, with c = cos(fov / 2); fov in degrees.

    The edge belongs to the field of view in either precision, because c is decreased by EDGE machine epsilons: with 180
    degrees a neighbour exactly abeam is in view, for every heading.
    """
    cosine = math.cos(math.radians(fov) / 2.0) - EDGE * float(np.finfo(dtype).eps)
    return cosine * abs(cosine)


class Numbered(Protocol):
    """The members of a kernel plan that hold the numbers to be packed."""

    @property
    def dimension(self) -> int:
        """Number of axes, D."""

    @property
    def dtype(self) -> str:
        """The precision of all numbers."""

    @property
    def space(self) -> Space:
        """The space in which agents move."""

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects on agents."""

    @property
    def integrator(self) -> Integrator:
        """The integrator."""

    @property
    def shape_table(self) -> tuple[Any, dict[Any, tuple[int, int]]]:
        """The rows of all shapes, and where the rows of each form lie."""

    @property
    def circles(self) -> tuple[Any, ...]:
        """The circles of the scene that are kept in the state."""

    @property
    def cells(self) -> dict[Any, Any]:
        """The grids of forms that have one."""

    @property
    def tables(self) -> tuple[Any, ...]:
        """The lookup tables of tabled effects."""

    @property
    def reach(self) -> float:
        """The largest radius of a sight, m."""

    @property
    def sights(self) -> Any:
        """The sights of pair laws, each once."""

    @property
    def starts(self) -> tuple[int, ...]:
        """The first agent of each group, and N."""

    @property
    def counters(self) -> int:
        """How many counters laws have."""

    @property
    def look(self) -> Any:
        """The query of a task, if it has one."""

    def numbers_of(self, effect: Effect) -> dict[str, Any]:
        """Return the numbers of an effect by name."""

    def names_of(self, effect: Effect) -> Any:
        """Return the names of the fields that its laws read."""


def pack_numbers(parts: Numbered) -> tuple[list[float], NumberPlan]:
    """Return every number that a kernel is passed, and where each lies; tables follow behind them.

    What follows (rows of shapes, grids, tables) is addressed by where it begins, a table also by where it ends. Circles
    of the state have no rows.
    """
    shapes, forms = parts.shape_table
    ends = np.cumsum([len(shapes), *map(len, parts.cells.values())]).tolist()
    grids = dict(zip(parts.cells, ends, strict=False))
    tables = iter(np.cumsum([ends[-1], *map(len, parts.tables)]).tolist())
    begin, behind = next(tables), []  # (place, offset behind all numbers that goes there)
    values: list[float] = [*parts.space.extent(parts.dimension), parts.reach]
    planned_forms, views, effects = [], [], []
    for form, (where, count) in forms.items():
        planned_forms.append((len(values), form in grids))
        behind.append((len(values), where))
        values += [0.0, float(count)]
        if form in grids:
            behind.append((len(values), grids[form]))
            values.append(0.0)
    circles = -1
    if CIRCLES in grids:
        circles = len(values)
        values += [0.0, float(len(parts.circles)), 0.0]
        behind.append((circles + 2, grids[CIRCLES]))
    for sight in parts.sights:
        views.append((len(values), sight.group is not None))
        values += [sight.radius**2, view_of(sight.fov, parts.dtype)]
        if sight.group is not None:
            values += parts.starts[sight.group : sight.group + 2]
    left = parts.counters
    for effect in parts.effects:
        kinds: list[tuple[str, int, int]] = []
        for value in parts.numbers_of(effect).values():
            vector = isinstance(value, tuple)
            kinds.append(("vector" if vector else "number", len(values), len(value) if vector else 1))
            values.extend(value if vector else (value,))
        if effect.tabled:
            kinds.append(("table", len(values), 2))
            behind += [(len(values), begin), (len(values) + 1, begin := next(tables))]
            values += [0.0, 0.0]
        if effect.count_law:
            kinds.append(("counters", len(values), 2))
            values += [float(left), float(left - effect.counters)]
            left -= effect.counters
        effects.append(EffectPlan(tuple(parts.names_of(effect)), tuple(kinds)))
    rest = []
    for more in (parts.space.numbers(), parts.integrator.settings(), _look_numbers(parts)):
        rest.append((len(values), len(more)))
        values += more
    for place, bound in behind:
        values[place] = float(len(values) + bound)
    return values, NumberPlan(parts.dimension, tuple(planned_forms), circles, tuple(views), tuple(effects), *rest)


def _look_numbers(parts: Numbered) -> list[float]:
    """Return the radius of a task's query, m, and its square; an empty list if there is none."""
    return [parts.look.radius, parts.look.radius**2] if parts.look else []


@section
def numbers_of(plan: NumberPlan) -> Callable[[Any, Any], Numbers]:
    """Make `numbers_of(params, counters)`: read all numbers of a scene from the arrays that its kernel is passed."""
    d, size = plan.dimension, tuple(range(plan.dimension))
    forms, views, effects = _all(_form, plan.forms), _all(_view, plan.views), _all(_effect, plan.effects)
    space, method, look = (_places(*some) for some in (plan.space, plan.method, plan.look))
    circles = _form((plan.circles, True)) if plan.circles >= 0 else _no_form()

    def read(params: Any, counters: Any) -> Any:
        begin = np.uint64(0)
        return Numbers(
            gather(params, begin, size),
            params[d],
            forms(params, counters),
            circles(params, counters),
            views(params, counters),
            effects(params, counters),
            gather(params, begin, space),
            gather(params, begin, method),
            gather(params, begin, look),
        )

    return read


def _all(reads: Callable[[Any], Callable[..., Any]], plans: tuple[Any, ...]) -> Callable[..., tuple[Any, ...]]:
    return tuple_from(*map(reads, plans)) if plans else kernel(lambda params, counters: ())


def _places(first: int, count: int) -> tuple[int, ...]:
    return tuple(range(first, first + count))


@functools.cache
def _form(place: tuple[int, bool]) -> Callable[..., Form]:
    at, gridded = place

    def form(params: Any, counters: Any) -> Any:
        if gridded:
            return Form(np.int64(params[at]), np.int64(params[at + 1]), np.int64(params[at + 2]))
        return Form(np.int64(params[at]), np.int64(params[at + 1]), np.int64(0))

    return kernel(form)


@functools.cache
def _no_form() -> Callable[..., Form]:
    return kernel(lambda params, counters: Form(0, 0, 0))


@functools.cache
def _view(place: tuple[int, bool]) -> Callable[..., View]:
    at, grouped = place
    places = _places(at, 4) if grouped else (at, at + 1, at, at)
    return kernel(lambda params, counters: View(*gather(params, np.uint64(0), places)))


@functools.cache
def _effect(plan: EffectPlan) -> Callable[..., Any]:
    """Make a function that reads the record of an effect."""
    kind, runs = record(plan.names), _runs(plan.kinds or (("number", 0, 1),))
    if len(runs) == 1 and runs[0][0] == "number":
        places = _places(*runs[0][1:])
        return kernel(lambda params, counters: kind(*gather(params, np.uint64(0), places)))
    values = concatenation_from(*map(_run, runs))
    return kernel(lambda params, counters: kind(*values(params, counters)))


def _runs(kinds: tuple[tuple[str, int, int], ...]) -> tuple[tuple[str, int, int], ...]:
    """Return the kinds with consecutive numbers joined into one, to be read at once."""
    runs: list[tuple[str, int, int]] = []
    for kind, at, count in kinds:
        if kind == "number" and runs and runs[-1][0] == "number" and sum(runs[-1][1:]) == at:
            runs[-1] = (kind, runs[-1][1], runs[-1][2] + 1)
        else:
            runs.append((kind, at, count))
    return tuple(runs)


@functools.cache
def _run(run: tuple[str, int, int]) -> Callable[..., tuple[Any, ...]]:
    kind, at, count = run
    places = _places(at, count)
    if kind == "number":
        return kernel(lambda params, counters: gather(params, np.uint64(0), places))
    if kind == "vector":
        return kernel(lambda params, counters: (gather(params, np.uint64(0), places),))
    if kind == "table":
        return kernel(lambda params, counters: (params[np.int64(params[at]) : np.int64(params[at + 1])],))

    def counters_of(params: Any, counters: Any) -> Any:
        end = len(counters)
        return (counters[end - np.int64(params[at]) : end - np.int64(params[at + 1])],)

    return kernel(counters_of)


class Images(NamedTuple):
    """Which numbers of an effect are points: on a torus these have images, and laws are passed the nearest."""

    names: tuple[str, ...]
    points: tuple[str, ...]
    offset_to: Law


def images_in(parts: Numbered, effect: Effect) -> Images | None:
    """Return which numbers of an effect have images in the space of a scene; None if it has none."""
    if not (parts.space.periodic and effect.places):
        return None
    return Images(tuple(parts.names_of(effect)), tuple(effect.places), parts.space.offset_law)


@section
def images_of(plan: Images) -> Callable[..., Any]:
    """Make `images_of(p, size, here)`: return an effect's record with the images of its points nearest to `here`."""
    kind = record(plan.names)
    values = _nearest_images(tuple(name in plan.points for name in plan.names), plan.offset_to)

    def images(p: Any, size: Any, here: Any) -> Any:
        return kind(*values(p, size, here))

    return images


@functools.cache
def _nearest_images(points: tuple[bool, ...], offset_to: Law) -> Callable[..., tuple[Any, ...]]:
    """Make a function that returns the values of a record, points as the images nearest to a position."""
    *earlier, point = points
    before, last = _nearest_images(tuple(earlier), offset_to) if earlier else None, len(earlier)

    def values(p: Any, size: Any, here: Any) -> Any:
        mine = (add(here, offset_to(size, here, p[last])),) if point else (p[last],)
        return mine if before is None else before(p, size, here) + mine

    return kernel(values)
